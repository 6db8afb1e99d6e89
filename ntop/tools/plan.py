"""`ntop plan`: cut a campaign into shards once, and say what it will take before anything runs."""

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from ntop.config.frozen import Estimate, FrozenPlan, changed_runs, described_runs, read_plan
from ntop.config.plan import planned_jobs
from ntop.config.run import Run, load_files
from ntop.conventions import VIEWS, ConfigError
from ntop.storage.atomic import write_bytes
from ntop.storage.benchmarks import read_usage
from ntop.tools.gpus import Gpus, asked_gpus

# where nothing was measured yet: the demo on one core (benchmarks/results/demo.json)
DEFAULT_VIEWS_PER_S = 1.3
DEFAULT_TRAIN_S = 200.0
DEFAULT_BYTES_PER_IMAGE = 190e3
DEFAULT_JOB_MINUTES = 30.0
JOB_MINUTES = (10.0, 60.0)  # shorter: start-up tells; longer: time limits and lost work do


@dataclass(frozen=True)
class Pace:
    """What was measured, or assumed: views/s of a render job, seconds of a training, bytes."""

    views_per_s: float
    train_s: float
    bytes_per_image: float
    basis: str


def main(
    out: Path,
    configfile: list[Path] | None = None,
    directory: Path = Path(),
    minutes_per_job: float | None = None,
    views_per_s: float | None = None,
    refreeze: bool = False,
    profile: Path | None = None,
    set_resources: list[str] | None = None,
) -> None:
    """Freeze the plan of a campaign into the JSON file `out`, and print what it will take.

    Name the file as `plan` in the configuration; the workflow then takes its shards from it. The
    size of shards is chosen when the file is made, so that a render job lasts `minutes_per_job`
    (30) at the pace that earlier jobs in `directory` had (or `views_per_s`); a configuration that
    says `render.sets_per_shard` is followed, unless minutes are given. Later calls add new
    sequences and keep the size. `refreeze` starts anew. Give `profile` and `set_resources` as to
    Snakemake: GPU-hours are the hours of the jobs that ask for GPUs there, times their number.

    Raises:
        ConfigError: the configuration cannot be used, a planned sequence has changed, or the
            minutes are outside 10 to 60.
        DataError: the file cannot be written.
    """
    if minutes_per_job is not None and not JOB_MINUTES[0] <= minutes_per_job <= JOB_MINUTES[1]:
        raise ConfigError(f"minutes_per_job {minutes_per_job}: expected {JOB_MINUTES[0]:.0f} to 60")
    run = load_files(configfile or [], directory=directory, frozen=False)
    pace = measured_pace(run, directory=directory, views_per_s=views_per_s)
    gpus = asked_gpus(directory, profile=profile, words=set_resources)
    known = read_plan(out) if out.exists() and not refreeze else None
    plan = frozen_plan(run, pace, gpus=gpus, known=known, minutes_per_job=minutes_per_job)
    write_bytes(out, (plan.model_dump_json(indent=1) + "\n").encode())
    sys.stdout.write("\n".join(describe(plan, out, known=known)) + "\n")


def frozen_plan(
    run: Run, pace: Pace, *, gpus: Gpus, known: FrozenPlan | None, minutes_per_job: float | None
) -> FrozenPlan:
    """The plan of a run; shards of a plan that is known already stay as they are.

    Raises:
        ConfigError: a planned sequence has changed.
    """
    runs, rigs = described_runs(run.sequences), list(run.config.render.rigs)
    if known is not None:
        if changes := changed_runs(known, runs):
            raise ConfigError(
                "planned sequences have changed:\n"
                + "\n".join(changes)
                + "\nset them back, or give --refreeze: all shards are cut and rendered anew"
            )
        runs = known.runs | runs
        rigs = list(dict.fromkeys([*known.rigs, *rigs]))
    size = known.sets_per_shard if known else chosen_size(run, pace, minutes_per_job)
    return FrozenPlan(
        dataset=run.config.dataset,
        sets_per_shard=size,
        rigs=tuple(rigs),
        runs=dict(sorted(runs.items())),
        estimate=estimate(run, size, pace, gpus=gpus),
    )


def chosen_size(run: Run, pace: Pace, minutes_per_job: float | None) -> int:
    """Sets a shard: as many as a job renders in those minutes, else what the configuration says."""
    render = run.config.render
    if minutes_per_job is None and "sets_per_shard" in render.model_fields_set:
        return render.sets_per_shard
    minutes = DEFAULT_JOB_MINUTES if minutes_per_job is None else minutes_per_job
    return max(1, round(60 * minutes * pace.views_per_s / len(VIEWS)))


def estimate(run: Run, sets_per_shard: int, pace: Pace, *, gpus: Gpus) -> Estimate:
    """What the whole campaign takes with shards of this size."""
    render = run.config.render.model_copy(update={"sets_per_shard": sets_per_shard})
    sized = replace(run, config=run.config.model_copy(update={"render": render}))
    jobs = planned_jobs(sized)
    shards = [job for job in jobs if job.stage == "render"]
    num_sets = sum(len(job.frames) for job in shards)
    images = num_sets * len(VIEWS)
    longest = max((len(job.frames) for job in shards), default=0)
    render_s = images / pace.views_per_s
    train_s = sum(job.stage == "train" for job in jobs) * pace.train_s
    return Estimate(
        images=images,
        sets=num_sets,
        jobs=len(jobs),
        hours=round((render_s + train_s) / 3600, 2),
        gpu_hours=round((render_s * gpus.render + train_s * gpus.train) / 3600, 2),
        gigabytes=round(images * pace.bytes_per_image / 1e9, 2),
        minutes_per_job=round(longest * len(VIEWS) / pace.views_per_s / 60, 1),
        basis=f"{pace.basis}; GPUs a job: {gpus.train:g} to train, {gpus.render:g} to render, by "
        f"{gpus.origin}",
    )


def measured_pace(run: Run, *, directory: Path, views_per_s: float | None) -> Pace:
    """The pace of jobs that have finished in `directory`; stated defaults where there are none."""
    jobs = planned_jobs(run)
    used = [(job, read_usage(directory / job.benchmark)) for job in jobs]
    timed = [(job, usage.wall_s) for job, usage in used if usage and usage.wall_s]
    renders = [(job, s) for job, s in timed if job.stage == "render"]
    trains = [s for job, s in timed if job.stage == "train"]
    views = len(VIEWS) * sum(len(job.frames) for job, _ in renders)
    words = []
    if views_per_s is not None:
        words.append(f"{views_per_s:g} views/s as given")
    elif renders:
        views_per_s = views / sum(s for _, s in renders)
        words.append(f"{views_per_s:.2f} views/s in {len(renders)} finished render jobs")
    else:
        views_per_s = DEFAULT_VIEWS_PER_S
        words.append(f"{views_per_s:g} views/s assumed, nothing was rendered here yet")
    size = sum(_folder_bytes(directory / job.output) for job, _ in renders)
    return Pace(
        views_per_s=views_per_s,
        train_s=sum(trains) / len(trains) if trains else DEFAULT_TRAIN_S,
        bytes_per_image=size / views if size else DEFAULT_BYTES_PER_IMAGE,
        basis=", ".join(words),
    )


def describe(plan: FrozenPlan, path: Path, *, known: FrozenPlan | None) -> list[str]:
    """The plan as lines of text."""
    figures, added = plan.estimate, len(plan.runs) - len(known.runs if known else {})
    return [
        f"plan {path}: {len(plan.runs)} sequences ({added} new) x {len(plan.rigs)} rigs",
        f"  {figures.images} images in {figures.sets} sets, {figures.jobs} jobs",
        f"  {plan.sets_per_shard} sets a shard"
        + (", kept" if known else ", chosen now")
        + f": render jobs of up to {figures.minutes_per_job} minutes",
        f"  {figures.hours} hours of jobs, {figures.gpu_hours} GPU-hours, {figures.gigabytes} GB",
        f"  by {figures.basis}",
        f"use it: --config plan={path}, or `plan: {path}` in the configuration",
    ]


def _folder_bytes(folder: Path) -> int:
    return sum(
        (Path(where) / name).stat().st_size for where, _, names in os.walk(folder) for name in names
    )
