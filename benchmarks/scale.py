"""Time and memory of everything that a campaign's size could slow down, up to 570 thousand images.

Every phase of a campaign's life is run as a user would and measured from outside; a phase that was
measured already is not repeated, so an interrupted benchmark goes on where it was.

Usage: python -m benchmarks.scale run FOLDER SIZE {files,tar} [--work PLACE]
       python -m benchmarks.scale record FOLDER
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from benchmarks.measuring import measured
from benchmarks.scale_campaign import SOCKET, Campaign

SIZES = {  # actors, actions, frames
    "1k": (2, 1, 56),
    "10k": (1, 5, 246),
    "100k": (8, 6, 246),
    "570k": (43, 6, 246),
    "short": (43, 30, 49),  # many short shards: what jobs cost
}
PLAN_ONLY = ("short",)
SNAKEMAKE = ["snakemake", "--config", "plan=plan.json", "--quiet", "progress", "rules"]
JOBS = 2
PARSE = """import json, logging, sys, time
from pathlib import Path
from snakemake.api import SnakemakeApi
from snakemake.settings.types import ConfigSettings, OutputSettings, ResourceSettings
with SnakemakeApi(OutputSettings()) as api:
    workflow = api.workflow(
        resource_settings=ResourceSettings(),
        config_settings=ConfigSettings(config={"plan": "plan.json"}),
        snakefile=Path("Snakefile"),
    )
    wall, cpu = time.perf_counter(), time.process_time()
    workflow.list_rules()
    Path("parse.json").write_text(
        json.dumps([time.perf_counter() - wall, time.process_time() - cpu])
    )
"""


class Run:
    """One campaign and its measurements so far."""

    def __init__(self, campaign: Campaign) -> None:
        """Read what was measured already."""
        self.campaign = campaign
        self.path = campaign.folder / "phases.json"
        self.phases = json.loads(self.path.read_text()) if self.path.exists() else {}

    def once(self, name: str, work: Callable[[], dict]) -> None:
        """Measure a phase unless that is done."""
        if name not in self.phases:
            print(f"{time.strftime('%H:%M:%S')} {self.campaign.folder.name} {name}", flush=True)
            self.phases[name] = work()
            text = json.dumps(self.phases, indent=1) + "\n"
            self.path.write_text(text)

    def command(self, name: str, words: list[str]) -> None:
        """Measure a command."""
        folder = self.campaign.folder
        self.once(
            name,
            lambda: asdict(
                measured(
                    words,
                    folder=folder,
                    environment=self.campaign.environment(),
                    log=folder / f"{name}.log",
                )
            ),
        )


def run(folder: Path, size: str, storage: str, *, work: Path | None) -> None:
    """Measure the life of one campaign, with its unfinished shards at `work` if that is given."""
    place = folder / f"{size}_{storage}"
    actors, actions, frames = SIZES[size]
    if (place / "config/config.yaml").exists():
        campaign = Campaign(place, Campaign.images_of(actors, actions, frames))
    else:
        campaign = Campaign.make(
            place, actors=actors, actions=actions, frames=frames, storage=storage
        )
    if work is not None and not (place / "results").exists():
        work.mkdir(parents=True)
        (place / "results").mkdir()
        (place / "results/work").symlink_to(work)
    life = Run(campaign)
    life.phases["images"] = campaign.images
    life.command("plan", ["ntop", "plan", "--out", "plan.json"])
    life.once("parse", lambda: parse(campaign))
    life.command("dry_run", [*SNAKEMAKE, "-n"])
    if size in PLAN_ONLY:
        return
    life.once("execute", lambda: execute(campaign))
    target = "results/7_assemble/scale"
    cores = ["--cores", str(JOBS), "--"]
    life.command("assemble", [*SNAKEMAKE, *cores, target])
    life.command("check", ["ntop", "check", "--dataset", target])
    life.command("evaluate", [*SNAKEMAKE, *cores])
    life.command("no_op", [*SNAKEMAKE, *cores])
    life.once("disk", lambda: {name: usage(place / "results" / name) for name in STORES})


STORES = ("5_render", "6_annotate", "7_assemble")


def parse(campaign: Campaign) -> dict:
    """Seconds in which Snakemake reads the Snakefile: configuration, tables, plan, rules."""
    with (campaign.folder / "parse.log").open("w") as log:
        subprocess.run(
            [sys.executable, "-c", PARSE],
            cwd=campaign.folder,
            env=campaign.environment(),
            stdout=log,
            stderr=subprocess.STDOUT,
            check=True,
        )
    wall_s, cpu_s = json.loads((campaign.folder / "parse.json").read_text())
    return {"wall_s": round(wall_s, 3), "cpu_s": round(cpu_s, 3)}


def execute(campaign: Campaign) -> dict:
    """Capture, train, render and annotate everything; the server's work is part of it."""
    folder = campaign.folder
    lines = (folder / "config/actors.tsv").read_text().splitlines()[1:]
    done = [f"results/6_annotate/{'/'.join(line.split(chr(9))[:2])}/done" for line in lines]
    with server(campaign) as used:
        cost = measured(
            [*SNAKEMAKE, "--cores", str(JOBS), "--", *done],
            folder=folder,
            environment=campaign.environment(),
            log=folder / "execute.log",
        )
    figures = asdict(cost)
    figures["cpu_s"] = round(cost.cpu_s + used["cpu_s"], 2)
    figures["peak_mb"] = max(cost.peak_mb, used["peak_mb"])
    return figures


@contextmanager
def server(campaign: Campaign):
    """The preloaded stages while the block runs; afterwards the yielded dict holds their cost."""
    path = campaign.folder / SOCKET
    path.unlink(missing_ok=True)
    words = [sys.executable, "-m", "benchmarks.fast_stages", str(path)]
    used: dict[str, float] = {}
    process = subprocess.Popen(words, env=campaign.environment())
    try:
        while not path.exists():
            time.sleep(0.2)
        yield used
    finally:
        process.terminate()
        _, _, usage_of = os.wait4(process.pid, 0)
        process.returncode = 0
        used["cpu_s"] = usage_of.ru_utime + usage_of.ru_stime
        used["peak_mb"] = round(usage_of.ru_maxrss * 1024 / 1e6, 1)


def usage(folder: Path) -> dict[str, int]:
    """Inodes and bytes on the disk below a folder; a file with several names counts once."""
    seen: dict[int, int] = {}
    for where, _, names in os.walk(folder):
        for path in (where, *(f"{where}/{name}" for name in names)):
            found = os.lstat(path)
            seen[found.st_ino] = found.st_blocks * 512
    return {"inodes": len(seen), "bytes": sum(seen.values())}


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    one = verbs.add_parser("run")
    one.add_argument("folder", type=Path)
    one.add_argument("size", choices=SIZES)
    one.add_argument("storage", choices=("files", "tar"))
    one.add_argument("--work", type=Path, metavar="PLACE", help="a folder in memory, say")
    all_ = verbs.add_parser("record")
    all_.add_argument("folder", type=Path)
    given = parser.parse_args()
    if given.verb == "run":
        work = given.work.resolve() if given.work else None
        run(given.folder.resolve(), given.size, given.storage, work=work)
    else:
        from benchmarks.scale_report import record

        record(given.folder)


if __name__ == "__main__":
    main()
