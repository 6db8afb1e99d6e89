"""What a run is about: one frozen section per stage, unknown keys are errors, units in the names.

The sections hold science only (what, never how): threads, memory and folders belong to profiles and
rules. The Snakefile validates the merged YAML with `read_config` and hands every stage its own
section as JSON (`stage_section`), so that a stage can be run alone and a changed value reruns
exactly that stage and what follows from it.
"""

import csv
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ntop.conventions import ConfigError

# keys of earlier versions -> what to write instead
RETIRED_KEYS = {
    "heights_above_pelvis_m": "use render.rigs.<name>.height_above_pelvis_m",
    "frame_step": "use the column `step` of the sequences table",
    "splits": "use the column `split` of the actors table",
}


class Section(BaseModel):
    """Base of all sections: frozen, and a misspelt key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Sequence(Section):
    """One row of the sequences table: a run of frames of one actor, and what it is used for."""

    source: str
    actor: str
    action: str
    first: int = Field(ge=0, description="First frame, 0-based.")
    last: int = Field(ge=0, description="Last frame, included.")
    step: int = Field(default=1, ge=1)
    use: Literal["train", "render"]
    motion: str = Field(
        default="",
        description="Empty: the recorded poses of `action`. Else `authored:<name>` or "
        "`deepmimic:<name>`, sampled at 30 frames per second.",
    )
    truth: bool = Field(
        default=False, description="Studio only: ray-cast the true fisheye views of these sets."
    )

    @property
    def frames(self) -> range:
        """The frames of the sequence."""
        return range(self.first, self.last + 1, self.step)


class Actor(Section):
    """One row of the actors table."""

    source: str
    actor: str
    split: Literal["train", "val"]
    gender: Literal["f", "m", "n"] = "n"


Given = Literal["masks", "keypoints2d", "bodies"]


class ReferenceMasks(Section):
    """Hand-checked masks of one camera in one action, for evaluation only."""

    action: str
    view: str
    path: str = Field(description="Polygon file (ntop.masks.polygons).")


class SourceSection(Section):
    """What every source declares, whatever its reader."""

    provides: tuple[Given, ...] = Field(
        default=(), description="What comes with the source, so that no stage computes it."
    )
    held_out_views: tuple[str, ...] = Field(
        default=(), description="Cameras of which no pixel or mask reaches training."
    )
    reference_masks: tuple[ReferenceMasks, ...] = ()
    overrides: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="Stage section values that differ for this source."
    )


class QualisysTrial(Section):
    """One trial of a Qualisys recording."""

    videos: str = Field(description="Folder of the trial's videos, below the package folder.")


class QualisysSource(SourceSection):
    """A recording calibrated with Qualisys Track Manager, shipped in a published package."""

    reader: Literal["qualisys"]
    package: str
    calibration: str = Field(description="Path of the .qca.txt file below the package folder.")
    views: tuple[str, ...]
    trials: dict[str, QualisysTrial] = Field(description="Action -> trial.")
    letterbox_sizes_px: tuple[tuple[int, int], ...] = Field(
        default=(),
        description="Video sizes (width, height) known to be letter-boxed copies of the "
        "calibrated image: scaled to fit, centred between bars.",
    )
    pose2sim_compat: bool = Field(
        default=False, description="Divide the distortion by 64, as Pose2Sim does."
    )


class StudioSource(SourceSection):
    """A synthetic capture with known truth."""

    reader: Literal["studio"]
    num_cameras: int = Field(default=8, ge=2, description="Side cameras on the ring.")
    image_size_px: int = Field(default=512, ge=32, description="Side of their square images.")
    camera_radius_m: float = Field(default=2.7, gt=1, lt=4, description="Radius of the ring.")
    supersampling: int = Field(
        default=3, ge=1, description="Rays per pixel and axis on outlines of the side views."
    )
    truth_supersampling: int = Field(
        default=4, ge=1, description="Rays per pixel and axis on outlines of the true top views."
    )
    seed: int = Field(default=0, description="Of all noise below.")
    light_to_ambient: float = Field(
        default=3.5, ge=0, description="Strength of the distant light over that of the ambient."
    )
    pose_noise_mm: float = Field(
        default=0.0, ge=0, description="Standard deviation of the given bodies' errors."
    )
    calibration_noise_px: float = Field(
        default=0.0, ge=0, description="Standard deviation of the given cameras' errors."
    )
    mask_growth_px: int = Field(default=0, description="Dilation (>0) or erosion (<0) of masks.")
    keypoint_noise_px: float = Field(
        default=0.0, ge=0, description="Standard deviation of the given 2D keypoints' errors."
    )


Source = Annotated[QualisysSource | StudioSource, Field(discriminator="reader")]


class RigConfig(Section):
    """One setting of the nine-camera rig (paper section 3.2)."""

    height_above_pelvis_m: float = Field(gt=0)
    ring_radius_m: float = Field(ge=0)


class ImageConfig(Section):
    """Size and lens of the virtual fisheye images."""

    width_px: int = Field(default=1000, ge=16)
    height_px: int = Field(default=1000, ge=16)
    focal_px: float | None = Field(
        default=None, gt=0, description="Pixels per radian; default min(width, height) / pi."
    )
    max_theta_deg: float = Field(default=90.0, gt=0, lt=180)


class CaptureConfig(Section):
    """Section `capture`, completed by the workflow with the actor's source and sequences."""

    source_section: Source
    sequences: tuple[Sequence, ...]
    rigs: dict[str, RigConfig] = Field(default_factory=dict, description="For studio truth.")
    image: ImageConfig = ImageConfig()


class MaskConfig(Section):
    """Section `mask`."""

    method: Literal["mediapipe", "background"] = "mediapipe"
    provides: tuple[Given, ...] = ()
    overrides: str = Field(
        default="",
        description="Folder of hand-corrected mattes `{action}/{view}/{frame:06d}.png`; "
        "empty: none.",
    )
    detector: str = Field(
        default="mediapipe/pose_detection/pose_detection.tflite",
        description="Pose detector, below the package folder.",
    )
    landmarks: str = Field(
        default="mediapipe/pose_landmark/pose_landmark_full.tflite",
        description="Pose landmark network, below the package folder; the heavy one fits as well.",
    )


class FitConfig(Section):
    """Section `fit`."""

    held_out_views: tuple[str, ...] = ()
    refine_cameras: bool = Field(
        default=True, description="Refine the extrinsics on the limbs' keypoints."
    )
    prior_weight: float = Field(
        default=30.0, ge=0, description="Pixels per radian and metre that a camera moves."
    )
    loss_scale_px: float = Field(default=4.0, gt=0, description="Beyond, the loss is linear.")
    outlier_px: float = Field(
        default=25.0, gt=0, description="A camera that misses a point by more is left out."
    )
    min_confidence: float = Field(default=0.3, ge=0, le=1, description="Of a keypoint to count.")
    landmark_spread_px: float = Field(default=6.0, gt=0, description="The detector's noise.")
    silhouettes: bool = Field(
        default=True, description="Fit the mattes' borders as well; not for loose garments."
    )


class TrainConfig(Section):
    """Section `train`."""

    held_out_views: tuple[str, ...] = ()
    steps: int = Field(default=800, ge=1)
    rays_per_batch: int = Field(default=8192, ge=64)
    finest_voxel_mm: float = Field(default=5.0, gt=0, description="Cells of the finest level.")
    reach_m: float = Field(
        default=0.05, gt=0, description="How far off the body clothes and hair may be."
    )
    sharpness: float = Field(
        default=16.0,
        ge=1,
        description="How many times harder the surface ends than it began; "
        "lower it where poses are measured, not given.",
    )
    warp_cell_mm: float = Field(
        default=12.0,
        gt=0,
        description="Cells of the poses' warp grids: memory falls with its cube.",
    )
    density_smoothness: float = Field(
        default=3e-5,
        ge=0,
        description="Pull between neighbouring cells' densities; raise it "
        "where masks and poses are measured, not given.",
    )
    colour_smoothness: float = Field(default=2e-4, ge=0, description="The same for colours.")
    entropy_weight: float = Field(
        default=0.02, ge=0, description="Pushes rays towards opaque or empty."
    )
    matte_weight: float = Field(
        default=1.0, ge=0, description="How much the matte counts beside the colours."
    )
    matte_edge_weight: float = Field(
        default=0.5, ge=0, description="How much it counts along the person's outline."
    )
    body_weight: float = Field(
        default=0.0,
        ge=0,
        description="Pull of density towards the body's own surface: what few "
        "rays see stays the body.",
    )
    camera_colour: bool = Field(
        default=False, description="Learn a gain and bias per camera, for real captures."
    )
    max_person_px: int = Field(
        default=480, ge=16, description="Pictures with a taller person are shrunk first."
    )
    seed: int = 0


class RenderConfig(Section):
    """Section `render`."""

    rigs: dict[str, RigConfig]
    image: ImageConfig = ImageConfig()
    sets_per_shard: int = Field(default=10, ge=1)
    seed: int = 0
    paper_compat: bool = False


class AnnotateConfig(Section):
    """Section `annotate`."""


class AssembleConfig(Section):
    """Section `assemble`, completed by the workflow with the actors and their splits."""

    dataset: str
    actors: tuple[Actor, ...]


class EvaluateConfig(Section):
    """Section `evaluate`, completed by the workflow with what the sources hold out."""

    held_out_views: dict[str, tuple[str, ...]] = Field(
        default_factory=dict, description="Source -> cameras that training never saw."
    )
    reference_masks: dict[str, tuple[ReferenceMasks, ...]] = Field(
        default_factory=dict, description="Source -> hand-checked masks of those cameras."
    )


STAGE_SECTIONS: dict[str, type[Section]] = {
    "capture": CaptureConfig,
    "mask": MaskConfig,
    "fit": FitConfig,
    "train": TrainConfig,
    "render": RenderConfig,
    "annotate": AnnotateConfig,
    "assemble": AssembleConfig,
    "evaluate": EvaluateConfig,
}


class CaptureKeys(Section):
    """What the YAML may say about `capture`; the workflow adds the rest."""


class AssembleKeys(Section):
    """What the YAML may say about `assemble`; the workflow adds the rest."""


class EvaluateKeys(Section):
    """What the YAML may say about `evaluate`; the workflow adds the rest."""


class Config(Section):
    """The whole configuration, as merged from the YAML files."""

    dataset: str = Field(pattern=r"^[a-z0-9_]+$")
    actors: str = Field(description="Path of the actors table (TSV).")
    sequences: str = Field(description="Path of the sequences table (TSV).")
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


def explain(error: ValidationError, what: str) -> str:
    """A validation error in words: where, got, expected, remedy."""
    lines = [f"the {what} is not usable:"]
    for item in error.errors():
        place = ".".join(str(part) for part in item["loc"])
        key = str(item["loc"][-1]) if item["loc"] else ""
        if item["type"] == "extra_forbidden":
            hint = RETIRED_KEYS.get(key, "check the spelling; config/README.md lists all keys")
            lines.append(f"  {place}: unknown key; {hint}")
        else:
            lines.append(f"  {place}: {item['msg']}, got {item.get('input')!r}")
    return "\n".join(lines)


def read_tsv(path: Path, kind: type[Section]) -> list[Any]:
    """Rows of a tab-separated table as sections; `-` or an empty cell means the default.

    Raises:
        ConfigError: the file is missing, or a row is not usable.
    """
    try:
        with path.open(newline="") as stream:
            rows = list(csv.DictReader(stream, delimiter="\t"))
    except OSError as error:
        raise ConfigError(f"cannot read table {path}: {error.strerror}") from error
    sections = []
    for number, row in enumerate(rows, start=2):
        given = {key: cell for key, cell in row.items() if cell not in {"", "-", None}}
        try:
            sections.append(kind.model_validate(given))
        except ValidationError as error:
            raise ConfigError(explain(error, f"table {path} line {number}")) from error
    return sections


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
