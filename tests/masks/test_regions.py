"""The warp from the frame to the network's crop and back, in continuous pixels."""

import math

import cv2
import numpy as np
import pytest

from ntop.masks.regions import (
    Region,
    box_around,
    crop_region,
    opencv_affine,
    region_of_person,
    transform_points,
    warp_back,
)


def smooth_picture(width, height):
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    waves = [np.sin(u / 17 + 1), np.cos(v / 23), np.sin((u + v) / 31)]
    return np.rint(127 + 100 * np.stack(waves, -1)).astype(np.uint8)


def test_the_person_stands_upright_in_the_crop():
    region = region_of_person(np.array([100.0, 200.0]), np.array([180.0, 140.0]))
    assert region.side_px == pytest.approx(250.0)
    matrix = region.image_from_crop(256)
    centre, up = transform_points(matrix, np.array([[128.0, 128.0], [128.0, 128.0 - 102.4]]))
    assert np.allclose(centre, [100, 200])
    assert np.allclose(up, [180, 140])  # straight above the hip in the crop


@pytest.mark.parametrize("angle_rad", [0.0, 0.4, -2.0, math.pi])
def test_crop_and_back_is_the_picture(angle_rad):
    picture = smooth_picture(320, 400)
    region = Region(160.0, 190.0, 240.0, angle_rad)
    crop = crop_region(picture, region, size=256).astype(np.float32)
    back = warp_back(crop[..., 0].copy(), region, shape=(400, 320))
    inside = warp_back(np.ones((256, 256), np.float32), region, shape=(400, 320)) > 0.999
    inside = cv2.erode(inside.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert inside.sum() > 40000
    assert np.abs(back - picture[..., 0])[inside].max() < 3.0


def test_a_region_equal_to_the_image_is_the_image():
    picture = smooth_picture(64, 64)
    assert np.array_equal(crop_region(picture, Region(32, 32, 64, 0.0), size=64), picture)


def test_shrinking_a_large_region_keeps_its_place():
    picture = smooth_picture(1200, 1200)
    crop = crop_region(picture, Region(600, 600, 1200, 0.0), size=100)
    wanted = cv2.resize(picture, (100, 100), interpolation=cv2.INTER_AREA)
    assert np.abs(crop.astype(int) - wanted)[2:-2, 2:-2].mean() < 1.0


def test_opencvs_matrix_differs_by_half_a_pixel_only():
    matrix = Region(50, 70, 90, 0.7).image_from_crop(30)
    ours = transform_points(matrix, np.array([[3.5, 8.5]]))
    theirs = transform_points(opencv_affine(matrix), np.array([[3.0, 8.0]]))
    assert np.allclose(ours, theirs + 0.5)


def test_box_of_a_mask_is_clipped_and_empty_has_none():
    mask = np.zeros((10, 12), bool)
    assert box_around(mask, margin_px=3) is None
    mask[1, 4] = True
    rows, columns = box_around(mask, margin_px=2)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (0, 4, 2, 7)
