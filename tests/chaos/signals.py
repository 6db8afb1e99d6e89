"""Disturbances that end processes: workers, groups, heads; at moments that progress decides."""

import contextlib
import os
import random
import signal
import subprocess
import time
from pathlib import Path

import psutil

from ntop.storage.work import EXIT_TERMINATED
from tests.chaos.trial import DefeatError, Hit, Strike
from tests.chaos.workspace import PATIENCE_S, WORK, TooLateError, Workspace

# seconds of an undisturbed job on an idle core: the range of random moments
LASTS_S = {
    "capture": 8.0, "mask": 3.0, "fit": 8.0, "render": 4.0, "annotate": 2.0, "assemble": 3.0,
    "evaluate": 8.0,
}  # fmt: skip


def moment(space: Workspace, chance: random.Random, stage: str) -> str:
    """Start the run and wait for a random moment of the stage; returns it in words.

    Training and rendering are met after some progress, the others after some time.
    """
    space.undo(stage)
    space.start()
    space.worker(stage)
    if stage == "render" and chance.random() < 0.7:
        sets = chance.randint(1, 2)
        space.wait_for(lambda: space.sets_done() >= sets, f"{sets} finished sets")
        delay_s = chance.uniform(0, 0.5)
        words = f"{sets} of 3 sets and {delay_s:.2f} s later"
    elif stage == "train" and chance.random() < 0.7:
        checkpoint = space.folder / WORK["train"] / "content/checkpoint.safetensors"
        space.wait_for(checkpoint.exists, "a checkpoint")
        delay_s = chance.uniform(0, 4)
        words = f"its first checkpoint and {delay_s:.2f} s later"
    else:
        delay_s = chance.uniform(0, LASTS_S.get(stage, 5.0))
        words = f"{delay_s:.2f} s of its process"
    time.sleep(delay_s)
    return words


def kill_worker(number: signal.Signals, stage: str) -> Strike:
    """A signal to the stage's own process, as the kernel or a colleague sends it."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        after = moment(space, chance, stage)
        with gone_is_too_late():
            worker = space.worker(stage)
            worker.send_signal(number)
        code = wait_for_end(space)
        if number == signal.SIGTERM and stage in WORK and code == 0:
            raise TooLateError("it had just finished")
        return Hit(f"{number.name} to its process after {after}; the run ended with {code}")

    return strike


def kill_group(stage: str) -> Strike:
    """kill -9 of the head's and the worker's process groups at once."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        after = moment(space, chance, stage)
        with gone_is_too_late():
            groups = {os.getpgid(p.pid) for p in (space.worker(stage), space.head())}
            for group in groups:
                os.killpg(group, signal.SIGKILL)
        wait_for_end(space)
        count = "the process group" if len(groups) == 1 else f"{len(groups)} process groups"
        return Hit(f"SIGKILL to {count} of head and worker after {after}")

    return strike


def pull_the_plug(stage: str) -> Strike:
    """kill -9 of everything, as a power cut."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        after = moment(space, chance, stage)
        with gone_is_too_late():
            space.worker(stage)
        space.kill_everything()
        return Hit(f"SIGKILL to every process after {after}")

    return strike


def kill_head(number: signal.Signals, stage: str) -> Strike:
    """A signal to Snakemake alone; after SIGKILL its jobs live on as orphans."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        after = moment(space, chance, stage)
        with gone_is_too_late():
            worker = space.worker(stage)
            if number == signal.SIGKILL:
                worker.suspend()  # however slow the machine, it is still there at the next command
            space.head().send_signal(number)
        code = wait_for_end(space)
        if number == signal.SIGKILL:
            worker.resume()
        return Hit(f"{number.name} to snakemake after {after}; the run ended with {code}")

    return strike


def press_ctrl_c(stage: str) -> Strike:
    """SIGINT to the terminal's foreground group."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        after = moment(space, chance, stage)
        with gone_is_too_late():
            space.worker(stage)
            os.killpg(os.getpgid(space.head().pid), signal.SIGINT)
        code = wait_for_end(space)
        return Hit(f"SIGINT to the foreground group after {after}; the run ended with {code}")

    return strike


def terminate_cleanly(stage: str) -> Strike:
    """SIGTERM to a stage that can stop at a border: exit code 143, and finished pieces stay."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        space.undo(stage)
        space.start()
        words = space.worker(stage).cmdline()
        content = space.folder / WORK[stage] / "content"
        space.wait_for(lambda: pieces(content), "a finished piece")
        space.kill_everything()
        # the same job by hand: only its parent learns an exit code
        alone = subprocess.Popen(words, cwd=space.folder, env=space.environment,
                                 stderr=subprocess.PIPE, text=True)  # fmt: skip
        before = len(pieces(content))
        while alone.poll() is None and not catches_sigterm(alone.pid):
            time.sleep(0.02)
        time.sleep(chance.uniform(0, 0.5))
        alone.send_signal(signal.SIGTERM)
        said = alone.communicate(timeout=PATIENCE_S)[1]
        if alone.returncode in {0, -signal.SIGTERM}:
            raise TooLateError("it had just finished, or not yet begun")
        if alone.returncode != EXIT_TERMINATED or len(pieces(content)) < before:
            raise DefeatError(f"exit code {alone.returncode}, {pieces(content)} left: {said}")
        return Hit(f"SIGTERM, {before} pieces there: exit code 143, {len(pieces(content))} left")

    return strike


def catches_sigterm(pid: int) -> bool:
    """Whether a process has come so far that it handles SIGTERM."""
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    return bool(int(status.get("SigCgt", "0"), 16) >> (signal.SIGTERM - 1) & 1)


def pieces(content: Path) -> list[str]:
    """Finished sets or checkpoints below a work folder."""
    names = [path.name for path in content.glob("*")]
    return [name for name in names if not name.startswith(".") and not name.endswith(".tmp")]


@contextlib.contextmanager
def gone_is_too_late():
    """A process that has ended meanwhile: the moment has passed."""
    try:
        yield
    except (psutil.NoSuchProcess, ProcessLookupError) as error:
        raise TooLateError(str(error)) from error


def wait_for_end(space: Workspace) -> int:
    """The exit code of the disturbed run."""
    return space.heads[-1].wait(timeout=PATIENCE_S)
