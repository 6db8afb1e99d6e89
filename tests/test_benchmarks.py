"""What the field's benchmarks rest on, and that their page shows what was measured."""

import importlib.util
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.error_parts import SLOW_SIGMA_PX, diagnosis, scores
from benchmarks.field_points import STYLES, Point, plot
from benchmarks.filled import clothed_model
from benchmarks.studio import Scores
from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose, pose_body
from ntop.captures.studio.actors import dress_actor, pose_actor
from ntop.metrics.images import Cutout

ROOT = Path(__file__).parents[1]


def page_script():
    path = ROOT / "scripts/write_field_page.py"
    spec = importlib.util.spec_from_file_location("write_field_page", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


def test_the_page_shows_the_committed_figures():
    script = page_script()
    shown = script.PAGE.read_text().split(script.START)[1].split(script.END)[0]
    assert shown == script.sections(script.RESULTS), "run: python scripts/write_field_page.py"


def test_a_page_without_figures_has_no_sections(tmp_path):
    assert page_script().sections(tmp_path).split() == []


def points() -> list[Point]:
    """One point of every field; without LPIPS, as where its weights were not fetched."""
    found = Scores(30.0, 0.95, 0.99, 2.0, None)
    first = Point("grid", 10.0, 9.5, 80, True, "colour", 0.1, found)
    return [
        replace(first, field=field, seconds=9.5 + k, converged=field != "humannerf")
        for k, field in enumerate(STYLES)
    ]


def test_the_page_has_a_line_for_a_point_of_every_field(tmp_path):
    script = page_script()
    assert {field: name for field, (name, _) in STYLES.items()} == script.VARIANTS
    values = {
        "device": "cpu", "pictures": 160, "scored_views": 12, "twin_wins": [],
        "points": [asdict(point) for point in points()],
        "environment": {"cores": 2, "cpu": "any", "commit": "0"},
    }  # fmt: skip
    (tmp_path / "field.json").write_text(json.dumps(values))
    page = script.sections(tmp_path)
    for k, (name, _) in enumerate(STYLES.values()):
        (line,) = (line for line in page.splitlines() if f"| {9.5 + k:.1f} |" in line)
        assert line.startswith(f"| {name}")
        assert ("unconverged" in line) == ("HumanNeRF" in name)


def test_the_plot_takes_points_of_every_field(tmp_path):
    plot(points(), tmp_path / "all.png")
    plot(points()[:1], tmp_path / "one.png")
    assert (tmp_path / "all.png").read_bytes() != (tmp_path / "one.png").read_bytes()


def test_the_clothed_model_moves_as_the_actor_does():
    actor = dress_actor("plain", load_body_model())
    generator = torch.Generator().manual_seed(0)
    pose = BodyPose(
        betas=torch.from_numpy(actor.betas),
        global_orient=torch.tensor([1.5, 0.2, 0.1], dtype=torch.float64),
        body_pose=0.3 * torch.randn(69, generator=generator, dtype=torch.float64),
        transl=torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64),
    )
    ours, truth = pose_body(clothed_model(actor), pose), pose_actor(actor, pose)
    assert np.abs(ours.vertices.numpy() - truth.vertices_world).max() < 1e-6  # metres; float32
    assert np.abs(ours.joints.numpy() - truth.joints_world).max() < 1e-6


def textured_disc(shift_px: float = 0.0) -> Cutout:
    v, u = np.indices((160, 160)) + 0.5
    wave = 0.5 + 0.3 * np.sin((u + shift_px) / 5) * np.sin(v / 6)
    rgb = np.stack([wave, 1 - wave, 0.5 * wave], -1)
    return Cutout(rgb, (np.hypot(u - 80, v - 80) < 60).astype(np.float64))


def test_a_shift_is_found_by_flow_and_counts_as_fine():
    found = diagnosis(textured_disc(1.0), textured_disc())
    assert abs(found.flow_px - 1) < 0.2
    assert found.flow_gain_db > 6
    assert found.slow_db > found.fine_db + 10


def test_a_shade_counts_as_slow():
    truth = textured_disc()
    shaded = Cutout(truth.rgb - 0.05, truth.alpha)
    found = diagnosis(shaded, truth)
    whole_db = scores(shaded, truth).psnr_core_db
    assert abs(whole_db - 20 * np.log10(1 / 0.05)) < 1e-6
    assert abs(found.slow_db - whole_db) < 1e-6  # the mean around a pixel is over the core only
    assert found.fine_db > 90
    assert SLOW_SIGMA_PX < 60  # fits into the disc


def test_an_error_along_the_outline_is_none_of_the_core():
    truth = textured_disc()
    v, u = np.indices((160, 160)) + 0.5
    radius = np.hypot(u - 80, v - 80)
    wrong = np.where(((radius > 57) & (radius < 60))[..., None], 1 - truth.rgb, truth.rgb)
    found = diagnosis(Cutout(wrong, truth.alpha), truth)
    assert found.outline_share > 0.95
