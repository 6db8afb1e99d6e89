"""Camera tables: what is written comes back, and what is impossible is refused."""

import math

import pytest
import torch

from ntop.conventions import DataError
from ntop.geometry.cameras import Camera, Equidistant, Pinhole
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.storage import schemas
from ntop.storage.cameras import camera_row, read_cameras, write_cameras
from ntop.storage.tables import write_table

LENS = Pinhole(
    fx=1681.24, fy=1681.08, cx=533.47, cy=948.64, width=1088, height=1920,
    distortion=(-0.046, 0.14, 6e-4, 7e-4, 0.0),
)  # fmt: skip


def camera() -> Camera:
    rotation = matrix_from_axis_angle(torch.tensor([1.7, 1.0, -0.4], dtype=torch.float64))
    return Camera(LENS, torch.tensor([1.46, -1.909, 1.897], dtype=torch.float64), rotation)


def test_written_cameras_come_back_bit_for_bit(tmp_path):
    path = tmp_path / "cameras.parquet"
    write_cameras({("walk", "cam01"): camera()}, source="s", actor="a", path=path)
    cameras = read_cameras(path)
    assert list(cameras) == [("walk", "cam01")]
    read = cameras["walk", "cam01"]
    assert read.lens == LENS
    assert torch.equal(read.center_world, camera().center_world)
    assert torch.equal(read.rotation, camera().rotation)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("rotation_camera_from_world", [-1.0, 0, 0, 0, 1, 0, 0, 0, 1], "no proper rotation"),
        ("rotation_camera_from_world", [1.01, 0, 0, 0, 1, 0, 0, 0, 1], "no proper rotation"),
        ("rotation_camera_from_world", [math.nan] * 9, "no proper rotation"),
        ("fx_px", -1681.0, "must be positive"),
        ("width", 0, "must be positive"),
        ("model", "equidistant", "expected 'pinhole_radtan'"),
    ],
)
def test_impossible_cameras_are_refused(tmp_path, column, value, message):
    row = camera_row(camera(), source="s", actor="a", action="walk", view="cam01")
    path = tmp_path / "cameras.parquet"
    write_table([row | {column: value}], schema=schemas.CAMERA, path=path)
    with pytest.raises(DataError, match=message) as error:
        read_cameras(path)
    assert "s/a walk cam01" in str(error.value)


def test_two_cameras_for_one_view_are_refused(tmp_path):
    row = camera_row(camera(), source="s", actor="a", action="walk", view="cam01")
    path = tmp_path / "cameras.parquet"
    write_table([row, row], schema=schemas.CAMERA, path=path)
    with pytest.raises(DataError, match="two cameras"):
        read_cameras(path)


def test_a_fisheye_is_no_capture_camera():
    lens = Equidistant(focal=318.0, cx=500.0, cy=500.0, width=1000, height=1000)
    fisheye = Camera(lens, camera().center_world, camera().rotation)
    with pytest.raises(DataError, match="'equidistant'"):
        camera_row(fisheye, source="s", actor="a", action="walk", view="cam01")
