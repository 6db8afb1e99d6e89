"""The Qualisys reader: calibration against published values, and bad recordings refused."""

import os
import stat
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from ntop.captures.qualisys import (
    camera_for_video,
    capture_qualisys,
    find_videos,
    normalised_view,
    read_qca,
)
from ntop.config.tables import Sequence
from ntop.conventions import DataError
from ntop.storage import schemas
from ntop.storage.cameras import read_cameras
from ntop.storage.frames import read_frame
from ntop.storage.tables import read_table
from tests.captures.recording import (
    HEIGHT,
    PUBLISHED,
    VIEWS,
    WIDTH,
    make_recording,
    qca_text,
    sequence,
    settings,
)


@pytest.fixture
def calibration(tmp_path) -> Path:
    path = tmp_path / "Calib.qca.txt"
    path.write_text(qca_text())
    return path


# ---- calibration -------------------------------------------------------------------------------


@pytest.mark.parametrize("serial", PUBLISHED)
def test_cameras_equal_the_published_ones(calibration, serial):
    published = PUBLISHED[serial]
    camera = read_qca(calibration, pose2sim_compat=False)[normalised_view(serial)]
    centre = torch.tensor(published.centre_mm, dtype=torch.float64) / 1000
    assert torch.allclose(camera.center_world, centre, atol=1e-12, rtol=0)
    assert torch.linalg.det(camera.rotation).item() == pytest.approx(1, abs=1e-9)
    translation = camera.camera_from_world.translation.tolist()
    assert translation == pytest.approx(published.translation_m, abs=5e-6)  # printed digits
    rotation_vector = cv2.Rodrigues(camera.rotation.numpy())[0].ravel()
    assert rotation_vector.tolist() == pytest.approx(published.rotation_vector_rad, abs=1e-5)
    assert camera.lens.distortion == (*published.distortion, 0.0)
    assert (camera.lens.width, camera.lens.height) == (1088, 1920)


def test_intrinsics_are_subpixels_and_shift_by_half_a_pixel(calibration):
    lens = read_qca(calibration, pose2sim_compat=False)["cam01"].lens
    assert (lens.fx, lens.fy) == pytest.approx((1681.24, 1681.08), abs=5e-3)
    assert (lens.cx - 0.5, lens.cy - 0.5) == pytest.approx((532.97, 948.14), abs=5e-3)


def test_projection_equals_opencv_at_integer_centres(calibration):
    points = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    points = points * 2 - torch.tensor([2.0, 1.0, 0.0])
    for serial, published in PUBLISHED.items():
        camera = read_qca(calibration, pose2sim_compat=False)[normalised_view(serial)]
        ours, seen = camera.project(points)
        (fu, fv), (cu, cv) = published.focal_subpixels, published.centre_subpixels
        matrix = np.array([[fu, 0, cu], [0, fv, cv], [0, 0, 64]]) / 64
        axes = np.diag([1, -1, -1]) @ np.reshape(published.axes, (3, 3))
        translation = -axes @ np.array(published.centre_mm) / 1000
        theirs, _ = cv2.projectPoints(
            points.numpy(), cv2.Rodrigues(axes)[0], translation, matrix,
            np.array(published.distortion),
        )  # fmt: skip
        assert seen.all()
        # px; Rodrigues forth and back on axes that are orthonormal to 1e-9 only
        assert np.abs(ours.numpy() - 0.5 - theirs[:, 0]).max() < 1e-4


def test_pose2sim_compat_divides_the_distortion_only(calibration):
    raw = read_qca(calibration, pose2sim_compat=False)["cam02"]
    divided = read_qca(calibration, pose2sim_compat=True)["cam02"]
    assert divided.lens.distortion == pytest.approx([d / 64 for d in raw.lens.distortion])
    assert divided.lens.fx == raw.lens.fx
    assert torch.equal(divided.rotation, raw.rotation)


def test_a_cropped_image_moves_the_principal_point(calibration):
    text = calibration.read_text().replace('left="0"', 'left="100"').replace('top="0"', 'top="7"')
    calibration.write_text(text)
    lens = read_qca(calibration, pose2sim_compat=False)["cam01"].lens
    assert (lens.width, lens.height) == (988, 1913)
    assert (lens.cx - 0.5, lens.cy - 0.5) == pytest.approx((432.97, 941.14), abs=5e-3)


@pytest.mark.parametrize("name", ["cam01", "cam_01", "Cam-01", "CAM 01"])
def test_spellings_of_one_camera_are_one_name(name):
    assert normalised_view(name) == "cam01"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<calibration>", "calibration>", "no Qualisys calibration"),
        ('serial="cam_02"', 'serial="cam01"', "empty or doubled"),
        ('viewrotation="0"', 'viewrotation="90"', "viewrotation is 90, only 0"),
        ('skew="0.000000"', 'skew="0.5"', "skew is 0.5"),
        ("<transform", "<transformed", "<transform> is missing"),
        ('r22="', 'q22="', "r22 is None, expected a number"),
        ('centerPointU="', 'centerPointU="x', "centerPointU is 'x"),
        ("<camera ", "<kamera ", "mismatched tag"),
    ],
)
def test_an_unusable_calibration_is_refused(calibration, old, new, message):
    calibration.write_text(calibration.read_text().replace(old, new))
    with pytest.raises(DataError, match=message) as error:
        read_qca(calibration, pose2sim_compat=False)
    assert str(calibration) in str(error.value)


def test_a_calibration_without_cameras_is_refused(calibration):
    calibration.write_text("<calibration><cameras/></calibration>")
    with pytest.raises(DataError, match="no <camera>"):
        read_qca(calibration, pose2sim_compat=False)


# ---- letter-boxed copies -----------------------------------------------------------------------


def test_a_letterboxed_copy_scales_and_shifts_as_measured(calibration):
    camera = read_qca(calibration, pose2sim_compat=False)["cam01"]
    copy = camera_for_video(
        camera, size_px=(1080, 1920), letterbox_sizes_px=((1080, 1920),), where="cam01.mp4"
    )
    factor = 1080 / 1088
    assert copy.lens.fx == pytest.approx(camera.lens.fx * factor)
    assert copy.lens.fy == pytest.approx(camera.lens.fy * factor)
    assert copy.lens.cx == pytest.approx(camera.lens.cx * factor)
    # 7.06 px: offset measured between a still of the camera and its video
    assert copy.lens.cy - camera.lens.cy * factor == pytest.approx(7.06, abs=5e-3)
    assert (copy.lens.width, copy.lens.height) == (1080, 1920)


def test_corners_of_the_calibrated_image_land_on_the_bars_edges(calibration):
    camera = read_qca(calibration, pose2sim_compat=False)["cam03"]
    for size in [(1080, 1920), (1088, 1800), (544, 1000), (2176, 3840)]:
        lens = camera_for_video(
            camera, size_px=size, letterbox_sizes_px=(size,), where="video"
        ).lens
        scale = min(size[0] / 1088, size[1] / 1920)
        corners = torch.tensor([[0.0, 0.0], [1088.0, 1920.0]], dtype=torch.float64)
        plain = torch.tensor([camera.lens.cx, camera.lens.cy], dtype=torch.float64)
        copied = torch.tensor([lens.cx, lens.cy], dtype=torch.float64)
        landed = (corners - plain) * scale + copied
        bars = (torch.tensor(size, dtype=torch.float64) - corners[1] * scale) / 2
        assert torch.allclose(landed[0], bars, atol=1e-9)
        assert torch.allclose(landed[1], torch.tensor(size) - bars, atol=1e-9)


def test_an_undeclared_size_is_refused(calibration):
    camera = read_qca(calibration, pose2sim_compat=False)["cam01"]
    with pytest.raises(DataError, match=r"1080x1920 px.*calibrated for 1088x1920.*letterbox_sizes"):
        camera_for_video(camera, size_px=(1080, 1920), letterbox_sizes_px=(), where="cam01.mp4")


# ---- whole recordings --------------------------------------------------------------------------


@pytest.fixture
def recording(tmp_path, write_video) -> Path:
    return make_recording(tmp_path / "packages", write_video)


def capture(packages: Path, out: Path, *sequences: Sequence, **changes) -> None:
    capture_qualisys(
        settings(**changes),
        source="demo",
        actor="p00",
        sequences=sequences or (sequence(),),
        packages=packages,
        out=out,
    )


def test_frames_point_into_the_untouched_videos(recording, tmp_path):
    out = tmp_path / "out"
    capture(recording, out, sequence(last=8, step=4), sequence("stand", first=1, last=4, step=1))
    rows = read_table(out / "frames.parquet", schema=schemas.FRAME)
    assert len(rows) == 4 * (3 + 4)
    assert {(r["action"], r["frame"]) for r in rows} == {
        ("walk", 0), ("walk", 4), ("walk", 8),
        ("stand", 1), ("stand", 2), ("stand", 3), ("stand", 4),
    }  # fmt: skip
    for row in rows:
        assert row["image_index"] == row["frame"]
        assert row["image_path"] == f"footage/{row['action']}/{row['view']}.mp4"
        original = recording / f"demo/{row['action']}/{row['view']}.mp4"
        assert (out / row["image_path"]).read_bytes() == original.read_bytes()
    row = next(r for r in rows if (r["action"], r["frame"], r["view"]) == ("walk", 8, "cam03"))
    assert abs(read_frame(out / "frames.parquet", row).mean() - 120) < 4  # grey 40 + 10 * 8


def test_each_action_has_the_camera_of_its_videos(recording, tmp_path):
    capture(recording, tmp_path / "out", sequence(), sequence("stand", last=4))
    cameras = read_cameras(tmp_path / "out/cameras.parquet")
    assert set(cameras) == {(action, view) for action in ("walk", "stand") for view in VIEWS}
    plain, boxed = cameras["walk", "cam01"], cameras["stand", "cam01"]
    assert (plain.lens.width, boxed.lens.width) == (WIDTH, 64)
    assert boxed.lens.fx / plain.lens.fx == pytest.approx(64 / 68)
    assert torch.equal(plain.rotation, boxed.rotation)


def test_overlapping_sequences_give_each_frame_once(recording, tmp_path):
    capture(recording, tmp_path / "out", sequence(last=4), sequence(last=8, step=2))
    rows = read_table(tmp_path / "out/frames.parquet", schema=schemas.FRAME)
    assert sorted({r["frame"] for r in rows}) == [0, 1, 2, 3, 4, 6, 8]
    assert len(rows) == 7 * 4


def test_two_captures_are_equal_byte_for_byte(recording, tmp_path):
    for name in ("a", "b"):
        capture(recording, tmp_path / name)
    for table in ("frames.parquet", "cameras.parquet"):
        assert (tmp_path / "a" / table).read_bytes() == (tmp_path / "b" / table).read_bytes()


def test_a_camera_missing_from_the_calibration_is_an_error(recording, tmp_path):
    with pytest.raises(DataError, match=r"no camera cam09; it holds cam01, cam02, cam03, cam04"):
        capture(recording, tmp_path / "out", views=(*VIEWS, "cam09"))


def test_a_missing_video_is_an_error(recording, tmp_path):
    (recording / "demo/walk/cam03.mp4").unlink()
    with pytest.raises(DataError, match=r"expected one video cam03\.mp4.*cam01, cam02, cam04"):
        capture(recording, tmp_path / "out")


def test_two_spellings_of_one_video_are_an_error(recording, write_video):
    write_video(recording / "demo/walk/cam_03.mp4", num_frames=2)
    with pytest.raises(DataError, match=r"expected one video cam03\.mp4, got \['cam03"):
        find_videos(recording / "demo/walk", views=VIEWS)


def test_views_of_different_length_are_an_error(recording, tmp_path, write_video):
    video = recording / "demo/walk/cam02.mp4"
    write_video(video, num_frames=11, width=WIDTH, height=HEIGHT)
    with pytest.raises(DataError, match="cam01 12, cam02 11, cam03 12, cam04 12"):
        capture(recording, tmp_path / "out")


def test_a_video_of_another_size_than_the_calibration_is_an_error(recording, tmp_path):
    with pytest.raises(DataError, match=r"cam01\.mp4: video is 64x120 px.*68x120 px"):
        capture(recording, tmp_path / "out", sequence("stand", last=4), letterbox_sizes_px=())


def test_a_truncated_video_is_an_error(recording, tmp_path, truncate_video):
    truncate_video(recording / "demo/walk/cam04.mp4")
    with pytest.raises(DataError, match=r"cam04\.mp4: truncated.*its container says 12"):
        capture(recording, tmp_path / "out")


def test_frames_beyond_the_videos_are_an_error(recording, tmp_path):
    with pytest.raises(DataError, match=r"declares frames 0\.\.12, its videos hold 0\.\.11"):
        capture(recording, tmp_path / "out", sequence(last=12))


def test_an_action_without_a_trial_is_an_error(recording, tmp_path):
    with pytest.raises(DataError, match="'jump' is declared, but not among the trials"):
        capture(recording, tmp_path / "out", sequence("jump"))


def test_missing_packages_are_an_error(tmp_path):
    with pytest.raises(DataError, match=r"cannot read calibration .*No such file"):
        capture(tmp_path / "nowhere", tmp_path / "out")


def test_an_unwritable_output_folder_is_an_error(recording, tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder is needed")
    with pytest.raises(DataError, match=r"cannot write .*footage/walk/cam01\.mp4"):
        capture(recording, blocked / "out")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_output_folder_is_an_error(recording, tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(DataError, match="cannot write"):
        capture(recording, folder / "out")
    assert list(folder.iterdir()) == []
