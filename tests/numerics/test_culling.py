"""Cases 14 and 27: what is skipped is empty, and the default preset is close to the integral."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.quadrature_errors import doubled
from benchmarks.skipping import paper
from benchmarks.subjects import painted
from ntop.conventions import PIXEL_CENTRE
from ntop.field.culling import body_pixels
from ntop.field.quality import PRESETS, RenderSettings
from ntop.field.rendering import render_view, trace_rays
from ntop.geometry.windows import resized

SIDE = 160
RESULTS = Path(__file__).parents[2] / "benchmarks/results"
ONE_RAY = replace(PRESETS["default"], edge_rays=1)
UNSKIPPED = replace(ONE_RAY, crop=False, intervals=False, cells=False)


@pytest.fixture(scope="module")
def person():
    return painted()


def camera_of(person, rig, view):
    camera = person.cameras(rig)[view]
    return replace(camera, lens=resized(camera.lens, width=SIDE, height=SIDE))


def seen(person, camera, settings):
    view = render_view(person.posed(settings), camera, settings=settings)
    return np.concatenate([view.rgb * view.alpha[..., None], view.alpha[..., None]], -1), view


@pytest.mark.parametrize(("rig", "view"), [("h1.0_r0.5", "ne"), ("h1.2_r1.0", "w")])
def test_14_culling_is_exact(margin, person, rig, view):
    camera = camera_of(person, rig, view)
    culled, with_all = seen(person, camera, ONE_RAY)
    whole, without = seen(person, camera, UNSKIPPED)
    assert culled[..., 3].max() > 0.99
    margin.at_most("all culling on against off", np.abs(culled - whole).max(), 1e-6)
    margin.at_least("evaluations saved", 1 - with_all.evaluations / without.evaluations, 0.5)
    endless, _ = seen(person, camera, replace(UNSKIPPED, stop_transmittance=0.0))
    limit = 1e-6 + ONE_RAY.stop_transmittance
    margin.at_most("and no early stop", np.abs(culled - endless).max(), limit)


def test_14_octants_judged_by_their_centres_lose_thin_limbs(margin, person):
    camera = camera_of(person, "h1.0_r0.5", "e")
    whole, _ = seen(person, camera, UNSKIPPED)
    mutant, _ = seen(person, camera, replace(ONE_RAY, extent=0.0))
    margin.mutant_exceeds("no margin", np.abs(mutant - whole).max(), 1e-6)


def test_14_most_of_the_papers_samples_are_left_out(margin, person):
    """18 views, one ray through each pixel's centre, as the paper has them."""
    found = paper(person)
    assert found["views"] == 18
    margin.at_least("share of the paper's samples left out, mean of 18 views", found["mean"], 0.96)


def test_14_every_level_measured_keeps_its_bound():
    measured = json.loads((RESULTS / "skipping.json").read_text())
    assert [row for row in measured["rows"] if row["within_bound"] is False] == []
    assert min(row["mean"] for row in measured["paper"]) >= 0.96


def test_27_the_reference_of_an_avatar_is_float64(person):
    """It tells fields apart that are the same in float32: all that is packed and seen is finer."""
    camera = camera_of(person, "h1.0_r0.5", "e")
    posed = doubled(person.posed(ONE_RAY))
    v, u = np.nonzero(body_pixels(posed.warp, camera))
    directions, valid = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
    finer = replace(posed, grid=replace(posed.grid, values=posed.grid.values * (1 + 1e-10)))
    one, other = (
        trace_rays(field, camera.center_world, directions[valid], settings=ONE_RAY)
        for field in (posed, finer)
    )
    assert one.rgb.dtype == one.alpha.dtype == np.float64
    for change in (np.abs(one.rgb - other.rgb), np.abs(one.alpha - other.alpha)):
        assert 1e-13 < np.median(change[one.alpha > 0.02]) < 1e-9


def test_27_the_default_preset_is_close_to_the_integral(margin, person):
    """The integral: float64, pieces of 0.2 mm, nothing skipped, no early stop."""
    differences = []
    for rig, view in (("h1.0_r0.5", "e"), ("h1.2_r1.0", "ne")):
        camera = person.cameras(rig)[view]
        posed = person.posed(ONE_RAY)
        v, u = np.nonzero(body_pixels(posed.warp, camera))
        chosen = np.random.default_rng(0).permutation(len(v))[:2500]
        pixels = np.stack([u, v], 1)[chosen] + PIXEL_CENTRE
        directions, valid = camera.rays(torch.from_numpy(pixels))
        exact = RenderSettings(
            step_m=2e-4, stop_transmittance=0.0, colour_floor=0.0, cells=False, edge_rays=1
        )
        found = [
            trace_rays(one, camera.center_world, directions[valid], settings=settings)
            for one, settings in ((posed, ONE_RAY), (doubled(person.posed(exact)), exact))
        ]
        ours, truth = (np.concatenate([f.rgb, f.alpha[:, None]], 1) for f in found)
        differences.append(255 * (ours - truth)[truth[:, 3] > 0.02])
    every = np.concatenate(differences)
    assert len(every) > 1500
    margin.at_most("rms", float(np.sqrt((every**2).mean())), 0.5, "/255")
    margin.at_most("p99.9", float(np.percentile(np.abs(every).max(-1), 99.9)), 1.0, "/255")


def test_27_the_default_preset_is_what_the_benchmark_chose():
    chosen = json.loads((RESULTS / "quadrature.json").read_text())["chosen"]
    assert {knob: getattr(PRESETS["default"], knob) for knob in chosen} == chosen
