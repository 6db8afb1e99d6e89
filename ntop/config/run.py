"""Everything a run is told, loaded and checked together: configuration, tables, frozen plan."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ntop.config.files import read_files
from ntop.config.frozen import check_plan, read_plan
from ntop.config.tables import Actor, Sequence, read_tsv
from ntop.config.whole import Config, check_tables, read_config

BASE = "config/config.yaml"  # the workflow's own `configfile:`


@dataclass(frozen=True)
class Run:
    """A checked configuration with its tables; a frozen plan's shard size is already in it."""

    config: Config
    actors: list[Actor]
    sequences: list[Sequence]


def load_run(merged: dict[str, Any], *, directory: Path = Path(), frozen: bool = True) -> Run:
    """The run of a merged configuration; paths of tables and plan start at `directory`.

    `frozen=False` leaves the plan aside, for whoever makes one.

    Raises:
        ConfigError: configuration, tables or plan cannot be used, or contradict each other.
    """
    config = read_config(merged)
    actors = read_tsv(directory / config.actors, Actor)
    sequences = read_tsv(directory / config.sequences, Sequence)
    check_tables(config, actors, sequences)
    if config.plan and frozen:
        plan = read_plan(directory / config.plan)
        check_plan(plan, config, sequences)
        size = {"sets_per_shard": plan.sets_per_shard}
        config = config.model_copy(update={"render": config.render.model_copy(update=size)})
    return Run(config, actors, sequences)


def load_files(configfiles: list[Path], *, directory: Path = Path(), frozen: bool = True) -> Run:
    """The run as Snakemake would load it with these `--configfile`s in `directory`."""
    base = directory / BASE
    # as in Snakemake, files given by hand may replace a base that is not there
    paths = [base, *configfiles] if base.exists() or not configfiles else configfiles
    return load_run(read_files(paths), directory=directory, frozen=frozen)
