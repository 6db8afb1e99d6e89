"""`ntop status`: how far a run is, how long it will take, what failed and what it said."""

import json as json_format
import os
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from ntop.config.plan import NUMBERS, planned_jobs
from ntop.config.run import load_files
from ntop.conventions import ConfigError
from ntop.storage.pace import duration
from ntop.tools.alive import is_locked, processes_in, read_marks, slurm_queue
from ntop.tools.progress import progress_of, witness
from ntop.tools.summary import Stage, Summary, summarise

HEADER = ("stage", "jobs", "done", "running", "failed", "remaining", "time each", "work left")


def main(
    configfile: list[Path] | None = None,
    directory: Path = Path(),
    json: bool = False,
    every_s: float | None = None,
) -> None:
    """Show how far a run is: jobs per stage, sets and images, pace, slow shards, failures.

    Give `configfile` and `directory` as to Snakemake: the files are merged in their order over
    config/config.yaml of the directory. Done means that the output is there; whether a changed
    configuration has made it out of date is what `snakemake -n` says. Reads only.

    With `every_s` it says in short every so many seconds what is going on, first after that time,
    until all is done, or until the shell that started it has ended.

    Raises:
        ConfigError: the configuration or its tables cannot be used, or `every_s` is no time.
    """
    if every_s is not None:
        follow(configfile or [], directory=directory, every_s=every_s)
        return
    summary = survey(configfile or [], directory=directory)
    figures = json_format.dumps(asdict(summary), indent=1) if json else None
    sys.stdout.write((figures or "\n".join(describe(summary))) + "\n")


def follow(configfiles: list[Path], *, directory: Path, every_s: float) -> None:
    """Say in short how far a run is, again and again.

    Raises:
        ConfigError: `every_s` is not a positive number.
    """
    if not 0 < every_s < float("inf"):
        raise ConfigError(f"--every-s {every_s}: expected seconds, more than 0")
    with suppress(KeyboardInterrupt):
        left = True
        while left and _slept(every_s):
            summary = survey(configfiles, directory=directory)
            sys.stdout.write("\n".join(brief(summary)) + "\n")
            sys.stdout.flush()
            left = any(stage.done < stage.jobs for stage in summary.stages)


def _slept(seconds: float) -> bool:
    """Whether this process slept so long and its parent lives; at most a second longer than it."""
    shell, end_s = os.getppid(), time.monotonic() + seconds
    while os.getppid() == shell:
        rest_s = end_s - time.monotonic()
        if rest_s <= 0:
            return True
        time.sleep(min(rest_s, 1.0))
    return False


def brief(summary: Summary) -> list[str]:
    """The stages at work, what their jobs say, and the whole: a few lines."""
    lines = []
    for stage in summary.stages:
        if not stage.running and not stage.failed:
            continue
        parts = [f"{stage.done} of {stage.jobs} done", f"{stage.running} running"]
        parts += [f"{stage.failed} failed"] * (stage.failed > 0)
        if stage.seconds_per_unit is not None:
            parts.append(f"{stage.seconds_per_unit:.1f} s/{stage.unit}")
        if stage.hours_left is not None:
            parts.append(f"{duration(3600 * stage.hours_left)} of work left")
        lines.append(f"ntop: {stage.name}: {', '.join(parts)}")
        lines += [
            f"ntop:   {job.key}: {job.last_line}"
            for job in summary.at_work
            if job.stage == stage.name
        ]
    images = f"{summary.images_done} of {summary.images_planned} images"
    return [*lines, f"ntop: {images}, left {_time_left(summary)}"]


def survey(configfiles: list[Path], *, directory: Path) -> Summary:
    """The figures of the run that these files configure, in `directory`."""
    run = load_files(configfiles, directory=directory)
    marks, processes = read_marks(directory), processes_in(directory)
    queue = slurm_queue(directory, marks)
    notes = []
    if queue is None:
        notes.append("squeue cannot be asked here: jobs handed to SLURM count as running")
    if not processes.heads and (marks or is_locked(directory)):
        notes.append(
            "no snakemake works here on this machine, but one left its lock or marks behind: "
            "`ntop orphans` explains"
        )
    seen = witness(marks, processes, queue)
    items = [progress_of(job, directory=directory, seen=seen) for job in planned_jobs(run)]
    return summarise(run.config.dataset, items, directory=directory, notes=tuple(notes))


def describe(summary: Summary) -> list[str]:
    """The summary as lines of plain text."""
    return [
        f"dataset {summary.dataset}",
        "",
        *table([HEADER, *(_row(stage) for stage in summary.stages)]),
        "",
        *_pace(summary),
        *_attention(summary),
    ]


def table(rows: list[tuple[str, ...]]) -> list[str]:
    """Rows with aligned columns: the first to the left, figures to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip()
        for row in rows
    ]


def _row(stage: Stage) -> tuple[str, ...]:
    counts = (stage.jobs, stage.done, stage.running, stage.failed, stage.remaining)
    each = stage.seconds_per_unit
    time_each = "" if each is None else f"{each:.1f} s/{stage.unit}"
    left = "unknown" if stage.hours_left is None else duration(3600 * stage.hours_left)
    finished = stage.done == stage.jobs
    name = f"{NUMBERS[stage.name]} {stage.name}"
    return (name, *map(str, counts), time_each, "" if finished else left)


def _pace(summary: Summary) -> list[str]:
    skipped = f" ({summary.sets_skipped} without a usable body)" if summary.sets_skipped else ""
    lines = [
        f"sets    {summary.sets_done} of {summary.sets_planned}{skipped}",
        f"images  {summary.images_done} of {summary.images_planned}",
    ]
    if summary.images_per_s is not None:
        lines.append(f"rate    {summary.images_per_s:.2f} images/s per render job")
    return [*lines, f"left    {_time_left(summary)}"]


def _time_left(summary: Summary) -> str:
    if all(stage.done == stage.jobs for stage in summary.stages):
        return "nothing: all outputs are there"
    jobs = "one job" if summary.jobs_at_once == 1 else f"{summary.jobs_at_once} jobs"
    known = f"{duration(3600 * summary.hours_left)} with {jobs} at once"
    if summary.unknown_pace:
        unknown = f"of {', '.join(summary.unknown_pace)} no job has ended yet"
        known = f"at least {known}; {unknown}" if summary.hours_left else f"unknown: {unknown}"
    return known


def _attention(summary: Summary) -> list[str]:
    lines: list[str] = []
    if summary.at_work:
        lines += ["", "at work"]
        lines += [f"  {job.stage} {job.key}: {job.last_line}" for job in summary.at_work]
    if summary.slowest:
        lines += ["", "slowest shards"]
        lines += [
            f"  {slow.key}  {slow.seconds_per_set:.1f} s/set, {slow.times_median:.1f} x the median"
            for slow in summary.slowest
        ]
    if summary.stopped:
        lines += ["", "stopped, the next run goes on with them"]
        for job in summary.stopped:
            kept = f"  {job.sets_kept} of {job.sets} sets kept" if job.stage == "render" else ""
            lines.append(f"  {job.stage} {job.key}{kept}")
    for failure in summary.failures:
        lines += ["", f"failed: {failure.stage} {failure.key} ({failure.log})"]
        lines += [f"  {line}" for line in failure.last_lines or ("the log is empty",)]
    for stage in summary.stages:
        if stage.queued:
            lines += ["", f"queued in SLURM: {stage.queued} {stage.name} jobs"]
    return lines + [line for note in summary.notes for line in ("", f"note: {note}")]
