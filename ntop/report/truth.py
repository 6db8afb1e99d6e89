"""The dataset's images against the studio's ray-cast truth of the same sets and views."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from jaxtyping import UInt8

from ntop.body.skinning import BodyPose
from ntop.conventions import MASK_ALPHA
from ntop.geometry.cameras import Camera
from ntop.metrics.images import Cutout, tight_window
from ntop.report.capture import pose_of
from ntop.report.gallery import DIRECTIONS
from ntop.report.inputs import ActorFolders, Dataset
from ntop.report.page import Comparison
from ntop.report.pictures import Picture, error_colours, picture, square_around
from ntop.report.scores import ImageScores, best_median_worst, mean_scores, score_image, score_table
from ntop.storage import schemas
from ntop.storage.images import read_rgba
from ntop.storage.pace import paced
from ntop.storage.renders import fisheye_camera, set_key
from ntop.storage.tables import Row, read_table

PICTURE_MARGIN = 0.08

# the same posed body painted in its mean part colours, seen by a camera
Painter = Callable[[BodyPose, Camera], Cutout]


@dataclass(frozen=True)
class TruthScores:
    """Scores of one actor's views, in the order of `rows` (manifest rows)."""

    rows: tuple[Row, ...]
    scores: tuple[ImageScores, ...]
    visibility_agreement: float | None


def truth_rows(actor: ActorFolders) -> dict[str, Row]:
    """The truth's render rows by sample id; none where the source knows no truth."""
    path = actor.capture / "truth" / "renders.parquet"
    if not path.is_file():
        return {}
    return {row["sample_id"]: row for row in read_table(path, schema=schemas.RENDER)}


def score_truth(dataset: Dataset, actor: ActorFolders, *, paint: Painter) -> TruthScores | None:
    """Compare every image of which the truth is known; None if there is none.

    An image whose true view shows nobody is left out: there is no box to judge.
    """
    truth = truth_rows(actor)
    rows, scores = [], []
    known = list(dataset.rows_with(truth)) if truth else []
    what = f"evaluate: truth of {actor.name}"
    for row in paced(known, what=what, total=len(known), unit="images"):
        true_row = truth[row["sample_id"]]
        true_rgba, rgba = _true_image(actor, true_row), read_rgba(dataset.image_path(row))
        if not (true_rgba[..., 3] >= MASK_ALPHA).any():
            continue
        # the truth's camera and pose: the baseline must not profit from an error of ours
        painted = paint(pose_of(true_row), fisheye_camera(true_row))
        window = tight_window((true_rgba[..., 3] > 0) | (rgba[..., 3] > 0))
        image, reference = (Cutout.from_rgba(window.of(x)) for x in (rgba, true_rgba))
        rows.append(row)
        scores.append(score_image(image, reference, baseline=painted.within(window)))
    if not rows:
        return None
    return TruthScores(tuple(rows), tuple(scores), _visibility_agreement(actor, rows))


def truth_values(scores: TruthScores) -> dict[str, float | None]:
    """The figures `truth.*`."""
    mean = mean_scores(list(scores.scores))
    return {
        "truth.psnr_person_db": mean.psnr_person_db,
        "truth.psnr_box_db": mean.psnr_box_db,
        "truth.ssim_box": mean.ssim_box,
        "truth.mask_iou": mean.mask_iou,
        "truth.baseline_psnr_box_db": mean.baseline_psnr_box_db,
        "truth.gain_box_db": mean.psnr_box_db - mean.baseline_psnr_box_db,
        "truth.visibility_agreement": scores.visibility_agreement,
    }


def truth_comparison(
    dataset: Dataset, actor: ActorFolders, scores: TruthScores, *, paint: Painter
) -> Comparison:
    """Best, median and worst view beside their truth."""
    truth = truth_rows(actor)
    lines = []
    for name, index in best_median_worst(list(scores.scores)).items():
        row = scores.rows[index]
        true_row = truth[row["sample_id"]]
        painted = paint(pose_of(true_row), fisheye_camera(true_row))
        lines.append(
            compared(
                image=read_rgba(dataset.image_path(row)),
                reference=_true_image(actor, true_row),
                baseline=stored(painted),
                scores=scores.scores[index],
                names=(
                    f"{name} of {len(scores.rows)}: true {DIRECTIONS[row['view']]} view, "
                    f"{row['action']} frame {row['frame']}, rig {row['rig']}",
                    "rendered avatar",
                    "painted body",
                ),
            )
        )
    groups: dict[str, list[ImageScores]] = {}
    for row, score in zip(scores.rows, scores.scores, strict=True):
        groups.setdefault(f"{row['rig']} · {row['action']}", []).append(score)
    text = (
        f"For {actor.name} the studio knows what every fisheye camera would see: the clothed body "
        "is ray-cast from above in poses the training never saw. The painted body is the same body "
        "in its mean colour per part: what texture and clothes must beat."
    )
    return Comparison(text, tuple(lines), score_table(groups, first="rig · action"))


def compared(
    *,
    image: UInt8[np.ndarray, "height width 4"],
    reference: UInt8[np.ndarray, "height width 4"],
    baseline: UInt8[np.ndarray, "height width 4"],
    scores: ImageScores,
    names: tuple[str, str, str],
) -> tuple[Picture, ...]:
    """Reference, image, baseline and the image's error, cut to the person and put on grey."""
    everything = [Cutout.from_rgba(x) for x in (reference, image, baseline)]
    window = square_around(everything[0].mask | everything[1].mask, margin=PICTURE_MARGIN)
    flat = [np.rint(window.of(c.on_grey() - 127 / 255) * 255 + 127) for c in everything]
    true, ours, painted = (f.clip(0, 255).astype(np.uint8) for f in flat)
    place, ours_name, painted_name = names
    return (
        picture(true, alt=f"reference, {place}", caption=place[0].upper() + place[1:]),
        picture(
            ours,
            alt=f"{ours_name}, {scores.psnr_box_db:.1f} dB",
            caption=f"{ours_name[0].upper() + ours_name[1:]}: {scores.psnr_box_db:.1f} dB in the "
            f"box, mask IoU {scores.mask_iou:.3f}",
        ),
        picture(
            painted,
            alt=f"{painted_name}, {scores.baseline_psnr_box_db:.1f} dB",
            caption=f"{painted_name[0].upper() + painted_name[1:]}: "
            f"{scores.baseline_psnr_box_db:.1f} dB in the box",
        ),
        picture(
            error_colours(ours, true),
            alt="error of the rendered avatar in false colours, black is equal",
            caption="Error: of the rendered avatar",
        ),
    )


def stored(cutout: Cutout) -> UInt8[np.ndarray, "height width 4"]:
    """A cut-out as an 8-bit RGBA image."""
    rgba = np.dstack([cutout.rgb, cutout.alpha])
    return np.rint(np.clip(rgba, 0, 1) * 255).astype(np.uint8)


def _true_image(actor: ActorFolders, row: Row) -> UInt8[np.ndarray, "height width 4"]:
    return read_rgba(actor.capture / "truth" / row["image_path"])


def _visibility_agreement(actor: ActorFolders, rows: list[Row]) -> float | None:
    """Share of keypoints in view (of the truth) with the same flag, both skeletons together."""
    path: Path = actor.capture / "truth" / "visibility.parquet"
    if not path.is_file():
        return None
    table = pq.read_table(path).to_pylist()
    truth = {set_key(row).sample_id(row["view"]): row for row in table}
    equal = total = 0
    for row in rows:
        for person in row["persons"]:
            for name in ("visibility_coco17", "visibility_smpl24"):
                true, ours = np.array(truth[row["sample_id"]][name]), np.array(person[name])
                equal += int((true == ours)[true > 0].sum())
                total += int((true > 0).sum())
    return equal / total if total else None
