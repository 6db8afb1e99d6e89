"""The jobs that a configuration asks for: arithmetic on declared facts, nothing is looked up.

The workflow takes its shards from here, and whoever asks how far a run is takes all jobs. A folder
below `results` or `logs` is `{number}_{stage}`, a job's place in it is its key.
"""

from collections.abc import Sequence as ListLike
from dataclasses import dataclass

from ntop.config.run import Run
from ntop.config.sections import STAGE_SECTIONS
from ntop.config.tables import Sequence

NUMBERS = {name: number for number, name in enumerate(STAGE_SECTIONS, start=1)}


@dataclass(frozen=True)
class Job:
    """One job of the workflow; all paths are relative to the working directory."""

    stage: str
    key: str
    frames: tuple[int, ...] = ()  # the sets of a shard

    @property
    def name(self) -> str:
        """Stage folder and key, as in all paths."""
        return f"{NUMBERS[self.stage]}_{self.stage}/{self.key}"

    @property
    def output(self) -> str:
        """What the job publishes by one rename."""
        return f"results/{self.name}{'.parquet' if self.stage == 'annotate' else ''}"

    @property
    def log(self) -> str:
        """The stage's words during the last attempt."""
        return f"logs/{self.name}.log"

    @property
    def benchmark(self) -> str:
        """Time and memory of the last attempt that succeeded."""
        return f"results/benchmarks/{self.name}.tsv"

    @property
    def work(self) -> str:
        """Where a stopped job leaves finished pieces."""
        return f"results/work/{self.name}"


def cut_shards(row: Sequence, sets_per_shard: int) -> list[tuple[int, ...]]:
    """The frames (sets) of each shard of a render sequence."""
    frames = tuple(row.frames)
    return [frames[i : i + sets_per_shard] for i in range(0, len(frames), sets_per_shard)]


def shard_frames(
    sequences: ListLike[Sequence], *, rigs: ListLike[str], sets_per_shard: int
) -> dict[str, tuple[int, ...]]:
    """The shards `{source}/{actor}/{action}/{rig}/{first frame}` of the tables, and their sets.

    A shard's name depends on its own sequence and the size only, so that it stays when actors are
    added.
    """
    return {
        f"{row.source}/{row.actor}/{row.action}/{rig}/{frames[0]:06d}": frames
        for row in sequences
        if row.use == "render"
        for rig in rigs
        for frames in cut_shards(row, sets_per_shard)
    }


def planned_jobs(run: Run) -> list[Job]:
    """All jobs, stage by stage; what a source brings along needs none."""
    config = run.config
    jobs = {name: [] for name in STAGE_SECTIONS}
    for actor in run.actors:
        key, given = f"{actor.source}/{actor.actor}", config.sources[actor.source].provides
        fits = "bodies" not in given
        jobs["capture"].append(Job("capture", key))
        if "masks" not in given or (fits and "keypoints2d" not in given):
            jobs["mask"].append(Job("mask", key))
        if fits:
            jobs["fit"].append(Job("fit", key))
        jobs["train"].append(Job("train", key))
    size = config.render.sets_per_shard
    shards = shard_frames(run.sequences, rigs=list(config.render.rigs), sets_per_shard=size)
    for stage in ("render", "annotate"):
        jobs[stage] += [Job(stage, key, frames) for key, frames in shards.items()]
    jobs["assemble"].append(Job("assemble", config.dataset))
    jobs["evaluate"].append(Job("evaluate", config.dataset))
    return [job for name in STAGE_SECTIONS for job in jobs[name]]
