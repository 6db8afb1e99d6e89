"""Checks of a capture: sound ones pass, each way of misreading a source is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ntop.body.skeletons import SMPL24_NAMES
from ntop.captures.checks import (
    check_bodies,
    check_capture,
    check_frames,
    check_joints_in_masks,
    check_rig,
)
from ntop.captures.qualisys import read_qca
from ntop.conventions import DataError
from ntop.geometry.cameras import Camera, Pinhole
from ntop.storage.images import write_matte
from tests.captures.recording import qca_text

# a standing figure, facing +y, metres, SMPL order (pelvis, hips, spine1, knees, ... hands)
STANDING = torch.tensor([
    [0, 0, 0.95], [-0.1, 0, 0.87], [0.1, 0, 0.87], [0, 0, 1.08], [-0.1, 0, 0.5], [0.1, 0, 0.5],
    [0, 0, 1.2], [-0.1, 0, 0.1], [0.1, 0, 0.1], [0, 0, 1.3], [-0.1, 0.1, 0.03], [0.1, 0.1, 0.03],
    [0, 0, 1.48], [-0.08, 0, 1.42], [0.08, 0, 1.42], [0, 0, 1.6], [-0.18, 0, 1.43],
    [0.18, 0, 1.43], [-0.45, 0, 1.43], [0.45, 0, 1.43], [-0.7, 0, 1.43], [0.7, 0, 1.43],
    [-0.78, 0, 1.43], [0.78, 0, 1.43],
])  # fmt: skip
MM_AS_M = 1000.0
FEET_UP = torch.tensor([1.0, 1.0, -1.0])


@pytest.fixture
def rig(tmp_path) -> dict[str, Camera]:
    path = tmp_path / "Calib.qca.txt"
    path.write_text(qca_text())
    return read_qca(path, pose2sim_compat=False)


def body(joints: torch.Tensor, *, frame: int = 0, reason: str = "") -> dict:
    flat = joints.flatten().tolist()
    return {"action": "walk", "frame": frame, "joints3d_world_m": flat, "reason": reason}


def frame(**changes) -> dict:
    row = {"action": "walk", "view": "cam01", "frame": 0, "width": 1088, "height": 1920}
    return row | changes


def test_a_real_rig_passes(rig):
    check_rig(rig, where="demo")


def test_cameras_below_the_floor_are_refused(rig):
    flipped = {v: replace(c, center_world=c.center_world * FEET_UP) for v, c in rig.items()}
    with pytest.raises(DataError, match=r"camera cam01: centre .* is not above the floor"):
        check_rig(flipped, where="demo")


def test_millimetres_taken_for_metres_are_refused(rig):
    huge = {v: replace(c, center_world=c.center_world * MM_AS_M) for v, c in rig.items()}
    with pytest.raises(DataError, match=r"depth .* expected 0.3 to 50.0 m"):
        check_rig(huge, where="demo")


def test_rows_up_backward_taken_for_down_forward_are_refused(rig):
    # the file's own axes (up, backward) instead of OpenCV's: cameras look away from the scene
    axes = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    away = {view: replace(camera, rotation=axes @ camera.rotation) for view, camera in rig.items()}
    with pytest.raises(DataError, match="axes or unit were read wrongly"):
        check_rig(away, where="demo")


def test_one_camera_is_too_few(rig):
    with pytest.raises(DataError, match="1 camera, expected at least 2"):
        check_rig({"cam01": rig["cam01"]}, where="demo")


def test_frames_need_their_camera_and_its_size(rig):
    cameras = {("walk", view): camera for view, camera in rig.items()}
    check_frames([frame()], cameras, where="demo")
    with pytest.raises(DataError, match="no frame at all"):
        check_frames([], cameras, where="demo")
    with pytest.raises(DataError, match="view cam07 frame 0: no camera"):
        check_frames([frame(view="cam07")], cameras, where="demo")
    with pytest.raises(DataError, match=r"action run .*: no camera"):
        check_frames([frame(action="run")], cameras, where="demo")
    with pytest.raises(DataError, match="image is 1080x1920 px, its camera is for 1088x1920"):
        check_frames([frame(width=1080)], cameras, where="demo")


def test_a_standing_body_passes_even_if_he_lies_down_later():
    lying = STANDING[:, [0, 2, 1]]
    check_bodies([body(STANDING), body(lying, frame=1)], where="demo")


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (STANDING * FEET_UP, "never more than -1.50 m above the ankle"),
        (STANDING[:, [0, 2, 1]], "up axis was read wrongly"),
        (STANDING * MM_AS_M, "unit was read wrongly"),
        (STANDING * 0.5, "unit was read wrongly"),
        (STANDING * float("nan"), "unit was read wrongly"),
    ],
)
def test_misread_bodies_are_refused(joints, message):
    with pytest.raises(DataError, match=message):
        check_bodies([body(joints)], where="demo")


def test_bodies_without_a_usable_one_are_refused():
    with pytest.raises(DataError, match="no usable body"):
        check_bodies([body(STANDING, reason="not found")], where="demo")


@pytest.fixture
def silhouette(tmp_path) -> tuple[Path, list[dict], dict]:
    """One frontal camera, and the mask of the standing figure: a disc around every joint."""
    lens = Pinhole(fx=100.0, fy=100.0, cx=50.0, cy=60.0, width=100, height=120)
    down = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    camera = Camera(lens, torch.tensor([0.0, -2.5, 0.9], dtype=torch.float64), down)
    pixels, _ = camera.project(STANDING.double())
    v, u = np.mgrid[:120, :100] + 0.5
    near = [np.hypot(u - x, v - y) < 3 for x, y in pixels.tolist()]
    write_matte(np.any(near, axis=0).astype(float), path=tmp_path / "mask.png")
    row = {"action": "walk", "frame": 0, "view": "cam01", "mask_path": "mask.png", "reason": ""}
    return tmp_path, [row], {("walk", "cam01"): camera}


def test_joints_on_the_masks_pass(silhouette):
    folder, masks, cameras = silhouette
    check_joints_in_masks([body(STANDING)], masks, cameras=cameras, folder=folder)


def test_joints_beside_the_masks_are_refused(silhouette):
    folder, masks, cameras = silhouette
    moved = STANDING + torch.tensor([0.15, 0.0, 0.0])
    with pytest.raises(DataError, match=r"view cam01: .* of the projected joints lie on the masks"):
        check_joints_in_masks([body(moved)], masks, cameras=cameras, folder=folder)


def test_a_capture_without_tables_is_refused(tmp_path):
    with pytest.raises(DataError, match="cannot read table"):
        check_capture(tmp_path)


def test_skeleton_order_is_the_one_assumed_here():
    assert SMPL24_NAMES[15] == "head"
    assert SMPL24_NAMES[7:9] == ("left_ankle", "right_ankle")
