"""`ntop status`: how far a run is, how long it will take, what failed and what it said."""

import json as json_format
import sys
from dataclasses import asdict
from pathlib import Path

from ntop.config.plan import NUMBERS, planned_jobs
from ntop.config.run import load_files
from ntop.tools.alive import is_locked, processes_in, read_marks, slurm_queue
from ntop.tools.progress import progress_of, witness
from ntop.tools.summary import Stage, Summary, summarise

HEADER = ("stage", "jobs", "done", "running", "failed", "remaining", "time each", "work left")


def main(
    configfile: list[Path] | None = None, directory: Path = Path(), json: bool = False
) -> None:
    """Show how far a run is: jobs per stage, sets and images, pace, slow shards, failures.

    Give `configfile` and `directory` as to Snakemake: the files are merged in their order over
    config/config.yaml of the directory. Done means that the output is there; whether a changed
    configuration has made it out of date is what `snakemake -n` says. Reads only.

    Raises:
        ConfigError: the configuration or its tables cannot be used.
    """
    summary = survey(configfile or [], directory=directory)
    figures = json_format.dumps(asdict(summary), indent=1) if json else None
    sys.stdout.write((figures or "\n".join(describe(summary))) + "\n")


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
    left = "unknown" if stage.hours_left is None else _hours(stage.hours_left)
    finished = stage.done == stage.jobs
    name = f"{NUMBERS[stage.name]} {stage.name}"
    return (name, *map(str, counts), time_each, "" if finished else left)


def _hours(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1 else f"{60 * hours:.1f} min"


def _pace(summary: Summary) -> list[str]:
    skipped = f" ({summary.sets_skipped} without a usable body)" if summary.sets_skipped else ""
    lines = [
        f"sets    {summary.sets_done} of {summary.sets_planned}{skipped}",
        f"images  {summary.images_done} of {summary.images_planned}",
    ]
    if summary.images_per_s is not None:
        lines.append(f"rate    {summary.images_per_s:.2f} images/s per render job")
    if all(stage.done == stage.jobs for stage in summary.stages):
        return [*lines, "left    nothing: all outputs are there"]
    jobs = "one job" if summary.jobs_at_once == 1 else f"{summary.jobs_at_once} jobs"
    known = f"{_hours(summary.hours_left)} with {jobs} at once"
    if summary.unknown_pace:
        unknown = f"of {', '.join(summary.unknown_pace)} no job has ended yet"
        known = f"at least {known}; {unknown}" if summary.hours_left else f"unknown: {unknown}"
    return [*lines, f"left    {known}"]


def _attention(summary: Summary) -> list[str]:
    lines: list[str] = []
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
