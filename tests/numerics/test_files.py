"""Cases 38, 39, 41: what a file keeps of a picture and of a label."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from ntop.annotation.annotate import ViewImages, annotate_view
from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.storage import schemas
from ntop.storage.coco import COCO17, SMPL24, coco_writer
from ntop.storage.images import DILATION_PX, read_matte, read_rgba, write_matte, write_rgba
from ntop.storage.keys import SetKey
from ntop.storage.renders import body_columns, fisheye_camera, render_row
from ntop.storage.tables import read_table, write_table

BOTH = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["f32", "f64"])
# and one rounding of a value below 255 in the render's own type
HALF_LEVEL = {dtype: 0.5 / 255 + np.finfo(dtype).eps for dtype in (np.float32, np.float64)}
SIZE = 96


def person(dtype: type = np.float32) -> tuple[np.ndarray, np.ndarray]:
    """A soft disc of random colours whose alpha takes all values; black outside, as rendered."""
    generator = np.random.default_rng(38)
    yy, xx = np.mgrid[:SIZE, :SIZE] + 0.5
    distance = np.hypot(xx - 0.45 * SIZE, yy - 0.55 * SIZE)
    alpha = np.clip((0.35 * SIZE - distance) / 12, 0, 1) ** 1.5
    rgb = generator.random((SIZE, SIZE, 3)) * (alpha > 0)[..., None]
    return rgb.astype(dtype), alpha.astype(dtype)


def stored(rgb: np.ndarray, alpha: np.ndarray, folder: Path) -> np.ndarray:
    """The picture after a round trip through a file, in [0, 1]."""
    write_rgba(rgb, alpha, path=folder / "a.png")
    return read_rgba(folder / "a.png").astype(np.float64) / 255


def largest(difference: np.ndarray) -> float:
    return float(np.abs(difference).max())


@BOTH
def test_38_a_stored_picture_is_half_a_level_from_the_render(tmp_path, dtype, margin):
    rgb, alpha = person(dtype)
    kept = stored(rgb, alpha, tmp_path)
    inside = kept[..., 3] > 0
    margin.at_most("alpha", largest(kept[..., 3] - alpha), HALF_LEVEL[dtype])
    margin.at_most(
        "colour where alpha > 0", largest((kept[..., :3] - rgb)[inside]), HALF_LEVEL[dtype]
    )
    cut = np.floor(alpha * 255) / 255 - alpha
    margin.mutant_exceeds("truncated alpha", largest(cut), HALF_LEVEL[dtype])
    cut = (np.floor(rgb * 255) / 255 - rgb)[inside]
    margin.mutant_exceeds("truncated colour", largest(cut), HALF_LEVEL[dtype])


def test_38_rounding_leaves_59_db(tmp_path, margin):
    generator = np.random.default_rng(1)
    rgb = generator.random((200, 200, 3))
    kept = stored(rgb, np.ones((200, 200)), tmp_path)[..., :3]

    def decibels(values: np.ndarray) -> float:
        return float(-10 * np.log10(np.mean((values - rgb) ** 2)))

    margin.at_least("PSNR of the file", decibels(kept), 58.8, "dB")
    truncated = 58.8 - decibels(np.floor(rgb * 255) / 255)
    margin.mutant_exceeds("truncation's loss below that", truncated, 0, "dB")


@BOTH
def test_38_a_stored_matte_is_half_a_level_from_the_matte(tmp_path, dtype, margin):
    matte = np.linspace(0, 1, 4000, dtype=dtype).reshape(40, 100)
    write_matte(matte, path=tmp_path / "m.png")
    error = largest(read_matte(tmp_path / "m.png").astype(np.float64) - matte)
    margin.at_most("matte", error, HALF_LEVEL[dtype])


BACKGROUNDS = {
    "black": np.zeros((SIZE, SIZE, 3)),
    "white": np.ones((SIZE, SIZE, 3)),
    "noise": np.random.default_rng(39).random((SIZE, SIZE, 3)),
}


@BOTH
@pytest.mark.parametrize("name", BACKGROUNDS)
def test_39_recompositing_the_file_is_compositing_the_render(tmp_path, name, dtype, margin):
    rgb, alpha = person(dtype)
    background, matte = BACKGROUNDS[name], alpha[..., None]
    kept = stored(rgb, alpha, tmp_path)
    expected = matte * rgb + (1 - matte) * background
    enough = alpha >= 0.1
    again = kept[..., 3:] * kept[..., :3] + (1 - kept[..., 3:]) * background
    margin.at_most("alpha >= 0.1", largest((again - expected)[enough]), 1 / 255)
    margin.at_most("all pixels", largest(again - expected), 1 / 255)


def test_39_unpremultiplying_eight_bits_loses_the_colour(tmp_path, margin):
    rgb, alpha = person()
    kept = stored(rgb, alpha, tmp_path)
    some = kept[..., 3] >= 0.02
    margin.at_most("straight colour", largest((kept[..., :3] - rgb)[some]), 1 / 255)
    premultiplied = np.rint(rgb * alpha[..., None] * 255) / 255
    back = np.clip(premultiplied[some] / kept[some][:, 3:], 0, 1)
    margin.mutant_exceeds("premultiplied, divided again", largest(back - rgb[some]), 1 / 255)


def test_39_scaling_the_file_mixes_in_no_black(tmp_path, margin):
    """Colour reaches beyond the outline: the mean over 2 x 2 px of a bright person is bright."""
    _, alpha = person()
    rgb = np.full((SIZE, SIZE, 3), 0.8) * (alpha > 0)[..., None]
    kept = stored(rgb, alpha, tmp_path)
    halves = kept.reshape(SIZE // 2, 2, SIZE // 2, 2, 4).mean((1, 3))
    some = halves[..., 3] > 0
    margin.at_most("colour after halving", largest(halves[some][:, :3] - 0.8), 1 / 255)
    undilated = np.where(kept[..., 3:] > 0, kept[..., :3], 0)
    dark = undilated.reshape(SIZE // 2, 2, SIZE // 2, 2, 3).mean((1, 3))
    margin.mutant_exceeds("without dilation", largest(dark[some] - 0.8), 1 / 255)
    assert DILATION_PX >= 1


def labelled_row() -> dict:
    """A manifest row with one person: an oblique camera, numbers that use all their digits."""
    generator = torch.Generator().manual_seed(41)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(size, generator=generator, dtype=torch.float64)

    pose = BodyPose(normal(10), normal(3), 0.5 * normal(69), normal(3))
    body = body_columns(load_body_model(), pose)
    pelvis = torch.tensor(body["joints3d_world_m"][:3], dtype=torch.float64)
    rig = Rig(1.2, 1.0, 301, 211, 211 / np.pi)
    camera = top_view_cameras(rig, pelvis)["ne"]
    turn = matrix_from_axis_angle(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64))
    camera = type(camera)(camera.lens, camera.center_world, turn @ camera.rotation)
    row = render_row(
        SetKey("lab", "ada", "wave", "h1.2_r1.0", 0), "ne", camera=camera, rig=rig, body=body,
        image_sha256="", avatar_sha256="", seed=0,
    )  # fmt: skip
    mask = np.zeros((211, 301), bool)
    mask[50:150, 100:200] = True
    images = ViewImages(mask, np.where(mask, 1.0, 0.0), mask.astype(np.uint8))
    return row | annotate_view(row, images, camera=camera)


POINTS = {COCO17: "coco17_world_m", SMPL24: "joints3d_world_m"}


@pytest.mark.parametrize("skeleton", POINTS, ids=lambda skeleton: skeleton.name)
def test_41_labels_and_cameras_survive_json(tmp_path, skeleton, margin):
    row = labelled_row()
    (person_row,) = row["persons"]
    with coco_writer(tmp_path / "a.json", skeleton=skeleton, info={}) as writer:
        writer.add(row, rle=row["rle"], keypoints3d_world_m=row[POINTS[skeleton]])
    text = (tmp_path / "a.json").read_text()
    (image,), (annotation,) = (json.loads(text)[name] for name in ("images", "annotations"))
    written = person_row[f"keypoints2d_{skeleton.name}_px"]
    assert annotation["keypoints2d_px"] == written  # bit for bit
    assert annotation["keypoints3d_world_m"] == row[POINTS[skeleton]]
    assert image["center_world_m"] == row["center_world_m"]
    assert annotation["smpl"]["body_pose_rad"] == row["body_pose_rad"]

    def reprojected(record: dict, points: list[float]) -> float:
        world = torch.tensor(points, dtype=torch.float64).reshape(-1, 3)
        pixels, _ = fisheye_camera(record).project(world)
        expected = torch.tensor(written, dtype=torch.float64).reshape(-1, 2)
        return float((pixels - expected).abs().max())

    points = annotation["keypoints3d_world_m"]
    margin.at_most("reprojection from JSON", reprojected(image, points), 1e-9, "px")
    triplets = np.array(annotation["keypoints"]).reshape(-1, 3)
    seen = triplets[:, 2] > 0
    shift = largest(triplets[seen, :2] + 0.5 - np.array(written).reshape(-1, 2)[seen])
    margin.at_most("COCO's integer centres + 0.5", shift, 1e-12, "px")
    for what, lossy in (("float32", np.float32), ("6 decimals", lambda x: round(x, 6))):
        rounded = [float(lossy(x)) for x in points]
        margin.mutant_exceeds(f"points as {what}", reprojected(image, rounded), 1e-9, "px")
    slipped = largest(triplets[seen, :2] - np.array(written).reshape(-1, 2)[seen])
    margin.mutant_exceeds("COCO's keypoints read as ours", slipped, 1e-12, "px")


def test_41_labels_survive_parquet(tmp_path):
    row = labelled_row()
    label = {name: row[name] for name in ("sample_id", "persons", "rle")}
    write_table([label], schema=schemas.KEYPOINTS, path=tmp_path / "k.parquet")
    assert read_table(tmp_path / "k.parquet", schema=schemas.KEYPOINTS) == [label]
