"""The optimiser's loops against plain ones over single nodes."""

import numpy as np
import pytest

from ntop.field.canonical import number_bricks
from ntop.field.kernels.learn import NEIGHBOURS, adam_step, gather

SMOOTHNESS, EDGE = np.array([0.3, 0.1, 0.2, 0.4]), np.array([0.5, 0.1, 0.2, 0.3])


@pytest.fixture
def field():
    """Five bricks of a 2 x 2 x 2 box, float64, with gradients in three blocks."""
    occupied = np.ones((2, 2, 2), bool)
    occupied[0, 1, 1] = occupied[1, 0, 0] = occupied[1, 1, 1] = False
    bricks, positions = number_bricks(occupied)
    generator = np.random.default_rng(5)
    values = generator.normal(size=(64 * len(positions), 4))
    gradients = generator.normal(size=(3, *values.shape))
    gradients[:, :64] = 0
    return bricks, positions, values, gradients


def node_of(bricks, x, y, z):
    """Row of a node, -1 in the void or beyond."""
    if min(x, y, z) < 0 or max(x, y, z) >= 8:
        return -1
    slot = bricks[x // 4, y // 4, z // 4]
    return -1 if slot == 0 else slot * 64 + (x % 4) * 16 + (y % 4) * 4 + z % 4


def test_gathered_gradients_equal_a_plain_loop(field):
    bricks, positions, values, gradients = field
    anchors, weight = np.linspace(-3, 3, len(values)), 0.7
    expected = gradients.sum(0)
    for x, y, z in np.ndindex(8, 8, 8):
        row = node_of(bricks, x, y, z)
        if row < 0:
            continue
        off = values[row, 0] - anchors[row]
        expected[row, 0] += weight * off / np.sqrt(off**2 + EDGE[0] ** 2)
        for dx, dy, dz in NEIGHBOURS:
            other = node_of(bricks, x + dx, y + dy, z + dz)
            if other >= 0:
                d = values[row] - values[other]
                expected[row] += SMOOTHNESS * d / np.sqrt(d**2 + EDGE**2)
    touched = np.ones((3, len(positions)), np.uint8)
    active = np.arange(1, len(positions))
    gather(
        values, bricks, positions, active, gradients, touched, SMOOTHNESS, EDGE, anchors, weight
    )  # fmt: skip
    np.testing.assert_allclose(gradients[0, 64:], expected[64:], rtol=1e-12, atol=1e-12)
    assert not gradients[1:].any()  # ready for the next step
    assert not touched[:, 1:].any()


def test_adam_equals_its_definition_and_leaves_other_bricks_alone(field):
    _, positions, values, gradients = field
    first, second = np.zeros_like(values), np.zeros_like(values)
    counts = np.zeros(len(positions), np.int64)
    rates, low, high = np.array([0.3, 0.1, 0.1, 0.1]), np.full(4, -1.5), np.full(4, 1.5)
    active = np.array([1, 3])
    expected, m, v = values.copy(), first.copy(), second.copy()
    rows = np.concatenate([np.arange(64 * slot, 64 * slot + 64) for slot in active])
    for step in (1, 2, 3):
        gradient = gradients[0] * step
        m[rows] = 0.9 * m[rows] + 0.1 * gradient[rows]
        v[rows] = 0.99 * v[rows] + 0.01 * gradient[rows] ** 2
        move = rates * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.99**step)) + 1e-10)
        expected[rows] = np.clip(expected - move, low, high)[rows]
        given = gradient[None].copy()
        adam_step(values, active, given, first, second, counts, rates, 0.9, 0.99, low, high)
        assert not given[0, rows].any()
    np.testing.assert_allclose(values, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_array_equal(counts, np.isin(np.arange(len(positions)), active) * 3)
