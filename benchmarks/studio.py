"""The pinned studio capture (config/studio.yaml), made where missing, and scores against it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.environment import ROOT
from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.captures.training_views import Tables, training_views
from ntop.config.run import load_files
from ntop.config.sections import CaptureConfig
from ntop.field.rendering import Rendering
from ntop.field.views import TrainingViews
from ntop.geometry.cameras import Camera
from ntop.metrics.images import Cutout, mask_iou, psnr_box_db, ssim_box, tight_window
from ntop.metrics.lpips import MIN_SIDE_PX, Lpips
from ntop.stages import s1_capture
from ntop.storage import schemas
from ntop.storage.bodies import body_pose_from_rows
from ntop.storage.images import read_depth, read_rgba
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import Row, read_table
from ntop.tools import fetch

SOURCE = "pinned"
CLIPS = "pybullet"
MARGIN_M = 0.05  # of the crops around the body

Show = Callable[[BodyPose, list[Camera]], list[Rendering]]


@dataclass(frozen=True)
class Scores:
    """Means over views from above in poses that no camera recorded; None: not measured."""

    psnr_box_db: float
    ssim_box: float
    mask_iou: float
    depth_error_mm: float | None
    lpips_vgg: float | None


def studio_capture(folder: Path, *, actor: str, packages: Path) -> Path:
    """The capture of one actor below `folder`, with the truth from above."""
    out = folder / actor
    if out.exists():
        return out
    if not (packages / CLIPS).exists():
        fetch.main(CLIPS, packages / CLIPS)
    run = load_files([ROOT / "config/studio.yaml"], directory=ROOT)
    config = CaptureConfig(
        source_section=run.config.sources[SOURCE],
        sequences=tuple(
            row
            for row in run.sequences
            if (row.source, row.actor) == (SOURCE, actor) and (row.use == "train" or row.truth)
        ),
        rigs=run.config.render.rigs,
        image=run.config.render.image,
    )
    s1_capture.main(config, SOURCE, actor, packages=packages, out=out)
    return out


def capture_views(capture: Path, model: BodyModel) -> TrainingViews:
    """What training sees, at full size."""
    names = ("frames", "cameras", "masks", "bodies")
    tables = Tables(*(capture / f"{name}.parquet" for name in names))
    return training_views(tables, model, held_out_views=(), max_person_px=10_000, margin_m=MARGIN_M)


def chosen_rows(
    capture: Path, *, actions: list[str], views: list[str], rigs: int, sets: int
) -> list[Row]:
    """Rows of the truth: of each action the middle `sets` poses, in the first `rigs` rigs.

    No actions: all.
    """
    rows = read_table(capture / "truth/renders.parquet", schema=schemas.RENDER)
    kept_rigs = sorted({row["rig"] for row in rows})[:rigs]
    frames = {
        action: sorted({row["frame"] for row in rows if row["action"] == action})
        for action in {row["action"] for row in rows}
    }
    spare = {action: max(len(found) - sets, 0) // 2 for action, found in frames.items()}
    middle = {a: found[spare[a] : spare[a] + sets] for a, found in frames.items()}
    seen = [row for row in rows if row["rig"] in kept_rigs and row["view"] in views]
    seen = [row for row in seen if row["frame"] in middle[row["action"]]]
    return [row for row in seen if not actions or row["action"] in actions]


def score(capture: Path, rows: list[Row], show: Show, *, lpips: Lpips | None) -> Scores:
    """Mean scores; `show` renders all cameras of one pose."""
    by_set: dict[tuple, list[Row]] = {}
    for row in rows:
        by_set.setdefault((row["action"], row["rig"], row["frame"]), []).append(row)
    found = []
    for group in by_set.values():
        poses = body_pose_from_rows(group[:1])
        pose = BodyPose(poses.betas[0], poses.global_orient[0], poses.body_pose[0], poses.transl[0])
        seen = show(pose, [fisheye_camera(row) for row in group])
        found += [
            _score_view(capture / "truth", row, rendering, lpips)
            for row, rendering in zip(group, seen, strict=True)
        ]
    return Scores(
        **{
            name: float(np.mean(values)) if (values := _known(found, name)) else None
            for name in Scores.__dataclass_fields__
        }
    )


def _known(found: list[Scores], name: str) -> list[float]:
    return [value for scores in found if (value := getattr(scores, name)) is not None]


def _score_view(truth: Path, row: Row, rendering: Rendering, lpips: Lpips | None) -> Scores:
    reference = Cutout.from_rgba(read_rgba(truth / row["image_path"]))
    image = Cutout(rendering.rgb.astype(np.float64), rendering.alpha.astype(np.float64))
    depth_m = read_depth(truth / row["depth_path"])
    both = (depth_m > 0) & (rendering.depth_m > 0)
    errors_m = np.abs(depth_m - rendering.depth_m)[both]
    return Scores(
        psnr_box_db=psnr_box_db(image, reference),
        ssim_box=ssim_box(image, reference),
        mask_iou=mask_iou(image.mask, reference.mask),
        depth_error_mm=float(1000 * np.median(errors_m)) if len(errors_m) else None,
        lpips_vgg=_distance(image, reference, lpips),
    )


def _distance(image: Cutout, reference: Cutout, lpips: Lpips | None) -> float | None:
    """LPIPS of the tight box on grey, enlarged where it is too small for the network."""
    if lpips is None:
        return None
    window = tight_window(reference.mask)
    pair = [window.of(cutout.on_grey()).astype(np.float32) for cutout in (image, reference)]
    scale = MIN_SIDE_PX / min(pair[0].shape[:2])
    if scale > 1:
        pair = [cv2.resize(p, None, fx=1.01 * scale, fy=1.01 * scale) for p in pair]
    device = lpips.shift.device
    first, second = (torch.from_numpy(p)[None].to(device) for p in pair)
    with torch.no_grad():
        return float(lpips(first, second)[0])
