"""What the dataset took: time, memory and GPUs per stage, from Snakemake's benchmark tables."""

import resource
import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from ntop.config.sections import STAGE_SECTIONS
from ntop.report.charts import Chart, bar_chart, human
from ntop.report.page import Table
from ntop.storage.benchmarks import Usage, read_usage

MIB_PER_GIB = 1024.0
PER_DATASET = frozenset({"assemble", "evaluate"})  # one job each, named after the dataset
TEXT = (
    "As Snakemake measured the attempts that succeeded (what an interrupted attempt did before is "
    "not in it); the last stage measured itself. Hours are summed over a stage's jobs, load is "
    "CPU time over wall time, memory is that of the largest job."
)


@dataclass(frozen=True)
class StageCost:
    """A stage's jobs together; None where nothing was measured."""

    name: str
    jobs: int = 0
    wall_s: float | None = None
    cpu_s: float | None = None
    sampled_s: float = 0.0  # wall time of the jobs whose CPU time is known
    peak_gib: float | None = None
    gpu_s: float | None = None  # GPUs asked for times wall time


def stage_costs(benchmarks: Path, *, actors: Collection[str], dataset: str) -> list[StageCost]:
    """The costs of every stage for these actors (`source/actor`) and this dataset.

    Reads the tables below `{number}_{stage}/`; the folder may hold those of other datasets too.
    """
    costs = []
    for number, name in enumerate(STAGE_SECTIONS, start=1):
        folder = benchmarks / f"{number}_{name}"
        used = []
        for path in sorted(folder.rglob("*.tsv")):
            parts = path.relative_to(folder).with_suffix("").parts
            mine = parts == (dataset,) if name in PER_DATASET else "/".join(parts[:2]) in actors
            usage = read_usage(path) if mine else None
            if usage is not None:
                used.append(usage)
        costs.append(_together(name, used))
    return costs


def with_own(costs: list[StageCost], *, started: float) -> list[StageCost]:
    """The same with this process as the only job of evaluate: its table is written after its end.

    `started` is a time of `time.monotonic`.
    """
    used = resource.getrusage(resource.RUSAGE_SELF)
    own = Usage(
        wall_s=time.monotonic() - started,
        cpu_s=used.ru_utime + used.ru_stime,
        peak_mib=used.ru_maxrss / MIB_PER_GIB,  # kibibytes
    )
    return [_together(cost.name, [own]) if cost.name == "evaluate" else cost for cost in costs]


def cost_values(costs: list[StageCost]) -> dict[str, float | None]:
    """The figures `seconds.{stage}` (all jobs) and `peak_memory_gb.{stage}` (largest job)."""
    values: dict[str, float | None] = {}
    for cost in costs:
        values[f"seconds.{cost.name}"] = _rounded(cost.wall_s, 3)
        values[f"peak_memory_gb.{cost.name}"] = _rounded(cost.peak_gib, 4)
    return values


def cost_table(costs: list[StageCost], *, num_images: int) -> Table | None:
    """One line per stage and their sum, also per image; None if nothing was measured."""
    known = [cost for cost in costs if cost.wall_s is not None]
    if not known:
        return None
    with_gpus = any(cost.gpu_s for cost in known)
    total = StageCost(
        "all stages",
        jobs=sum(cost.jobs for cost in known),
        wall_s=_sum(cost.wall_s for cost in known),
        cpu_s=_sum(cost.cpu_s for cost in known),
        sampled_s=sum(cost.sampled_s for cost in known),
        peak_gib=max((cost.peak_gib for cost in known if cost.peak_gib is not None), default=None),
        gpu_s=_sum(cost.gpu_s for cost in known),
    )
    head = ("stage", "jobs", "wall hours", "CPU hours", "mean load", "largest memory (GB)")
    head += ("wall s per image", "CPU s per image") + ("GPU hours",) * with_gpus
    rows = [_row(cost, num_images, with_gpus=with_gpus) for cost in (*costs, total)]
    return Table(head, tuple(rows), text=TEXT, total=True)


def cost_charts(costs: list[StageCost]) -> tuple[Chart, ...]:
    """Time and memory per stage; nothing if nothing was measured."""
    if all(cost.wall_s is None for cost in costs):
        return ()
    total = sum(cost.wall_s for cost in costs if cost.wall_s is not None)
    seconds = {cost.name: cost.wall_s for cost in costs}
    memory = {cost.name: cost.peak_gib for cost in costs}
    return (
        bar_chart(seconds, title=f"Time per stage, {total:,.0f} s in all jobs together", unit="s"),
        bar_chart(memory, title="Largest resident memory of a stage's jobs", unit="GB"),
    )


def _together(name: str, used: list[Usage]) -> StageCost:
    if not used:
        return StageCost(name)
    return StageCost(
        name,
        jobs=len(used),
        wall_s=sum(usage.wall_s for usage in used),
        cpu_s=_sum(usage.cpu_s for usage in used),
        sampled_s=sum(usage.wall_s for usage in used if usage.cpu_s is not None),
        peak_gib=max(
            (usage.peak_mib / MIB_PER_GIB for usage in used if usage.peak_mib is not None),
            default=None,
        ),
        gpu_s=_sum(None if u.gpus is None else u.gpus * u.wall_s for u in used),
    )


def _row(cost: StageCost, num_images: int, *, with_gpus: bool) -> tuple[str, ...]:
    load = cost.cpu_s / cost.sampled_s if cost.cpu_s is not None and cost.sampled_s else None
    shown = [
        _hours(cost.wall_s),
        _hours(cost.cpu_s),
        _shown(load),
        _shown(cost.peak_gib),
        *(_shown(None if s is None else s / num_images) for s in (cost.wall_s, cost.cpu_s)),
    ]
    if with_gpus:
        shown.append(_hours(cost.gpu_s))
    return (cost.name, str(cost.jobs), *shown)


def _hours(seconds: float | None) -> str:
    if seconds is None or seconds >= 36000:
        return _shown(None if seconds is None else seconds / 3600)
    return f"{seconds / 3600:.4f}"


def _shown(value: float | None) -> str:
    return "–" if value is None else human(float(value))


def _sum(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
