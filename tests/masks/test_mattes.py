"""Sharpened mattes, the scene behind a moving person, and background subtraction."""

import cv2
import numpy as np
import pytest

from ntop.masks.background import subtract_background, temporal_median
from ntop.masks.landmarks import intersection_over_union
from ntop.masks.mattes import fill_small_holes, keep_person, sharpen_matte
from ntop.masks.plates import PlateBuilder, person_log_odds

SIZE = 240


def scene(rng, *, size=SIZE):
    """Smooth colours with some noise-free structure."""
    low = rng.uniform(40, 210, (6, 6, 3)).astype(np.float32)
    picture = cv2.resize(low, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(picture, 0, 255)


def figure_matte(*, centre, size=SIZE):
    """A trunk and a thin raised arm, anti-aliased; truth in [0, 1]."""
    big = np.zeros((4 * size, 4 * size), np.uint8)
    u, v = (int(4 * x) for x in centre)
    cv2.ellipse(big, (u, v), (100, 220), 0, 0, 360, 255, -1)
    cv2.line(big, (u, v - 100), (u + 220, v - 260), 255, 40)
    cv2.circle(big, (u, v - 270), 70, 255, -1)
    return cv2.resize(big, (size, size), interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def composed(matte, background, rng, *, noise=2.0, colour=(225, 150, 120)):
    person = np.array(colour, np.float32)
    picture = matte[..., None] * person + (1 - matte[..., None]) * background
    return np.clip(np.rint(picture + rng.normal(0, noise, picture.shape)), 0, 255).astype(np.uint8)


def coarse(matte):
    """What a network with five-pixel cells, slightly shifted, says about a matte; in 1/255."""
    small = cv2.resize(np.roll(matte, 2, axis=1), (SIZE // 5,) * 2, interpolation=cv2.INTER_AREA)
    return np.rint(255 * cv2.resize(small, (SIZE, SIZE), interpolation=cv2.INTER_CUBIC).clip(0, 1))


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_edges_move_onto_the_pictures_edges(rng):
    background = np.full((SIZE, SIZE, 3), (60, 90, 160), np.float32)
    truth = figure_matte(centre=(110, 130))
    picture = composed(truth, background, rng)
    person = coarse(truth).astype(np.uint8)
    before = intersection_over_union(person >= 128, truth >= 0.5)
    matte = sharpen_matte(picture, person, plate=None, radius_px=8)
    after = intersection_over_union(matte >= 0.5, truth >= 0.5)
    assert before < 0.90 and after > 0.97
    assert np.abs(matte - truth).mean() < 0.006


def test_a_scene_pieced_together_removes_what_is_not_the_person(rng):
    background = scene(rng)
    background[100:170, 140:160] = (20, 20, 20)  # a post that the network takes for a leg
    builder = PlateBuilder((SIZE, SIZE))
    for step in range(12):
        truth = figure_matte(centre=(60 + 10 * step, 130))
        person = coarse(truth).astype(np.uint8)
        builder.add(composed(truth, background, rng), person, radius_px=6)
    plate = builder.finish()
    known = plate.frames >= 5
    assert known.mean() > 0.9
    assert np.abs(plate.colour - background)[known].mean() < 2

    truth = figure_matte(centre=(110, 130))
    picture = composed(truth, background, rng)
    person = coarse(np.maximum(truth, 0)).astype(np.uint8)
    person[100:170, 140:160] = np.maximum(person[100:170, 140:160], 160)
    whole = np.s_[0:SIZE, 0:SIZE]
    odds = person_log_odds(picture, plate, box=whole)
    assert odds[(truth > 0.99) & known].mean() > 2.5
    assert odds[(truth < 0.01) & known].mean() < -1
    without = sharpen_matte(picture, person, plate=None, radius_px=8)
    matte = sharpen_matte(picture, person, plate=plate, radius_px=8)
    assert (without[110:160, 148:156] >= 0.5).mean() > 0.5
    assert (matte[110:160, 148:156] >= 0.5).mean() < 0.02
    assert intersection_over_union(matte >= 0.5, truth >= 0.5) > 0.96


def test_only_parts_with_keypoints_stay_and_pinholes_close():
    matte = np.zeros((100, 100), np.float32)
    matte[20:60, 20:50] = 1
    matte[30:32, 30:32] = 0  # pinhole
    matte[40:55, 25:45] = 0  # a gap between arm and trunk
    matte[70:80, 70:90] = 1  # somebody else
    points, confidence = np.array([[22.5, 22.5], [75.5, 75.5]]), np.array([0.9, 0.2])
    kept = keep_person(matte, points, confidence, radius_px=3)
    assert kept[31, 31] == 1 and kept[47, 35] == 0
    assert not kept[65:85, 65:95].any()
    assert (kept > 0).sum() == 40 * 30 - 15 * 20


def test_holes_at_the_border_are_open():
    mask = np.ones((10, 10), bool)
    mask[0, 4] = mask[5, 5] = False
    filled = fill_small_holes(mask, area_px=4)
    assert filled[5, 5] and not filled[0, 4]


@pytest.mark.parametrize("size", [160, 512])
def test_background_subtraction_against_truth(rng, size):
    background = scene(rng, size=size)
    small = figure_matte(centre=(110, 130))
    truth = cv2.resize(small, (size, size), interpolation=cv2.INTER_AREA)
    plate = np.clip(np.rint(background + rng.normal(0, 2, background.shape)), 0, 255)
    matte = subtract_background(composed(truth, background, rng), plate.astype(np.uint8))
    assert intersection_over_union(matte >= 0.5, truth >= 0.5) > 0.97
    assert np.abs(matte - truth).mean() < 0.01


def test_an_empty_scene_has_no_person(rng):
    background = scene(rng)
    nobody = np.zeros((SIZE, SIZE), np.float32)
    plate = composed(nobody, background, rng)
    assert subtract_background(composed(nobody, background, rng), plate).max() == 0


def test_the_median_of_a_moving_person_is_the_scene(rng):
    background = scene(rng)
    pictures = [
        composed(figure_matte(centre=(40 + 32 * i, 130)), background, rng, noise=0)
        for i in range(7)
    ]
    assert np.abs(temporal_median(pictures).astype(int) - np.rint(background)).mean() < 1.5
