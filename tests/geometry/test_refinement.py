"""Refinement: a disturbed rig is put right, its Jacobian is exact, a held-out camera is alone."""

import math

import numpy as np
import pytest
import torch

from ntop.conventions import DataError
from ntop.geometry.cameras import Camera, Pinhole
from ntop.geometry.refinement import Observations, _Bundle, observe, refine_extrinsics, resect
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.geometry.triangulation import (
    camera_centers,
    camera_rays,
    reprojection_errors_px,
    triangulate,
)

LENS = Pinhole(1680.0, 1680.0, 540.0, 960.0, 1088, 1920, (-0.05, 0.14, 6e-4, 7e-4, 0.0))


def ring() -> list[Camera]:
    cameras = []
    for angle in (0.3, 1.9, 3.4, 4.9):
        forward = -torch.tensor([math.cos(angle), math.sin(angle), 0.25], dtype=torch.float64)
        forward = forward / forward.norm()
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        right = torch.linalg.cross(forward, up)
        right = right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        cameras.append(Camera(LENS, -3.5 * forward, rotation))
    return cameras


def disturbed(camera: Camera, seed: int) -> Camera:
    generator = torch.Generator().manual_seed(seed)
    turn = torch.randn(3, generator=generator, dtype=torch.float64) * 0.006
    shift = torch.randn(3, generator=generator, dtype=torch.float64) * 0.01
    rotation = matrix_from_axis_angle(turn) @ camera.rotation
    return Camera(camera.lens, camera.center_world + shift, rotation)


def person_points(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([0.6, 0.6, 1.7], dtype=torch.float64)
    return (torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5) * size


def images(cameras: list[Camera], points: torch.Tensor, noise_px: float, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    pixels = torch.stack([camera.project(points)[0] for camera in cameras], -2)
    return pixels + noise_px * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)


def median_error_px(cameras: list[Camera], pixels: torch.Tensor) -> float:
    directions, covered = camera_rays(cameras, pixels)
    found = triangulate(camera_centers(cameras), directions, covered.double())
    return float(reprojection_errors_px(cameras, found.points_world, pixels).median())


def test_puts_a_disturbed_rig_right_on_points_it_has_not_seen():
    truth = ring()
    wrong = [disturbed(camera, seed) for seed, camera in enumerate(truth)]
    pixels = images(truth, person_points(300, 1), 2.0, 2)
    pixels[::37, 1] += 200.0  # outliers
    fresh = images(truth, person_points(200, 3), 2.0, 4)
    observations = observe(wrong, pixels, torch.ones(300, 4))
    refined = refine_extrinsics(wrong, observations, prior_weight=30.0, loss_scale_px=4.0)
    assert median_error_px(wrong, fresh) > 6
    assert median_error_px(refined, fresh) < 1.05 * median_error_px(truth, fresh) + 0.05


def test_perfect_cameras_stay():
    truth = ring()
    observations = observe(truth, images(truth, person_points(60, 5), 0.0, 6), torch.ones(60, 4))
    refined = refine_extrinsics(truth, observations, prior_weight=30.0, loss_scale_px=4.0)
    for camera, other in zip(truth, refined, strict=True):
        assert (camera.center_world - other.center_world).norm() < 1e-6  # metres
        assert (camera.rotation - other.rotation).abs().max() < 1e-6


def test_resection_moves_one_camera_against_given_points():
    truth = ring()
    points = person_points(80, 7)
    wrong = disturbed(truth[3], 11)
    pixels = images([truth[3]], points, 1.0, 8)
    observations = observe([wrong], pixels, torch.ones(80, 1))
    found = resect(wrong, observations, points, prior_weight=1.0, loss_scale_px=4.0)
    fresh = person_points(100, 9)
    pixels = images([truth[3]], fresh, 0.0, 0)
    assert reprojection_errors_px([wrong], fresh, pixels).median() > 5
    assert reprojection_errors_px([found], fresh, pixels).median() < 1
    assert (found.rotation @ found.rotation.T - torch.eye(3)).abs().max() < 1e-12


def test_jacobian_equals_finite_differences():
    cameras = ring()
    points = person_points(5, 12)
    observations = observe(cameras, images(cameras, points, 3.0, 13), torch.ones(5, 4))
    problem = _Bundle(cameras, observations, prior_weight=30.0, points=points)
    generator = np.random.default_rng(0)
    unknowns = np.concatenate([generator.normal(0, 0.02, 24), points.reshape(-1).numpy()])
    _, jacobian = problem._evaluate(unknowns)
    numeric = np.empty(jacobian.shape)
    for column in range(unknowns.size):
        step = np.zeros_like(unknowns)
        step[column] = 1e-6
        high, low = problem._evaluate(unknowns + step)[0], problem._evaluate(unknowns - step)[0]
        numeric[:, column] = (high - low) / 2e-6
    assert np.abs(jacobian.toarray() - numeric).max() < 1e-4  # pixels per metre or radian, of 1e3


def test_recordings_with_different_lenses_join():
    truth = ring()
    smaller = [Camera(LENS.scaled(0.5), c.center_world, c.rotation) for c in truth]
    points = person_points(40, 14)
    parts = [
        observe(cameras, images(cameras, points, 0.0, 0), torch.ones(40, 4))
        for cameras in (truth, smaller)
    ]
    joined = Observations.joined(parts)
    assert joined.weights.shape == (80, 4)
    assert torch.allclose(joined.bearings_camera[:40], joined.bearings_camera[40:], atol=1e-9)
    assert torch.equal(joined.scale_px[40:], 0.5 * joined.scale_px[:40])


def test_too_few_points_are_an_error():
    truth = ring()
    observations = observe(truth, images(truth, person_points(10, 15), 0.0, 0), torch.ones(10, 4))
    with pytest.raises(DataError, match="give more frames"):
        refine_extrinsics(truth, observations, prior_weight=30.0, loss_scale_px=4.0)
