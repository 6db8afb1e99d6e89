"""The stage as a whole: every key, the values that are known, one page with every section."""

import json
import re

import cv2
import numpy as np
import pytest

from ntop.config.sections import EvaluateConfig
from ntop.conventions import DataError
from ntop.report.figures import ALWAYS
from ntop.stages import s8_evaluate
from tests.report.small_world import World, build_world


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> World:
    return build_world(tmp_path_factory.mktemp("evaluate"))


def run(world, out, **changes):
    given = ["masks", "bodies"]  # lie with the captures
    config = {
        "held_out_views": {"real": ["cam02"]},
        "provides": {actor.source: given for actor in world.actors},
    }
    options = {
        "config": EvaluateConfig.model_validate(config),
        "dataset": world.dataset,
        "actors": world.actors_table(),
        "captures": world.root / "1_capture",
        "masks": world.root / "2_mask",
        "fits": world.root / "3_fit",
        "avatars": world.root / "4_train",
        "benchmarks": world.benchmarks,
        "out": out,
    }
    s8_evaluate.main(**(options | changes))


@pytest.fixture(scope="module")
def results(world, tmp_path_factory):
    out = tmp_path_factory.mktemp("results") / "8_evaluate" / "tiny"
    run(world, out)
    return out


def test_metrics_hold_every_key_and_the_known_values(results):
    metrics = json.loads((results / "metrics.json").read_text())
    for key in ALWAYS:
        group, name = key.split(".")
        assert name in metrics[group], key
    assert metrics["truth"]["psnr_person_db"] == pytest.approx(20, abs=0.1)
    assert metrics["truth"]["mask_iou"] == 1
    assert metrics["truth"]["visibility_agreement"] == 1
    assert metrics["labels"]["blob_max_px"] <= 0.05
    assert metrics["labels"]["reprojection_max_px"] <= 1e-9
    assert metrics["dataset"]["images"] == metrics["checks"]["images"] == 36
    assert metrics["fit"] == {"joint_error_mm": 21.5, "mask_iou": 0.9}
    assert metrics["refine_cameras"] == {"before_px": None, "heldout_px": None}
    # nobody checked masks of this actor by hand: nothing is invented
    assert set(metrics["heldout"].values()) == {None}
    assert metrics["checks"]["rle_equals_mask"] == 1
    stripes = metrics["stripes"]
    assert len(stripes) == 2 * 2 * 3  # of one rig: lenses, samplers, figures
    assert stripes["h1.2_r1.0.fisheye.ours.phase_rms"] <= 0.37
    assert stripes["h1.2_r1.0.pinhole.paper.z"] >= 0
    assert metrics["checks"]["coco_self_ap"] == pytest.approx(1)
    assert metrics["seconds"]["train"] == 22
    assert metrics["seconds"]["render"] is None
    assert metrics["seconds"]["evaluate"] > 0
    assert metrics["by_actor"]["real/p00"]["fit"]["mask_iou"] == 0.9
    assert "truth" not in metrics["by_actor"]["real/p00"]


def test_the_report_is_one_file_with_its_sections(results):
    found = sorted(path.name for path in results.iterdir())
    assert found == ["exhibits", "metrics.json", "report.html"]
    page = (results / "report.html").read_text()
    anchors = re.findall(r'<section id="(\w+)"', page)
    assert anchors == [
        "making", "views", "truth", "stripes", "training", "statistics", "figures", "costs",
        "provenance",
    ]  # fmt: skip
    assert len(re.findall(r"<img ", page)) == 2 * 6 + 2 * (9 + 4) + 3 * 4 + 4
    assert "http:" not in page and "https:" not in page


def test_the_exhibits_are_pictures_curves_and_tables(results):
    assert sorted(path.name for path in (results / "exhibits").iterdir()) == [
        "contents-joints_in_frame.svg", "contents-joints_visible.svg", "contents-pose.svg",
        "contents-statistics.html", "contents-subject_size.svg",
        "run-costs.html", "run-left_out.html",
        "scores-studio-plain-PSNR_against_truth.svg",
        "scores-studio-plain-mask_IoU_against_truth.svg",
        "training-real-p00-loss.svg", "training-real-p00-watched_frames.svg",
        "training-studio-plain-loss.svg", "training-studio-plain-watched_frames.svg",
        "views-real-p00-h1.2_r1.0.jpg", "views-studio-plain-h1.2_r1.0.jpg",
    ]  # fmt: skip
    for path in (results / "exhibits").glob("*.jpg"):
        sheet = cv2.imread(str(path))
        assert max(sheet.shape) <= 1600  # Snakemake's report crops larger ones
        assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 1000
    costs = (results / "exhibits/run-costs.html").read_text()
    assert "<td>train</td><td>2</td><td>0.0061</td>" in costs
    assert "GPU" not in costs


def test_a_missing_folder_is_an_error(world, tmp_path):
    with pytest.raises(DataError, match="cannot read"):
        run(world, tmp_path / "out", avatars=world.root / "3_fit")
    with pytest.raises(DataError, match="cannot read table"):
        run(world, tmp_path / "out", dataset=tmp_path / "nothing")
    assert not (tmp_path / "out").exists()
