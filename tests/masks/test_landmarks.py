"""Heatmap refinement against a slow twin, and the agreement of several looks."""

import numpy as np

from ntop.masks.consensus import GROUPS, MIRRORED, agree, naming, swapped_groups
from ntop.masks.landmarks import intersection_over_union, refine_by_heatmaps, sigmoid


def refined_slowly(point, heatmap):
    """MediaPipe's RefineLandmarksFromHeatmap for one point, as a double loop."""
    rows, columns = heatmap.shape
    column, row = int(np.floor(point[0] * columns)), int(np.floor(point[1] * rows))
    if not (0 <= column < columns and 0 <= row < rows):
        return point
    total = best = sum_column = sum_row = 0.0
    for r in range(row - 3, row + 4):
        for c in range(column - 3, column + 4):
            if 0 <= r < rows and 0 <= c < columns:
                value = heatmap[r, c]
                total, best = total + value, max(best, value)
                sum_column, sum_row = sum_column + c * value, sum_row + r * value
    if best < 0.5:
        return point
    return np.array([sum_column / total / columns, sum_row / total / rows])


def test_refinement_equals_the_slow_twin_also_at_the_borders():
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.05, 1.05, (200, 2))
    heatmaps = rng.uniform(0, 1, (64, 64, 200)) ** 6
    heatmaps[..., ::3] *= 0.4  # too weak to be trusted
    fast = refine_by_heatmaps(points, heatmaps)
    slow = np.array([refined_slowly(points[i], heatmaps[..., i]) for i in range(200)])
    assert np.allclose(fast, slow, atol=1e-12)
    moved = np.any(fast != points, axis=1)
    assert 60 < moved.sum() < 140  # both branches were taken


def test_a_peak_pulls_the_point_onto_it():
    heatmap = np.zeros((64, 64, 1))
    heatmap[20, 31, 0] = 0.9
    (point,) = refine_by_heatmaps(np.array([[30.2 / 64, 21.7 / 64]]), heatmap)
    assert np.allclose(point, [31 / 64, 20 / 64])


def test_sigmoid_does_not_overflow():
    with np.errstate(over="raise"):
        values = sigmoid(np.array([-1e4, 0.0, 1e4], np.float32))
    assert np.allclose(values, [0, 0.5, 1])


def test_mirroring_twice_changes_nothing():
    order = np.array(MIRRORED)
    assert np.array_equal(order[order], np.arange(35))


def body(rng):
    return rng.uniform(0, 1000, (35, 2))


def test_swapped_looks_are_renamed_and_a_wild_one_left_out():
    rng = np.random.default_rng(2)
    truth = body(rng)
    looks = np.stack([truth + rng.normal(0, 2, truth.shape) for _ in range(6)])
    looks[1] = looks[1][list(MIRRORED)]
    looks[4] = looks[4][list(MIRRORED)]
    looks[2] += 400  # collapsed: everything elsewhere
    found = agree(looks, np.full((6, 35), 0.9), truth + 3, side_px=1000)
    assert np.linalg.norm(found.landmarks_px - truth, axis=1).max() < 6
    assert np.allclose(found.confidence, 0.9 * 5 / 6)
    assert found.votes.tolist() == [2, 2, 2]


def test_without_a_frame_before_the_most_typical_look_names_the_sides():
    rng = np.random.default_rng(3)
    truth = body(rng)
    looks = np.stack([truth + rng.normal(0, 2, truth.shape) for _ in range(6)])
    looks[0] = looks[0][list(MIRRORED)]
    found = agree(looks, np.ones((6, 35)), None, side_px=1000)
    assert np.linalg.norm(found.landmarks_px - truth, axis=1).max() < 6
    assert found.votes.tolist() == [4, 4, 4]


def test_only_the_crossed_legs_are_swapped():
    rng = np.random.default_rng(4)
    truth = body(rng)
    crossed = truth.copy()
    legs = list(GROUPS[2])
    crossed[legs] = truth[np.array(MIRRORED)[legs]]
    swapped = swapped_groups(crossed, truth)
    assert swapped.tolist() == [False, False, True]
    assert np.allclose(crossed[naming(swapped)], truth)


def test_points_on_which_the_looks_disagree_lose_their_confidence():
    rng = np.random.default_rng(5)
    truth = body(rng)
    looks = np.stack([truth] * 6)
    looks[:, 20] += rng.normal(0, 300, (6, 2))
    found = agree(looks, np.ones((6, 35)), truth, side_px=1000)
    assert found.confidence[20] < 0.5
    assert np.isclose(found.confidence[19], 1)


def test_intersection_over_union_of_halves():
    one, other = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert intersection_over_union(one, other) == 0
    one[:2], other[1:3] = True, True
    assert np.isclose(intersection_over_union(one, other), 4 / 12)
