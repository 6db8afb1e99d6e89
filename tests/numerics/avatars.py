"""An avatar of which everything is known: the embedded body, crisp, its colour fading inwards."""

import functools

import numpy as np
import torch

from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose
from ntop.field.avatar import Avatar
from ntop.field.canonical import (
    CanonicalGrid,
    canonical_body,
    distance_grid,
    number_bricks,
    void_values,
)
from ntop.field.posing import PosedAvatar, pose_avatar

VOXEL_M = 0.012
SHELL_M = 0.036  # inside and outside of the surface
RAW_PER_M = 3000.0  # the surface is a millimetre thick
FADE_PER_M = 60.0  # of raw colour: 3 grey levels per millimetre below the surface
CELL_M = 0.024


@functools.lru_cache(maxsize=2)
def analytic_avatar(voxel_m: float = VOXEL_M) -> Avatar:
    """Raw density and raw colour are linear in the signed distance to the body's surface."""
    betas = (0.0,) * 10
    body = canonical_body(load_body_model(), betas)
    distances, _, origin = distance_grid(body, spacing_m=voxel_m, reach_m=SHELL_M)
    shape = [n // 4 for n in distances.shape]
    blocks = distances.reshape(shape[0], 4, shape[1], 4, shape[2], 4).transpose(0, 2, 4, 1, 3, 5)
    bricks, positions = number_bricks((np.abs(blocks) <= SHELL_M).any(axis=(3, 4, 5)))
    within = blocks[tuple(positions[1:].T)].ravel().clip(-SHELL_M, SHELL_M)
    values = void_values(len(positions))
    values[64:, 0] = -RAW_PER_M * within
    values[64:, 1:] = (1 + FADE_PER_M * within)[:, None]
    light = np.zeros((9, 3), np.float32)
    light[0] = 1
    grid = CanonicalGrid(values, bricks, positions, origin, voxel_m)
    return Avatar(grid, light, betas, 0.03, 0)


def standing(*, raised_arm: bool = False) -> BodyPose:
    """Upright (z up), arms lowered, or one of them raised."""
    body_pose = torch.zeros(69, dtype=torch.float64)
    body_pose[15 * 3 + 2], body_pose[16 * 3 + 2] = -1.1, 1.1  # shoulders, about body z
    if raised_arm:
        body_pose[15 * 3 + 2] = 1.2
    return BodyPose(
        betas=torch.zeros(10, dtype=torch.float64),
        global_orient=torch.tensor([np.pi / 2, 0.0, 0.0], dtype=torch.float64),
        body_pose=body_pose,
        transl=torch.tensor([0.0, 0.0, 1.3], dtype=torch.float64),
    )


def posed_at(avatar: Avatar, pose: BodyPose) -> PosedAvatar:
    return pose_avatar(avatar, load_body_model(), pose, cell_m=CELL_M)
