"""`ntop orphans`: what a killed Snakemake left behind, what of it still runs, and what to do.

Whoever starts Snakemake again while jobs of a killed one still run gets every one of them twice:
it does not look whether the old ones still run.
"""

import shlex
import sys
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from ntop.tools.alive import (
    Mark,
    Processes,
    SlurmJob,
    is_locked,
    jobs_of,
    processes_in,
    read_marks,
    slurm_queue,
)

EXIT_ORPHANS = 3

Fate = Literal["runs", "gone", "unknown"]


@dataclass(frozen=True)
class Remnant:
    """One output that a killed Snakemake worked on, and what became of its job."""

    output: str  # in brackets: what is known of a job whose output is not
    fate: Fate
    is_there: bool  # the output: whole, as stages publish by one rename
    slurm: tuple[SlurmJob, ...] = ()
    process: int | None = None  # of this machine
    since: float | None = None  # seconds since the epoch; None: Snakemake has no mark of it


def main(directory: Path = Path()) -> int:
    """Explain what a killed Snakemake left in `directory`; exit code 3 while jobs of it run.

    The exit code is 0 when nothing runs that a new Snakemake would start a second time, so
    `ntop orphans && snakemake ...` is safe. Jobs of SLURM that cannot be asked for count as
    running. Reads only.
    """
    marks, processes = read_marks(directory), processes_in(directory)
    if processes.heads:
        pids = ", ".join(map(str, processes.heads))
        sys.stdout.write(
            f"snakemake works in {directory.resolve()} (process {pids}) on {len(marks)} outputs: "
            "nothing is orphaned\n"
        )
        return 0
    queue = slurm_queue(directory, marks)
    found = remnants(marks, processes, queue, directory=directory)
    lines = explain(found, locked=is_locked(directory), place=str(directory.resolve()))
    sys.stdout.write("\n".join(lines) + "\n")
    return EXIT_ORPHANS if any(item.fate != "gone" for item in found) else 0


def remnants(
    marks: list[Mark],
    processes: Processes,
    queue: list[SlurmJob] | None,
    *,
    directory: Path,
) -> list[Remnant]:
    """What is left, by output: all marks, and jobs that no mark speaks of.

    `queue` is SLURM's of this directory, None if it cannot be asked.
    """
    unmarked = dict(processes.jobs)
    matched = {job for mark in marks for job in jobs_of(mark, queue or [])}
    others = [job for job in queue or [] if job not in matched]
    found = []
    for mark in marks:
        slurm = tuple(jobs_of(mark, queue or []))
        process = unmarked.pop(mark.output, None)
        fate: Fate = "gone"
        if slurm or process is not None:
            fate = "runs"
        elif queue is None or others:
            fate = "unknown"  # one of those jobs may be this mark's
        there = (directory / mark.output).exists()
        found.append(Remnant(mark.output, fate, there, slurm, process, mark.since))
    for output, process in sorted(unmarked.items()):
        found.append(Remnant(output, "runs", (directory / output).exists(), process=process))
    for job in others:
        found.append(Remnant(f"[{job.comment}]", "runs", False, (job,)))
    return found


def explain(found: list[Remnant], *, locked: bool, place: str) -> list[str]:
    """What is left and what to do about it, in words."""
    if not found and not locked:
        return [f"nothing is left in {place}: start snakemake as usual"]
    killed = locked or any(item.since is not None for item in found)
    left = "one ended without tidying up" if killed else "its jobs do"
    lines = [
        f"no snakemake works in {place} on this machine, but {left}",
        "(if it works on another machine, say a login node, all this is its own: leave it alone)",
    ]
    for fate, title in (
        ("runs", "still running"),
        ("unknown", "perhaps running, as SLURM cannot be asked here or lists jobs without output"),
        ("gone", "gone"),
    ):
        some = [item for item in found if item.fate == fate]
        if some:
            lines += ["", f"{title}:", *(f"  {_line(item)}" for item in some)]
    return [*lines, "", *_remedies(found, locked=locked)]


def _line(item: Remnant) -> str:
    words = [item.output]
    words += [f"SLURM job {job.job_id} {job.state}" for job in item.slurm]
    if item.process is not None:
        words.append(f"process {item.process} of this machine")
    if item.since is not None:
        words.append(f"since {datetime.fromtimestamp(item.since):%Y-%m-%d %H:%M}")
    else:
        words.append("not marked by snakemake")
    if item.fate == "gone":
        words.append("its output is there" if item.is_there else "no output")
    return ", ".join(words)


def _remedies(found: list[Remnant], *, locked: bool) -> list[str]:
    alive = [item for item in found if item.fate != "gone"]
    finished = [item.output for item in found if item.fate == "gone" and item.is_there]
    lines = []
    if alive:
        lines += [
            "Do not start snakemake yet: it would start these jobs again, beside the running ones.",
            "Wait until they have ended (this command says so), or end them:",
            *_ending(alive),
            "Run again, training goes on at its last checkpoint, rendering at its next set.",
            "",
        ]
    if locked:
        lines += [
            "The killed snakemake's lock is still there; workflow/run.sh removes it, and so does:",
            "  snakemake --unlock --cores 1",
        ]
    if finished:
        lines += [
            "Outputs of jobs that ended alone are whole, but would be made again. If the "
            "configuration is still the",
            "same, keep them (a complaint about absent metadata does not matter):",
            f"  snakemake --cleanup-metadata {shlex.join(finished)} --cores 1",
        ]
    if any(item.fate == "gone" and not item.is_there for item in found):
        lines += [
            "What is unfinished needs nothing: the next run makes it (profiles/default sets "
            "rerun-incomplete;",
            "without that profile add --rerun-incomplete).",
        ]
    then = "Then start" if lines else "Start"
    return [*lines, f"{then} the same snakemake command as before."]


def _ending(alive: list[Remnant]) -> list[str]:
    """Command lines that end jobs, each job once: a job may have several outputs."""
    slurm = dict.fromkeys(job.job_id for item in alive for job in item.slurm)
    here = [str(item.process) for item in alive if item.process is not None and not item.slurm]
    lines = []
    if slurm:
        lines.append(f"  scancel {shlex.join(slurm)}")
    if here:
        lines.append(f"  kill {shlex.join(here)}")
    return lines
