import math

import pytest
import torch

from ntop.geometry.rotations import (
    axis_angle_from_matrix,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

ANGLES = (0.0, 1e-12, 1e-8, 1e-4, 0.0099, 0.0101, 1.0, math.pi - 1e-4, math.pi - 1e-9, math.pi)


def vectors(angle, dtype=torch.float64):
    generator = torch.Generator().manual_seed(3)
    axes = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    return (axes / axes.norm(dim=-1, keepdim=True) * angle).to(dtype)


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_inverts_the_exponential_up_to_pi(angle):
    r = vectors(angle)
    matrices = matrix_from_axis_angle(r)
    back = axis_angle_from_matrix(matrices)
    assert (matrix_from_axis_angle(back) - matrices).abs().max() < 2e-12
    assert back.norm(dim=-1).max() <= math.pi + 1e-12


def test_whole_turns_give_the_same_matrix():
    r = vectors(1.3)
    wrapped = r * (1 - 2 * math.pi / 1.3)
    assert (matrix_from_axis_angle(r) - matrix_from_axis_angle(wrapped)).abs().max() < 1e-14


def test_gradients_are_exact_and_finite_from_zero_to_pi():
    for angle in ANGLES:
        r = vectors(angle)[:3].clone().requires_grad_()
        assert torch.autograd.gradcheck(matrix_from_axis_angle, r, eps=1e-6, atol=1e-6)


def test_quaternions_round_trip():
    matrices = matrix_from_axis_angle(torch.cat([vectors(a) for a in ANGLES]))
    quaternions = quaternion_from_matrix(matrices)
    assert (quaternions[:, 0] >= 0).all()
    assert (matrix_from_quaternion(quaternions) - matrices).abs().max() < 1e-14
