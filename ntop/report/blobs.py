"""Labels judged end to end (NUMERICS test 35): an opaque ball is rendered where a joint lies.

The ball is an analytic field behind the avatar's own interface; a dataset's camera looks at it
through the real renderer, with 8 x 8 rays per pixel, and the centroid of its opacity is compared
with the written 2D keypoint. One number covers half-pixel slips, flips, signs and scales.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from ntop.field.canonical import CanonicalGrid, PartLabels, dense_voxels, number_bricks
from ntop.field.kernels.tables import EMPTY_RAW, VOID_RAW
from ntop.field.posing import PosedAvatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import render_view
from ntop.field.warp import identity_warp, occupied
from ntop.geometry.cameras import Camera
from ntop.geometry.windows import cropped, resized
from ntop.report.inputs import Dataset
from ntop.storage.keys import SetKey
from ntop.storage.renders import fisheye_camera

RADIUS_M = 0.020
RAYS_PER_SIDE = 8
MARGIN_M = 0.006  # room around the ball, of the grid and of the picture
VOXEL_M = 0.004
CELL_M = 0.02
RAW_PER_M = 6000.0  # opaque within a fraction of a millimetre
RAW_LIMITS = (VOID_RAW, 30.0)
SETTINGS = RenderSettings(step_m=0.001, edge_rays=1)


def blob_max_px(dataset: Dataset) -> float | None:
    """Largest distance over one set per rig: all its views, all 24 joints in view.

    None if no set shows a person.
    """
    worst = [
        distance
        for key in _one_set_per_rig(dataset)
        for distance in blob_errors_px(dataset, key).values()
    ]
    return max(worst, default=None)


def blob_errors_px(dataset: Dataset, key: SetKey) -> dict[tuple[str, int], float]:
    """Distance of the ball's centroid from the keypoint, by view and joint, for one set."""
    errors = {}
    balls: dict[int, PosedAvatar] = {}
    for view, row in dataset.sets[key].items():
        for person in row["persons"]:
            joints = np.array(person["joints3d_world_m"]).reshape(-1, 3)
            labels = np.array(person["keypoints2d_smpl24_px"]).reshape(-1, 2)
            for joint, (label, flag) in enumerate(
                zip(labels, person["visibility_smpl24"], strict=True)
            ):
                if flag == 0:
                    continue  # outside the image circle nothing is rendered
                if joint not in balls:
                    balls[joint] = ball(joints[joint])
                centroid = ball_centroid_px(balls[joint], joints[joint], fisheye_camera(row))
                errors[view, joint] = float(np.linalg.norm(centroid - label))
    return errors


def ball(center_world: Float[np.ndarray, " 3"]) -> PosedAvatar:
    """An opaque ball as a posed avatar: a small grid, and a warp that only shifts."""
    reach = RADIUS_M + MARGIN_M
    low = center_world - reach
    num_bricks = int(np.ceil((2 * reach / VOXEL_M + 1) / 4))
    bricks, positions = number_bricks(np.ones((num_bricks,) * 3, bool))
    within = np.stack(np.meshgrid(*(np.arange(4),) * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = (4 * positions[1:, None] + within).reshape(-1, 3) * VOXEL_M - reach
    values = np.zeros((64 * len(positions), 4), np.float32)
    values[:, 0] = VOID_RAW
    depth = RADIUS_M - np.linalg.norm(nodes, axis=1)
    values[64:, 0] = np.clip(RAW_PER_M * depth, *RAW_LIMITS)
    grid = CanonicalGrid(values, bricks, positions, np.zeros(3), VOXEL_M)
    warp = identity_warp(low, center_world + reach, cell_m=CELL_M)
    dense = dense_voxels(grid, raw_threshold=EMPTY_RAW)
    warp = replace(warp, tables=occupied(warp.tables, dense, extent=1.0))
    light = np.zeros((9, 3), np.float32)
    light[0] = 1
    labels = PartLabels(np.ones((1, 1, 1), np.uint8), np.zeros(3), 1.0)
    return PosedAvatar(grid=grid, warp=warp, light=light, labels=labels)


def ball_centroid_px(
    posed: PosedAvatar, center_world: Float[np.ndarray, " 3"], camera: Camera
) -> Float[np.ndarray, " 2"]:
    """Opacity-weighted mean position of the ball in a fisheye view (pixels)."""
    window, fine = _close_up(camera, center_world)
    alpha = render_view(posed, fine, settings=SETTINGS).alpha.astype(np.float64)
    v, u = np.mgrid[: alpha.shape[0], : alpha.shape[1]] + 0.5
    centroid = np.array([(u * alpha).sum(), (v * alpha).sum()]) / alpha.sum()
    return centroid / RAYS_PER_SIDE + window


def _close_up(
    camera: Camera, center_world: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, " 2"], Camera]:
    """The window of whole pixels around the ball, and the same camera with 8 x 8 rays per pixel."""
    lens = camera.lens
    center = torch.from_numpy(center_world)
    pixel, _ = camera.project(center)
    distance = float((center - camera.center_world).norm())
    radius = lens.max_px_per_rad * (RADIUS_M + MARGIN_M) / distance + 1
    left, top = np.floor(pixel.numpy() - radius).astype(int).tolist()
    side = int(np.ceil(2 * radius)) + 1
    window = cropped(lens, left=left, top=top, width=side, height=side)
    fine = resized(window, width=side * RAYS_PER_SIDE, height=side * RAYS_PER_SIDE)
    return np.array([left, top], dtype=float), replace(camera, lens=fine)


def _one_set_per_rig(dataset: Dataset) -> list[SetKey]:
    """The middle set of each rig among those in which every view shows a person."""
    chosen = []
    for rig in sorted({key.rig for key in dataset.sets}):
        keys = [
            key
            for key, views in dataset.sets.items()
            if key.rig == rig and all(row["persons"] for row in views.values())
        ]
        if keys:
            chosen.append(keys[len(keys) // 2])
    return chosen
