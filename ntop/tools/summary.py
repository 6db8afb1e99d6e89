"""A run in figures: what `ntop status` shows, as values."""

import statistics
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from ntop.config.plan import NUMBERS
from ntop.conventions import VIEWS
from ntop.tools.progress import Progress, log_tail, seconds_left, seconds_per_unit

NUM_SLOWEST, NUM_LINES, NUM_AT_WORK = 5, 6, 8


@dataclass(frozen=True)
class Stage:
    """One stage; `done + running + failed + remaining` are its jobs."""

    name: str
    jobs: int
    done: int
    running: int
    failed: int
    remaining: int
    queued: int  # of the remaining: handed to the cluster
    stopped: int  # of the remaining: begun, they go on where they were
    unit: str  # set or job
    seconds_per_unit: float | None
    hours_left: float | None  # of work, one job after the other


@dataclass(frozen=True)
class Slow:
    """A finished shard, and how its time per set compares with the median."""

    key: str
    seconds: float
    seconds_per_set: float
    times_median: float


@dataclass(frozen=True)
class AtWork:
    """A running job and the last line of its log: how far it is, its rate and its time left."""

    stage: str
    key: str
    last_line: str


@dataclass(frozen=True)
class Failure:
    """A job that ended without its output, and what it said last."""

    stage: str
    key: str
    log: str
    last_lines: tuple[str, ...]


@dataclass(frozen=True)
class Stopped:
    """A job that was ended from outside, and the sets that it keeps for its successor."""

    stage: str
    key: str
    sets_kept: int
    sets: int


@dataclass(frozen=True)
class Summary:
    """A run: counts, pace, and what needs a look."""

    dataset: str
    stages: tuple[Stage, ...]
    sets_planned: int
    sets_done: int
    sets_skipped: int  # their frame has no usable body
    images_planned: int
    images_done: int
    jobs_at_once: int  # now; 1 if none runs
    images_per_s: float | None  # rendered by one job
    work_hours_left: float  # of the stages whose pace is known
    hours_left: float  # the same with as many jobs at once as now
    unknown_pace: tuple[str, ...]  # stages with work left that no finished job tells about
    at_work: tuple[AtWork, ...]  # some of the running jobs
    slowest: tuple[Slow, ...]
    failures: tuple[Failure, ...]
    stopped: tuple[Stopped, ...]
    notes: tuple[str, ...]


def summarise(
    dataset: str, items: list[Progress], *, directory: Path, notes: tuple[str, ...] = ()
) -> Summary:
    """The figures of a run; `directory` holds the logs of what failed."""
    by_stage = {name: [i for i in items if i.job.stage == name] for name in NUMBERS}
    stages = tuple(_stage(name, found) for name, found in by_stage.items() if found)
    shards = by_stage["render"]
    planned = sum(len(item.job.frames) for item in shards)
    done = sum(item.sets_done for item in shards)
    skipped = sum(item.sets_skipped for item in shards)
    at_once = max(1, sum(stage.running for stage in stages))
    work = sum(stage.hours_left or 0.0 for stage in stages)
    each = seconds_per_unit(shards)
    return Summary(
        dataset=dataset,
        stages=stages,
        sets_planned=planned,
        sets_done=done,
        sets_skipped=skipped,
        images_planned=planned * len(VIEWS),
        images_done=done * len(VIEWS),
        jobs_at_once=at_once,
        images_per_s=len(VIEWS) / each if each else None,
        work_hours_left=work,
        hours_left=work / at_once,
        unknown_pace=tuple(stage.name for stage in stages if stage.hours_left is None),
        at_work=_at_work(items, directory),
        slowest=_slowest(shards),
        failures=tuple(
            Failure(i.job.stage, i.job.key, i.job.log, last_lines(log_tail(directory / i.job.log)))
            for i in items
            if i.state == "failed"
        ),
        stopped=tuple(
            Stopped(item.job.stage, item.job.key, item.sets_done, len(item.job.frames))
            for item in items
            if item.state == "stopped"
        ),
        notes=notes,
    )


def _stage(name: str, items: list[Progress]) -> Stage:
    count = Counter(item.state for item in items)
    left_s = seconds_left(items)
    return Stage(
        name=name,
        jobs=len(items),
        done=count["done"],
        running=count["running"],
        failed=count["failed"],
        remaining=count["waiting"] + count["queued"] + count["stopped"],
        queued=count["queued"],
        stopped=count["stopped"],
        unit="set" if any(item.job.frames for item in items) else "job",
        seconds_per_unit=seconds_per_unit(items),
        hours_left=None if left_s is None else left_s / 3600,
    )


def _at_work(items: list[Progress], directory: Path) -> tuple[AtWork, ...]:
    running = [item.job for item in items if item.state == "running"][:NUM_AT_WORK]
    said = [last_lines(log_tail(directory / job.log)) for job in running]
    return tuple(
        AtWork(job.stage, job.key, lines[-1] if lines else "nothing said yet")
        for job, lines in zip(running, said, strict=True)
    )


def _slowest(shards: list[Progress]) -> tuple[Slow, ...]:
    timed = [(i.seconds / len(i.job.frames), i) for i in shards if i.seconds is not None]
    if len(timed) < 2:
        return ()  # one shard is neither fast nor slow
    median = statistics.median(each for each, _ in timed)
    timed.sort(key=lambda pair: -pair[0])
    return tuple(
        Slow(item.job.key, item.seconds, each, each / median if median else 1.0)
        for each, item in timed[:NUM_SLOWEST]
    )


def last_lines(text: str) -> tuple[str, ...]:
    """The last lines that say something."""
    return tuple(line.rstrip() for line in text.splitlines() if line.strip())[-NUM_LINES:]
