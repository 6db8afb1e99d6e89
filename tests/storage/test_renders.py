import json

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from ntop.config.rigs import configured_rig
from ntop.config.sections import ImageConfig, RigConfig
from ntop.conventions import DataError
from ntop.geometry.rigs import top_view_cameras
from ntop.storage import schemas
from ntop.storage.keys import SetKey
from ntop.storage.renders import fisheye_camera, render_row
from ntop.storage.sets import CAMERA_KEYS
from ntop.storage.tables import read_table, write_table

PLACE = RigConfig(height_above_pelvis_m=1.2, ring_radius_m=1.0)
KB = {
    "lens": "kannala_brandt",
    "focal_px": 101.3,
    "focal_y_px": 102.7,
    "center_px": (149.3, 98.1),
    "distortion": (0.05, 0.08, -0.03, 0.004),
    "max_theta_deg": 100.0,
}
BODY = {
    "betas": [0.0] * 10, "global_orient_rad": [0.0] * 3, "body_pose_rad": [0.0] * 69,
    "transl_m": [0.0] * 3, "joints3d_world_m": [0.0] * 72, "coco17_world_m": [0.0] * 51,
}  # fmt: skip


def row_of(image: ImageConfig):
    """A camera of the configured rig, and its row of a render table."""
    rig = configured_rig(PLACE, image)
    camera = top_view_cameras(rig, torch.tensor([0.1, 0.2, 0.9]))["ne"]
    row = render_row(
        SetKey("s", "a", "walk", "near", 3), "ne", camera=camera, rig=rig, body=BODY,
        image_sha256="0", avatar_sha256="1", seed=0,
    )  # fmt: skip
    return camera, row


@pytest.mark.parametrize(
    "values",
    [{}, {"lens": "equisolid"}, {"lens": "stereographic", "max_theta_deg": 120.0}, KB],
    ids=["equidistant", "equisolid", "stereographic", "kannala_brandt"],
)
def test_the_configured_lens_comes_back_from_tables_and_json_bit_for_bit(values, tmp_path):
    camera, row = row_of(ImageConfig(width_px=300, height_px=200, **values))
    write_table([row], schema=schemas.RENDER, path=tmp_path / "renders.parquet")
    read = fisheye_camera(read_table(tmp_path / "renders.parquet", schema=schemas.RENDER)[0])
    text = json.dumps({key: row[key] for key in CAMERA_KEYS})
    for again in (read, fisheye_camera(json.loads(text))):
        assert again.lens == camera.lens
        assert torch.equal(again.center_world, camera.center_world)
    if "focal_px" not in values:  # 90 degrees lie at the middle of the shorter side
        across = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        assert float(read.lens.project(across)[0][1]) == pytest.approx(200, abs=1e-9)


def test_a_table_from_before_the_lens_columns_reads_as_equidistant(tmp_path):
    camera, row = row_of(ImageConfig(width_px=300, height_px=200))
    write_table([row], schema=schemas.RENDER, path=tmp_path / "new.parquet")
    table = pq.read_table(tmp_path / "new.parquet")
    pq.write_table(table.drop_columns(["focal_y_px", "distortion"]), tmp_path / "old.parquet")
    old = read_table(tmp_path / "old.parquet", schema=schemas.RENDER)[0]
    assert (old["focal_y_px"], old["distortion"]) == (None, None)
    assert fisheye_camera(old).lens == camera.lens
    pq.write_table(pa.table({"sample_id": ["x"]}), tmp_path / "other.parquet")
    with pytest.raises(DataError, match="another version"):
        read_table(tmp_path / "other.parquet", schema=schemas.RENDER)


def test_an_unknown_lens_is_an_error_that_names_the_known_ones():
    _, row = row_of(ImageConfig(width_px=300, height_px=200))
    with pytest.raises(DataError, match="equisolid"):
        fisheye_camera({**row, "camera_model": "double_sphere"})


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"distortion": (0.1, 0, 0, 0)}, "alone"),
        ({**KB, "distortion": (-0.12, 0, 0, 0)}, "folds at 95.49"),
        ({"lens": "pinhole"}, "equidistant"),
    ],
)
def test_impossible_lenses_are_refused_by_the_configuration(values, said):
    with pytest.raises(ValueError, match=said):
        ImageConfig(**values)
