"""Warp grids against forward skinning and brute force: points come back to where they came from."""

import math

import numpy as np
import pytest
import torch

from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose, pose_body
from ntop.field.canonical import canonical_body
from ntop.field.kernels.nearest import nearest_vertices
from ntop.field.warp import joined, pose_warp
from tests.field.ways_back import ways_back

BETAS = (0.0,) * 10
CELL_M, REACH_M = 0.02, 0.05
LEFT_HIP, RIGHT_KNEE, LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_ELBOW = 0, 4, 15, 16, 17


@pytest.fixture(scope="module")
def model():
    return load_body_model()


@pytest.fixture(scope="module")
def body(model):
    return canonical_body(model, BETAS)


def pose_of(bends: dict[tuple[int, int], float]) -> BodyPose:
    """Upright at (0.3, -0.2, 1) with joints of `body_pose` bent: (joint, axis) -> degrees."""
    body_pose = torch.zeros(23, 3, dtype=torch.float64)
    for (joint, axis), degrees in bends.items():
        body_pose[joint, axis] = math.radians(degrees)
    return BodyPose(
        betas=torch.zeros(10, dtype=torch.float64),
        global_orient=torch.tensor([math.pi / 2, 0, 0], dtype=torch.float64),
        body_pose=body_pose.flatten(),
        transl=torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64),
    )


POSES = {
    "T": {},
    "arms hang": {(LEFT_SHOULDER, 2): -70, (RIGHT_SHOULDER, 2): 70},
    "elbow and knee at 90": {(LEFT_ELBOW, 1): -90, (RIGHT_KNEE, 0): 90, (LEFT_HIP, 0): -80},
}


@pytest.mark.parametrize("name", POSES)
def test_skinned_points_come_back(name, model, body):
    pose = pose_of(POSES[name])
    warp = pose_warp(body, model, pose, cell_m=CELL_M, reach_m=REACH_M)
    chosen = np.arange(0, len(body.vertices), 7)
    vertices = pose_body(model, pose).vertices.numpy()[chosen]
    errors = np.linalg.norm(ways_back(warp, vertices) - body.vertices[chosen][:, None], axis=-1)
    best_mm = 1000 * np.nanmin(errors, axis=1)
    assert np.isfinite(best_mm).all()  # every surface point lies in a cell
    assert np.median(best_mm) < 0.2  # straight limbs are exact, up to float32 tables
    # what is left: 2 cm cells where skin stretches, and folds, where the way back is not unique
    assert np.quantile(best_mm, 0.95) < 1.0
    assert np.quantile(best_mm, 0.99) < 5.0


def test_points_off_the_surface_keep_their_distance(model, body):
    """On rigid parts a garment 3 cm off the skin is 3 cm off it in canonical space."""
    pose = pose_of(POSES["elbow and knee at 90"])
    warp = pose_warp(body, model, pose, cell_m=CELL_M, reach_m=REACH_M)
    rigid = np.flatnonzero(body.lbs_weights.max(1) > 0.999)[::11]
    posed = pose_body(model, pose)
    rotations = posed.posed_from_rest[body.parts[rigid], :3, :3].numpy()
    back = body.rest_from_canonical_bones[body.parts[rigid], :3, :3]
    normals = np.einsum("nij,njk,nk->ni", rotations, back, body.normals[rigid])
    points = posed.vertices.numpy()[rigid] + 0.03 * normals
    expected = body.vertices[rigid] + 0.03 * body.normals[rigid]
    errors = np.linalg.norm(ways_back(warp, points) - expected[:, None], axis=-1)
    assert np.nanmedian(np.nanmin(errors, axis=1)) < 1e-3


def test_between_arm_and_trunk_both_ways_back_are_kept(model, body):
    pose = pose_of({(LEFT_SHOULDER, 2): -88, (RIGHT_SHOULDER, 2): 88})
    warp = pose_warp(body, model, pose, cell_m=CELL_M, reach_m=REACH_M)
    vertices = pose_body(model, pose).vertices.numpy()
    arm = np.flatnonzero(np.isin(body.parts, (18, 20, 22)))  # left elbow, wrist, hand
    trunk = np.flatnonzero(np.isin(body.parts, (0, 1, 3)))  # pelvis, left hip, spine
    gaps = np.linalg.norm(vertices[arm][:, None] - vertices[trunk], axis=-1)
    a, t = np.unravel_index(np.argsort(gaps, axis=None)[:50], gaps.shape)
    assert gaps[a, t].max() < 2 * REACH_M  # the pose does bring them near each other
    middle = (vertices[arm[a]] + vertices[trunk[t]]) / 2
    ways = ways_back(warp, middle)
    both = np.isfinite(ways).all((1, 2))
    assert both.mean() > 0.9
    spread = np.linalg.norm(ways[both, 0] - ways[both, 1], axis=-1)
    assert (spread > 0.15).all()  # an arm and a trunk, not a mixture of both
    for part in (arm[a], trunk[t]):
        near = np.linalg.norm(ways[both] - body.vertices[part[both]][:, None], axis=-1).min(1)
        assert np.median(near) < REACH_M + CELL_M


def test_nearest_vertices_equal_brute_force():
    generator = np.random.default_rng(3)
    posed = generator.uniform(0.05, 0.35, (200, 3)).astype(np.float32)
    maps = generator.uniform(-0.5, 0.5, (200, 3, 4)).astype(np.float32)
    dims, cell, radius, apart = np.array([21, 22, 23]), 0.02, 0.06, 0.15
    nearest = np.empty((2, dims.prod()), np.int32)
    distance = np.empty((2, dims.prod()), np.float32)
    nearest_vertices(posed, maps, dims, cell, radius, apart, 2, nearest, distance)
    nodes = np.stack(np.unravel_index(np.arange(dims.prod()), dims), 1) * cell
    squared = ((nodes[:, None] - posed) ** 2).sum(-1)
    first = np.where(squared.min(1) < radius**2, squared.argmin(1), -1)
    np.testing.assert_array_equal(nearest[0], first)
    places = np.einsum("vij,nj->nvi", maps[:, :, :3].astype(float), nodes) + maps[:, :, 3]
    own = places[np.arange(len(nodes)), first]
    far = ((own[:, None] - places) ** 2).sum(-1) >= apart**2
    other = np.where(far & (first >= 0)[:, None], squared, np.inf)
    second = np.where(other.min(1) < radius**2, other.argmin(1), -1)
    np.testing.assert_array_equal(nearest[1], second)


def test_joined_tables_hold_each_pose_unchanged(model, body):
    warps = [
        pose_warp(body, model, pose_of(POSES[name]), cell_m=0.04, reach_m=0.03) for name in POSES
    ]
    tables = joined([warp.tables for warp in warps])
    for p, warp in enumerate(warps):
        cells = tables.cells[tables.cell_offset[p] :][: len(warp.tables.cells)]
        filled = warp.tables.cells >= 0
        np.testing.assert_array_equal(cells >= 0, filled)
        sheets = tables.sheets[cells[filled], 0]
        expected = warp.tables.nodes[warp.tables.sheets[warp.tables.cells[filled], 0]]
        np.testing.assert_array_equal(tables.nodes[sheets], expected)
