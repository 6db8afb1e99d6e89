"""Triangulation against known points: exact data, outliers, degenerate geometry, bad numbers."""

import math

import pytest
import torch

from ntop.conventions import DataError
from ntop.geometry.cameras import Camera, Pinhole
from ntop.geometry.triangulation import (
    camera_centers,
    camera_rays,
    reprojection_errors_px,
    triangulate,
    triangulate_robust,
)


def looking_at_origin(center: tuple[float, float, float], focal_px: float = 1600.0) -> Camera:
    position = torch.tensor(center, dtype=torch.float64)
    forward = -position / position.norm()
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    lens = Pinhole(focal_px, focal_px, 540.0, 960.0, 1080, 1920, (-0.05, 0.14, 6e-4, 7e-4, 0.0))
    return Camera(lens, position, rotation)


def ring(count: int) -> list[Camera]:
    angles = [2 * math.pi * i / count + 0.2 for i in range(count)]
    return [looking_at_origin((3.5 * math.cos(a), 3.5 * math.sin(a), 1.0)) for a in angles]


def images(cameras: list[Camera], points: torch.Tensor) -> torch.Tensor:
    return torch.stack([camera.project(points)[0] for camera in cameras], -2)


def some_points(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=generator, dtype=torch.float64) * 1.4 - 0.7


def test_leading_dimensions_are_free_and_weights_zero_mean_absent():
    cameras = ring(4)
    points = some_points(24).reshape(4, 6, 3)
    pixels = images(cameras, points)
    pixels[..., 2, :] += 300.0
    directions, covered = camera_rays(cameras, pixels)
    weights = covered.double()
    weights[..., 2] = 0
    found = triangulate(camera_centers(cameras), directions, weights)
    assert found.points_world.shape == (4, 6, 3)
    assert (found.points_world - points).norm(dim=-1).max() < 1e-6
    assert not found.used[..., 2].any()


def test_one_wrong_camera_in_four_is_dropped():
    cameras = ring(4)
    points = some_points(80)
    pixels = images(cameras, points)
    generator = torch.Generator().manual_seed(1)
    pixels += torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    wrong = torch.arange(80) % 4
    pixels[torch.arange(80), wrong] += 150.0
    directions, covered = camera_rays(cameras, pixels)
    centers = camera_centers(cameras)
    plain = triangulate(centers, directions, covered.double())
    robust = triangulate_robust(centers, directions, covered.double(), tolerance_rad=20 / 1600)
    assert robust.valid.all()
    assert not robust.used[torch.arange(80), wrong].any()
    assert (robust.used.sum(-1) == 3).all()
    robust_error = (robust.points_world - points).norm(dim=-1)
    assert robust_error.max() < 0.012  # metres: 1 px is 2.2 mm at 3.5 m
    assert (plain.points_world - points).norm(dim=-1).median() > 0.05


def test_minimises_the_squared_angles():
    cameras = ring(3)
    pixels = images(cameras, some_points(1)) + torch.tensor([[3.0, -2.0], [-4.0, 1.0], [2.0, 5.0]])
    directions, _ = camera_rays(cameras, pixels)
    centers = camera_centers(cameras)
    found = triangulate(centers, directions, torch.ones(1, 3))

    def cost(point: torch.Tensor) -> float:
        offset = point - centers
        sine = torch.linalg.cross(offset, directions[0]).norm(dim=-1) / offset.norm(dim=-1)
        return float(sine.square().sum())

    best = cost(found.points_world[0])
    generator = torch.Generator().manual_seed(2)
    for _ in range(50):
        step = torch.randn(3, generator=generator, dtype=torch.float64) * 2e-3
        assert cost(found.points_world[0] + step) > best


def test_parallel_rays_one_ray_and_points_behind_are_refused():
    centers = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    forward = torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    assert not triangulate(centers, forward, torch.ones(2)).valid
    assert not triangulate(centers, forward, torch.tensor([1.0, 0.0])).valid
    point = torch.tensor([0.5, -2.0, 0.0], dtype=torch.float64)
    away = (centers - point) / (centers - point).norm(dim=-1, keepdim=True)
    behind = triangulate(centers, away, torch.ones(2))
    assert not behind.valid
    assert not behind.used.any()
    assert behind.points_world.abs().sum() == 0


def test_numbers_that_are_not_finite_are_an_error():
    cameras = ring(2)
    directions, _ = camera_rays(cameras, images(cameras, some_points(3)))
    directions[1, 0, 2] = torch.nan
    with pytest.raises(DataError, match="weight 0"):
        triangulate(camera_centers(cameras), directions, torch.ones(3, 2))


def test_reprojection_error_is_the_offset_in_pixels():
    cameras = ring(3)
    points = some_points(5)
    pixels = images(cameras, points)
    pixels[2, 1] += torch.tensor([3.0, 4.0])
    errors = reprojection_errors_px(cameras, points, pixels)
    assert errors[2, 1] == pytest.approx(5.0, abs=1e-9)
    errors[2, 1] = 0
    assert errors.max() < 1e-9
