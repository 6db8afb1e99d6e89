"""Rows of the render table: written by whoever renders, read by whoever needs the camera back."""

from typing import Any

import torch

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, coco17_points, pose_body
from ntop.conventions import DataError
from ntop.geometry.cameras import Camera
from ntop.geometry.fisheyes import Fisheye, fisheye_lens
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.pinhole import Pinhole
from ntop.geometry.rigs import Rig
from ntop.storage.keys import SetKey
from ntop.storage.tables import Row

NO_BACKGROUND = "none"  # the image is transparent where the person is not
IMAGE_FOLDERS = {"image_path": "images", "depth_path": "depth", "parts_path": "parts"}
LENS_KEYS = (
    "camera_model", "width", "height", "focal_px", "cx_px", "cy_px", "max_theta_rad",
    "focal_y_px", "distortion",
)  # fmt: skip


def body_columns(model: BodyModel, pose: BodyPose) -> Row:
    """SMPL parameters, the 24 joints and the COCO-17 points of one pose, in float64.

    Labels never go below float64: float32 joints are off by 1e-7 m, a hundredth of a micro-pixel
    that the round trip through JSON would then have to excuse.

    Raises:
        DataError: a parameter is not finite, or so large that a joint is not.
    """
    exact = pose.double()
    body = pose_body(model, exact)
    if not (body.joints.isfinite().all() and exact.betas.isfinite().all()):
        raise DataError(
            f"a body at {exact.transl.tolist()} m: {int((~body.joints.isfinite()).sum())} joint "
            "coordinates are not finite; check pose and shape (metres, radians)"
        )
    return {
        "betas": exact.betas.tolist(),
        "global_orient_rad": exact.global_orient.tolist(),
        "body_pose_rad": exact.body_pose.tolist(),
        "transl_m": exact.transl.tolist(),
        "joints3d_world_m": body.joints.flatten().tolist(),
        "coco17_world_m": coco17_points(model, body.vertices).flatten().tolist(),
    }


def image_paths(key: SetKey, view: str) -> dict[str, str]:
    """Where a view's three files lie below the folder of its render table."""
    name = key.image_name(view)
    return {column: f"{folder}/{name}" for column, folder in IMAGE_FOLDERS.items()}


def render_row(
    key: SetKey,
    view: str,
    *,
    camera: Camera,
    rig: Rig,
    body: Row,
    image_sha256: str,
    avatar_sha256: str,
    seed: int,
) -> Row:
    """The row of schema RENDER for one view; `body` comes from `body_columns`."""
    lens = camera.lens
    if isinstance(lens, Pinhole):
        raise DataError(f"{key} {view}: lens {lens.model!r} in a render table, expected a fisheye")
    return {
        "sample_id": key.sample_id(view),
        "source": key.source,
        "actor": key.actor,
        "action": key.action,
        "rig": key.rig,
        "frame": key.frame,
        "view": view,
        **image_paths(key, view),
        "image_sha256": image_sha256,
        "width": lens.width,
        "height": lens.height,
        "camera_model": lens.model,
        "focal_px": lens.fx,
        "cx_px": lens.cx,
        "cy_px": lens.cy,
        "max_theta_rad": lens.max_theta,
        "center_world_m": camera.center_world.tolist(),
        "rotation_camera_from_world": camera.rotation.flatten().tolist(),
        "height_above_pelvis_m": rig.height_above_pelvis_m,
        "ring_radius_m": rig.ring_radius_m,
        "seed": seed,
        "avatar_sha256": avatar_sha256,
        "background_id": NO_BACKGROUND,
        **body,
        "focal_y_px": lens.fy,
        "distortion": list(lens.distortion) if isinstance(lens, KannalaBrandt) else [],
    }


def set_key(row: Row) -> SetKey:
    """The set that a row of a render table or manifest belongs to."""
    return SetKey(row["source"], row["actor"], row["action"], row["rig"], row["frame"])


def fisheye_camera(row: dict[str, Any]) -> Camera:
    """The camera of a row of a render table, a manifest or a set file (float64)."""
    return Camera(
        lens=row_lens(row),
        center_world=torch.tensor(row["center_world_m"], dtype=torch.float64),
        rotation=torch.tensor(row["rotation_camera_from_world"], dtype=torch.float64).reshape(3, 3),
    )


def row_lens(row: dict[str, Any]) -> Fisheye:
    """The lens of such a row, of which the columns LENS_KEYS are enough.

    Tables made before lenses could differ lack the last two columns: they are equidistant.

    Raises:
        DataError: an unknown lens model, or parameters that it cannot have.
    """
    return fisheye_lens(
        row["camera_model"],
        fx=row["focal_px"],
        fy=row.get("focal_y_px") or row["focal_px"],
        cx=row["cx_px"],
        cy=row["cy_px"],
        width=row["width"],
        height=row["height"],
        max_theta=row["max_theta_rad"],
        distortion=tuple(row.get("distortion") or ()),
    )
