"""Mask and fit on a tiny studio capture whose truth is known, and what they refuse."""

import shutil

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from ntop.body.model import EMBEDDED_BODY_PATH
from ntop.config.sections import FitConfig, MaskConfig
from ntop.conventions import DataError
from ntop.metrics.images import mask_iou
from ntop.stages import s2_mask, s3_fit
from ntop.storage import schemas
from ntop.storage.files import record_files
from ntop.storage.images import read_matte, write_matte
from ntop.storage.tables import read_table, write_table
from tests.captures.tiny_studio import tiny_capture

BACKGROUND = MaskConfig(method="background", provides=("keypoints2d",))
STILL_CAMERAS = FitConfig(refine_cameras=False)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Five cameras, four frames of 160 px, everything given, 0.3 px of keypoint noise."""
    out = tmp_path_factory.mktemp("capture") / "plain"
    return tiny_capture(out, last=60, num_cameras=5, image_size_px=160, keypoint_noise_px=0.3)


@pytest.fixture(scope="module")
def masks(capture, tmp_path_factory):
    out = tmp_path_factory.mktemp("masks") / "plain"
    s2_mask.main(BACKGROUND, capture, packages=capture, out=out)
    return out


def fit(capture, out, *, keypoints=None, masks=None, config=STILL_CAMERAS):
    s3_fit.main(
        config, capture, keypoints=keypoints or capture / "keypoints2d.parquet",
        masks=masks or capture / "masks.parquet", out=out,
    )  # fmt: skip


def changed(capture, name, schema, path, change):
    rows = read_table(capture / name, schema=schema)
    change(rows)
    write_table(rows, schema=schema, path=path)
    return path


def test_background_subtraction_finds_the_person(capture, masks):
    rows = read_table(masks / "masks.parquet", schema=schemas.MASK)
    assert len(rows) == 20
    overlaps = []
    for row in rows:
        truth = read_matte(capture / row["mask_path"]) >= 0.5
        overlaps.append(mask_iou(read_matte(masks / row["mask_path"]) >= 0.5, truth))
        assert row["reason"] == ""
    assert np.mean(overlaps) > 0.95
    assert not (masks / "keypoints2d.parquet").exists()  # they come with the source


def test_a_hand_corrected_mask_replaces_the_computed_one(capture, tmp_path):
    square = np.zeros((160, 160), np.float32)
    square[40:90, 50:80] = 1
    view = read_table(capture / "masks.parquet", schema=schemas.MASK)[0]["view"]
    name = f"range/{view}/000020.png"
    (tmp_path / "corrected" / name).parent.mkdir(parents=True)
    write_matte(square, path=tmp_path / "corrected" / name)
    config = BACKGROUND.model_copy(update={"overrides": str(tmp_path / "corrected")})
    s2_mask.main(config, capture, packages=capture, out=tmp_path / "out")
    rows = read_table(tmp_path / "out/masks.parquet", schema=schemas.MASK)
    assert [r["method"] for r in rows].count("manual") == 1
    assert (read_matte(tmp_path / "out/masks" / name) == square).all()


def test_nobody_in_any_picture_is_an_error_and_leaves_nothing(capture, tmp_path):
    empty = tmp_path / "empty"
    shutil.copytree(capture, empty)
    for row in read_table(empty / "frames.parquet", schema=schemas.FRAME):
        plate = empty / "plates" / f"{row['action']}_{row['view']}.png"
        shutil.copy(plate, empty / row["image_path"])
    record_files(empty)
    with pytest.raises(DataError, match="not one frame has a usable mask"):
        s2_mask.main(BACKGROUND, empty, packages=empty, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_one_empty_picture_is_a_row_with_a_reason(capture, tmp_path):
    partly = tmp_path / "partly"
    shutil.copytree(capture, partly)
    row = read_table(partly / "frames.parquet", schema=schemas.FRAME)[3]
    shutil.copy(partly / f"plates/{row['action']}_{row['view']}.png", partly / row["image_path"])
    record_files(partly)
    s2_mask.main(BACKGROUND, partly, packages=partly, out=tmp_path / "out")
    rows = read_table(tmp_path / "out/masks.parquet", schema=schemas.MASK)
    reasons = {(r["frame"], r["view"]): r["reason"] for r in rows if r["reason"]}
    assert list(reasons) == [(row["frame"], row["view"])]


def test_a_plate_of_another_size_is_named(capture, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(capture, broken)
    plate = next((broken / "plates").glob("*.png"))
    cv2.imwrite(str(plate), np.zeros((10, 10, 3), np.uint8))
    record_files(broken)
    with pytest.raises(DataError, match=rf"{plate.stem}.*expected 160x160"):
        s2_mask.main(BACKGROUND, broken, packages=broken, out=tmp_path / "out")


def test_the_true_body_is_recovered_from_noisy_keypoints(capture, tmp_path):
    fit(capture, tmp_path / "fit")
    fitted = read_table(tmp_path / "fit/bodies.parquet", schema=schemas.BODY)
    truth = read_table(capture / "bodies.parquet", schema=schemas.BODY)
    errors = [
        np.linalg.norm(np.subtract(a["joints3d_world_m"], b["joints3d_world_m"]).reshape(24, 3),
                       axis=1)
        for a, b in zip(fitted, truth, strict=True)
    ]  # fmt: skip
    assert np.median(errors) < 0.015  # m; 0.3 px of 160 px pictures are about 6 mm
    assert all(row["reason"] == "" for row in fitted)
    assert len({tuple(row["betas"]) for row in fitted}) == 1


def test_a_model_file_replaces_the_embedded_body(capture, tmp_path):
    with np.load(EMBEDDED_BODY_PATH) as arrays:
        smaller = {name: arrays[name] for name in arrays.files}
    smaller["v_template"] = (0.95 * smaller["v_template"]).astype(np.float32)
    path = tmp_path / "SMPL_NEUTRAL.npz"
    np.savez(path, **smaller)
    fit(capture, tmp_path / "embedded")
    fit(
        capture, tmp_path / "file", config=FitConfig(refine_cameras=False, body_model=str(path))
    )  # fmt: skip
    first, second = (
        read_table(tmp_path / name / "bodies.parquet", schema=schemas.BODY)[0]
        for name in ("embedded", "file")
    )
    # the same person: the smaller template needs other betas for the same joints
    assert np.abs(np.subtract(first["betas"], second["betas"])).max() > 0.2
    gap = np.subtract(first["joints3d_world_m"], second["joints3d_world_m"]).reshape(24, 3)
    assert np.median(np.linalg.norm(gap, axis=1)) < 0.03
    with pytest.raises(DataError, match="nowhere"):
        fit(capture, tmp_path / "x", config=FitConfig(body_model=str(tmp_path / "nowhere.npz")))


def test_nan_keypoints_are_refused_with_their_place(capture, tmp_path):
    def poison(rows):
        rows[4]["keypoints_px"][7] = float("nan")

    path = changed(
        capture, "keypoints2d.parquet", schemas.KEYPOINTS2D, tmp_path / "k.parquet", poison
    )
    with pytest.raises(DataError, match=r"not finite|NaN|nan"):
        fit(capture, tmp_path / "fit", keypoints=path)
    assert not (tmp_path / "fit").exists()


def test_keypoints_of_an_unknown_camera_are_refused(capture, tmp_path):
    def rename(rows):
        rows[0]["view"] = "cam99"

    path = changed(
        capture, "keypoints2d.parquet", schemas.KEYPOINTS2D, tmp_path / "k.parquet", rename
    )
    with pytest.raises(DataError, match="cam99"):
        fit(capture, tmp_path / "fit", keypoints=path)


def test_bodies_and_cameras_have_one_row_per_frame_and_camera(capture, masks, tmp_path):
    fit(capture, tmp_path / "fit", masks=masks / "masks.parquet")
    assert pq.read_table(tmp_path / "fit/bodies.parquet").num_rows == 4
    assert pq.read_table(tmp_path / "fit/cameras.parquet").num_rows == 5
