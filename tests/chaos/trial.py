"""A trial: disturb a campaign, then do what a user does until its dataset is whole again.

A user repeats the command. If it stops, its error must name a file and what to do about it, and
that is done to the letter. If it says nothing, `ntop check` must.
"""

import random
import re
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import psutil

from tests.chaos.workspace import DATASET, TooLateError, Workspace
from tests.workflow.project import Project

ATTEMPTS = 5  # to hit the moment
NOT_TRIED = "LOST: not tried"
COMMANDS = 5  # of the user, until the dataset is whole

Strike = Callable[[Workspace, random.Random], "Hit"]


@dataclass(frozen=True)
class Hit:
    """What a disturbance did; `path` is the damaged file, which an error has to name."""

    what: str
    path: str = ""


@dataclass(frozen=True)
class Kind:
    """A disturbance of a stage; `needs` is what a machine may lack: mount, faketime, slurm."""

    name: str
    stage: str
    strike: Strike
    needs: str = ""


@dataclass(frozen=True)
class Outcome:
    """A line of the table."""

    number: int
    seed: int
    disturbance: str
    stage: str
    hit: str
    outcome: str
    survived: bool
    rerun_s: float


class DefeatError(Exception):
    """A trial that the pipeline has not survived."""


def run_trial(number: int, kind: Kind, seed: int, *, finished: Project, place: Path) -> Outcome:
    """Disturb a copy of the finished campaign below `place`; its dataset must come out the same."""
    chance = random.Random(seed)
    for attempt in range(ATTEMPTS):
        started, hit = time.monotonic(), Hit("it failed before it was disturbed")
        space = Workspace(finished, place / f"trial{number:03d}_{attempt}")
        try:
            hit = kind.strike(space, chance)
            started = time.monotonic()
            outcome, survived = recover(space, hit), True
            if space.digest() != finished.digest():
                outcome, survived = f"DIFFERENT: {difference(space, finished)}", False
        except TooLateError:
            continue
        except (DefeatError, AssertionError, subprocess.TimeoutExpired, psutil.Error) as defeat:
            outcome, survived = f"LOST: {defeat}", False
        finally:
            space.remove()
        seconds = time.monotonic() - started
        break
    else:
        hit, seconds = Hit(f"the moment was missed {ATTEMPTS} times"), 0.0
        outcome, survived = NOT_TRIED, False
    return Outcome(
        number=number,
        seed=seed,
        disturbance=kind.name,
        stage=kind.stage,
        hit=hit.what,
        outcome=outcome,
        survived=survived,
        rerun_s=round(seconds, 1),
    )


def recover(space: Workspace, hit: Hit) -> str:
    """Repeat the command, do what errors say; returns how the dataset became whole.

    Raises:
        DefeatError: an error does not name the damaged file or no remedy, or nothing helps.
    """
    words: list[str] = []
    steps: list[str] = []
    named = not hit.path
    for _ in range(COMMANDS):
        code, said = space.finish(*words), space.said()
        if code == 0:
            code, said = check(space)
            if code == 0:
                if not named:
                    raise DefeatError(f"nobody noticed the damage of {hit.path}")
                return "; ".join([*steps, "identical"])
            steps.append("ntop check named it")
        else:
            steps.append("the error named it")
        named = named or hit.path in said
        words = [*words, *remedy_in(said, space, steps)]
    raise DefeatError(f"not whole after {COMMANDS} commands ({'; '.join(steps)}): {said[-600:]}")


def check(space: Workspace) -> tuple[int, str]:
    """What `ntop check` makes of the dataset."""
    done = subprocess.run(
        ["ntop", "check", "--dataset", DATASET, "--processes", "1"],
        cwd=space.folder, env=space.environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


def remedy_in(said: str, space: Workspace, steps: list[str]) -> list[str]:
    """Do what an error says; returns words to add to the command.

    Raises:
        DefeatError: it says nothing that could be done.
    """
    if again := re.search(r"--forcerun ([^`\n]+?)(?:`|\n|$)", said):
        steps.append("--forcerun as it says")
        return ["--forcerun", *again[1].split()]
    if damaged := re.search(r"checkpoint (\S+) is damaged .*delete it", said):
        (space.folder / damaged[1]).unlink()
        steps.append("deleted as it says")
    elif re.search(r"cannot .*No space left on device.*free space", said):
        space.remount("size=2g")
        steps.append("space made")
    elif re.search(r"cannot .*Read-only file system.*permissions", said):
        space.remount("rw")
        steps.append("made writable")
    elif ahead := re.search(r"^  (find results .*)$", said, re.MULTILINE):
        subprocess.run(ahead[1], shell=True, cwd=space.folder, check=True)
        steps.append("times set as it says")
    elif orphans := re.search(r"^  kill ([0-9 ]+)$", said, re.MULTILINE):
        for process in space.processes(lambda words: "--out" in words):
            if str(process.pid) in orphans[1].split():
                process.send_signal(signal.SIGTERM)
        steps.append("orphans ended as it says")
        time.sleep(2)
    elif "run the same command again" in said or "the same command continues there" in said:
        steps.append("the same command again as it says")
    else:
        raise DefeatError(f"no remedy in: {said[-800:]}")
    return []


def difference(space: Project, finished: Project) -> str:
    """The files that differ from the undisturbed dataset's."""
    ours, theirs = space.digest(), finished.digest()
    names = sorted(name for name in {*ours, *theirs} if ours.get(name) != theirs.get(name))
    return f"{len(names)} files, {', '.join(names[:3])}"
