"""The page: everything escaped and inlined, empty parts left out; figures and charts."""

import base64
import json
import re
import shutil
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from ntop.body.model import load_body_model
from ntop.conventions import DataError
from ntop.report.capture import Recording
from ntop.report.charts import STYLE, Line, bar_chart, human, line_chart
from ntop.report.figures import ALWAYS, MEANINGS, complete, figures, write_metrics
from ntop.report.gallery import COMPASS, contact_sheet, representative_sets
from ntop.report.inputs import Dataset
from ntop.report.making import making_panels, making_strip
from ntop.report.mesh import shaded_body
from ntop.report.page import Page, Table, render_page
from ntop.report.pictures import (
    Skeleton,
    Square,
    depth_colours,
    error_colours,
    part_colours,
    picture,
    skeleton_svg,
    square_around,
)
from ntop.report.summary import provenance_rows, read_dataset_record
from ntop.report.training import training_charts, training_note, training_values
from ntop.storage.images import read_rgba
from tests.report.small_world import cutout, pose, side_cameras


def decoded(shown) -> np.ndarray:
    data = base64.b64decode(shown.uri.split(",", 1)[1])
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


def minimal_page(**changes) -> Page:
    values = {m.key: None for m in MEANINGS}
    given = {
        "title": "t",
        "headline": "<h & m>",
        "lead": "l",
        "tiles": (),
        "figures": tuple(figures(values)),
        "provenance": (("ntop", "0"),),
    }
    return Page(**(given | changes))


def test_text_is_escaped_and_empty_sections_are_left_out():
    page = render_page(minimal_page())
    assert "&lt;h &amp; m&gt;" in page
    assert 'id="heldout"' not in page and 'href="#heldout"' not in page
    assert 'id="figures"' in page
    table = Table(("a<b",), (("1",), ("2",)), total=True)
    assert "a&lt;b" in render_page(minimal_page(statistics=table))


def test_the_page_asks_the_network_for_nothing(world):
    dataset = Dataset.read(world.dataset)
    key = representative_sets(dataset, world.studio)["h1.2_r1.0"]
    page = render_page(minimal_page(sheets=(contact_sheet(dataset, key, index=0),)))
    targets = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert targets
    assert all(target.startswith(("data:", "#")) for target in targets)
    assert "@import" not in page and "url(" not in page and "<script" not in page


def test_contact_sheet_has_nine_equal_windows_in_compass_order(world):
    dataset = Dataset.read(world.dataset)
    key = representative_sets(dataset, world.studio)["h1.2_r1.0"]
    sheet = contact_sheet(dataset, key, index=0)
    assert len(sheet.pictures) == 9
    assert len({(p.width, p.height) for p in sheet.pictures}) == 1
    words = {"nw": "north-west", "centre": "centre", "se": "south-east"}
    order = [name for line in COMPASS for name in line]
    for view, word in words.items():
        assert sheet.pictures[order.index(view)].caption.startswith(word)
    assert all(p.alt for p in (*sheet.pictures, *sheet.layers))
    # overlay and picture are cut alike: under every joint lies what the whole image has there
    views = dataset.sets[key]
    for view, shown in zip(order, sheet.pictures, strict=True):
        alpha = read_rgba(dataset.image_path(views[view]))[..., 3]
        stored = np.array(views[view]["persons"][0]["keypoints2d_smpl24_px"]).reshape(-1, 2)
        u, v = np.floor(stored).astype(int).T
        cut_u, cut_v = np.floor(shown.skeletons[1].points_px).astype(int).T
        assert (decoded(shown)[cut_v, cut_u, 3] == alpha[v, u]).all()
        assert (alpha[v, u] > 0).any() and (alpha[v, u] == 0).sum() < 8


def test_strip_shows_all_six_stages(world):
    recording, dataset = Recording(world.real), Dataset.read(world.dataset)
    model = load_body_model()
    panels = making_panels(dataset, recording, model=model, render=cutout)
    assert [panel.name for panel in panels] == [
        "Capture", "Mask", "Body", "Avatar", "Fisheye", "Keypoints",
    ]  # fmt: skip
    assert all(panel.image.shape[0] == panel.image.shape[1] for panel in panels)
    strip = making_strip(dataset, recording, model=model, render=cutout)
    assert all(shown.alt for shown in strip.pictures)


def test_drawn_body_covers_what_rays_hit():
    model = load_body_model()
    camera = side_cameras()["cam01"]
    drawn = shaded_body(model, pose(0), camera)[..., 3] > 0
    cast = cutout(pose(0), camera).mask
    # OpenCV fills every pixel an edge touches: a rim of one pixel more than rays through centres
    assert (drawn & cast).sum() == cast.sum()
    assert (drawn & ~cast).sum() < 0.35 * cast.sum()


def test_windows_reach_beyond_the_image():
    image = np.arange(25, dtype=np.uint8).reshape(5, 5) + 1
    window = Square(-1, 3, 4).of(image)
    assert window.tolist() == [[0, 16, 17, 18], [0, 21, 22, 23], [0, 0, 0, 0], [0, 0, 0, 0]]
    mask = np.zeros((50, 50), bool)
    mask[10:20, 5:35] = True
    around = square_around(mask, margin=0)
    assert (around.left, around.side) == (5, 30)
    assert square_around(mask & ~mask, margin=0) == Square(0, 0, 50)


def test_pictures_keep_size_or_shrink_with_their_overlay():
    image = np.zeros((40, 80, 4), np.uint8)
    image[:, 40:] = (200, 100, 50, 255)
    skeleton = Skeleton("coco17", np.array([[60.0, 20.0]]), np.array([2], np.uint8), (), ("nose",))
    whole = picture(image, alt="a", skeletons=(skeleton,))
    assert (whole.width, whole.height) == (80, 40)
    small = picture(image, alt="a", side_px=20, skeletons=(skeleton,))
    assert (small.width, small.height) == (20, 10)
    assert small.skeletons[0].points_px.tolist() == [[15.0, 5.0]]
    pixels = decoded(small)
    assert pixels[5, 15, 3] == 255 and pixels[5, 4, 3] == 0
    assert np.abs(pixels[5, 15, :3].astype(int) - [50, 100, 200]).max() < 12  # lossy


def test_visible_and_occluded_keypoints_are_drawn_differently():
    points = np.array([[10.0, 10.0], [20.0, 20.0], [30.0, 30.0]])
    overlay = Skeleton(
        "coco17", points, np.array([2, 1, 0], np.uint8), ((0, 1), (1, 2)), ("a", "b", "c<")
    )
    svg = skeleton_svg(overlay, width=40, height=40)
    assert svg.count('class="seen"') == 1
    assert svg.count('class="occluded"') == 1
    assert svg.count("<line") == 1 and "hidden-bone" in svg  # nothing towards v = 0


def test_error_depth_and_part_colours():
    a, b = np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3), np.uint8)
    b[0, 0] = 255
    coloured = error_colours(a, b)
    assert coloured[3, 3].sum() < 20 and coloured[0, 0].sum() > 500
    with pytest.raises(DataError, match="cannot compare"):
        error_colours(a, b[:2])
    depth = np.zeros((2, 2), np.float32)
    depth[0] = [1.0, 2.0]
    assert depth_colours(depth)[..., 3].tolist() == [[255, 255], [0, 0]]
    parts = np.arange(25, dtype=np.uint8).reshape(5, 5)
    colours = part_colours(parts)
    assert colours[0, 0, 3] == 0
    assert len({tuple(c) for c in colours.reshape(-1, 4)[1:].tolist()}) == 24


def test_charts_scale_to_their_values():
    chart = line_chart(
        [Line("a<b", [0, 10], [1.0, float("nan")]), Line("c", [0, 10], [0.0, 2.0], 1)],
        title="T", x_label="x", y_label="y",
    )  # fmt: skip
    assert "a&lt;b" in chart.figure and "nan" not in chart.figure
    assert line_chart([Line("a", [], [])], title="T", x_label="x", y_label="y") is None
    bars = bar_chart({"one": 2.0, "two": None}, title="T", unit="s")
    assert "2.00 s" in bars.figure and "not measured" in bars.figure


def test_a_chart_in_a_file_of_its_own_is_whole():
    lines = [Line("a<b", [0, 10], [1.0, 3.0]), Line("c", [0, 10], [0.0, 2.0], 1)]
    chart = line_chart(lines, title="T & U", x_label="x", y_label="y")
    svg = ElementTree.fromstring(chart.document)
    words = [element.text for element in svg.iter("{http://www.w3.org/2000/svg}text")]
    assert {"T & U", "x", "y", "a<b", "c"} <= set(words)
    assert max(float(svg.get("width")), float(svg.get("height"))) <= 1600
    drawn = re.findall(r'class="([^"]+)"', chart.document)
    assert all(f".{name}" in STYLE for names in drawn for name in names.split() if name != "tick")


def test_training_charts_come_from_the_curves(world):
    charts = training_charts(list(world.actors))
    assert list(charts) == ["loss", "watched_psnr_db"]
    loss = charts["loss"].figure
    assert "Training loss" in loss and loss.count("<polyline") == 2
    assert "PSNR" in charts["watched_psnr_db"].figure
    assert training_charts([world.real])["loss"].title == "Training loss: real/p00"


def test_an_unconverged_avatar_is_called_so(world, tmp_path):
    actor = world.actors[0]
    folder = shutil.copytree(actor.avatar, tmp_path / "avatar")
    header = json.loads((folder / "avatar.json").read_text())
    assert training_note(actor) == "" and training_values(actor) == {}
    record = {"iterations": 1200, "planned": 100_000, "loss": "0.2 MSE", "converged": False}
    header |= {"field": "humannerf", "training": record}
    (folder / "avatar.json").write_text(json.dumps(header))
    twin = replace(actor, avatar=folder)
    assert training_values(twin) == {
        "avatar.iterations": 1200, "avatar.iterations_planned": 100_000, "avatar.converged": 0.0,
    }  # fmt: skip
    assert training_note(twin) == (
        "humannerf, 1,200 of 100,000 iterations, unconverged (fewer than 30,000), loss 0.2 MSE"
    )
    assert f"{twin.name} (unconverged)" in training_charts([twin])["loss"].title
    dataset = Dataset.read(world.dataset)
    rows = dict(provenance_rows(read_dataset_record(dataset), [twin]))
    assert rows[f"avatar of {twin.name}, training"] == training_note(twin)


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0, "0"), (12345.6, "12,346"), (720, "720"), (27.94, "27.9"), (0.98765, "0.988"),
     (3.2e-13, "3.2e-13"), (1.0, "1.00"), (99.96, "100.0")],
)  # fmt: skip
def test_numbers_for_people(value, shown):
    assert human(value) == shown


def test_metrics_always_have_all_keys_and_never_nan(tmp_path):
    path = tmp_path / "metrics.json"
    values = {"truth.psnr_box_db": 28.0, "fit.mask_iou": float("nan")}
    write_metrics(values, by_actor={"studio/plain": {"truth.mask_iou": 0.5}}, path=path)
    document = json.loads(path.read_text())
    assert len(ALWAYS) == 17 + 16
    for key in ALWAYS:
        group, name = key.split(".")
        assert name in document[group]
    assert document["truth"]["psnr_box_db"] == 28.0
    assert document["fit"]["mask_iou"] is None and document["heldout"]["ssim_box"] is None
    assert document["by_actor"] == {"studio/plain": {"truth": {"mask_iou": 0.5}}}


def test_targets_are_judged_in_their_direction():
    shown = {f.key: f for f in figures(complete({"truth.psnr_box_db": 26.9, "dataset.images": 7}))}
    assert shown["truth.psnr_box_db"].status == "missed"
    assert shown["truth.mask_iou"].status == "none" and shown["truth.mask_iou"].shown == "–"
    assert shown["dataset.images"].shown == "7"
    met = {f.key: f for f in figures({"labels.blob_max_px": 0.05, "truth.mask_iou": 0.98})}
    assert met["labels.blob_max_px"].status == met["truth.mask_iou"].status == "met"
