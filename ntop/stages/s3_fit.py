"""Stage 3, fit: keypoints and mattes -> refined cameras, one body shape, one pose per frame.

| written below `out` | what |
|---|---|
| `cameras.parquet` (schema CAMERA) | every (action, view), extrinsics refined |
| `bodies.parquet` (schema BODY) | one row per frame; `reason` says why a body is not usable |
| `scores.json` | calibration and fit errors in px and mm, bone lengths, mask IoU |

Held-out cameras: their keypoints serve nothing but their own extrinsics, on even frames; their
mattes are not read.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import torch

from ntop.body.fitting.actor import ActorFit, fit_actor, num_descents
from ntop.body.fitting.contours import View, matte_border
from ntop.body.fitting.quality import (
    body_height_m,
    check_upright,
    frame_reasons,
)
from ntop.body.fitting.recordings import Recording, landmark_rays
from ntop.body.fitting.rig import place_on_bodies, refine_recordings
from ntop.body.fitting.silhouettes import share_inside, silhouette_iou
from ntop.body.fitting.solver import FitSettings
from ntop.body.landmarks import landmarks_on
from ntop.body.model import BodyModel, load_body_model
from ntop.body.skinning import BodyPose
from ntop.config.sections import FitConfig
from ntop.conventions import DataError
from ntop.geometry.calibration import RefinementSettings
from ntop.stages import VERSIONS
from ntop.storage import schemas
from ntop.storage.atomic import publish_folder, write_bytes
from ntop.storage.bodies import body_rows
from ntop.storage.cameras import write_cameras
from ntop.storage.files import check_files, record_files
from ntop.storage.images import read_matte
from ntop.storage.pace import Pace
from ntop.storage.provenance import file_sha256, provenance, write_provenance
from ntop.storage.recordings import read_recordings
from ntop.storage.tables import read_table, write_table

STAGE = "fit"
IOU_EVERY = 5  # frames: outlines are slow to draw
JOINT_MARGIN_PX = 10  # mattes end a few pixels inside hands and feet

MattePaths = dict[tuple[str, int, str], Path]


def main(config: FitConfig, capture: Path, keypoints: Path, masks: Path, out: Path) -> None:
    """Fit one actor; `out` appears by one rename, whole and checked.

    `keypoints` and `masks` are tables; each lies with the capture or with the mask stage.

    Raises:
        DataError: keypoints, cameras and frames do not fit together, or the result cannot be a
            person.
    """
    torch.set_num_threads(1)  # sums in one order: the same bytes whatever the machine
    check_files(capture, keypoints.parent, masks.parent)
    inputs = {
        "frames": capture / "frames.parquet",
        "cameras": capture / "cameras.parquet",
        "keypoints2d": keypoints,
    }
    recordings = read_recordings(**inputs)
    model = load_body_model(config.body_path)
    landmarks = landmarks_on(model, recordings[0].skeleton)
    scores: dict[str, Any] = {}
    refinement = RefinementSettings(config.prior_weight, config.loss_scale_px, config.outlier_px)
    if config.refine_cameras:
        recordings, scores = refine_recordings(
            recordings,
            landmarks,
            held_out_views=config.held_out_views,
            min_confidence=config.min_confidence,
            settings=refinement,
        )
    training = [recording.without_views(config.held_out_views) for recording in recordings]
    mattes = _matte_paths(masks, held_out_views=config.held_out_views)
    views = _views(training, mattes) if config.silhouettes else []
    pace = Pace("fit", total=num_descents(with_views=bool(views)), unit="steps")
    fit = fit_actor(
        model,
        landmarks,
        landmark_rays(training, landmarks, min_confidence=config.min_confidence),
        views,
        frames=[(r.action, frame) for r in recordings for frame in r.frames],
        outlier_px=config.outlier_px,
        settings=FitSettings(landmark_px=config.landmark_spread_px),
        on_descent=pace.step,
    )
    if config.refine_cameras:
        recordings = place_on_bodies(
            recordings,
            fit.points_world.detach(),
            landmarks,
            views=config.held_out_views,
            min_confidence=config.min_confidence,
            settings=refinement,
        )
    check_upright(fit.joints_world, f"{recordings[0].source}/{recordings[0].actor}")
    distance = (fit.points_world - fit.found.points_world).norm(dim=-1)[fit.found.valid]
    scores |= {
        "fit.height_m": body_height_m(model, fit.pose.betas[0].float()),
        "fit.joint_error_mm": 1000 * float(distance.median()),
        **_mask_scores(model, fit, training, mattes),
    }
    _publish(config, recordings, fit, scores=scores, inputs=inputs, out=out)


def _matte_paths(table: Path, *, held_out_views: tuple[str, ...]) -> MattePaths:
    """Files of usable mattes by (action, frame, view), held-out views left out."""
    return {
        (row["action"], row["frame"], row["view"]): table.parent / row["mask_path"]
        for row in read_table(table, schema=schemas.MASK)
        if not row["reason"] and row["view"] not in held_out_views
    }


def _views(recordings: list[Recording], mattes: MattePaths) -> list[View]:
    """Matte borders of all frames and views; the frame index runs over all recordings."""
    views, first = [], 0
    for recording in recordings:
        for i, frame in enumerate(recording.frames):
            for view, camera in zip(recording.views, recording.cameras, strict=True):
                path = mattes.get((recording.action, frame, view))
                if path is not None:
                    views.append(View(first + i, camera, matte_border(read_matte(path))))
        first += len(recording.frames)
    return views


def _mask_scores(
    model: BodyModel, fit: ActorFit, recordings: list[Recording], mattes: MattePaths
) -> dict[str, float | None]:
    """How well posed bodies cover the mattes, on every fifth frame of the training views.

    Raises:
        DataError: most joints lie outside the mattes, so that frames and poses do not belong
            together.
    """
    ious, inside, index = [], [], -1
    for recording in recordings:
        for i, frame in enumerate(recording.frames):
            index += 1
            if i % IOU_EVERY:
                continue
            pose = BodyPose(
                fit.pose.betas[index].float(),
                fit.pose.global_orient[index].float(),
                fit.pose.body_pose[index].float(),
                fit.pose.transl[index].float(),
            )
            for view, camera in zip(recording.views, recording.cameras, strict=True):
                path = mattes.get((recording.action, frame, view))
                if path is None:
                    continue
                matte = read_matte(path)
                ious.append(silhouette_iou(model, pose, camera, matte=matte))
                joints = camera.project(fit.joints_world[index])[0]
                inside.append(share_inside(joints, matte, margin_px=JOINT_MARGIN_PX))
    if not ious:
        return {"fit.mask_iou": None, "fit.joints_inside": None}
    share = sum(inside) / len(inside)
    if share < 0.5:
        raise DataError(
            f"{recordings[0].source}/{recordings[0].actor}: {share:.0%} of the joints lie in the "
            "mattes, expected 95 %; check that keypoints, mattes and cameras are of the same frames"
        )
    return {"fit.mask_iou": sum(ious) / len(ious), "fit.joints_inside": share}


def _publish(
    config: FitConfig,
    recordings: list[Recording],
    fit: ActorFit,
    *,
    scores: dict[str, Any],
    inputs: dict[str, Path],
    out: Path,
) -> None:
    source, actor = recordings[0].source, recordings[0].actor
    work = out.with_name(f".{out.name}.work")
    try:
        shutil.rmtree(work, ignore_errors=True)  # left by a run that was killed
        rows = body_rows(
            fit.pose,
            fit.joints_world,
            source=source,
            actor=actor,
            frames=[(r.action, frame) for r in recordings for frame in r.frames],
            errors_mm=fit.error_mm.tolist(),
            reasons=frame_reasons(fit.found.valid, fit.error_mm),
        )
        write_table(rows, schema=schemas.BODY, path=work / "bodies.parquet")
        cameras = {
            (recording.action, view): camera
            for recording in recordings
            for view, camera in zip(recording.views, recording.cameras, strict=True)
        }
        write_cameras(cameras, source=source, actor=actor, path=work / "cameras.parquet")
        text = json.dumps(scores, indent=2, sort_keys=True, allow_nan=False)
        write_bytes(work / "scores.json", text.encode())
        record = provenance(
            stage=STAGE,
            version=VERSIONS[STAGE],
            config=config.model_dump(mode="json"),
            inputs={name: file_sha256(path) for name, path in inputs.items()},
        )
        write_provenance(record, folder=work)
        record_files(work)
        publish_folder(work, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)
