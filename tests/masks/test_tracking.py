"""The real networks on real frames (fetched by `conftest.py`); choices without them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ntop.config.sections import MaskConfig
from ntop.conventions import DataError
from ntop.masks.landmarks import intersection_over_union
from ntop.masks.network import Network
from ntop.masks.polygons import read_polygon_masks
from ntop.masks.regions import box_around
from ntop.masks.segmentation import segment_person
from ntop.masks.tracking import Networks, follow_person

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "config" / "reference_masks" / "balancing_cam04.json"
LEFT_HIP, RIGHT_HIP = 23, 24


@pytest.fixture(scope="module")
def networks(packages):
    config = MaskConfig()
    return Networks(Network(packages / config.detector), Network(packages / config.landmarks))


@pytest.fixture
def frame_of(packages):
    """A function that reads frame `index` of a camera of the real recording, RGB."""

    def read(view, index):
        (path,) = packages.glob(f"pose2sim/**/*BalancingTrial/videos/{view}.mp4")
        video = cv2.VideoCapture(str(path))
        for _ in range(index + 1):
            assert video.grab()
        return cv2.cvtColor(video.retrieve()[1], cv2.COLOR_BGR2RGB)

    return read


def test_a_reference_frame_is_segmented(networks, frame_of):
    image = frame_of("cam04", 11)
    sighting = follow_person(networks, image, None)
    found = segment_person(image, sighting, plate=None)
    truth = read_polygon_masks(REFERENCE)[11]
    assert found.reason == "" and found.confidence > 0.9
    assert intersection_over_union(found.matte >= 0.5, truth) > 0.92
    confident = sighting.pose.confidence[:33] > 0.5
    u, v = np.floor(sighting.pose.landmarks_px[:33][confident]).astype(int).T
    assert truth[v, u].mean() > 0.9
    # seen from behind: his left is on the left of the picture
    left, right = sighting.pose.landmarks_px[[LEFT_HIP, RIGHT_HIP], 0]
    assert left < right


def test_the_bystander_never_becomes_the_person(networks, frame_of):
    image = frame_of("cam02", 0)
    sighting = follow_person(networks, image, None)
    region = sighting.pose.next_region
    assert abs(region.centre_u_px - 565) < 40 and region.side_px > 850
    # once the actor is covered there is nobody, although she is still there
    box = box_around(segment_person(image, sighting, plate=None).matte > 0, margin_px=10)
    without = image.copy()
    without[box] = 128
    lost = follow_person(networks, without, sighting.pose)
    assert lost.pose is None and lost.reason


def test_a_jump_of_the_person_is_refused(networks, frame_of):
    image = frame_of("cam04", 11)
    pose = follow_person(networks, image, None).pose
    elsewhere = replace(pose.next_region, centre_u_px=pose.next_region.centre_u_px + 900)
    lost = follow_person(networks, image, replace(pose, next_region=elsewhere))
    assert lost.pose is None and lost.reason


def test_a_missing_or_damaged_network_is_named(tmp_path):
    with pytest.raises(DataError, match=r"missing\.tflite"):
        Network(tmp_path / "missing.tflite")
    (tmp_path / "damaged.tflite").write_bytes(b"no network")
    with pytest.raises(DataError, match=r"damaged\.tflite"):
        Network(tmp_path / "damaged.tflite")
