"""The final tables of the tiny campaign against truth that no stage has touched."""

import json
import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from pycocotools.coco import COCO

from ntop.body.authored_motions import authored_motion
from ntop.body.model import load_body_model
from ntop.body.motions import retarget
from ntop.body.skinning import pose_joints
from ntop.captures.studio.actors import dress_actor
from ntop.conventions import MASK_ALPHA, VIEWS
from ntop.storage.images import read_depth, read_rgba

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("campaign")]

ALWAYS_IN_METRICS = [
    "refine_cameras.before_px", "refine_cameras.heldout_px", "fit.joint_error_mm", "fit.mask_iou",
    "heldout.psnr_person_db", "heldout.psnr_box_db", "heldout.ssim_box", "heldout.mask_iou",
    "heldout.baseline_psnr_person_db", "truth.psnr_person_db", "truth.psnr_box_db",
    "truth.mask_iou", "truth.baseline_psnr_box_db", "truth.visibility_agreement",
    "labels.blob_max_px", "labels.reprojection_max_px", "dataset.images",
]  # fmt: skip


def rows(path: Path) -> list[dict]:
    return pq.read_table(path).to_pylist()


def true_joints_world_m(actor: str, motion: str, frames: list[int]) -> np.ndarray:
    """Joints of the actor in an authored clip, [frame, joint, 3]."""
    model = load_body_model()
    dressed = dress_actor(actor, model)
    times_s = torch.tensor(frames, dtype=torch.float64) / 30
    betas = torch.from_numpy(dressed.betas)
    pose = retarget(authored_motion(motion), model, betas, frame_times_s=times_s)
    return pose_joints(model, pose).numpy()


@pytest.fixture(scope="module")
def manifest(campaign):
    return rows(campaign.dataset() / "manifest.parquet")


def test_every_planned_image_is_there_once(campaign, manifest):
    expected = {
        (source, actor, action, rig, frame, view)
        for source, actor, action, frames in (
            ("studio", "plain", "sit", (0, 20, 40)),
            ("raw", "loose", "range", (0, 25, 50, 75)),
        )
        for rig in ("h1.2_r1.0", "h1.0_r0.5")
        for frame in frames
        for view in VIEWS
    }
    keys = [tuple(r[k] for k in ("source", "actor", "action", "rig", "frame", "view"))
            for r in manifest]  # fmt: skip
    assert len(keys) == len(set(keys))
    assert set(keys) == expected
    assert len({r["sample_id"] for r in manifest}) == len(manifest)
    assert {(r["source"], r["split"]) for r in manifest} == {("studio", "train"), ("raw", "val")}
    for row in manifest:
        for column in ("image_path", "depth_path", "parts_path"):
            assert (campaign.dataset() / row[column]).is_file()


def test_given_bodies_reach_the_labels_unchanged(manifest):
    frames = [0, 20, 40]
    truth = true_joints_world_m("plain", "sit", frames)
    for row in manifest:
        if row["source"] == "studio":
            joints = np.array(row["persons"][0]["joints3d_world_m"]).reshape(24, 3)
            assert np.abs(joints - truth[frames.index(row["frame"])]).max() < 1e-5  # m, float32


def test_fitted_bodies_are_near_the_truth(manifest):
    frames = [0, 25, 50, 75]
    truth = true_joints_world_m("loose", "range", frames)
    errors = []
    for row in manifest:
        if row["source"] == "raw" and row["view"] == "centre":
            joints = np.array(row["persons"][0]["joints3d_world_m"]).reshape(24, 3)
            errors.append(np.linalg.norm(joints - truth[frames.index(row["frame"])], axis=-1))
    assert np.median(errors) < 0.02  # m; 0.3 px of 128 px images are about 9 mm


def test_labels_are_the_equidistant_projection_of_the_joints(manifest):
    for row in manifest:
        person = row["persons"][0]
        joints = np.array(person["joints3d_world_m"]).reshape(24, 3)
        x, up, down = (joints - np.array(row["center_world_m"])).T * [[1], [1], [-1]]
        y = -up  # image down is world -y
        theta, azimuth = np.arctan2(np.hypot(x, y), down), np.arctan2(y, x)
        rho = row["focal_px"] * theta
        expected = np.stack([120 + rho * np.cos(azimuth), 120 + rho * np.sin(azimuth)], -1)
        labels = np.array(person["keypoints2d_smpl24_px"]).reshape(24, 2)
        assert np.abs(labels - expected).max() < 1e-6
        visibility = np.array(person["visibility_smpl24"])
        assert ((visibility == 0) == (theta > math.pi / 2)).all()


def test_renders_match_the_ray_cast_truth(campaign, manifest):
    truth_folder = campaign.folder / "results/1_capture/studio/plain/truth"
    truths = {
        (r["action"], r["rig"], r["frame"], r["view"]): r
        for r in rows(truth_folder / "renders.parquet")
    }
    overlaps, depth_errors_m = [], []
    for row in manifest:
        if row["source"] != "studio":
            continue
        truth = truths[(row["action"], row["rig"], row["frame"], row["view"])]
        ours = read_rgba(campaign.dataset() / row["image_path"])[..., 3] >= MASK_ALPHA
        true = read_rgba(truth_folder / truth["image_path"])[..., 3] >= MASK_ALPHA
        overlaps.append((ours & true).sum() / (ours | true).sum())
        both = ours & true
        ours_m = read_depth(campaign.dataset() / row["depth_path"])
        true_m = read_depth(truth_folder / truth["depth_path"])
        depth_errors_m.append(np.median(np.abs(ours_m - true_m)[both]))
    assert np.mean(overlaps) > 0.9  # 150 steps on 128 px images
    assert np.median(depth_errors_m) < 0.02


def test_coco_files_load_and_agree_with_the_masks(campaign, manifest):
    folder = campaign.dataset() / "annotations"
    by_path = {r["image_path"]: r for r in manifest}
    images = 0
    for split in ("train", "val"):
        for kind, count in (("keypoints", 17), ("smpl24", 24)):
            coco = COCO(str(folder / f"person_{kind}_{split}.json"))
            for annotation in coco.loadAnns(coco.getAnnIds()):
                record = coco.loadImgs(annotation["image_id"])[0]
                path = next(p for p in by_path if p.endswith(record["file_name"]))
                mask = read_rgba(campaign.dataset() / path)[..., 3] >= MASK_ALPHA
                assert (coco.annToMask(annotation).astype(bool) == mask).all()
                assert annotation["area"] == mask.sum()
                assert len(annotation["keypoints"]) == 3 * count
                images += 1
    assert images == 2 * len(manifest)


def test_metrics_have_all_keys_and_labels_are_exact(campaign):
    text = (campaign.folder / "results/8_evaluate/test/metrics.json").read_text()
    metrics = json.loads(text)

    def value(key):
        found = metrics
        for part in key.split("."):
            found = found[part]
        return found

    for key in ALWAYS_IN_METRICS:
        value(key)  # raises KeyError if absent
    assert value("labels.blob_max_px") <= 0.05
    assert value("labels.reprojection_max_px") <= 1e-6
    assert value("truth.visibility_agreement") >= 0.9
    assert value("dataset.images") == 126
    assert value("heldout.mask_iou") is None  # nothing is held out here, so nothing is invented
