"""A small field whose every number is known: a coloured ball in an identity warp."""

from dataclasses import replace

import numpy as np
import pytest

from ntop.field.canonical import CanonicalGrid, number_bricks, void_values
from ntop.field.warp import identity_warp

VOXEL_M = 0.02
BALL_M = 0.15


def ball_grid(seed: int = 0, dtype=np.float32) -> CanonicalGrid:
    """A soft ball of radius 15 cm with random colours, centre at 0.3 m on each axis."""
    bricks, positions = number_bricks(np.ones((8, 8, 8), bool))
    generator = np.random.default_rng(seed)
    values = void_values(len(positions)).astype(dtype)
    inner = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = (4 * positions[1:, None] + inner).reshape(-1, 3) * VOXEL_M
    distance = np.linalg.norm(nodes - 0.3, axis=1) - BALL_M
    values[64:, 0] = np.clip(-40 * distance, -8, 8) + generator.normal(0, 0.2, len(nodes))
    values[64:, 1:] = generator.normal(0, 1, (len(nodes), 3))
    return CanonicalGrid(values, bricks, positions, np.zeros(3), VOXEL_M)


@pytest.fixture
def ball():
    return ball_grid()


@pytest.fixture
def full_warp():
    """An identity warp of 64 cm in which every octant may hold density."""
    warp = identity_warp(np.zeros(3), np.full(3, 0.62), cell_m=0.031)
    tables = warp.tables
    return replace(
        warp,
        tables=tables._replace(
            occupancy=np.full_like(tables.occupancy, 255), away=np.zeros_like(tables.away)
        ),
    )


def random_rays(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Origins on a sphere of 1 m around the ball, directions towards points near it."""
    generator = np.random.default_rng(seed)
    away = generator.normal(size=(count, 3))
    origins = 0.3 + away / np.linalg.norm(away, axis=1, keepdims=True)
    aims = 0.3 + generator.uniform(-0.17, 0.17, (count, 3))
    directions = aims - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)
