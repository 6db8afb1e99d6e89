"""The frozen plan of a campaign: what was cut into which shards, decided once.

Its size of shards holds for the whole campaign, so that a shard keeps its name and its sets while
actors are added; a sequence that changed behind the plan's back is an error, not a new shard.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from ntop.config.base import Section, explain
from ntop.config.tables import Sequence
from ntop.config.whole import Config
from ntop.conventions import ConfigError


class Estimate(Section):
    """What the campaign will take; hours are those of its jobs, one after the other."""

    images: int
    sets: int
    jobs: int
    hours: float
    gpu_hours: float = Field(description="Of jobs that ask for GPUs, times how many they ask for.")
    gigabytes: float
    minutes_per_job: float = Field(description="Of the longest render job.")
    basis: str = Field(description="Where pace and sizes come from.")


class FrozenPlan(Section):
    """The file that `ntop plan` writes and the Snakefile reads."""

    format: Literal[1] = 1
    dataset: str
    sets_per_shard: int = Field(ge=1)
    rigs: tuple[str, ...]
    runs: dict[str, str] = Field(description="source/actor/action -> frames and motion.")
    estimate: Estimate


def described_runs(sequences: Iterable[Sequence]) -> dict[str, str]:
    """The render sequences, each as the words that its shards depend on."""
    return {
        f"{row.source}/{row.actor}/{row.action}": (
            f"{row.first}-{row.last} step {row.step}" + (f" {row.motion}" if row.motion else "")
        )
        for row in sequences
        if row.use == "render"
    }


def read_plan(path: Path) -> FrozenPlan:
    """The plan of a file.

    Raises:
        ConfigError: it is missing, damaged or of another format.
    """
    try:
        return FrozenPlan.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ConfigError(
            f"cannot read plan {path}: {error.strerror}; make it: ntop plan --out {path}"
        ) from error
    except ValidationError as error:
        raise ConfigError(explain(error, f"plan {path}")) from error


def check_plan(plan: FrozenPlan, config: Config, sequences: Iterable[Sequence]) -> None:
    """Refuse tables that ask for other sets than the plan has.

    Raises:
        ConfigError: names the sequences and rigs that differ.
    """
    runs = described_runs(sequences)
    new = sorted(runs.keys() - plan.runs.keys())
    lines = [f"  {key}: not in the plan" for key in new]
    lines += changed_runs(plan, runs)
    lines += [
        f"  rig {name}: not in the plan" for name in config.render.rigs if name not in plan.rigs
    ]
    if lines:
        raise ConfigError(
            f"{config.sequences} asks for other sets than the frozen plan {config.plan}:\n"
            + "\n".join(lines)
            + "\nrun `ntop plan` again: additions keep all shards, changes need --refreeze"
        )


def changed_runs(plan: FrozenPlan, runs: dict[str, str]) -> list[str]:
    """Lines about the sequences whose frames or motion differ from the plan's."""
    return [
        f"  {key}: {runs[key]}, planned {plan.runs[key]}"
        for key in sorted(runs.keys() & plan.runs.keys())
        if runs[key] != plan.runs[key]
    ]
