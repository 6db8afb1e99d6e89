"""Training views from tables: the box around the person of every usable frame, at a useful size."""

import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, pose_body
from ntop.conventions import DataError
from ntop.field.views import TrainingViews
from ntop.geometry.cameras import Camera
from ntop.storage import schemas
from ntop.storage.cameras import read_cameras
from ntop.storage.frames import iterate_frames
from ntop.storage.images import read_matte
from ntop.storage.remedies import remedy
from ntop.storage.tables import Row, read_table

WATCH_EVERY = 10  # every tenth frame of the training cameras only says when to stop
MIN_CROP_PX = 8


@dataclass(frozen=True)
class Tables:
    """Where a training finds its pictures, cameras, mattes and poses."""

    frames: Path
    cameras: Path
    masks: Path
    bodies: Path


def training_views(
    tables: Tables,
    model: BodyModel,
    *,
    held_out_views: tuple[str, ...],
    max_person_px: int,
    margin_m: float,
) -> TrainingViews:
    """Crops, cameras and poses of every usable frame that is not held out.

    Args:
        tables: The capture's tables.
        model: The body that the poses drive.
        held_out_views: Views of which nothing is read.
        max_person_px: Pictures in which the person is taller are shrunk: finer detail than a voxel
            cannot be learned and costs memory.
        margin_m: How far around the body's surface the crop reaches.

    Raises:
        DataError: nothing usable is left, or a view has no camera.
    """
    cameras = read_cameras(tables.cameras)
    bodies = {
        (row["action"], row["frame"]): row
        for row in read_table(tables.bodies, schema=schemas.BODY)
        if not row["reason"]
    }
    masks = {
        (row["action"], row["frame"], row["view"]): row
        for row in read_table(tables.masks, schema=schemas.MASK)
        if row["view"] not in held_out_views
    }
    usable, skipped = [], Counter()
    for row in read_table(tables.frames, schema=schemas.FRAME):
        reason = _reason_to_skip(row, bodies, masks, held_out_views)
        if reason:
            skipped[reason] += 1
        elif (row["action"], row["view"]) not in cameras:
            raise DataError(
                f"{tables.cameras}: no camera for action {row['action']!r}, view {row['view']!r}; "
                f"have {sorted(cameras)}"
            )
        else:
            usable.append(row)
    for reason, count in sorted(skipped.items()):
        sys.stderr.write(f"train: skipped {count} pictures: {reason}\n")
    if not usable:
        raise DataError(
            f"{tables.frames}: no usable picture left ({dict(skipped)}); "
            "check the masks, the bodies and held_out_views"
        )
    return _crops(usable, tables, model, cameras, bodies, masks, (max_person_px, margin_m))


def _reason_to_skip(row: Row, bodies: dict, masks: dict, held_out_views: tuple[str, ...]) -> str:
    mask = masks.get((row["action"], row["frame"], row["view"]))
    if row["view"] in held_out_views:
        return "view is held out"
    if row["reason"]:
        return row["reason"]
    if (row["action"], row["frame"]) not in bodies:
        return "no body pose for this frame"
    if mask is None:
        return "no mask for this picture"
    return mask["reason"]


def _crops(
    usable: list[Row],
    tables: Tables,
    model: BodyModel,
    cameras: dict[tuple[str, str], Camera],
    bodies: dict[tuple[str, int], Row],
    masks: dict[tuple[str, int, str], Row],
    limits: tuple[int, float],
) -> TrainingViews:
    frames = sorted({(row["action"], row["frame"]) for row in usable})
    poses = _poses([bodies[frame] for frame in frames])
    vertices = [
        pose_body(model, BodyPose(*(getattr(poses, n)[p] for n in _POSE_FIELDS))).vertices
        for p in range(len(frames))
    ]
    keys = sorted({(row["action"], row["view"]) for row in usable})
    scaled = {}
    for key in keys:
        seen = [vertices[p] for p, frame in enumerate(frames) if frame[0] == key[0]]
        scaled[key] = _shrunk(cameras[key], seen, limits[0])
    boxes, crops, view_camera, view_pose = [], [], [], []
    for row, picture in iterate_frames(tables.frames, usable):
        frame, key = (row["action"], row["frame"]), (row["action"], row["view"])
        camera, pose = scaled[key], frames.index(frame)
        box = _body_box(camera, vertices[pose], limits[1])
        if box is None:
            continue
        mask = masks[(*frame, row["view"])]
        matte = read_matte(tables.masks.parent / mask["mask_path"])
        if matte.shape != picture.shape[:2]:
            raise DataError(
                f"{mask['mask_path']}: matte {matte.shape}, picture {picture.shape[:2]}; "
                + remedy(tables.masks)
            )
        size = (camera.lens.width, camera.lens.height)
        if size != picture.shape[1::-1]:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            matte = cv2.resize(matte, size, interpolation=cv2.INTER_AREA)
        left, top, width, height = box
        part = (slice(top, top + height), slice(left, left + width))
        soft = np.rint(matte[part] * 255).astype(np.uint8)
        crops.append(np.concatenate([picture[part], soft[..., None]], -1))
        boxes.append(box)
        view_camera.append(keys.index(key))
        view_pose.append(pose)
    numbers = {
        frame: n
        for a in {f[0] for f in frames}
        for n, frame in enumerate(f for f in frames if f[0] == a)
    }
    watched = [numbers[frames[p]] % WATCH_EVERY == WATCH_EVERY // 2 for p in view_pose]
    return TrainingViews(
        cameras=tuple(scaled[key] for key in keys),
        crops=tuple(crops),
        boxes=np.array(boxes),
        camera_of_view=np.array(view_camera),
        pose_of_view=np.array(view_pose),
        poses=poses,
        watched=np.array(watched),
        camera_names=tuple(keys),
        pose_names=tuple(frames),
    )


_POSE_FIELDS = ("betas", "global_orient", "body_pose", "transl")


def _poses(rows: list[Row]) -> BodyPose:
    columns = ("betas", "global_orient_rad", "body_pose_rad", "transl_m")
    return BodyPose(
        *(torch.tensor([row[column] for row in rows], dtype=torch.float64) for column in columns)
    )


def _shrunk(camera: Camera, bodies: list[Float[torch.Tensor, "v 3"]], max_person_px: int) -> Camera:
    """The camera of the picture shrunk so that the person's median extent fits."""
    extents = []
    for vertices in bodies:
        pixels, _ = camera.project(vertices)
        extents.append(float((pixels.amax(0) - pixels.amin(0)).max()))
    factor = min(1.0, max_person_px / max(float(np.median(extents)), 1.0))
    # whole pixels per picture: the rounded size decides the exact factor
    width, height = (round(n * factor) for n in (camera.lens.width, camera.lens.height))
    lens = camera.lens.scaled(width / camera.lens.width)
    return replace(camera, lens=replace(lens, width=width, height=height))


def _body_box(
    camera: Camera, vertices: Float[torch.Tensor, "v 3"], margin_m: float
) -> tuple[int, int, int, int] | None:
    """Box around the projected body, grown by a margin; None where little of it is in view."""
    pixels, seen = camera.project(vertices)
    if not bool(seen.all()):
        return None
    distance = float((vertices - camera.center_world).norm(dim=-1).min())
    grow = margin_m * camera.lens.fx / distance + 4
    low = (pixels.amin(0) - grow).floor().long().tolist()
    high = (pixels.amax(0) + grow).ceil().long().tolist()
    left, top = max(low[0], 0), max(low[1], 0)
    width = min(high[0], camera.lens.width) - left
    height = min(high[1], camera.lens.height) - top
    if width < MIN_CROP_PX or height < MIN_CROP_PX:
        return None
    return left, top, width, height
