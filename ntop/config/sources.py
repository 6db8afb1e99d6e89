"""Where recordings come from: one section per source, chosen by its reader."""

from typing import Annotated, Any, Literal

from pydantic import Field

from ntop.config.base import Section
from ntop.config.tables import Gender

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
    body_models: dict[Gender, str] = Field(
        default_factory=dict,
        description="Gender of the actors table -> SMPL model file (.pkl or .npz) to fit; "
        "empty: the embedded body.",
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
