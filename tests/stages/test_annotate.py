"""Annotations of rendered shards against the images and the cameras they describe."""

import shutil

import numpy as np
import pytest
import torch
from pycocotools import mask as coco_mask

from ntop.config.sections import AnnotateConfig
from ntop.conventions import MASK_ALPHA, DataError
from ntop.stages import s6_annotate
from ntop.storage import schemas
from ntop.storage.files import record_files
from ntop.storage.images import read_rgba, write_depth, write_parts, write_rgba
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import read_table


@pytest.fixture
def pairs(shards, annotations):
    """(render row, annotation row, mask) of every view of the first shard."""
    folder = shards["first"]
    renders = read_table(folder / "renders.parquet", schema=schemas.RENDER)
    labels = read_table(annotations["first"], schema=schemas.KEYPOINTS)
    return [
        (render, label, read_rgba(folder / render["image_path"])[..., 3] >= MASK_ALPHA)
        for render, label in zip(renders, labels, strict=True)
    ]


def test_boxes_areas_and_run_lengths_are_those_of_the_stored_mask(pairs):
    for render, label, mask in pairs:
        assert label["sample_id"] == render["sample_id"]
        code = {"size": list(mask.shape), "counts": label["rle"]}
        np.testing.assert_array_equal(coco_mask.decode(code).astype(bool), mask)
        (person,) = label["persons"]
        assert person["area_px"] == mask.sum()
        left, top, width, height = (int(value) for value in person["bbox_xywh_px"])
        inside = mask[top : top + height, left : left + width]
        assert inside.sum() == mask.sum()
        assert inside[[0, -1]].any(1).all()
        assert inside[:, [0, -1]].any(0).all()


def test_keypoints_reproject_and_visible_ones_lie_on_the_mask(pairs):
    on_mask = []
    for render, label, mask in pairs:
        (person,) = label["persons"]
        camera = fisheye_camera(render)
        for name, points in (("smpl24", "joints3d_world_m"), ("coco17", "coco17_world_m")):
            world = torch.tensor(render[points], dtype=torch.float64).reshape(-1, 3)
            pixels = np.array(person[f"keypoints2d_{name}_px"]).reshape(-1, 2)
            expected, _ = camera.project(world)
            assert np.abs(pixels - expected.numpy()).max() <= 1e-9  # px
            visible = np.array(person[f"visibility_{name}"]) == 2
            u, v = pixels[visible].astype(int).T
            on_mask.extend(mask[v, u])
        joints = torch.tensor(person["joints3d_camera_m"], dtype=torch.float64).reshape(24, 3)
        back = joints @ camera.rotation + camera.center_world
        expected = torch.tensor(person["joints3d_world_m"], dtype=torch.float64).reshape(24, 3)
        torch.testing.assert_close(back, expected, atol=1e-12, rtol=0)  # metres
    assert len(on_mask) > 200
    assert np.mean(on_mask) >= 0.95


def test_occlusion_differs_between_views_and_both_kinds_occur(pairs):
    values = np.array([label["persons"][0]["visibility_coco17"] for _, label, _ in pairs])
    assert {1, 2} <= set(values.ravel())
    assert (values.min(0) != values.max(0)).sum() >= 5


@pytest.fixture
def copied(shards, tmp_path):
    """A copy of a shard whose first view may be spoilt, and that view's row."""
    folder = tmp_path / "shard"
    shutil.copytree(shards["other"], folder)
    return folder, read_table(folder / "renders.parquet", schema=schemas.RENDER)[0]


def test_a_view_without_a_person_is_kept_and_has_nobody(copied, tmp_path):
    folder, row = copied
    shape = (row["height"], row["width"])
    empty = np.zeros(shape, np.float32)
    write_rgba(np.zeros((*shape, 3), np.float32), empty, path=folder / row["image_path"])
    write_depth(empty, path=folder / row["depth_path"])
    write_parts(np.zeros(shape, np.uint8), path=folder / row["parts_path"])
    record_files(folder)
    s6_annotate.main(AnnotateConfig(), renders=folder, out=tmp_path / "labels.parquet")
    labels = read_table(tmp_path / "labels.parquet", schema=schemas.KEYPOINTS)
    assert [len(label["persons"]) for label in labels] == [0] + [1] * 8
    assert not coco_mask.decode({"size": list(shape), "counts": labels[0]["rle"]}).any()


def test_an_image_of_another_size_or_none_at_all_is_refused(copied, tmp_path):
    folder, row = copied
    write_depth(np.ones((8, 9), np.float32), path=folder / row["depth_path"])
    with pytest.raises(DataError, match=r"bytes, .* were written.*--forcerun"):
        s6_annotate.main(AnnotateConfig(), renders=folder, out=tmp_path / "labels.parquet")
    record_files(folder)  # as if it had been rendered so
    with pytest.raises(DataError, match="9x8 px"):
        s6_annotate.main(AnnotateConfig(), renders=folder, out=tmp_path / "labels.parquet")
    (folder / row["image_path"]).unlink()
    with pytest.raises(DataError, match="cannot be read: No such file"):
        s6_annotate.main(AnnotateConfig(), renders=folder, out=tmp_path / "labels.parquet")
    assert not (tmp_path / "labels.parquet").exists()
