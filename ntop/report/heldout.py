"""The avatar against a real camera it never saw, on frames whose masks were checked by hand."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

from ntop.body.skinning import BodyPose
from ntop.geometry.cameras import Camera
from ntop.metrics.images import Cutout, tight_window
from ntop.report.capture import FrameKey, Recording
from ntop.report.page import Comparison
from ntop.report.scores import ImageScores, best_median_worst, mean_scores, score_image, score_table
from ntop.report.truth import Painter, compared, stored
from ntop.storage.pace import paced

Renderer = Callable[[BodyPose, Camera], Cutout]  # the avatar in a pose, seen by a camera
ReferenceMasks = dict[FrameKey, Bool[np.ndarray, "height width"]]


@dataclass(frozen=True)
class Compared:
    """One frame as 8-bit cut-outs in one window; kept, because rendering takes seconds."""

    image: UInt8[np.ndarray, "height width 4"]
    reference: UInt8[np.ndarray, "height width 4"]
    baseline: UInt8[np.ndarray, "height width 4"]


@dataclass(frozen=True)
class HeldoutScores:
    """Scores and pictures per frame of a held-out camera, in key order."""

    keys: tuple[FrameKey, ...]
    scores: tuple[ImageScores, ...]
    pictures: tuple[Compared, ...]


def score_heldout(
    recording: Recording, references: ReferenceMasks, *, render: Renderer, paint: Painter
) -> HeldoutScores | None:
    """Score every reference mask's frame that has a picture and a body; None if there is none."""
    keys = sorted(
        key for key in references if key in recording.frames and key[:2] in recording.bodies
    )
    if not keys:
        return None
    photos = recording.pictures(keys)
    scores, pictures = [], []
    what = f"evaluate: held-out camera of {recording.folders.name}"
    for key in paced(keys, what=what, total=len(keys), unit="frames"):
        action, frame, view = key
        pose, camera = recording.pose((action, frame)), recording.cameras[action, view]
        image, baseline = render(pose, camera), paint(pose, camera)
        reference = Cutout.from_rgba(_cut_out(photos[key], references[key]))
        scores.append(score_image(image, reference, baseline=baseline))
        window = tight_window((image.alpha > 0) | reference.mask | (baseline.alpha > 0))
        pictures.append(Compared(*(stored(c.within(window)) for c in (image, reference, baseline))))
    return HeldoutScores(tuple(keys), tuple(scores), tuple(pictures))


def heldout_values(scores: HeldoutScores) -> dict[str, float | None]:
    """The figures `heldout.*`."""
    mean = mean_scores(list(scores.scores))
    return {
        "heldout.psnr_person_db": mean.psnr_person_db,
        "heldout.psnr_box_db": mean.psnr_box_db,
        "heldout.ssim_box": mean.ssim_box,
        "heldout.mask_iou": mean.mask_iou,
        "heldout.baseline_psnr_person_db": mean.baseline_psnr_person_db,
        "heldout.gain_person_db": mean.psnr_person_db - mean.baseline_psnr_person_db,
    }


def heldout_comparison(recording: Recording, scores: HeldoutScores) -> Comparison:
    """Best, median and worst frame beside the real picture."""
    lines = []
    for name, index in best_median_worst(list(scores.scores)).items():
        action, frame, view = scores.keys[index]
        shown = scores.pictures[index]
        lines.append(
            compared(
                image=shown.image,
                reference=shown.reference,
                baseline=shown.baseline,
                scores=scores.scores[index],
                names=(
                    f"{name} of {len(scores.keys)}: real picture, {view}, {action} frame {frame}",
                    "avatar",
                    "painted body",
                ),
            )
        )
    groups = {
        f"{view} · {action} {frame}": [score]
        for (action, frame, view), score in zip(scores.keys, scores.scores, strict=True)
    }
    views = " and ".join(sorted({key[2] for key in scores.keys}))
    text = (
        f"{views} of {recording.folders.name} was kept from training: no mask, pixel or colour of "
        "it was used; only its position was refined, on other frames. The real picture is cut out "
        "with a mask checked by hand. The painted body is the same body in its mean colour per "
        "part."
    )
    return Comparison(text, tuple(lines), score_table(groups, first="frame"))


def _cut_out(
    image: UInt8[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 4"]:
    return np.dstack([image, np.where(mask, 255, 0).astype(np.uint8)])
