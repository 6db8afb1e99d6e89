"""Disturbances of what is around a run: disk, permissions, clock, another head, another worker."""

import random
import re
import shutil
import subprocess
import time
from pathlib import Path

from tests.chaos.signals import wait_for_end
from tests.chaos.trial import Hit, Strike
from tests.chaos.workspace import OUTPUTS, PATIENCE_S, SHARD, WORK, TooLateError, Workspace

FAKETIME = next(Path("/usr/lib").glob("*/faketime/libfaketime.so.1"), None)


def full_disk(stage: str, place: str, sizes_kb: tuple[int, int]) -> Strike:
    """A small disk at `place` that runs full while the stage writes."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        space.undo(stage)
        held = sum(p.stat().st_size for p in (space.folder / place).rglob("*") if p.is_file())
        size_kb = held // 1024 + chance.randint(*sizes_kb)
        space.mount(place, size=f"{size_kb}k")
        if space.finish() == 0:
            raise TooLateError("it has fitted")
        said = space.said()
        space.remount("size=2g")
        named = re.search(rf"cannot .*?({place}[^:\s]*).*No space left on device.*free space", said)
        assert named, said
        return Hit(f"{place} was full at {size_kb} KiB, the error named {Path(named[1]).name}")

    return strike


def read_only(stage: str, place: str) -> Strike:
    """`place` cannot be written."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        space.undo(stage)
        space.mount(place, size="2g")
        space.remount("ro")
        assert space.finish() != 0, "nothing was said"
        said = space.said()
        assert "Read-only file system" in said, said
        assert place in said, said
        if chance.random() < 0.5:
            space.remount("rw")
            return Hit(f"{place} read-only for one run")
        return Hit(f"{place} read-only for two runs", place)

    return strike


def wrong_clock(stage: str) -> Strike:
    """A run under another date is killed, the next one has the right date."""

    def strike(space: Workspace, chance: random.Random) -> Hit:
        days = chance.choice([-400, -2, 2, 400])
        space.undo(stage)
        clock = {"LD_PRELOAD": str(FAKETIME), "FAKETIME": f"{days:+d}d", "NTOP_LOCK_WAIT_S": "30"}
        shown = subprocess.run(
            ["date", "+%s"],
            env=space.environment | clock,
            capture_output=True,
            text=True,
            check=True,
        )
        seen_days = round((int(shown.stdout) - time.time()) / 86400)
        assert seen_days == days, f"the clock is off by {seen_days} days, wanted {days}"
        space.start(**clock)
        space.worker(stage)
        killed = chance.random() < 0.5
        if killed:
            space.kill_everything()
        else:
            assert wait_for_end(space) == 0, space.said()
        ended = "killed" if killed else "finished"
        return Hit(f"a run whose clock was {days:+d} days off was {ended}")

    return strike


def two_heads(space: Workspace, chance: random.Random) -> Hit:
    """The same command a second time while the first runs: refused, and the first goes on."""
    space.undo("render")
    first = space.start()
    space.worker("render")
    plain = chance.random() < 0.5
    words = space.command()
    if plain:  # past workflow/run.sh and its lock: Snakemake's own has to hold
        words = ["snakemake", "--cores", "1", *words[3:]]
    second = subprocess.run(
        words, cwd=space.folder, env=space.environment | {"NTOP_LOCK_WAIT_S": "0"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    said = second.stdout + second.stderr
    assert second.returncode != 0, said
    assert ("cannot be locked" if plain else "another run works in") in said, said
    assert first.wait(timeout=PATIENCE_S) == 0, space.said()
    kind = "snakemake" if plain else "workflow/run.sh"
    return Hit(f"a second {kind} was refused, the first one finished")


def duplicate_worker(stage: str) -> Strike:
    """The same job started by hand beside the running one: the lock of its work folder holds."""

    def strike(space: Workspace, _chance: random.Random) -> Hit:
        space.undo(stage)
        head = space.start()
        worker = space.worker(stage)
        space.wait_for((space.folder / WORK[stage] / "content").exists, "its work folder")
        words = worker.cmdline()
        worker.suspend()
        try:
            second = subprocess.run(
                words, cwd=space.folder, env=space.environment, capture_output=True, text=True,
                check=False,
            )  # fmt: skip
        finally:
            worker.resume()
        assert second.returncode == 2, second
        assert f"{WORK[stage]} is in use" in second.stderr, second.stderr
        assert not (space.folder / OUTPUTS[stage]).exists()
        assert head.wait(timeout=PATIENCE_S) == 0, space.said()
        return Hit("a second process of the job was refused by its lock, the first one finished")

    return strike


def stale_plan_of_work(space: Workspace, _chance: random.Random) -> Hit:
    """Work that another recipe has left: it must not be used."""
    space.undo("render")
    content = space.folder / WORK["render"] / "content/000000"
    content.parent.mkdir(parents=True, exist_ok=True)
    other = f"results/5_render/{SHARD.replace('h1.2_r1.0', 'h1.0_r0.5')}"
    shutil.copytree(space.folder / other, content)
    return Hit("sets of another rig lay in the work folder")
