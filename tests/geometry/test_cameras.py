import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.geometry.cameras import Camera, Equidistant, Pinhole, pixel_grid
from ntop.geometry.rotations import matrix_from_axis_angle

GOLDEN = Path(__file__).parents[1] / "golden" / "cycles_fisheye_rays.npz"
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


def test_the_opposite_point_is_never_taken_for_the_point():
    wide = Equidistant(100.0, 50.0, 50.0, 100, 100, max_theta=math.radians(100))
    for degrees in (85, 95, 99):
        point = direction(math.radians(degrees), 0.4)
        here, seen = wide.project(point)
        there, _ = wide.project(-point)
        assert seen
        assert (here - there).norm() > 1
    assert not wide.project(direction(math.radians(101), 0.4))[1]


@pytest.mark.parametrize("lens", [FISHEYE, DISTORTED], ids=["equidistant", "pinhole"])
def test_project_inverts_unproject(lens):
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([lens.width, lens.height], dtype=torch.float64)
    pixels = torch.rand(100_000, 2, generator=generator, dtype=torch.float64) * size
    directions, valid = lens.unproject(pixels)
    back, seen = lens.project(3 * directions)
    assert (seen | ~valid).all()
    assert valid.double().mean() > 0.9
    tolerance = 1e-11 if lens is FISHEYE else 1e-6  # px; the pinhole inverse is iterative
    assert (back - pixels)[valid].abs().max() < tolerance
    assert (directions.norm(dim=-1) - 1).abs().max() < 1e-14


def test_the_principal_point_has_finite_values_and_gradients():
    pixel = torch.tensor([500.0, 500.0], dtype=torch.float64, requires_grad=True)
    ray, _ = FISHEYE.unproject(pixel)
    gradient = torch.autograd.grad(ray[0], pixel)[0]
    assert np.allclose(ray.detach(), [0, 0, 1])
    assert np.allclose(gradient, [1 / FISHEYE.focal, 0], atol=1e-12)
    point = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, requires_grad=True)
    gradient = torch.autograd.grad(FISHEYE.project(point)[0][0], point)[0]
    assert np.allclose(gradient, [FISHEYE.focal, 0, 0])


# the file also holds an equisolid and an anisotropic camera, which are not in this family
@pytest.mark.parametrize(
    "key", [f"eqd_fov{size}" for size in ("180_64x64", "180_63x63", "220_64x64", "140_64x64")]
)
def test_agrees_with_the_rays_of_blender_cycles(key):
    rays = torch.from_numpy(np.load(GOLDEN)[key].astype(np.float64))
    height, width, _ = rays.shape
    fov = math.radians(int(key.split("fov")[1][:3]))
    lens = Equidistant(width / fov, width / 2, height / 2, width, height, max_theta=fov / 2)
    good = torch.isfinite(rays).all(-1)
    grid = pixel_grid(width, height, torch.float64)
    pixels, seen = lens.project(rays[good])
    assert seen.all()
    assert (pixels - grid[good]).norm(dim=-1).max() < 0.005
    # the integer-centre mutant misses by half a diagonal pixel
    assert (pixels - (grid[good] - PIXEL_CENTRE)).norm(dim=-1).min() > 0.7


def test_pinhole_agrees_with_opencv():
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(1000, 3, generator=generator, dtype=torch.float64) * 0.4
    points[:, 2] += 3
    ours, _ = DISTORTED.project(points)
    zero = np.zeros(3)
    theirs, _ = cv2.projectPoints(
        points.numpy(), zero, zero, DISTORTED.opencv_matrix().numpy(),
        np.array(DISTORTED.distortion),
    )  # fmt: skip
    assert np.abs(ours.numpy() - (theirs[:, 0] + PIXEL_CENTRE)).max() < 1e-9


def test_points_behind_a_pinhole_are_not_seen():
    assert not DISTORTED.project(torch.tensor([0.1, 0.1, -2.0]))[1]


def test_camera_far_from_the_origin_keeps_its_precision():
    centre = torch.tensor([5e3, -5e3, 1e3], dtype=torch.float32)
    camera = Camera(FISHEYE, centre, matrix_from_axis_angle(torch.tensor([0.3, 0.2, 0.1])))
    pixels = torch.tensor([[123.5, 700.5], [500.0, 500.0]])
    directions, _ = camera.rays(pixels)
    exact, _ = FISHEYE.unproject(pixels.double())
    error = (directions.double() @ camera.rotation.double().T - exact).norm(dim=-1)
    assert error.max() < 1e-6  # rad


def test_scaled_lens_scales_pixels():
    point = torch.tensor([0.2, -0.1, 2.0], dtype=torch.float64)
    half, _ = DISTORTED.scaled(0.5).project(point)
    full, _ = DISTORTED.project(point)
    assert np.allclose(half, full * 0.5)


def test_an_impossible_fisheye_is_refused():
    with pytest.raises(DataError, match="max_theta"):
        Equidistant(100.0, 0.0, 0.0, 10, 10, max_theta=math.pi)
