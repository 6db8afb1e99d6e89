"""Wall time, processor time and peak memory of a command and all it starts."""

import os
import subprocess
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

PERIOD_S = 0.2


@dataclass(frozen=True)
class Cost:
    """What a command took; memory is the sum over its processes, shared pages counted in each."""

    wall_s: float
    cpu_s: float
    peak_mb: float
    load: float  # the machine's load average over a minute, at the end


def measured(words: list[str], *, folder: Path, environment: dict[str, str], log: Path) -> Cost:
    """Run a command in `folder`; its output goes to `log`.

    Raises:
        RuntimeError: it failed.
    """
    started = time.monotonic()
    with log.open("w") as stream:
        process = subprocess.Popen(
            words, cwd=folder, env=environment, stdout=stream, stderr=subprocess.STDOUT
        )
        peaks = [0.0]
        watcher = threading.Thread(target=_watch, args=(process.pid, peaks), daemon=True)
        watcher.start()
        _, status, usage = os.wait4(process.pid, 0)  # of all descendants that were waited for
    process.returncode = os.waitstatus_to_exitcode(status)
    watcher.join()
    if process.returncode:
        raise RuntimeError(f"{' '.join(words)} ended with {process.returncode}, see {log}")
    return Cost(
        wall_s=round(time.monotonic() - started, 2),
        cpu_s=round(usage.ru_utime + usage.ru_stime, 2),
        peak_mb=round(max(peaks[0], usage.ru_maxrss * 1024 / 1e6), 1),
        load=round(os.getloadavg()[0], 1),
    )


def _watch(pid: int, peaks: list[float]) -> None:
    try:
        root = psutil.Process(pid)
        while root.is_running() and root.status() != psutil.STATUS_ZOMBIE:
            total = 0
            for process in [root, *root.children(recursive=True)]:
                try:
                    total += process.memory_info().rss
                except psutil.NoSuchProcess:
                    continue  # it ended between listing and asking
            peaks[0] = max(peaks[0], total / 1e6)
            time.sleep(PERIOD_S)
    except psutil.NoSuchProcess:
        return
