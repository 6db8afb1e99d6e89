"""The avatar against a real camera it never saw, on frames whose masks were checked by hand."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

from ntop.body.skinning import BodyPose
from ntop.geometry.cameras import Camera
from ntop.metrics.images import Cutout
from ntop.report.capture import FrameKey, Recording
from ntop.report.page import Comparison
from ntop.report.scores import ImageScores, best_median_worst, mean_scores, score_image, score_table
from ntop.report.truth import Painter, compared, stored

Renderer = Callable[[BodyPose, Camera], Cutout]  # the avatar in a pose, seen by a camera
ReferenceMasks = dict[FrameKey, Bool[np.ndarray, "height width"]]


@dataclass(frozen=True)
class HeldoutScores:
    """Scores per frame of a held-out camera, in key order."""

    keys: tuple[FrameKey, ...]
    scores: tuple[ImageScores, ...]


def score_heldout(
    recording: Recording, references: ReferenceMasks, *, render: Renderer, paint: Painter
) -> HeldoutScores | None:
    """Score every reference mask's frame that has a picture and a body; None if there is none."""
    keys = sorted(
        key for key in references if key in recording.frames and key[:2] in recording.bodies
    )
    if not keys:
        return None
    pictures = recording.pictures(keys)
    scores = []
    for key in keys:
        pose, camera = _seen(recording, key)
        scores.append(
            score_image(
                render(pose, camera),
                Cutout.from_rgba(_cut_out(pictures[key], references[key])),
                baseline=paint(pose, camera),
            )
        )
    return HeldoutScores(tuple(keys), tuple(scores))


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


def heldout_comparison(
    recording: Recording,
    scores: HeldoutScores,
    *,
    references: ReferenceMasks,
    render: Renderer,
    paint: Painter,
) -> Comparison:
    """Best, median and worst frame beside the real picture."""
    lines = []
    for name, index in best_median_worst(list(scores.scores)).items():
        key = scores.keys[index]
        pose, camera = _seen(recording, key)
        action, frame, view = key
        lines.append(
            compared(
                image=stored(render(pose, camera)),
                reference=_cut_out(recording.picture(key), references[key]),
                baseline=stored(paint(pose, camera)),
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


def _seen(recording: Recording, key: FrameKey) -> tuple[BodyPose, Camera]:
    action, frame, view = key
    return recording.pose((action, frame)), recording.cameras[action, view]


def _cut_out(
    image: UInt8[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 4"]:
    return np.dstack([image, np.where(mask, 255, 0).astype(np.uint8)])
