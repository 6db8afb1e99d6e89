"""The Qualisys reader: calibration against published values, and bad recordings refused."""

import os
import stat
from pathlib import Path
from typing import NamedTuple

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
from ntop.config import QualisysSource, Sequence
from ntop.conventions import DataError
from ntop.storage import schemas
from ntop.storage.cameras import read_cameras
from ntop.storage.frames import read_frame
from ntop.storage.tables import read_table


class Calibrated(NamedTuple):
    """One camera as published: in the file's own terms, and as others read it from that file."""

    axes: tuple[float, ...]  # rows: right, up, backward
    centre_mm: tuple[float, float, float]
    focal_subpixels: tuple[float, float]
    centre_subpixels: tuple[float, float]
    distortion: tuple[float, float, float, float]  # k1, k2, p1, p2
    translation_m: tuple[float, float, float]
    rotation_vector_rad: tuple[float, float, float]


# the Pose2Sim demo's calibration; translation and rotation vector as its users report them
PUBLISHED = {
    "cam_01": Calibrated(
        (0.5536380477336265, 0.8046719867383512, 0.2144479094331626, -0.4345300743838753,
         0.05946489349975602, 0.8986921279821063, 0.7104002579937896, -0.5907342212870501,
         0.3825762057979294),
        (1460.2323709212087, -1909.1590482454608, 1896.5058524092062),
        (107599.671875, 107588.828125), (34110.316406, 60680.792969),
        (-0.046183, 0.139983, 0.000608, 0.00069),
        (0.32110, 0.95633, 2.89071), (1.68828, 1.04832, -0.41956),
    ),
    "cam_02": Calibrated(
        (-0.1966832217091926, 0.979523227309506, -0.043011131806342306, -0.31478107085300017,
         -0.02153908797812718, 0.9489198834051846, 0.9285626460991909, 0.20017570994064315,
         0.3125717476340885),
        (2582.0136248568124, 706.5662881637625, 1690.9818366061595),
        (107118.695313, 107123.023438), (34207.652344, 61646.457031),
        (-0.047847, 0.136786, 0.000972, 0.000291),
        (-0.11153, 0.77662, 3.06755), (1.34976, 1.59638, -1.19833),
    ),
    "cam_03": Calibrated(
        (-0.740641130147863, -0.6704153360235378, -0.044654154988568895, 0.25251118212268814,
         -0.3393170985114385, 0.9061467925015139, -0.6226466246887545, 0.6598539110153292,
         0.4205995683324882),
        (-3216.86586729648, 2231.1786368869416, 2088.19103027083),
        (107622.296875, 107616.632813), (32845.335938, 61120.328125),
        (-0.046705, 0.137622, -0.000542, -0.000517),
        (-0.79348, 0.32284, 4.35351), (0.81097, -2.19721, 1.37603),
    ),
    "cam_04": Calibrated(
        (0.2586331447643361, -0.875095795920923, -0.40904308378315923, 0.49590579729377593,
         -0.24310718522469382, 0.8336524076031634, -0.8289670298870364, -0.4184569804097585,
         0.3710895025551282),
        (-3758.720480260634, -1415.6654017496533, 1881.7941041388026),
        (107215.039063, 107213.070313), (34566.796875, 61697.9375),
        (-0.047633, 0.134667, 0.000277, 0.000199),
        (0.50302, 0.04895, 4.40656), (1.40456, -1.38874, 0.42536),
    ),
}  # fmt: skip


def qca_text(*, width: int = 1088, height: int = 1920, scale: float = 1.0) -> str:
    """A .qca.txt file with the published cameras; `scale` multiplies their focals and centres."""
    cameras = []
    for serial, camera in PUBLISHED.items():
        names = [f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)] + ["x", "y", "z"]
        values = (*camera.axes, *camera.centre_mm)
        transform = " ".join(f'{n}="{v!r}"' for n, v in zip(names, values, strict=True))
        k1, k2, p1, p2 = camera.distortion
        focal_u, focal_v = (value * scale for value in camera.focal_subpixels)
        centre_u, centre_v = (value * scale for value in camera.centre_subpixels)
        cameras.append(f"""
    <camera active="1" serial="{serial}" viewrotation="0">
      <fov_video bottom="{height - 1}" left="0" right="{width - 1}" top="0"/>
      <transform {transform}/>
      <intrinsic centerPointU="{centre_u!r}" centerPointV="{centre_v!r}"
        focalLengthU="{focal_u!r}" focalLengthV="{focal_v!r}" skew="0.000000"
        radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="0.000000"
        tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/>
    </camera>""")
    return f"<calibration><cameras>{''.join(cameras)}</cameras></calibration>"


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

WIDTH, HEIGHT = 68, 120  # the calibrated image at 1/16
VIEWS = ("cam01", "cam02", "cam03", "cam04")


@pytest.fixture
def recording(tmp_path, write_video) -> Path:
    """A folder of packages with one small recording: 2 trials, 4 views; 12 and 5 frames."""
    packages = tmp_path / "packages"
    folder = packages / "demo"
    folder.mkdir(parents=True)
    (folder / "Calib.qca.txt").write_text(qca_text(width=WIDTH, height=HEIGHT, scale=1 / 16))
    for view in VIEWS:
        write_video(folder / f"walk/{view}.mp4", num_frames=12, width=WIDTH, height=HEIGHT)
        write_video(folder / f"stand/{view}.mp4", num_frames=5, width=64, height=HEIGHT)
    return packages


def settings(**changes) -> QualisysSource:
    values = {
        "reader": "qualisys",
        "package": "demo",
        "calibration": "Calib.qca.txt",
        "views": VIEWS,
        "trials": {"walk": {"videos": "walk"}, "stand": {"videos": "stand"}},
        "letterbox_sizes_px": [(64, HEIGHT)],
    }
    return QualisysSource.model_validate(values | changes)


def sequence(action: str = "walk", *, last: int = 11, step: int = 1, first: int = 0) -> Sequence:
    return Sequence(
        source="demo", actor="p00", action=action, first=first, last=last, step=step, use="train"
    )


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
