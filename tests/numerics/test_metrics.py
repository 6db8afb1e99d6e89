"""Case 36: Procrustes alignment of mirrored, flat, coinciding, broken and far-away skeletons."""

import numpy as np
import pytest
import torch

from ntop.conventions import DataError
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.metrics.joints3d import joint_errors_mm, procrustes_aligned, score_poses

FAR_M = 1000.0  # 1e6 mm
LIMIT_MM = 1e-6


def skeletons(count: int = 5, joints: int = 24, *, seed: int = 0) -> np.ndarray:
    """Random joints, metres."""
    return np.random.default_rng(seed).normal(scale=0.4, size=(count, joints, 3))


def similarity(
    joints: np.ndarray, *, scale: float, axis_angle: list[float], shift: list[float]
) -> np.ndarray:
    rotation = matrix_from_axis_angle(torch.tensor(axis_angle, dtype=torch.float64)).numpy()
    return scale * joints @ rotation.T + np.array(shift)


def worst_mm(predicted: np.ndarray, reference: np.ndarray) -> float:
    """Largest error after our alignment, where no sample is flagged."""
    aligned = procrustes_aligned(predicted, reference)
    assert not aligned.degenerate.any()
    return float(joint_errors_mm(aligned.joints, reference).max())


def kabsch(source: np.ndarray, target: np.ndarray, *, proper: bool) -> np.ndarray:
    """Umeyama's alignment of one sample in its own dtype, with or without the determinant."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    source_0, target_0 = source - source_mean, target - target_mean
    left, singular, right = np.linalg.svd(source_0.T @ target_0)
    signs = np.ones(3, source.dtype)
    if proper:
        signs[-1] = np.sign(np.linalg.det(left @ right))
    scale = (singular * signs).sum() / (source_0**2).sum()
    return scale * source_0 @ ((left * signs) @ right) + target_mean


def test_36_a_mirrored_skeleton_is_not_forgiven(margin):
    reference = skeletons()
    mirrored = reference * [-1.0, 1.0, 1.0]
    aligned = procrustes_aligned(mirrored, reference).joints
    margin.at_least("mirrored", joint_errors_mm(aligned, reference).mean(), 100, "mm")
    forgiven = np.stack(
        [kabsch(m, r, proper=False) for m, r in zip(mirrored, reference, strict=True)]
    )
    error = float(joint_errors_mm(forgiven, reference).mean())
    # the mutant must fall below the limit: its distance from the limit is what is caught
    margin.mutant_exceeds("without the determinant, limit - error", 100 - error, 99, "mm")


@pytest.mark.parametrize("shift_m", [0.0, FAR_M])
def test_36_similarities_vanish(shift_m, margin):
    reference = skeletons()
    shift = [shift_m, -shift_m, 0.5 * shift_m]
    moved = similarity(reference, scale=1.7, axis_angle=[0.3, -2.0, 1.0], shift=shift)
    margin.at_most("similarity", worst_mm(moved, reference), LIMIT_MM, "mm")
    if shift_m:
        single = np.stack(
            [
                kabsch(m, r, proper=True)
                for m, r in zip(moved.astype(np.float32), reference.astype(np.float32), strict=True)
            ]
        )
        error = float(joint_errors_mm(single, reference).max())
        margin.mutant_exceeds("in float32", error, LIMIT_MM, "mm")


def test_36_float32_predictions_are_aligned_in_float64(margin):
    reference = skeletons().astype(np.float32)
    moved = similarity(reference, scale=2.0, axis_angle=[0.3, -2.0, 1.0], shift=[0.0, 0.0, 0.0])
    error = worst_mm(moved.astype(np.float32), reference)
    # rounding the input itself: half a unit in the last place of 2 m, on each axis
    margin.at_most("float32 input", error, 1000 * 1.2e-7 * 3**0.5, "mm")


def test_36_scores_are_invariant(margin):
    reference, predicted = skeletons(seed=1), skeletons(seed=2)
    plain = score_poses(predicted, reference).pa_mpjpe_mm
    moved = similarity(predicted, scale=0.5, axis_angle=[1.0, 0.2, -0.4], shift=[1, 2, 3])
    change = abs(score_poses(moved, reference).pa_mpjpe_mm / plain - 1)
    margin.at_most("PA-MPJPE after a similarity, relative", change, 1e-9)


def test_36_planes_are_aligned_exactly(margin):
    reference = skeletons(2)
    reference[..., 2] = 0
    moved = similarity(reference, scale=2.0, axis_angle=[0.0, 0.0, 1.2], shift=[1, 1, 0])
    margin.at_most("planar", worst_mm(moved, reference), LIMIT_MM, "mm")
    tilted = similarity(reference, scale=2.0, axis_angle=[0.9, -0.3, 1.2], shift=[1, 1, 0])
    margin.at_most("planar, tilted", worst_mm(tilted, reference), LIMIT_MM, "mm")


@pytest.mark.parametrize(
    ("joints", "count"), [("line", 24), ("equal", 24), ("random", 1), ("random", 2)]
)
def test_36_clouds_without_a_rotation_are_flagged_and_finite(joints, count):
    reference = skeletons(3, count)
    predicted = skeletons(3, count, seed=1)
    predicted[0] = reference[0]
    if joints == "line":
        predicted[1] = np.linspace(-1, 1, count)[:, None] * [1.0, 2.0, 0.5]
    elif joints == "equal":
        predicted[1] = 0.25
    alignment = procrustes_aligned(predicted, reference)
    expected = [count <= 2, True, count <= 2]
    assert alignment.degenerate.tolist() == expected
    assert np.isfinite(alignment.joints).all()
    scores = score_poses(predicted, reference)
    assert scores.num_degenerate == sum(expected)
    if count > 2:
        assert np.isfinite(scores.pa_mpjpe_mm)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", ["predicted", "reference"])
def test_36_numbers_that_are_not_finite_are_flagged_and_never_scored(value, which):
    joints = {"predicted": skeletons(3), "reference": skeletons(3, seed=1)}
    joints[which][1, 3, 0] = value
    alignment = procrustes_aligned(**joints)
    assert alignment.degenerate.tolist() == [False, True, False]
    with pytest.raises(DataError, match=f"{which} joint 3 of sample 1"):
        score_poses(**joints)
