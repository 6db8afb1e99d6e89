"""Disturbances of files: cut short, overwritten, moved in time, gone."""

import os
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from tests.chaos.signals import pieces
from tests.chaos.trial import Hit, Strike
from tests.chaos.workspace import ACTOR, DATASET, OUTPUTS, WORK, TooLateError, Workspace

Harm = Callable[[Path, random.Random], str]


def some_file(space: Workspace, chance: random.Random, place: str, pattern: str) -> Path:
    """One of the files below a place."""
    return chance.choice(sorted((space.folder / place).rglob(pattern)))


def truncate(path: Path, chance: random.Random) -> str:
    """Cut a file at a random byte, in place: links to it see that, too."""
    size = path.stat().st_size
    left = chance.randrange(size)
    os.truncate(path, left)
    return f"cut from {size} to {left} bytes"


def mangle(path: Path, chance: random.Random) -> str:
    """Overwrite some bytes in place; size and times stay."""
    times, size = path.stat(), path.stat().st_size
    first = chance.randrange(size)
    with path.open("r+b") as stream:
        stream.seek(first)
        old = stream.read(16)
        stream.seek(first)
        stream.write(bytes(byte ^ 0xA5 for byte in old))
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    return f"bytes {first} to {first + len(old) - 1} of {size} overwritten"


def damaged_result(how: Harm, place: str, pattern: str, *, rerun: str = "") -> Strike:
    """Damage a finished result; `rerun` is a stage that has yet to read it, or none."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        if rerun:
            space.undo(rerun)
        path = some_file(space, chance, place, pattern)
        name = str(path.relative_to(space.folder))
        return Hit(f"{name} {how(path, chance)}", name)

    return strike


def damaged_work(stage: str, pattern: str, how: Harm = truncate) -> Strike:
    """Damage what a killed job has left in its work folder."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        space.undo(stage)
        space.start()
        content = space.folder / WORK[stage] / "content"
        space.wait_for(lambda: pieces(content), "a finished piece")
        space.kill_everything()
        found = sorted(path for path in content.rglob(pattern) if ".partial" not in str(path))
        if not found or (space.folder / OUTPUTS[stage]).exists():
            raise TooLateError("nothing is left to damage")
        path = chance.choice(found)
        name = str(path.relative_to(space.folder))
        # a damaged set is made again without a word to the user, a checkpoint has to be named
        return Hit(f"{name} {how(path, chance)}", name if stage == "train" else "")

    return strike


def moved_in_time(days: float) -> Strike:
    """Give all results times that are off, as a restored backup or a wrong clock does."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        space.undo("annotate")
        now = time.time() + days * 86400
        paths = sorted((space.folder / "results").rglob("*"))
        for path in paths:
            moment = now + chance.uniform(-3600, 3600)
            os.utime(path, (moment, moment))
        return Hit(f"{len(paths)} times moved by {days:+.0f} days, each by up to an hour more")

    return strike


def lost_metadata(space: Workspace, chance: random.Random) -> Hit:
    """Remove Snakemake's own records."""
    space.undo(chance.choice(["render", "annotate", "assemble"]))
    shutil.rmtree(space.folder / ".snakemake")
    return Hit(".snakemake removed")


def truncated_metadata(space: Workspace, chance: random.Random) -> Hit:
    """Empty some of Snakemake's own records, as a power cut does."""
    space.undo(chance.choice(["render", "annotate", "assemble"]))
    records = sorted(p for p in (space.folder / ".snakemake/metadata").rglob("*") if p.is_file())
    chosen = chance.sample(records, len(records) // 2)
    for path in chosen:
        os.truncate(path, 0)
    return Hit(f"{len(chosen)} of {len(records)} records of Snakemake emptied")


def missing_file(place: str, pattern: str, *, rerun: str) -> Strike:
    """Remove a file from a finished folder."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        space.undo(rerun)
        path = some_file(space, chance, place, pattern)
        path.unlink()
        name = str(path.relative_to(space.folder))
        return Hit(f"{name} removed", name)

    return strike


CAPTURED = f"results/1_capture/{ACTOR}"
IMAGES = f"{DATASET}/images"
