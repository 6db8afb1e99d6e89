"""`ntop lens` against OpenCV itself: its calibration, its files, its projection."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose
from ntop.cli import main
from ntop.config.rigs import configured_rig
from ntop.config.sections import ImageConfig, RigConfig
from ntop.geometry.cameras import Camera
from ntop.geometry.fields_of_view import field_of_view, pixels_per_radian
from ntop.geometry.ideal_fisheyes import Equidistant, Equisolid, Stereographic
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.pinhole import Pinhole
from ntop.geometry.rigs import Rig
from ntop.storage import schemas
from ntop.storage.cameras import write_cameras
from ntop.storage.keys import SetKey
from ntop.storage.opencv import read_opencv_lens, write_opencv_lens
from ntop.storage.renders import body_columns, render_row
from ntop.storage.tables import write_table

ROOT = Path(__file__).parents[2]
BENT = KannalaBrandt(
    330.7, 331.2, 319.9, 241.1, 640, 480, math.radians(85), (0.05, -0.02, 0.006, -0.001)
)
PLACE = {"cx": 201.5, "cy": 148.0, "width": 400, "height": 300, "max_theta": math.radians(85)}
FISHEYES = [
    Equidistant(120.0, aspect=1.02, **PLACE),
    Equisolid(120.0, **PLACE),
    Stereographic(120.0, aspect=0.98, **PLACE),
    replace(BENT, max_theta=math.radians(80)),
]


def section_of(text):
    """The lens that the workflow makes of what was printed."""
    image = ImageConfig.model_validate(yaml.safe_load(text)["render"]["image"])
    return configured_rig(RigConfig(height_above_pelvis_m=1.0, ring_radius_m=0.0), image).lens()


def run(capsys, *words):
    assert main(["lens", *map(str, words)]) == 0
    return capsys.readouterr().out


def rays_within(lens, count=200):
    generator = np.random.default_rng(0)
    theta = generator.uniform(0.02, 0.98 * lens.max_theta, count)
    azimuth = generator.uniform(-np.pi, np.pi, count)
    across = np.sin(theta)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(theta)], 1)


def opencvs_pixels(path, rays):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, distortion = (
        storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients")
    )
    project = cv2.projectPoints
    if storage.getNode("fisheye_model").real():
        project = cv2.fisheye.projectPoints
    pixels, _ = project(rays[:, None], np.zeros(3), np.zeros(3), matrix, distortion)
    return pixels[:, 0] + 0.5


def test_a_calibration_of_opencv_becomes_the_configurations_lens(tmp_path, capsys):
    board = np.stack(np.meshgrid(np.arange(7), np.arange(5), [0]), -1).reshape(1, -1, 3) * 0.1
    generator = np.random.default_rng(1)
    boards, corners = [], []
    for _ in range(12):
        turn, _ = cv2.Rodrigues(generator.uniform(-0.5, 0.5, 3))
        place = np.array([*generator.uniform(-0.6, 0.2, 2), generator.uniform(0.3, 0.6)])
        pixels, seen = BENT.project(torch.from_numpy(board[0] @ turn.T + place))
        assert seen.all()
        boards.append(board)
        corners.append(pixels.numpy()[None] - 0.5)
    names = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # of OpenCV 4, 5
    flags = names.CALIB_RECOMPUTE_EXTRINSIC | names.CALIB_FIX_SKEW
    rms, matrix, distortion, _, _ = cv2.fisheye.calibrate(
        boards, corners, (640, 480), np.eye(3), np.zeros((4, 1)), flags=flags,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12),
    )  # fmt: skip
    assert rms < 1e-3
    path = tmp_path / "out_camera_data.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in (("image_width", 640), ("image_height", 480), ("fisheye_model", 1)):
        storage.write(key, value)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", distortion)
    storage.release()
    text = run(capsys, "--opencv", path, "--max-theta-deg", 80)
    lens = section_of(text)
    assert math.degrees(lens.max_theta) == pytest.approx(80, abs=1e-6)
    rays = rays_within(lens)
    ours, seen = lens.project(torch.from_numpy(rays))
    assert seen.all()
    assert np.abs(ours.numpy() - opencvs_pixels(path, rays)).max() < 1e-9
    truth, _ = BENT.project(torch.from_numpy(rays))
    assert np.abs(ours.numpy() - truth.numpy()).max() < 0.05

    fragment = tmp_path / "lens.yaml"  # as it was printed
    fragment.write_text(text)
    assert section_of(run(capsys, "--directory", ROOT, "--configfile", fragment)) == lens


@pytest.fixture(scope="module")
def body():
    zeros = torch.zeros(10), torch.zeros(3), torch.zeros(69), torch.zeros(3)
    return body_columns(load_body_model(), BodyPose(*zeros))


def write_shard(folder, lenses, body):
    rows = []
    for view, lens in lenses.items():
        camera = Camera(lens, torch.zeros(3).double(), torch.eye(3).double())
        rig = Rig(1.0, 0.5, lens.width, lens.height, lens.fx)
        rows.append(
            render_row(
                SetKey("lab", "ada", "stand", "top", 0), view, camera=camera, rig=rig, body=body,
                image_sha256="", avatar_sha256="", seed=0,
            )
        )  # fmt: skip
    write_table(rows, schema=schemas.RENDER, path=folder / "renders.parquet")


@pytest.mark.parametrize("lens", FISHEYES, ids=lambda lens: lens.model)
def test_opencv_projects_with_the_file_as_the_rendered_camera_does(lens, tmp_path, body, capsys):
    write_shard(tmp_path, {"centre": lens, "e": lens}, body)
    path = tmp_path / "camera.yaml"
    text = run(capsys, "--folder", tmp_path, "--out", path)
    assert "renders.parquet: 2 images, views centre, e\n" in text
    exact = isinstance(lens, Equidistant | KannalaBrandt)
    assert ("below 90 degrees only: exact\n" in text) == exact
    rays = rays_within(lens)
    ours, _ = lens.project(torch.from_numpy(rays))
    assert np.abs(opencvs_pixels(path, rays) - ours.numpy()).max() < (1e-9 if exact else 1e-3)
    again = section_of(
        run(capsys, "--opencv", path, "--max-theta-deg", math.degrees(lens.max_theta))
    )
    back, seen = again.project(torch.from_numpy(rays))
    assert seen.all()
    assert np.abs(back.numpy() - ours.numpy()).max() < (1e-9 if exact else 1e-3)
    assert section_of(text).model == lens.model
    same, _ = section_of(text).project(torch.from_numpy(rays))
    assert np.abs(same.numpy() - ours.numpy()).max() < 1e-9


def test_a_real_camera_is_picked_by_action_and_view(tmp_path, capsys):
    lens = Pinhole(1681.24, 1681.08, 533.1, 948.6, 1088, 1920, (-0.05, 0.14, 1e-3, -2e-3, 0.01))
    cameras = {
        ("walk", view): Camera(
            replace(lens, cx=lens.cx + shift), torch.zeros(3).double(), torch.eye(3).double()
        )
        for shift, view in enumerate(("cam01", "cam02"))
    }
    write_cameras(cameras, source="lab", actor="ada", path=tmp_path / "cameras.parquet")
    path = tmp_path / "camera.xml"
    text = run(capsys, "--folder", tmp_path, "--view", "walk/cam02", "--out", path)
    assert "1 cameras, views walk/cam02\n" in text and "render:" not in text
    found = read_opencv_lens(path)
    assert (found.cx, found.distortion) == (534.1, lens.distortion)
    rays = rays_within(found)
    ours, _ = found.project(torch.from_numpy(rays))
    assert np.abs(opencvs_pixels(path, rays) - ours.numpy()).max() < 1e-9
    assert main(["lens", "--folder", str(tmp_path), "--out", str(path)]) == 2
    assert "2 lenses" in capsys.readouterr().err


def test_a_polynomial_that_folds_is_used_up_to_its_fold(tmp_path, capsys):
    path = tmp_path / "camera.yaml"
    folding = replace(BENT, distortion=(-0.12, 0.0, 0.0, 0.0), max_theta=1.0)
    write_opencv_lens(folding, path=path)
    text = run(capsys, "--opencv", path)
    assert "does not say how far it holds" in text
    fold_deg = math.degrees(math.sqrt(1 / (3 * 0.12)))  # 1 + 3 k1 theta^2 = 0
    lens = section_of(text)
    assert fold_deg * (1 - 2e-6) <= math.degrees(lens.max_theta) <= fold_deg


def test_fields_of_view_are_those_of_the_formulas():
    circle = Equidistant(50.0, 100.0, 100.0, 200, 200, math.radians(100))
    view = field_of_view(circle)  # the image ends at 2 rad, the circle before
    assert (view.horizontal, view.vertical) == pytest.approx((2 * math.radians(100),) * 2)
    wide = Equidistant(50.0, 50.0, 20.0, 60, 40, 3.0)
    view = field_of_view(wide)
    assert (view.horizontal, view.vertical) == pytest.approx((60 / 50, 40 / 50))
    assert view.diagonal == pytest.approx((math.hypot(50, 20) + math.hypot(10, 20)) / 50)
    beside = Pinhole(100.0, 100.0, -100.0, 50.0, 200, 100)
    assert field_of_view(beside).horizontal == pytest.approx(math.atan(3) - math.atan(1))


@pytest.mark.parametrize("theta", [0.3, 1.0, math.radians(85)])
def test_pixels_per_radian_are_those_of_the_formulas(theta):
    half = theta / 2
    place = (100.0, 100.0, 200, 200, math.radians(85))
    expected = {
        Equidistant(50.0, *place): (1, theta / math.sin(theta)),
        Equisolid(50.0, *place): (math.cos(half), 2 * math.sin(half) / math.sin(theta)),
        Stereographic(50.0, *place): (math.cos(half) ** -2, 2 * math.tan(half) / math.sin(theta)),
        Pinhole(50.0, 50.0, *place[:4]): (math.cos(theta) ** -2, 1 / math.cos(theta)),
    }
    for lens, in_focals in expected.items():
        assert pixels_per_radian(lens, theta) == pytest.approx(
            [50 * n for n in in_focals], rel=1e-5
        )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--opencv", "a.yaml", "--folder", "b"], "give one of them"),
        (["--max-theta-deg", "80"], "belongs to --opencv"),
        (["--view", "e"], "belongs to --folder"),
        (["--opencv", "absent.yaml"], "absent.yaml: no such camera file"),
        (["--opencv", "pinhole.yaml", "--max-theta-deg", "80"], "pinhole"),
        (["--opencv", "pinhole.yaml", "--max-theta-deg", "180"], "less than 180"),
        (["--opencv", "pinhole.yaml", "--out", "x.txt"], "x.txt: expected .yaml"),
        (["--folder", "nowhere"], "nowhere: none of manifest.parquet, renders.parquet"),
        (["--folder", ".", "--view", "up"], "no view 'up'; it has centre"),
        (["--folder", ".", "--out", "x.yaml"], "off by"),
    ],
)
def test_what_cannot_be_done_is_said_in_words(words, message, tmp_path, body, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_opencv_lens(Pinhole(100.0, 100.0, 50.0, 50.0, 100, 100), path=Path("pinhole.yaml"))
    write_shard(Path(), {"centre": Stereographic(50.0, 50.0, 50.0, 100, 100, 2.8)}, body)
    assert main(["lens", *words]) == 2
    said = capsys.readouterr().err
    assert message in said and "Traceback" not in said
    assert not Path("x.yaml").exists()
