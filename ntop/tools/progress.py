"""How far every planned job is, from what it left on disk; nothing is written or locked."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ntop.config.plan import Job
from ntop.conventions import VIEWS
from ntop.storage.benchmarks import read_usage
from ntop.tools.alive import QUEUED, Mark, Processes, SlurmJob, jobs_of

State = Literal["done", "running", "queued", "stopped", "failed", "waiting"]

TAIL_BYTES = 8192  # of a log: enough for its last lines
# last words of a job that was asked to stop: render's, train's, and Python's on Ctrl-C
STOPPED_WORDS = re.compile(r"run again to go on$|the same command continues there$|^KeyboardInterr")
VIEW_RATE = re.compile(r"([0-9.]+) views/s")


@dataclass(frozen=True)
class Progress:
    """One job: its state and what is there of it."""

    job: Job
    state: State
    sets_done: int = 0  # of a shard
    sets_skipped: int = 0  # of a finished shard: no usable body
    seconds: float | None = None  # of the attempt that succeeded
    views_per_s: float | None = None  # of an unfinished shard's last attempt


@dataclass(frozen=True)
class Witness:
    """What is known about jobs at work, beside the files they write."""

    running: frozenset[str]  # outputs
    queued: frozenset[str]
    marked: frozenset[str]  # running or queued when their Snakemake was last heard of


def witness(marks: list[Mark], processes: Processes, queue: list[SlurmJob] | None) -> Witness:
    """Which outputs are being made.

    A mark alone does not say so: it outlives a killed head process. SLURM's queue, a living head
    or a working process does; if SLURM was used and cannot be asked, the mark is believed.
    """
    running, queued = set(processes.jobs), set()
    for mark in marks:
        states = {job.state for job in jobs_of(mark, queue or [])}
        if states and states <= QUEUED:
            queued.add(mark.output)
        elif states or queue is None or (processes.heads and mark.job_id is None):
            running.add(mark.output)
    marked = frozenset(mark.output for mark in marks)
    return Witness(frozenset(running), frozenset(queued - running), marked)


def progress_of(job: Job, *, directory: Path, seen: Witness) -> Progress:
    """The state of one job, and what its folders and tables say about it."""
    state = _state(job, directory=directory, seen=seen)
    if state == "done":
        skipped = _count_skipped(directory / job.output) if job.stage == "render" else 0
        usage = read_usage(directory / job.benchmark)
        seconds = usage and usage.wall_s
        return Progress(job, state, len(job.frames) - skipped, skipped, seconds)
    if job.stage != "render":
        return Progress(job, state)
    rates = VIEW_RATE.findall(log_tail(directory / job.log))
    rate = float(rates[-1]) if rates and float(rates[-1]) > 0 else None
    return Progress(job, state, _count_kept(job, directory), views_per_s=rate)


def _state(job: Job, *, directory: Path, seen: Witness) -> State:
    if job.output in seen.running:
        return "running"
    if job.output in seen.queued:
        return "queued"
    if job.output in seen.marked:
        return "stopped"  # it went down with its head; what it had published is made again
    if (directory / job.output).exists():
        return "done"
    log, benchmark = directory / job.log, directory / job.benchmark
    if not log.exists():
        return "waiting"
    if benchmark.exists() and benchmark.stat().st_mtime >= log.stat().st_mtime:
        return "waiting"  # the attempt succeeded; its output was removed since
    lines = log_tail(log).rstrip().splitlines()
    return "stopped" if lines and STOPPED_WORDS.search(lines[-1]) else "failed"


def _count_kept(job: Job, directory: Path) -> int:
    """Finished sets in a shard's work folder; a set is published there by one rename."""
    content = directory / job.work / "content"
    return sum((content / f"{frame:06d}").is_dir() for frame in job.frames)


def _count_skipped(shard: Path) -> int:
    try:
        return len(json.loads((shard / "skipped.json").read_text()))
    except (OSError, json.JSONDecodeError):
        return 0  # a detail of a summary: the stages are the ones to complain


def log_tail(log: Path) -> str:
    """The end of a log, empty if there is none."""
    try:
        with log.open("rb") as stream:
            stream.seek(max(0, log.stat().st_size - TAIL_BYTES))
            return stream.read().decode(errors="replace")
    except OSError:
        return ""


def seconds_per_unit(stage: list[Progress]) -> float | None:
    """What one set of a shard, or one job of another stage, takes; None if nothing tells yet.

    A job that went on after a stop counts with its last attempt only: the mean is then too small.
    """
    timed = [item for item in stage if item.seconds is not None]
    units = sum(_units(item) for item in timed)
    if units:
        return sum(item.seconds for item in timed) / units
    rates = [item.views_per_s for item in stage if item.views_per_s]
    return len(VIEWS) * len(rates) / sum(rates) if rates else None


def seconds_left(stage: list[Progress]) -> float | None:
    """Work left in a stage, in seconds of one job after the other; None if nothing tells yet."""
    todo = [item for item in stage if item.state != "done"]
    if not todo:
        return 0.0
    each = seconds_per_unit(stage)
    return None if each is None else each * sum(_units(item) - item.sets_done for item in todo)


def _units(item: Progress) -> int:
    return len(item.job.frames) or 1
