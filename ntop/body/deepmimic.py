"""DeepMimic's humanoid clips (Peng et al. 2018; JSON, 44 columns) as motions of SMPL's joints.

Columns: 0 duration of the frame (s); 1-3 root position; 4-7 root rotation; then, in the order
chest, neck, right hip, knee, ankle, shoulder, elbow, left hip, knee, ankle, shoulder, elbow, a
quaternion (w, x, y, z), or for knees and elbows one angle about z (radians).
"""

import json
import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.motions import WORLD_FROM_BODY, Motion
from ntop.body.skeletons import SMPL24_NAMES
from ntop.conventions import NUM_JOINTS, DataError
from ntop.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

# DeepMimic: x forward, y up, z right -> body: x left, y up, z forward.
_BODY_FROM_DEEPMIMIC = ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
_COLUMNS = 44
_LEG_M = 0.4215 + 0.4099  # hip to knee, knee to ankle, of its humanoid
_QUATERNIONS = {  # first of four columns
    "pelvis": 4, "neck": 12, "right_hip": 16, "right_ankle": 21, "right_shoulder": 25,
    "left_hip": 30, "left_ankle": 35, "left_shoulder": 39,
}  # fmt: skip
_CHEST = 8
_HINGES = {"right_knee": 20, "right_elbow": 29, "left_knee": 34, "left_elbow": 43}
# Of DeepMimic's fifteen clips those in which the actor is in the air for a while. The files do
# not say so, and pelvis heights cannot tell a leap from a roll.
_AIRBORNE = ("backflip", "jump", "run", "spin", "spinkick")
_SPINE = ("spine1", "spine2", "spine3")


def load_motion(path: Path) -> Motion:
    """Read a DeepMimic humanoid clip and map it to SMPL's joints.

    Rotations change basis (B R B^T). DeepMimic's arms hang in the rest pose, ours point
    sideways, so shoulders and elbows absorb a quarter turn. The chest's rotation is spread
    evenly over the three spine joints: one joint would crease the belly.

    Raises:
        DataError: Not JSON of the expected layout, or not the 44-column humanoid.
    """
    rows, loops = _read_clip(path)
    basis = torch.tensor(_BODY_FROM_DEEPMIMIC, dtype=torch.float64)
    rotations = torch.eye(3, dtype=torch.float64).repeat(len(rows), NUM_JOINTS, 1, 1)

    def rotation_at(column: int) -> Float[Tensor, "sample 3 3"]:
        return basis @ matrix_from_quaternion(rows[:, column : column + 4]) @ basis.T

    for name, column in _QUATERNIONS.items():
        rotations[:, SMPL24_NAMES.index(name)] = rotation_at(column)
    hinge_axis = basis @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for name, column in _HINGES.items():
        angle = rows[:, column, None]
        rotations[:, SMPL24_NAMES.index(name)] = matrix_from_axis_angle(angle * hinge_axis)
    third = matrix_from_axis_angle(axis_angle_from_matrix(rotation_at(_CHEST)) / 3)
    for name in _SPINE:
        rotations[:, SMPL24_NAMES.index(name)] = third
    for side, angle in (("left", -math.pi / 2), ("right", math.pi / 2)):
        lowered = matrix_from_axis_angle(torch.tensor([0.0, 0.0, angle], dtype=torch.float64))
        shoulder, elbow = (SMPL24_NAMES.index(f"{side}_{part}") for part in ("shoulder", "elbow"))
        rotations[:, shoulder] = rotations[:, shoulder] @ lowered
        rotations[:, elbow] = lowered.T @ rotations[:, elbow] @ lowered
    world_from_body = torch.tensor(WORLD_FROM_BODY, dtype=torch.float64)
    rotations[:, 0] = world_from_body @ rotations[:, 0]
    pelvis = rows[:, 1:4] @ (world_from_body @ basis).T
    # A frame's first column is how long it lasts, so the last one's does not count.
    times = torch.cat([torch.zeros(1, dtype=torch.float64), rows[:-1, 0].cumsum(0)])
    return Motion(
        times_s=times,
        quaternions=quaternion_from_matrix(rotations),
        pelvis_world_m=pelvis,
        leg_length_m=_LEG_M,
        loops=loops,
        leaves_floor=path.stem.removeprefix("humanoid3d_") in _AIRBORNE,
    )


def _read_clip(path: Path) -> tuple[Float[Tensor, "sample 44"], bool]:
    """The frames of a clip, and whether it loops."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        frames, loop = content["Frames"], content["Loop"]
        rows = torch.tensor(frames, dtype=torch.float64)
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}: not a DeepMimic clip ({error}); expected JSON with 'Loop' and 'Frames'"
        ) from error
    if rows.ndim != 2 or rows.shape[1] != _COLUMNS or len(rows) < 2:
        raise DataError(
            f"{path}: frames of shape {tuple(rows.shape)}, expected (2 or more, "
            f"{_COLUMNS}); only the humanoid clips (humanoid3d_*.txt) can be used"
        )
    if not (rows[:-1, 0] > 0).all():
        raise DataError(
            f"{path}: a frame lasts {float(rows[:-1, 0].min())} s, expected more than 0"
        )
    return rows, loop == "wrap"
