"""What must hold for every captured actor, whatever its reader: datasets lie about their axes.

A recording is refused here, once, so that no later stage has to doubt it.
"""

from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.skeletons import SMPL24_NAMES, SMPL24_PARENTS
from ntop.conventions import MASK_ALPHA, NUM_JOINTS, DataError
from ntop.geometry.cameras import Camera
from ntop.storage import schemas
from ntop.storage.cameras import CameraKey, read_cameras
from ntop.storage.images import read_matte
from ntop.storage.tables import Row, read_table

DISTANCE_M = (0.3, 50.0)  # of a camera from the point that all cameras look at
JOINT_HEIGHT_M = (1.0, 1.95)  # ankle to head joint along the bones: 0.86 of a height of 1.2-2.2 m
MIN_SHARE_IN_MASK = 0.95  # of the joints that lie in the image
HEAD, ANKLE = SMPL24_NAMES.index("head"), SMPL24_NAMES.index("left_ankle")


def check_capture(folder: Path) -> None:
    """Check the tables below `folder`: frames and cameras, and bodies and masks if given.

    Raises:
        DataError: no frame, a frame without its camera or of another size, a camera that is
            implausible, a body upside down or of no human size, joints outside the masks.
    """
    frames = read_table(folder / "frames.parquet", schema=schemas.FRAME)
    cameras = read_cameras(folder / "cameras.parquet")
    check_frames(frames, cameras, where=str(folder))
    for action in sorted({action for action, _ in cameras}):
        views = {view: camera for (name, view), camera in cameras.items() if name == action}
        check_rig(views, where=f"{folder} action {action}")
    if (folder / "bodies.parquet").exists():
        bodies = read_table(folder / "bodies.parquet", schema=schemas.BODY)
        check_bodies(bodies, where=str(folder / "bodies.parquet"))
        if (folder / "masks.parquet").exists():
            masks = read_table(folder / "masks.parquet", schema=schemas.MASK)
            check_joints_in_masks(bodies, masks, cameras=cameras, folder=folder)


def check_frames(frames: list[Row], cameras: dict[CameraKey, Camera], *, where: str) -> None:
    """Every frame has a camera for images of its size, and there are frames."""
    if not frames:
        raise DataError(f"{where}: no frame at all; declare frames in config/sequences.tsv")
    for row in frames:
        key = row["action"], row["view"]
        place = f"{where}: action {key[0]} view {key[1]} frame {row['frame']}"
        if key not in cameras:
            raise DataError(f"{place}: no camera; have {sorted(cameras)}")
        size = cameras[key].lens.width, cameras[key].lens.height
        if size != (row["width"], row["height"]):
            raise DataError(
                f"{place}: image is {row['width']}x{row['height']} px, its camera is for "
                f"{size[0]}x{size[1]} px"
            )


def check_rig(cameras: dict[str, Camera], *, where: str) -> None:
    """The cameras of one action stand above the floor and look at one place from a sane distance.

    Mirrored or inverted extrinsics put that place behind some of them.
    """
    for view, camera in cameras.items():
        if not camera.center_world[2] > 0:
            raise DataError(
                f"{where} camera {view}: centre {camera.center_world.tolist()} m is not above the "
                "floor z = 0; the source's up axis, origin or unit was read wrongly"
            )
    if len(cameras) < 2:
        raise DataError(f"{where}: {len(cameras)} camera, expected at least 2 to triangulate")
    target = _common_target(list(cameras.values()))
    near, far = DISTANCE_M
    for view, camera in cameras.items():
        depth = (camera.rotation @ (target - camera.center_world))[2].item()
        if not near < depth < far:
            raise DataError(
                f"{where} camera {view}: the place all cameras look at, {target.tolist()} m, is at "
                f"depth {depth:.2f} m, expected {near} to {far} m; the source's axes or unit were "
                "read wrongly"
            )


def check_bodies(bodies: list[Row], *, where: str) -> None:
    """Given bodies are of human size and stand upright in at least one frame."""
    joints = torch.tensor([row["joints3d_world_m"] for row in bodies if not row["reason"]])
    if joints.numel() == 0:
        raise DataError(f"{where}: no usable body")
    joints = joints.reshape(-1, NUM_JOINTS, 3)
    height = _chain_length(joints, HEAD) + _chain_length(joints, ANKLE)
    low, high = JOINT_HEIGHT_M
    if not (height.min() >= low and height.max() <= high):
        raise DataError(
            f"{where}: ankle to head along the bones is {height.min():.2f} to {height.max():.2f} "
            f"m, expected {low} to {high} m; the source's unit was read wrongly"
        )
    rise = (joints[:, HEAD, 2] - joints[:, ANKLE, 2]).max()
    if rise < low / 2:
        raise DataError(
            f"{where}: the head is never more than {rise:.2f} m above the ankle; the source's up "
            "axis was read wrongly (expected +z)"
        )


def check_joints_in_masks(
    bodies: list[Row], masks: list[Row], *, cameras: dict[CameraKey, Camera], folder: Path
) -> None:
    """Given bodies and masks fit each other: the projected joints lie on the masks."""
    joints = {
        (row["action"], row["frame"]): torch.tensor(row["joints3d_world_m"]).reshape(-1, 3)
        for row in bodies
        if not row["reason"]
    }
    inside: dict[str, list[np.ndarray]] = defaultdict(list)
    for row in masks:
        points = joints.get((row["action"], row["frame"]))
        if row["reason"] or points is None:
            continue
        matte = read_matte(folder / row["mask_path"])
        pixels, seen = cameras[row["action"], row["view"]].project(points.double())
        u, v = pixels.floor().long().unbind(-1)
        seen &= (u >= 0) & (v >= 0) & (u < matte.shape[1]) & (v < matte.shape[0])
        inside[row["view"]].append(matte[v[seen], u[seen]] >= MASK_ALPHA / 255)
    for view, shares in sorted(inside.items()):
        share = np.concatenate(shares).mean()
        if share < MIN_SHARE_IN_MASK:
            raise DataError(
                f"{folder} view {view}: {share:.1%} of the projected joints lie on the masks, "
                f"expected {MIN_SHARE_IN_MASK:.0%}; cameras, bodies and masks do not belong "
                "together"
            )


def _common_target(cameras: list[Camera]) -> Float[Tensor, " 3"]:
    """The world point nearest to all optical axes, in metres (least squares)."""
    axes = torch.stack([camera.rotation[2] for camera in cameras])
    centres = torch.stack([camera.center_world for camera in cameras])
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]
    normal, right = across.sum(0), (across @ centres[..., None]).sum(0).squeeze(-1)
    return torch.linalg.lstsq(normal, right[:, None]).solution.squeeze(-1)


def _chain_length(joints: Float[Tensor, "frame 24 3"], joint: int) -> Float[Tensor, " frame"]:
    """Length of the bones from the root to a joint, in metres."""
    length = torch.zeros(len(joints))
    while SMPL24_PARENTS[joint] >= 0:
        parent = SMPL24_PARENTS[joint]
        length = length + (joints[:, joint] - joints[:, parent]).norm(dim=-1)
        joint = parent
    return length
