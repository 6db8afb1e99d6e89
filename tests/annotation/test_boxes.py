"""Masks as boxes, areas and run-length codes, against pycocotools."""

import numpy as np
import pytest
from pycocotools import mask as coco_mask

from ntop.annotation.boxes import silhouette


def decode(rle: str, shape: tuple[int, int]) -> np.ndarray:
    return coco_mask.decode({"size": list(shape), "counts": rle}).astype(bool)


@pytest.mark.parametrize("shape", [(40, 60), (61, 33), (1, 5)])
def test_run_lengths_area_and_box_describe_the_mask(shape):
    mask = np.random.default_rng(shape[0]).random(shape) < 0.3
    mask[0, 0] = True  # the first run of the code has length zero
    outline = silhouette(mask)
    np.testing.assert_array_equal(decode(outline.rle, shape), mask)
    assert outline.area_px == mask.sum()
    code = {"size": list(shape), "counts": outline.rle}
    assert outline.bbox_xywh_px == tuple(coco_mask.toBbox(code))
    assert outline.area_px == coco_mask.area(code)


def test_the_box_of_one_pixel_spans_its_edges():
    mask = np.zeros((20, 30), bool)
    mask[7, 11] = True
    assert silhouette(mask).bbox_xywh_px == (11.0, 7.0, 1.0, 1.0)


def test_nobody_has_no_box():
    outline = silhouette(np.zeros((20, 30), bool))
    assert outline.bbox_xywh_px is None
    assert outline.area_px == 0
    assert not decode(outline.rle, (20, 30)).any()
