"""The whole configuration: the merged YAML, its checks against the tables, and each stage's share.

The Snakefile validates the YAML with `read_config` and hands every stage its own section as JSON
(`stage_section`), so that a stage can be run alone and a changed value reruns exactly that stage
and what follows from it.
"""

from typing import Any

from pydantic import Field, ValidationError

from ntop.config.base import Section, explain
from ntop.config.sections import (
    STAGE_SECTIONS,
    AnnotateConfig,
    EvaluateKeys,
    FitConfig,
    MaskConfig,
    RenderConfig,
    TrainConfig,
)
from ntop.config.sources import Source
from ntop.config.tables import Actor, Sequence
from ntop.conventions import ConfigError


class CaptureKeys(Section):
    """What the YAML may say about `capture`; the workflow adds the rest."""


class AssembleKeys(Section):
    """What the YAML may say about `assemble`; the workflow adds the rest."""


class Config(Section):
    """The whole configuration, as merged from the YAML files."""

    dataset: str = Field(pattern=r"^[a-z0-9_]+$")
    actors: str = Field(description="Path of the actors table (TSV).")
    sequences: str = Field(description="Path of the sequences table (TSV).")
    plan: str = Field(
        default="",
        description="Frozen plan that `ntop plan` made; empty: shards of render.sets_per_shard.",
    )
    sources: dict[str, Source]
    capture: CaptureKeys = CaptureKeys()
    mask: MaskConfig = MaskConfig()
    fit: FitConfig = FitConfig()
    train: TrainConfig = TrainConfig()
    render: RenderConfig
    annotate: AnnotateConfig = AnnotateConfig()
    assemble: AssembleKeys = AssembleKeys()
    evaluate: EvaluateKeys = EvaluateKeys()


def read_config(merged: dict[str, Any]) -> Config:
    """The validated configuration.

    Raises:
        ConfigError: names every wrong key with its place, and the replacement of a retired one.
    """
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        raise ConfigError(explain(error, "configuration")) from error


def check_tables(config: Config, actors: list[Actor], sequences: list[Sequence]) -> None:
    """Refuse tables that contradict each other or the configuration.

    Raises:
        ConfigError: an actor is in two splits or listed twice, a source or actor is unknown,
            two sequences render the same sets, or frames run backwards.
    """
    splits: dict[tuple[str, str], str] = {}
    for actor in actors:
        key = (actor.source, actor.actor)
        if actor.source not in config.sources:
            raise ConfigError(
                f"{config.actors}: source {actor.source!r} of actor {actor.actor!r} is not in "
                f"`sources`, have {sorted(config.sources)}"
            )
        if key in splits:
            raise ConfigError(
                f"{config.actors}: actor {actor.source}/{actor.actor} is listed twice "
                f"(split {splits[key]} and {actor.split}); an actor belongs to one split, so that "
                "nobody is seen in training and in validation: keep one line"
            )
        splits[key] = actor.split
        body_model_of(config, actor)
    seen: set[tuple[str, str, str, str]] = set()
    for row in sequences:
        place = f"{config.sequences}: {row.source}/{row.actor}/{row.action}"
        if (row.source, row.actor) not in splits:
            raise ConfigError(f"{place}: this actor is not in {config.actors}")
        if row.last < row.first:
            raise ConfigError(f"{place}: last frame {row.last} lies before first {row.first}")
        key = (row.source, row.actor, row.action, row.use)
        if key in seen:
            raise ConfigError(f"{place}: two lines with use={row.use}; give one another action")
        seen.add(key)
        if (
            row.use == "render"
            and row.action
            in {
                s.action
                for s in sequences
                if (s.source, s.actor, s.use) == (row.source, row.actor, "train")
            }
            and row.motion
        ):
            raise ConfigError(
                f"{place}: a recorded action cannot also be a motion; choose another action name"
            )
    for source, actor in splits:
        uses = {s.use for s in sequences if (s.source, s.actor) == (source, actor)}
        if uses != {"train", "render"}:
            raise ConfigError(
                f"{config.sequences}: {source}/{actor} has lines for {sorted(uses)}; expected at "
                "least one with use=train and one with use=render"
            )


def body_model_of(config: Config, actor: Actor) -> str:
    """The SMPL file of an actor, empty for the embedded body.

    Raises:
        ConfigError: the source names files, but none for this actor's gender.
    """
    files = getattr(config.sources[actor.source], "body_models", {})
    if files and actor.gender not in files:
        raise ConfigError(
            f"sources.{actor.source}.body_models has no file for gender {actor.gender!r} of actor "
            f"{actor.actor!r}, have {sorted(files)}; add one, or change {config.actors}"
        )
    return files.get(actor.gender, "")


def stage_section(
    config: Config,
    stage: str,
    *,
    source: str | None = None,
    extra: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The values one stage's jobs get: its section, its source's overrides, and `extra`.

    Raises:
        ConfigError: an override names a key the stage does not have.
    """
    values = getattr(config, stage).model_dump(mode="json", exclude_defaults=True)
    kind = STAGE_SECTIONS[stage]
    if source is not None:
        section = config.sources[source]
        given = {"provides": section.provides, "held_out_views": section.held_out_views}
        values |= {key: list(v) for key, v in given.items() if v and key in kind.model_fields}
        values |= section.overrides.get(stage, {})
    values |= extra or {}
    try:
        kind.model_validate(values)
    except ValidationError as error:
        raise ConfigError(explain(error, f"section {stage} of source {source}")) from error
    return values
