"""The end-to-end label test: passes on exact labels, and sees the slips it is there to see."""

import numpy as np
import pytest
import torch

from ntop.geometry.cameras import Camera, Equidistant
from ntop.geometry.rigs import ROTATION_LOOKING_DOWN, Rig, top_view_cameras
from ntop.report.blobs import ball, ball_centroid_px, blob_errors_px, blob_max_px
from ntop.report.inputs import Dataset


def test_labels_of_a_dataset_are_right_to_a_twentieth_of_a_pixel(world):
    dataset = Dataset.read(world.dataset)
    errors = blob_errors_px(dataset, next(iter(dataset.sets)))
    assert len(errors) == 9 * 24
    assert max(errors.values()) <= 0.05
    assert blob_max_px(dataset) <= 0.05


@pytest.mark.parametrize("size", [(1000, 1000), (501, 333)])
@pytest.mark.parametrize("theta_deg", [0, 3, 40, 75])
def test_a_ball_appears_where_the_lens_says(size, theta_deg):
    width, height = size
    rig = Rig(1.2, 1.0, width, height, min(size) / np.pi)
    camera = top_view_cameras(rig, torch.tensor([0.3, -0.2, 1.0]))["ne"]
    theta, azimuth = np.radians(theta_deg), 0.7
    direction = torch.tensor(
        [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), -np.cos(theta)]
    )
    center = camera.center_world + 1.4 * direction
    got = ball_centroid_px(ball(center.numpy()), center.numpy(), camera)
    rho = rig.focal_px * theta
    # image right is +x, image up is +y
    expected = [width / 2 + rho * np.cos(azimuth), height / 2 - rho * np.sin(azimuth)]
    assert np.abs(got - expected).max() <= 0.05


def test_a_camera_behind_its_own_sign_is_seen():
    down = torch.tensor(ROTATION_LOOKING_DOWN, dtype=torch.float64)
    lens = Equidistant(focal=30.0, cx=48.0, cy=48.0, width=96, height=96)
    camera = Camera(lens, torch.tensor([0.4, 0.0, 2.0], dtype=torch.float64), down)
    center = np.array([0.0, 0.0, 0.8])
    right = ball_centroid_px(ball(center), center, camera)
    assert right[0] < 48  # a camera in the east sees the person in the west
