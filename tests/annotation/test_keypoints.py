"""Projection of keypoints against the lens's law, and what counts as in view."""

import math

import pytest
import torch

from ntop.annotation.keypoints import project_keypoints
from ntop.geometry.cameras import Camera, Equidistant
from ntop.geometry.rigs import Rig, top_view_cameras

SIZE = 1000
FOCAL = SIZE / math.pi


def camera(width: int = SIZE, height: int = SIZE) -> Camera:
    """At (0.3, -0.2, 2.5), looking down, image up = +y."""
    rig = Rig(2.5, 0.0, width, height, FOCAL)
    return top_view_cameras(rig, torch.tensor([0.3, -0.2, 0.0]))["centre"]


@pytest.mark.parametrize("theta_deg", [0.0, 20.0, 60.0, 89.9])
@pytest.mark.parametrize("azimuth_deg", [0.0, 130.0, 260.0])
def test_pixels_follow_the_equidistant_law_and_distances_are_ray_lengths(theta_deg, azimuth_deg):
    theta, azimuth = math.radians(theta_deg), math.radians(azimuth_deg)
    direction = torch.tensor(
        [
            math.sin(theta) * math.cos(azimuth),
            math.sin(theta) * math.sin(azimuth),
            -math.cos(theta),
        ],
        dtype=torch.float64,
    )
    point = camera().center_world + 1.7 * direction
    projected = project_keypoints(point[None], camera())
    u = 500 + FOCAL * theta * math.cos(azimuth)
    v = 500 - FOCAL * theta * math.sin(azimuth)
    assert projected.pixels[0].tolist() == pytest.approx([u, v], abs=1e-9)  # px
    assert projected.distances_m.item() == pytest.approx(1.7, abs=1e-12)
    assert projected.in_view.item()


def test_points_beyond_the_circle_or_the_image_are_kept_but_not_in_view():
    centre = camera().center_world
    offsets = torch.tensor([[1.0, 0.0, 0.1], [0.0, 2.0, -0.2], [0.0, -2.0, -0.2]])
    wide = project_keypoints(centre + offsets, camera())
    assert wide.in_view.tolist() == [False, True, True]
    assert wide.pixels[0, 0] > SIZE  # unclipped
    # the same lens on a low, wide image: up and down are now cut off
    low = Camera(
        Equidistant(focal=FOCAL, cx=500.0, cy=100.0, width=1000, height=200),
        centre,
        camera().rotation,
    )
    flat = project_keypoints(centre + offsets, low)
    assert flat.in_view.tolist() == [False, False, False]
    assert flat.pixels[1, 1] < 0
    assert flat.pixels[2, 1] > 200


def test_camera_points_are_the_world_points_seen_from_the_camera():
    points = torch.randn(24, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    projected = project_keypoints(points, camera())
    expected = camera().camera_from_world.apply(points)
    torch.testing.assert_close(projected.points_camera, expected, atol=1e-12, rtol=0)  # metres
