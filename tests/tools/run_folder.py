"""A run's folder made by hand: the tiny configuration, and whatever jobs left there."""

import base64
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from ntop.config.plan import Job

ROOT = Path(__file__).parents[2]
PATIENCE_S = 30


class RunFolder:
    """A working folder with `config/` in it, in which tests leave what jobs leave."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copytree(ROOT / "config", folder / "config")

    def write(self, name: str, text: str = "") -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def finish(self, job: Job, *, seconds: float) -> None:
        """Leave what a finished job leaves."""
        self.write(job.log, "fine\n")
        self.write(job.benchmark, f"s\th:m:s\tmax_rss\n{seconds}\t0:00:01\t-\n")
        if job.stage == "annotate":
            self.write(job.output)
        else:
            self.write(f"{job.output}/skipped.json", "[]\n")

    def mark(self, output: str, *, job_id: str | None = None) -> Path:
        """Mark an output as Snakemake does when its job starts."""
        name = base64.urlsafe_b64encode(output.encode()).decode()
        pieces = [name[i : i + 254] for i in range(0, len(name), 254)]
        place = "/".join([*(f"@{piece}" for piece in pieces[:-1]), pieces[-1]])
        return self.write(f".snakemake/incomplete/{place}", json.dumps({"external_jobid": job_id}))

    def start(self, output: str) -> subprocess.Popen[bytes]:
        """A real process that works in the folder and is told to make `output`."""
        code = "import time; open('started', 'w').close(); time.sleep(600)"
        process = subprocess.Popen(
            [sys.executable, "-c", code, "--out", output], cwd=self.folder, env=dict(os.environ)
        )
        self.processes.append(process)
        patience = time.monotonic() + PATIENCE_S
        while not (self.folder / "started").exists():
            assert time.monotonic() < patience
            time.sleep(0.02)
        return process

    def end(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


def stand_in_for_squeue(folder: Path, *, lines: str = "", error: str = "", code: int = 0) -> str:
    """PATH with a program `squeue` that answers so."""
    folder.mkdir(exist_ok=True)
    (folder / "squeue").write_text(
        f"#!/bin/sh\ncat <<'END'\n{lines}\nEND\necho '{error}' >&2\nexit {code}\n"
    )
    (folder / "squeue").chmod(0o755)
    return f"{folder}{os.pathsep}{os.environ['PATH']}"
