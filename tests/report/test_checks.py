"""Checks of a dataset: right on an exact one, and able to fail."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from ntop.report.checks import check_masks, coco_self_ap, reprojection_max_px
from ntop.report.inputs import Dataset
from ntop.storage.images import read_rgba, write_rgba


@pytest.fixture
def broken(world, tmp_path):
    """A copy of the dataset that may be damaged."""
    folder = tmp_path / "tiny"
    shutil.copytree(world.dataset, folder)
    return folder


def test_an_assembled_dataset_passes(world):
    dataset = Dataset.read(world.dataset)
    assert reprojection_max_px(dataset) <= 1e-9
    assert coco_self_ap(dataset) == pytest.approx(1.0)
    checks = check_masks(dataset)
    assert checks.rle_equals_mask == 1.0
    # one ray per pixel at 96 px: an ankle's pixel may miss a thin foot
    assert checks.visible_on_mask > 0.9


def test_a_camera_moved_by_a_millimetre_is_found_in_manifest_and_sets(world, broken):
    dataset = Dataset.read(world.dataset)
    row = dataset.rows[3]
    moved = row | {"center_world_m": [v + 1e-3 for v in row["center_world_m"]]}
    rows = (*dataset.rows[:3], moved, *dataset.rows[4:])
    assert reprojection_max_px(replace(dataset, rows=rows)) > 0.01
    path = sorted((broken / "sets").rglob("*.json"))[0]
    record = json.loads(path.read_text())
    record["views"]["e"]["camera"]["focal_px"] += 0.01
    path.write_text(json.dumps(record))
    assert reprojection_max_px(Dataset.read(broken)) > 1e-4


def test_one_changed_mask_pixel_is_found(broken):
    dataset = Dataset.read(broken)
    path = dataset.image_path(dataset.rows[0])
    rgba = read_rgba(path) / 255
    alpha = rgba[..., 3].copy()
    alpha[tuple(np.argwhere(alpha == 1)[0])] = 0
    path.unlink()  # it is a hard link to the shard's file
    write_rgba(rgba[..., :3], alpha, path=path)
    count = len(dataset.rows)
    # each image has a code in both files
    assert check_masks(dataset).rle_equals_mask == pytest.approx((count - 1) / count)


def test_a_wrong_annotation_id_lowers_the_self_score(broken):
    path = broken / "annotations" / "person_keypoints_val.json"
    text = path.read_text()
    # COCO treats id 0 as "not matched"
    path.write_text(text.replace('{"id":1,"image_id"', '{"id":0,"image_id"'))
    assert coco_self_ap(Dataset.read(broken)) < 1
