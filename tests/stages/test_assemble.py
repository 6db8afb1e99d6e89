"""The assembled dataset: manifest, COCO files as pycocotools sees them, set files, card, errors."""

import json
import os
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from ntop.body.skeletons import COCO17_SIGMAS, SMPL24_SIGMAS
from ntop.conventions import MASK_ALPHA, VIEWS, ConfigError, DataError
from ntop.storage import links, schemas
from ntop.storage.images import read_rgba
from ntop.storage.provenance import file_sha256
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import read_table

from .conftest import ACTION, ACTOR, RIG, SOURCE, UNUSABLE

# (file, split, OKS sigmas, number of images)
COCO_FILES = [
    ("person_keypoints", "train", COCO17_SIGMAS, 27),
    ("person_keypoints", "val", COCO17_SIGMAS, 9),
    ("person_smpl24", "train", SMPL24_SIGMAS, 27),
    ("person_smpl24", "val", SMPL24_SIGMAS, 9),
]


def digest(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): file_sha256(path) for path in paths}


@pytest.fixture(scope="module")
def manifest(dataset) -> list[dict]:
    return read_table(dataset / "manifest.parquet", schema=schemas.MANIFEST)


def test_the_manifest_has_one_sorted_row_per_image_and_its_files_exist(dataset, manifest):
    keys = [
        tuple(row[name] for name in ("source", "actor", "action", "rig", "frame"))
        for row in manifest
    ]
    assert keys == sorted(keys)
    assert [row["view"] for row in manifest] == [*VIEWS] * 4  # sets 0, 1, 3 and the other actor's
    assert {row["actor"]: row["split"] for row in manifest} == {ACTOR: "train", "bob": "val"}
    for row in manifest:
        assert row["image_path"].startswith(f"images/{row['split']}/{SOURCE}/{row['actor']}/")
        assert file_sha256(dataset / row["image_path"]) == row["image_sha256"]
        assert (dataset / row["depth_path"]).is_file()
        assert (dataset / row["parts_path"]).is_file()
    assert len({row["sample_id"] for row in manifest}) == len(manifest)


@pytest.mark.parametrize(("name", "split", "sigmas", "images"), COCO_FILES)
def test_pycocotools_scores_the_truth_against_itself_perfectly(
    dataset, name, split, sigmas, images
):
    truth = COCO(str(dataset / f"annotations/{name}_{split}.json"))
    assert len(truth.getImgIds()) == images
    assert min(truth.getAnnIds()) == 1
    results = [
        {
            "image_id": item["image_id"],
            "category_id": item["category_id"],
            "keypoints": item["keypoints"],
            "score": 1.0,
        }
        for item in truth.loadAnns(truth.getAnnIds())
    ]
    judge = COCOeval(truth, truth.loadRes(results), "keypoints")
    judge.params.kpt_oks_sigmas = np.array(sigmas)
    judge.evaluate()
    judge.accumulate()
    judge.summarize()
    assert judge.stats[0] == pytest.approx(1.0)
    assert judge.stats[5] == pytest.approx(1.0)  # recall


@pytest.mark.parametrize(("name", "split", "sigmas", "images"), COCO_FILES)
def test_coco_records_hold_to_the_strict_subset(dataset, name, split, sigmas, images):
    truth = COCO(str(dataset / f"annotations/{name}_{split}.json"))
    (category,) = truth.loadCats(truth.getCatIds())
    assert len(category["keypoints"]) == len(sigmas)
    assert min(min(edge) for edge in category["skeleton"]) == 1
    assert category["sigmas"] == list(sigmas)
    for item in truth.loadAnns(truth.getAnnIds()):
        image = truth.loadImgs(item["image_id"])[0]
        mask = read_rgba(dataset / image["file_name"])[..., 3] >= MASK_ALPHA
        np.testing.assert_array_equal(truth.annToMask(item).astype(bool), mask)
        assert item["area"] == mask.sum()
        keypoints = np.array(item["keypoints"]).reshape(-1, 3)
        labelled = keypoints[:, 2] > 0
        assert item["num_keypoints"] == labelled.sum()
        assert not keypoints[~labelled].any()
        # COCO counts from the first pixel's centre
        ours = np.array(item["keypoints2d_px"]).reshape(-1, 2)
        np.testing.assert_array_equal(keypoints[labelled, :2], ours[labelled] - 0.5)
    assert len(truth.getAnnIds()) == images


def test_cameras_and_keypoints_read_back_from_json_reproject(dataset):
    for name, *_ in COCO_FILES[::2]:
        content = json.loads((dataset / f"annotations/{name}_train.json").read_text())
        images = {image["id"]: image for image in content["images"]}
        for item in content["annotations"]:
            camera = fisheye_camera(images[item["image_id"]])
            world = torch.tensor(item["keypoints3d_world_m"], dtype=torch.float64).reshape(-1, 3)
            pixels, _ = camera.project(world)
            stored = np.array(item["keypoints2d_px"]).reshape(-1, 2)
            assert np.abs(pixels.numpy() - stored).max() <= 1e-9  # px


def test_set_files_hold_what_the_manifest_says_without_loss(dataset, manifest):
    path = dataset / f"sets/train/{SOURCE}/{ACTOR}/{ACTION}/{RIG}/000001.json"
    record = json.loads(path.read_text())
    assert list(record["views"]) == list(VIEWS)
    rows = {row["view"]: row for row in manifest if (row["actor"], row["frame"]) == (ACTOR, 1)}
    (body,) = record["bodies"]
    assert len(body["body_pose_rad"]) == 69
    for view, item in record["views"].items():
        row = rows[view]
        (person,) = row["persons"]
        assert item["sample_id"] == row["sample_id"]
        assert item["camera"]["center_world_m"] == row["center_world_m"]  # bit for bit
        assert body["transl_m"] == person["transl_m"]
        assert item["persons"][0]["keypoints2d_smpl24_px"] == person["keypoints2d_smpl24_px"]
        camera = fisheye_camera(item["camera"])
        world = torch.tensor(body["coco17_world_m"], dtype=torch.float64).reshape(-1, 3)
        stored = np.array(item["persons"][0]["keypoints2d_coco17_px"]).reshape(-1, 2)
        assert np.abs(camera.project(world)[0].numpy() - stored).max() <= 1e-9  # px


def test_statistics_card_and_unusable_frames_are_reported(dataset, manifest):
    summary = json.loads((dataset / "dataset.json").read_text())
    assert (summary["num_images"], summary["num_sets"]) == (36, 4)
    assert [(item["frame"], item["reason"]) for item in summary["skipped"]] == [
        (UNUSABLE, "head outside every view")
    ]
    total = summary["statistics"][-1]
    boxes = np.array([row["persons"][0]["bbox_xywh_px"] for row in manifest])
    assert total["subjects"] == len(boxes)
    assert total["mean_width_px"] == pytest.approx(boxes[:, 2].mean())
    card = (dataset / "README.md").read_text()
    assert card.startswith("---\n")
    assert "| tiny total | 2 (1M, 1F) | 36 |" in card


def test_the_order_of_shards_and_a_second_run_change_no_byte(dataset, assemble, tmp_path):
    splits = ((ACTOR, "train"), ("bob", "val"))
    again = assemble(tmp_path / "again", splits=splits, reverse=True)
    assert digest(again) == digest(dataset)


def test_images_are_hard_links_and_copies_where_links_are_refused(
    dataset, assemble, tmp_path, monkeypatch
):
    sample = next((dataset / "images").rglob("*.png"))
    assert sample.stat().st_nlink >= 2

    def refuse(*_arguments):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(links.os, "link", refuse)
    copied = assemble(tmp_path / "copied", splits=((ACTOR, "train"), ("bob", "val")))
    assert next((copied / "images").rglob("*.png")).stat().st_nlink == 1
    assert digest(copied) == digest(dataset)


def test_an_actor_in_two_splits_is_refused(assemble, tmp_path):
    splits = ((ACTOR, "train"), (ACTOR, "val"), ("bob", "val"))
    with pytest.raises(ConfigError, match="in splits 'train' and 'val'"):
        assemble(tmp_path / "bad", splits=splits)
    assert not (tmp_path / "bad").exists()


def test_an_actor_without_a_split_is_refused(assemble, tmp_path):
    with pytest.raises(ConfigError, match="bob has no split"):
        assemble(tmp_path / "bad", splits=((ACTOR, "train"),))
    assert not (tmp_path / "bad").exists()


def test_one_split_may_stay_empty(assemble, tmp_path):
    out = assemble(tmp_path / "train_only", splits=((ACTOR, "train"), ("bob", "train")))
    empty = COCO(str(out / "annotations/person_keypoints_val.json"))
    assert empty.getImgIds() == []
    assert pq.read_metadata(out / "manifest.parquet").num_rows == 36


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_write_permission_is_a_clear_error(assemble, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(DataError, match="permissions"):
        assemble(tmp_path / "dataset", splits=((ACTOR, "train"), ("bob", "val")))


def test_an_output_below_a_file_is_a_clear_error(assemble, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="permissions"):
        assemble(tmp_path / "file/dataset", splits=((ACTOR, "train"), ("bob", "val")))
