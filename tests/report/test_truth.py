"""Scores against truth and held-out cameras, where the answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from ntop.body.model import load_body_model
from ntop.metrics.images import PSNR_CEILING_DB, mask_iou
from ntop.report.capture import Recording
from ntop.report.heldout import heldout_comparison, heldout_values, score_heldout
from ntop.report.inputs import Dataset
from ntop.report.mesh import painted_body
from ntop.report.scores import ImageScores, best_median_worst, mean_scores, score_table
from ntop.report.truth import score_truth, truth_comparison, truth_values
from tests.report.small_world import cutout, painted, pose, side_cameras


def scores(*box_db):
    return [ImageScores(20, value, 0.5, 0.9, 10, 11) for value in box_db]


def test_a_constant_colour_error_gives_its_psnr_and_perfect_masks(world):
    found = score_truth(Dataset.read(world.dataset), world.studio, paint=painted)
    values = truth_values(found)
    assert len(found.rows) == 18
    # 0.1 is stored as 25 or 26 of 255; clipping at white does not happen below 0.9
    assert values["truth.psnr_person_db"] == pytest.approx(20.0, abs=0.1)
    assert values["truth.mask_iou"] == 1.0
    assert values["truth.visibility_agreement"] == 1.0
    assert values["truth.psnr_box_db"] > values["truth.psnr_person_db"]  # grey around him agrees
    assert values["truth.baseline_psnr_box_db"] < 20


def test_a_source_without_truth_has_no_figures(world):
    assert score_truth(Dataset.read(world.dataset), world.real, paint=painted) is None


def test_truth_pictures_show_reference_image_baseline_error(world):
    dataset = Dataset.read(world.dataset)
    found = score_truth(dataset, world.studio, paint=painted)
    comparison = truth_comparison(dataset, world.studio, found, paint=painted)
    assert [len(row) for row in comparison.rows] == [4, 4, 4]
    assert "studio/plain" in comparison.text


def test_the_exact_renderer_scores_the_ceiling_on_a_held_out_camera(world):
    recording = Recording(world.real)
    references = {key: recording.matte(key) > 0.5 for key in recording.frames if key[2] == "cam02"}
    found = score_heldout(recording, references, render=cutout, paint=painted)
    values = heldout_values(found)
    assert found.keys == (("stand", 0, "cam02"), ("stand", 4, "cam02"))
    assert values["heldout.psnr_person_db"] > 58  # 8-bit rounding of the picture
    assert values["heldout.psnr_person_db"] < PSNR_CEILING_DB
    assert values["heldout.mask_iou"] == 1.0
    assert values["heldout.baseline_psnr_person_db"] < 25
    comparison = heldout_comparison(recording, found)
    assert len(comparison.rows) == 2
    assert "cam02" in comparison.text
    nobody = {("stand", 99, "cam02"): np.ones((128, 96), bool)}
    assert score_heldout(recording, nobody, render=cutout, paint=painted) is None


def test_best_median_and_worst_are_distinct_pictures():
    assert best_median_worst(scores(5, 9, 7, 1, 3)) == {"best": 1, "median": 0, "worst": 3}
    assert best_median_worst(scores(5)) == {"best": 0}
    assert best_median_worst(scores(5, 6)) == {"best": 1, "worst": 0}


def test_means_and_tables():
    assert mean_scores(scores(10, 20)).psnr_box_db == 15
    table = score_table({"a": scores(10), "b": scores(20, 30)}, first="rig")
    assert [row[:2] for row in table.rows] == [("a", "1"), ("b", "2"), ("all", "3")]
    assert table.rows[-1][3] == "20.00"


def test_mean_part_colours_come_from_the_pictures(world):
    recording = Recording(world.real)
    model = load_body_model()
    body = painted_body(recording, model, views={"cam01"})
    labels = np.arange(24)
    seen = [0, 3, 6, 9, 12, 15]  # trunk and head: surely in view
    expected = labels / 30 + 0.1  # the small world's red
    assert np.abs(body.colours[seen, 0] - expected[seen]).max() < 0.03
    assert np.abs(body.colours[:, 2] - 0.4).max() < 0.01


def test_the_painted_body_covers_what_rays_hit(world):
    recording = Recording(world.real)
    body = painted_body(recording, load_body_model(), views={"cam01"})
    camera = side_cameras()["cam02"]
    mask = body.cutout(pose(0), camera).mask
    # drawn edges are half a sample wider than rays through pixel centres
    assert mask_iou(mask, cutout(pose(0), camera).mask) > 0.85
    away = replace(camera, center_world=camera.center_world + 50)
    assert not body.cutout(pose(0), away).mask.any()
