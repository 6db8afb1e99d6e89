"""The figures of `metrics.json`: key, unit, meaning, target; and whether a value meets it."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ntop.config.sections import STAGE_SECTIONS
from ntop.report.charts import human
from ntop.storage.atomic import write_bytes

Status = Literal["met", "missed", "none"]


@dataclass(frozen=True)
class Meaning:
    """What a figure says; `at_least` or `at_most` is its target, in its own unit."""

    key: str
    title: str
    unit: str
    text: str
    at_least: float | None = None
    at_most: float | None = None

    @property
    def target(self) -> str:
        """The target in words; empty where there is none."""
        if self.at_least is not None:
            return f"≥ {self.at_least:g} {self.unit}".strip()
        if self.at_most is not None:
            return f"≤ {self.at_most:g} {self.unit}".strip()
        return ""

    def status(self, value: float | None) -> Status:
        """Whether a value meets the target."""
        if value is None or (self.at_least is None and self.at_most is None):
            return "none"
        high_enough = self.at_least is None or value >= self.at_least
        low_enough = self.at_most is None or value <= self.at_most
        return "met" if high_enough and low_enough else "missed"


@dataclass(frozen=True)
class Figure:
    """A meaning with its measured value, ready to be shown."""

    key: str
    title: str
    unit: str
    meaning: str
    target: str
    value: float | None
    shown: str
    status: Status


MEANINGS = (
    Meaning(
        "refine_cameras.before_px", "keypoint error, shipped calibration", "px",
        "Distance between triangulated and detected keypoints with the calibration as it came.",
    ),
    Meaning(
        "refine_cameras.heldout_px", "keypoint error, refined cameras", "px",
        "The same in the held-out camera on frames the refinement did not see.", at_most=6,
    ),
    Meaning(
        "fit.joint_error_mm", "body fit", "mm",
        "Distance of the fitted body's joints from the triangulated ones.",
    ),
    Meaning(
        "fit.mask_iou", "body in mask", "",
        "Overlap of the posed body's silhouette with the masks of the training cameras.",
    ),
    Meaning(
        "heldout.psnr_person_db", "held-out camera, person", "dB",
        "Avatar against the real picture on the person's pixels, no compositing.", at_least=18,
    ),
    Meaning(
        "heldout.psnr_box_db", "held-out camera, box", "dB",
        "The same in the person's tight box, both on grey: silhouette errors count.",
    ),
    Meaning(
        "heldout.ssim_box", "held-out camera, structure", "",
        "Structural similarity in that box; 1 is identical.",
    ),
    Meaning(
        "heldout.mask_iou", "held-out camera, silhouette", "",
        "Overlap of the avatar's mask with the mask checked by hand.", at_least=0.90,
    ),
    Meaning(
        "heldout.baseline_psnr_person_db", "held-out camera, painted body", "dB",
        "The same body painted in its mean part colours: what the avatar must beat.",
    ),
    Meaning(
        "truth.psnr_person_db", "top view, person", "dB",
        "Rendered fisheye image against the studio's ray-cast truth on the person's pixels.",
    ),
    Meaning(
        "truth.psnr_box_db", "top view, box", "dB",
        "The same in the person's tight box, both on grey.", at_least=27,
    ),
    Meaning(
        "truth.mask_iou", "top view, silhouette", "",
        "Overlap of the rendered with the true mask.", at_least=0.98,
    ),
    Meaning(
        "truth.baseline_psnr_box_db", "top view, painted body", "dB",
        "The true body painted in its mean part colours: what texture is worth.", at_most=20,
    ),
    Meaning(
        "truth.visibility_agreement", "keypoint visibility", "",
        "Share of keypoints in view whose visible/occluded flag equals the studio's.",
        at_least=0.98,
    ),
    Meaning(
        "labels.blob_max_px", "labels, end to end", "px",
        "An opaque ball rendered at each joint: distance of its centre from the written keypoint.",
        at_most=0.05,
    ),
    Meaning(
        "labels.reprojection_max_px", "labels, cameras", "px",
        "3D joints projected with the stored cameras against the stored 2D keypoints.",
        at_most=1e-6,
    ),
    Meaning("dataset.images", "images", "", "Rows of the manifest."),
)  # fmt: skip
CHECKS = (
    Meaning(
        "refine_cameras.bone_length_std_mm", "bone lengths", "mm",
        "Largest standard deviation of a triangulated bone's length over the frames.", at_most=15,
    ),
    Meaning(
        "heldout.gain_person_db", "avatar over painted body, held-out", "dB",
        "How much better than the painted body the avatar shows the person.", at_least=2,
    ),
    Meaning(
        "truth.gain_box_db", "avatar over painted body, top view", "dB",
        "The same in the box of the fisheye views with known truth.", at_least=7,
    ),
    Meaning(
        "avatar.converged", "HumanNeRF avatars, converged", "",
        "Share with at least 30,000 iterations; others tell of their time, not of the method.",
        at_least=1,
    ),
    Meaning(
        "checks.images", "images checked", "",
        "What the checks of labels and masks looked at: all, or sets spread evenly over actors "
        "and rigs (evaluate.max_sets). `ntop check` reads every file.",
    ),
    Meaning(
        "checks.coco_self_ap", "COCO files", "",
        "Lowest average precision of an annotation file evaluated against itself.", at_least=1,
    ),
    Meaning(
        "checks.rle_equals_mask", "run-length masks", "",
        "Share of images whose run-length code equals alpha ≥ 128 exactly.", at_least=1,
    ),
    Meaning(
        "checks.visible_on_mask", "visible keypoints", "",
        "Share of keypoints marked visible that lie on the mask.", at_least=0.95,
    ),
)  # fmt: skip
STAGE_NAMES = tuple(STAGE_SECTIONS)
COSTS = (
    *(
        Meaning(f"seconds.{name}", f"time, {name}", "s", f"Sum over all jobs of stage {name}.")
        for name in STAGE_NAMES
    ),
    *(
        Meaning(f"peak_memory_gb.{name}", f"memory, {name}", "GB", f"Largest job of stage {name}.")
        for name in STAGE_NAMES
    ),
)
ALWAYS = tuple(m.key for m in (*MEANINGS, *COSTS))


def complete(values: dict[str, float | None]) -> dict[str, float | None]:
    """All keys that always exist, `None` where there is no value; JSON has no infinity or NaN."""
    found = dict.fromkeys(ALWAYS) | values
    return {
        key: None if value is None or not math.isfinite(value) else value
        for key, value in found.items()
    }


def figures(values: dict[str, float | None]) -> list[Figure]:
    """Every described figure with its value."""
    return [figure(meaning, values.get(meaning.key)) for meaning in (*MEANINGS, *CHECKS, *COSTS)]


def figure(meaning: Meaning, value: float | None) -> Figure:
    """One figure, ready to be shown."""
    return Figure(
        key=meaning.key,
        title=meaning.title,
        unit=meaning.unit,
        meaning=meaning.text,
        target=meaning.target,
        value=value,
        shown="–" if value is None else human(value),
        status=meaning.status(value),
    )


def write_metrics(
    values: dict[str, float | None], *, by_actor: dict[str, dict[str, float | None]], path: Path
) -> None:
    """Write `metrics.json`: a dot in a key is a level; figures per actor lie below `by_actor`."""
    document = _nested(complete(values))
    document["by_actor"] = {actor: _nested(found) for actor, found in by_actor.items()}
    text = json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_bytes(path, text.encode())


def _nested(values: dict[str, float | None]) -> dict[str, Any]:
    groups: dict[str, Any] = {}
    for key, value in values.items():
        group, name = key.split(".", 1)
        groups.setdefault(group, {})[name] = value
    return groups
