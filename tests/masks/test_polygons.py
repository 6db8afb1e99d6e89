"""Masks stored as polygons."""

import json
from pathlib import Path

import numpy as np
import pytest

from ntop.conventions import DataError
from ntop.masks.polygons import rasterise, read_polygon_masks, write_polygon_masks

REFERENCE = Path(__file__).parents[2] / "config" / "reference_masks" / "balancing_cam04.json"


def inside_slowly(rings, u, v):
    odd = False
    for ring in rings:
        for (u0, v0), (u1, v1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            if (v0 > v) != (v1 > v) and u < u0 + (v - v0) * (u1 - u0) / (v1 - v0):
                odd = not odd
    return odd


def test_a_square_covers_the_pixels_whose_centres_it_holds():
    mask = rasterise([np.array([[1.4, 1], [3.6, 1], [3.6, 3], [1.4, 3]])], height=5, width=6)
    wanted = np.zeros((5, 6), bool)
    wanted[1:3, 1:4] = True
    assert np.array_equal(mask, wanted)


def test_rasterising_equals_the_slow_twin_with_holes_and_beyond_the_image():
    rng = np.random.default_rng(0)
    for _ in range(5):
        rings = [rng.uniform(-5, 35, (9, 2)), rng.uniform(5, 20, (5, 2))]
        mask = rasterise(rings, height=24, width=30)
        slow = [[inside_slowly(rings, u + 0.5, v + 0.5) for u in range(30)] for v in range(24)]
        assert np.array_equal(mask, np.array(slow))


def test_written_masks_come_back(tmp_path):
    ring = np.array([[2.0, 2.0], [20.3, 3.1], [11.1, 18.7]])
    hole = np.array([[9.0, 6.0], [13.0, 6.0], [11.0, 10.0]])
    path = tmp_path / "masks.json"
    write_polygon_masks({7: [ring, hole]}, height=24, width=30, note="test", path=path)
    masks = read_polygon_masks(path)
    assert list(masks) == [7]
    assert np.array_equal(masks[7], rasterise([ring, hole], height=24, width=30))
    assert not masks[7][7, 10] and masks[7][12, 11]


@pytest.mark.parametrize(
    "content", ["no json", "[]", '{"width": 3, "height": 3}',
                '{"width": 3, "height": 3, "frames": {"0": [[[1, 1], [2, 2]]]}}']
)  # fmt: skip
def test_a_damaged_file_is_named(tmp_path, content):
    path = tmp_path / "masks.json"
    path.write_text(content)
    with pytest.raises(DataError, match=r"masks\.json"):
        read_polygon_masks(path)


def test_the_reference_masks_are_one_person_in_odd_frames():
    masks = read_polygon_masks(REFERENCE)
    assert list(masks) == list(range(3, 92, 8))
    for mask in masks.values():
        assert mask.shape == (1920, 1088)
        assert 100_000 < mask.sum() < 200_000  # pixels of a standing man at this distance
    assert REFERENCE.stat().st_size < 200_000
    assert set(json.loads(REFERENCE.read_text())) == {"note", "width", "height", "frames"}
