"""A copy of the finished tiny campaign to disturb, and eyes on what runs in it."""

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import psutil

from ntop.tools.alive import is_snakemake
from tests.workflow.project import Project

SHARD = "studio/plain/sit/h1.2_r1.0/000000"
ACTOR, FITTED = "studio/plain", "raw/loose"  # bodies are given, bodies are fitted
DATASET = "results/7_assemble/test"
OUTPUTS = {
    "capture": f"results/1_capture/{ACTOR}",
    "mask": f"results/2_mask/{FITTED}",
    "fit": f"results/3_fit/{FITTED}",
    "train": f"results/4_train/{ACTOR}",
    "render": f"results/5_render/{SHARD}",
    "annotate": f"results/6_annotate/{SHARD}.parquet",
    "assemble": DATASET,
    "evaluate": "results/8_evaluate/test",
}
_FITTED_SHARD = "raw/loose/range/h1.2_r1.0/000000"
_FITTED_RESULTS = [
    f"results/4_train/{FITTED}",
    f"results/5_render/{_FITTED_SHARD}",
    f"results/6_annotate/{_FITTED_SHARD}.parquet",
]
FOLLOWING = {
    "capture": [OUTPUTS["train"], OUTPUTS["render"], OUTPUTS["annotate"]],
    "mask": [f"results/3_fit/{FITTED}", *_FITTED_RESULTS],
    "fit": _FITTED_RESULTS,
    "train": [OUTPUTS["render"], OUTPUTS["annotate"]],
    "render": [OUTPUTS["annotate"]],
    "annotate": [],
    "assemble": [],
    "evaluate": [],
}
WORK = {"train": f"results/work/4_train/{ACTOR}", "render": f"results/work/5_render/{SHARD}"}
PATIENCE_S = 3600.0  # a busy machine is no defeat
T = TypeVar("T")


class TooLateError(Exception):
    """The moment for a disturbance has passed; another one has to be chosen."""


class Workspace(Project):
    """A finished campaign in a folder of its own; a stage is undone so that it runs again."""

    def __init__(self, finished: Project, folder: Path) -> None:
        self.folder = folder
        self.environment = finished.environment | {"NTOP_LOCK_WAIT_S": "5"}
        shutil.copytree(finished.folder, folder, symlinks=True, dirs_exist_ok=True)
        self.target = DATASET
        self.log = folder / "run.log"
        self.heads: list[subprocess.Popen[str]] = []
        self._mounts: list[Path] = []

    def undo(self, stage: str) -> None:
        """Remove a stage's output and, as Snakemake asks for it no sooner, what follows from it."""
        for name in [OUTPUTS[stage], *FOLLOWING[stage], DATASET]:
            path = self.folder / name
            if not path.exists():
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        if stage == "evaluate":
            self.target = OUTPUTS["evaluate"]

    def command(self, *words: str) -> list[str]:
        """The command that a user repeats, `words` added to it."""
        return [*super().command(), *words, "--", self.target]

    def start(self, *words: str, **environment: str) -> subprocess.Popen[str]:
        """Start the command in a session of its own; what it says goes to `log`."""
        with self.log.open("w") as log:
            head = subprocess.Popen(
                self.command(*words),
                cwd=self.folder,
                env=self.environment | environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
                # started in the background the test ignores SIGINT, and its children would, too
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )
        self.heads.append(head)
        return head

    def said(self) -> str:
        """What the last started command has printed."""
        return self.log.read_text()

    def finish(self, *words: str) -> int:
        """Run the command to its end; returns its exit code."""
        return self.start(*words).wait(timeout=PATIENCE_S)

    def processes(self, fits: Callable[[list[str]], bool]) -> list[psutil.Process]:
        """Processes in this folder whose command line fits."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                words = process.cmdline()
                if words and process.cwd() == str(self.folder) and fits(words):
                    found.append(process)
        return found

    def worker(self, stage: str) -> psutil.Process:
        """The process that makes the stage's output, once there is one.

        Raises:
            TooLateError: the run has ended without being seen at it.
        """

        def fits(words: list[str]) -> bool:
            return OUTPUTS[stage] in words and "--out" in words and "lease" not in words[:3]

        [process] = self.wait_for(lambda: self.processes(fits)[:1], f"a process of {stage}")
        return process

    def head(self) -> psutil.Process:
        """Snakemake itself."""
        [head] = self.wait_for(lambda: self.processes(is_snakemake)[:1], "snakemake")
        return head

    def wait_for(self, look: Callable[[], T], what: str) -> T:
        """What `look` sees once it is something.

        Raises:
            TooLateError: the run has ended before.
        """
        end = time.monotonic() + PATIENCE_S
        while True:
            running = any(head.poll() is None for head in self.heads)
            if seen := look():
                return seen
            if not running or time.monotonic() > end:
                raise TooLateError(f"the run has ended without {what}")
            time.sleep(0.02)

    def sets_done(self) -> int:
        """Sets of the disturbed shard that lie finished in its work folder."""
        content = self.folder / WORK["render"] / "content"
        return len([p for p in content.glob("*") if not p.name.startswith(".")])

    def kill_everything(self) -> None:
        """What pulling the plug does: no process of this folder lives on."""
        for process in self.processes(lambda _: True):
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        for head in self.heads:
            head.wait()

    def mount(self, place: str, *, size: str) -> None:
        """A small disk of its own at `place`, which keeps what it holds."""
        path = self.folder / place
        path.mkdir(parents=True, exist_ok=True)
        aside = self.folder / "aside"
        shutil.copytree(path, aside)
        self._mounts.append(path)
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", path], check=True)
        shutil.copytree(aside, path, dirs_exist_ok=True)
        shutil.rmtree(aside)

    def remount(self, options: str) -> None:
        """Change the small disk: `size=1g`, `ro`, `rw`."""
        command = ["mount", "-o", f"remount,{options}", self._mounts[-1]]
        subprocess.run(command, check=True)

    def remove(self) -> None:
        """End what still runs and remove the folder."""
        self.kill_everything()
        for path in self._mounts:
            subprocess.run(["umount", "--lazy", path], check=False)
        shutil.rmtree(self.folder, ignore_errors=True)


def can_mount() -> bool:
    """Whether this user may mount file systems (root outside of a strict container may)."""
    if os.geteuid() != 0:
        return False
    done = subprocess.run(["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], check=False)
    return done.returncode == 0
