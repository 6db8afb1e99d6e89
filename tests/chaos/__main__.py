"""`make chaos`: many trials, and their table.

    python -m tests.chaos --trials 60 --seed 1 --jobs 2 --out docs/chaos

A piece of a long campaign is written to a JSON file; `--merge` puts pieces together.
"""

import argparse
import json
import random
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from tests.chaos.catalogue import QUICK, SLOW, deal, find, lacking
from tests.chaos.slurm import SLURM_KINDS, slurm_trials
from tests.chaos.table import write_table
from tests.chaos.trial import NOT_TRIED, Kind, Outcome, run_trial
from tests.slurm.cluster import slurm_is_installed
from tests.workflow.project import Project


def main() -> int:
    parser = argparse.ArgumentParser(prog="make chaos", description=__doc__)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="trials at a time")
    parser.add_argument("--finished", type=Path, help="a finished tiny campaign, else one is run")
    parser.add_argument("--out", type=Path, default=Path("docs/chaos"))
    parser.add_argument("--only", nargs="*", default=[], help="these alone, as NAME:STAGE")
    parser.add_argument("--slurm", type=int, help="trials through SLURM, else a tenth of them")
    parser.add_argument("--merge", type=Path, nargs="*", default=[], help="JSON of earlier pieces")
    options = parser.parse_args()
    for kind in [*QUICK, *SLOW]:
        if said := lacking(kind):
            print(f"left out: {kind.name}, {kind.stage}: {said}")
    outcomes = merged(options.merge)
    with tempfile.TemporaryDirectory(prefix="ntop-chaos-") as place:
        finished = reference(options.finished, Path(place)) if options.trials else None
        outcomes += campaign(options, finished, Path(place))
    write_table(outcomes, options.out)
    lost = [outcome for outcome in outcomes if not outcome.survived]
    print(f"{len(outcomes) - len(lost)} of {len(outcomes)} survived")
    return 1 if lost else 0


def merged(pieces: list[Path]) -> list[Outcome]:
    """The trials of earlier pieces; one that missed its moment gives way to its repetition."""
    outcomes = [Outcome(**row) for path in pieces for row in json.loads(path.read_text())]
    tried = {(o.disturbance, o.stage) for o in outcomes if o.outcome != NOT_TRIED}
    return [o for o in outcomes if o.outcome != NOT_TRIED or (o.disturbance, o.stage) not in tried]


def reference(folder: Path | None, place: Path) -> Project:
    """The undisturbed campaign."""
    if folder is not None:
        return Project.existing(folder)
    (place / "finished").mkdir()
    project = Project(place / "finished")
    done = project.run()
    if done.returncode != 0:
        sys.exit(done.stdout + done.stderr)
    return project


def campaign(options: argparse.Namespace, finished: Project | None, place: Path) -> list[Outcome]:
    """All trials of this call, in the order of their numbers; each is kept once it is over."""
    if finished is None:
        return []
    num_slurm, deck = dealt(options)
    outcomes: list[Outcome] = []
    kept = threading.Lock()

    def keep(outcome: Outcome) -> None:
        with kept:
            outcomes.append(outcome)
            outcomes.sort(key=lambda other: other.number)
            write_table(outcomes, options.out)
            print(json.dumps(asdict(outcome)), flush=True)

    def attempt(number: int, kind: Kind, seed: int) -> None:
        keep(run_trial(number, kind, seed, finished=finished, place=place))

    with ThreadPoolExecutor(options.jobs) as pool:
        waiting = [pool.submit(attempt, n, *drawn) for n, drawn in enumerate(deck, start=1)]
        for trial in waiting:
            trial.result()
    kinds = SLURM_KINDS[:num_slurm]
    for outcome in slurm_trials(kinds, options.seed, len(deck) + 1, finished=finished, place=place):
        keep(outcome)
    return outcomes


def dealt(options: argparse.Namespace) -> tuple[int, list[tuple[Kind, int]]]:
    """How many trials go through SLURM, and the other disturbances with their seeds."""
    if options.only:
        chance = random.Random(options.seed)
        return options.slurm or 0, [
            (find(*name.split(":")), chance.randrange(2**31)) for name in options.only
        ]
    num_slurm = min(len(SLURM_KINDS), options.trials // 10) if slurm_is_installed() else 0
    num_slurm = num_slurm if options.slurm is None else options.slurm
    return num_slurm, deal(options.trials - num_slurm, options.seed)


if __name__ == "__main__":
    sys.exit(main())
