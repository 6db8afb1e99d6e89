import math

import numpy as np
import pytest
import torch

from ntop.geometry.cameras import Equidistant, Pinhole
from tests.numerics.lenses import directions, family

FISHEYE = Equidistant(1000 / math.pi, 500.0, 500.0, 1000, 1000, max_theta=math.radians(170))
DISTORTED = Pinhole(1681.0, 1680.0, 533.0, 948.6, 1088, 1920, (-0.05, 0.14, 1e-3, -2e-3, 0.01))


def direction(theta, azimuth):
    return torch.tensor(
        [
            math.sin(theta) * math.cos(azimuth),
            math.sin(theta) * math.sin(azimuth),
            math.cos(theta),
        ],
        dtype=torch.float64,
    )


@pytest.mark.parametrize("degrees", [0, 30, 89.9, 90, 109.9, 169.9])
def test_a_point_at_theta_lands_focal_times_theta_from_the_principal_point(degrees):
    theta = math.radians(degrees)
    for azimuth in np.linspace(-3, 3, 7):
        pixel, seen = FISHEYE.project(2.5 * direction(theta, azimuth))
        expected = [
            500 + FISHEYE.focal * theta * math.cos(azimuth),
            500 + FISHEYE.focal * theta * math.sin(azimuth),
        ]
        assert seen
        assert np.allclose(pixel, expected, atol=1e-10)


def test_points_behind_a_pinhole_are_not_seen():
    assert not DISTORTED.project(torch.tensor([0.1, 0.1, -2.0]))[1]


def test_scaled_lens_scales_pixels():
    point = torch.tensor([0.2, -0.1, 2.0], dtype=torch.float64)
    half, _ = DISTORTED.scaled(0.5).project(point)
    full, _ = DISTORTED.project(point)
    assert np.allclose(half, full * 0.5)


def test_a_pinhole_sees_only_where_its_distortion_is_one_to_one():
    folding = Pinhole(500.0, 500.0, 500.0, 500.0, 1000, 1000, (-0.3, 0.0, 0.0, 0.0, 0.0))
    assert folding.max_tangent == pytest.approx((1 / 0.9) ** 0.5, rel=1e-5)
    tangents = torch.tensor([0.5, 1.05, 1.06, 1.8], dtype=torch.float64)
    points = torch.stack([tangents, torch.zeros(4), torch.ones(4)], -1)
    pixels, seen = folding.project(points)
    assert seen.tolist() == [True, True, False, False]
    assert not folding.unproject(pixels[:1] + 400)[1].any()  # no ray lands there
    tilted = Pinhole(500.0, 500.0, 500.0, 500.0, 1000, 1000, (-0.3, 0.0, 0.02, 0.02, 0.0))
    assert 0.8 < tilted.max_tangent < folding.max_tangent


def test_a_lens_bounds_how_far_apart_the_images_of_two_rays_are():
    generator = torch.Generator().manual_seed(3)
    for lens in (*family(100.0), DISTORTED):
        theta = lens.max_theta * torch.rand(4000, generator=generator, dtype=torch.float64)
        around = 6.3 * torch.rand(4000, generator=generator, dtype=torch.float64)
        rays = directions(theta, around)
        near = rays + 0.02 * torch.randn(4000, 3, generator=generator, dtype=torch.float64)
        near = near / near.norm(dim=-1, keepdim=True)
        (here, seen), (there, also) = lens.project(rays), lens.project(near)
        both = seen & also & (theta < lens.max_theta - 0.1)
        angle = 2 * torch.asin(0.5 * (rays - near).norm(dim=-1))
        assert int(both.sum()) > 2000
        assert ((here - there).norm(dim=-1) <= lens.max_px_per_rad * angle)[both].all()
