"""The table of trials: JSON for machines, Markdown for the docs."""

import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from tests.chaos.trial import Outcome

HEAD = """# Chaos

What `make chaos` did to the tiny campaign of `config/test.yaml`, and what became of it. In every
trial a copy of the finished campaign has a stage undone, is run again, and is disturbed at a random
moment of that stage; then its user repeats the command, and does what errors say, to the letter.
**Survived** means: the dataset is the undisturbed one's, every byte of every file, and where a file
was damaged, an error (or `ntop check`) named it and what to do.

Moments follow from progress (a process seen, sets finished) and the seed; a trial that comes too
late is repeated. `make chaos` tries sixty, every kind of disturbance at least once, and writes this
page; further ones are put in with `--merge` (`python -m tests.chaos --help`). A dozen of the trials
are part of `make test`.

What the suite has found, by its trials or while they were written, and what was mended since:

| found | now |
|---|---|
"""

FOUND = [
    ("a changed byte of a checkpoint went on into another avatar", "checkpoints carry a SHA-256"),
    (
        "a picture that changed after its annotation, though not in size, went into the dataset",
        "assemble compares every picture with the shard's record",
    ),
    (
        "depth and part images of a dataset had no checksum",
        "`files.parquet` has those of all files, `ntop check` compares",
    ),
    (
        'advice as "delete it and rerun the stage" left Snakemake idle: the folder was still there',
        "errors say `--forcerun OUTPUT`",
    ),
    (
        "a read-only folder ended in Snakemake's traceback, without a remedy",
        "`workflow/run.sh` adds it",
    ),
    (
        "results from the future, of a clock that was wrong, stopped every later run",
        "`workflow/run.sh` prints the line that sets their times",
    ),
    (
        "a full disk ended assemble in a traceback",
        "the error names the file, the disk and the remedy",
    ),
]


def write_table(outcomes: list[Outcome], out: Path) -> None:
    """Write `out`.json and `out`.md."""
    rows = [asdict(outcome) | {"number": n} for n, outcome in enumerate(outcomes, start=1)]
    out.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n")
    survived = sum(outcome.survived for outcome in outcomes)
    kinds = Counter(outcome.disturbance for outcome in outcomes)
    lines = [
        HEAD + "\n".join(f"| {found} | {now} |" for found, now in FOUND),
        "",
        f"**{survived} of {len(outcomes)} trials survived**, {len(kinds)} kinds of disturbance.",
        "Seconds are those of the user's commands after the disturbance, on a busy machine.",
        "",
        "| trial | seed | disturbance | stage | what was hit | outcome | seconds |",
        "|---:|---:|---|---|---|---|---:|",
    ]
    lines += [
        f"| {number} | {o.seed} | {o.disturbance} | {o.stage} | {cell(o.hit)} | {cell(o.outcome)} "
        f"| {o.rerun_s:.0f} |"
        for number, o in enumerate(outcomes, start=1)
    ]
    out.with_suffix(".md").write_text("\n".join(lines) + "\n")


def cell(text: str) -> str:
    """Text that fits into a cell."""
    return text.replace("|", "/").replace("\n", " ")
