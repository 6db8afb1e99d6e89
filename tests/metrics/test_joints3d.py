"""3D scores: analytic cases; degenerate skeletons are case 36 of tests/numerics."""

import numpy as np
import pytest
import torch

from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.metrics.joints3d import (
    procrustes_aligned,
    root_aligned,
    score_poses,
)


def skeletons(count=5, joints=24, *, seed=0):
    return np.random.default_rng(seed).normal(scale=0.4, size=(count, joints, 3))


def similarity(joints, *, scale, axis_angle, shift):
    rotation = matrix_from_axis_angle(torch.tensor(axis_angle, dtype=torch.float64)).numpy()
    return scale * joints @ rotation.T + np.array(shift)


def test_one_joint_off_by_a_known_length():
    reference = skeletons()
    predicted = reference.copy()
    predicted[:, 7] += [0.024, 0.0, 0.0]
    scores = score_poses(predicted, reference)
    assert scores.mpjpe_mm == pytest.approx(1.0, abs=1e-9)  # 24 mm on one of 24 joints
    assert scores.per_joint_mm[7] == pytest.approx(24.0, abs=1e-9)
    assert scores.pck150 == 1.0


def test_truth_is_zero_and_its_auc_is_thirty_of_thirty_one():
    reference = skeletons()
    scores = score_poses(reference + np.array([3.0, -2.0, 1.0]), reference)  # the root is removed
    assert scores.mpjpe_mm == pytest.approx(0.0, abs=1e-9)
    assert scores.pa_mpjpe_mm == pytest.approx(0.0, abs=1e-9)
    assert scores.auc == pytest.approx(30 / 31)


def test_pck_and_auc_count_strictly_below():
    reference = np.zeros((1, 4, 3))
    predicted = reference.copy()
    predicted[0, 1:, 0] = [0.149, 0.151, 0.075]
    scores = score_poses(predicted, reference)
    assert scores.pck150 == 3 / 4
    expected = np.mean(
        [np.mean(np.array([0.0, 149.0, 151.0, 75.0]) < t - 1e-6) for t in range(0, 155, 5)]
    )
    assert scores.auc == pytest.approx(expected)


def test_the_best_similarity_beats_random_ones():
    reference, predicted = skeletons(1, seed=3), skeletons(1, seed=4)
    best = ((procrustes_aligned(predicted, reference).joints - reference) ** 2).sum()
    generator = np.random.default_rng(5)
    for _ in range(300):
        other = similarity(
            predicted - predicted.mean(1, keepdims=True),
            scale=generator.uniform(0, 1.5),
            axis_angle=generator.normal(size=3) * 1.5,
            shift=reference.mean((0, 1)),
        )
        assert ((other - reference) ** 2).sum() >= best - 1e-12


def test_root_alignment_moves_whole_skeletons():
    reference, predicted = skeletons(seed=6), skeletons(seed=7)
    moved = root_aligned(predicted, reference)
    assert np.allclose(moved[:, 0], reference[:, 0])
    assert np.allclose(np.diff(moved, axis=1), np.diff(predicted, axis=1))
