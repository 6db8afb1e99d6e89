"""Cases 35, 37, 40: labels of the real pipeline against what a renderer shows, and masks' areas.

Case 35 hides a body behind its labels: the pipeline's stages make and annotate the views of a
rendered avatar, then an opaque ball is rendered where each of the 24 written joints lies, one at a
time, and its centroid compared with the written keypoint.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from ntop.body.authored_motions import named_motion
from ntop.body.model import load_body_model
from ntop.body.motions import retarget
from ntop.body.skinning import pose_joints
from ntop.config.sections import AnnotateConfig, RenderConfig
from ntop.conventions import MASK_ALPHA
from ntop.field.avatar import Avatar, save_avatar
from ntop.field.canonical import canonical_body, initial_grid
from ntop.geometry.cameras import Camera
from ntop.geometry.triangulation import MAX_CONDITION, camera_centers, camera_rays, triangulate
from ntop.report.blobs import blob_errors_px
from ntop.report.inputs import Dataset
from ntop.stages import s5_render, s6_annotate
from ntop.storage import schemas
from ntop.storage.atomic import write_bytes
from ntop.storage.bodies import body_rows
from ntop.storage.images import read_rgba, write_rgba
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import Row, read_table, write_table

BLOB_LIMIT_PX = 0.05
RIGS = {
    "h1.2_r1.0": {"height_above_pelvis_m": 1.2, "ring_radius_m": 1.0},
    "h1.0_r0.5": {"height_above_pelvis_m": 1.0, "ring_radius_m": 0.5},
}
# even, odd, and not square
CASES = {
    "320x320": ((320, 320), "h1.2_r1.0"),
    "301x211": ((301, 211), "h1.0_r0.5"),
    "151x151": ((151, 151), "h1.0_r0.5"),
    "160x214": ((160, 214), "h1.2_r1.0"),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """An untrained avatar and one body in a posture with all limbs apart."""
    folder = tmp_path_factory.mktemp("labels")
    model, betas = load_body_model(), (0.0,) * 10
    grid = initial_grid(canonical_body(model, betas), voxel_m=0.016, outer_m=0.03, inner_m=0.03)
    light = np.zeros((9, 3), np.float32)
    light[0] = 1
    save_avatar(Avatar(grid, light, betas, 0.03, 0), folder / "avatar", write=write_bytes)
    shape = torch.zeros(10, dtype=torch.float64)
    motion = named_motion("authored:range", folder)
    pose = retarget(motion, model, shape, frame_times_s=torch.tensor([1.3]).double())
    rows = body_rows(
        pose, pose_joints(model, pose), source="lab", actor="ada", frames=[("wave", 0)],
        errors_mm=[0.0], reasons=[""],
    )  # fmt: skip
    write_table(rows, schema=schemas.BODY, path=folder / "bodies.parquet")
    return folder


def annotated_views(inputs: Path, out: Path, *, size: tuple[int, int], rig: str) -> list[Row]:
    """Render and annotate one set with the stages; its nine rows with their persons."""
    image = {"width_px": size[0], "height_px": size[1]}
    config = RenderConfig.model_validate({"rigs": RIGS, "image": image, "seed": 5})
    s5_render.main(
        config, source="lab", actor="ada", action="wave", rig=rig, frames=[0], motion="",
        avatar=inputs / "avatar", bodies=inputs / "bodies.parquet", packages=inputs,
        work=out / "work", out=out / "shard",
    )  # fmt: skip
    s6_annotate.main(AnnotateConfig(), renders=out / "shard", out=out / "labels.parquet")
    renders = read_table(out / "shard" / "renders.parquet", schema=schemas.RENDER)
    labels = read_table(out / "labels.parquet", schema=schemas.KEYPOINTS)
    return [
        render | {"persons": label["persons"]}
        for render, label in zip(renders, labels, strict=True)
    ]


def blob_errors(rows: list[Row]) -> np.ndarray:
    """Distances of all views and joints (px)."""
    dataset = Dataset(Path(), tuple(rows), len(rows), 1)
    (key,) = dataset.sets
    return np.array(list(blob_errors_px(dataset, key).values()))


def moved_labels(row: Row, change) -> Row:
    """The row with its written keypoints changed by `change(pixels)`."""
    (person,) = row["persons"]
    pixels = np.array(person["keypoints2d_smpl24_px"]).reshape(-1, 2)
    return row | {"persons": [person | {"keypoints2d_smpl24_px": change(pixels).ravel().tolist()}]}


@pytest.mark.parametrize("name", CASES)
def test_35_a_ball_at_a_joint_is_where_its_label_says(inputs, tmp_path, name, margin):
    size, rig = CASES[name]
    rows = annotated_views(inputs, tmp_path, size=size, rig=rig)
    assert len(rows) == 9
    errors = blob_errors(rows)
    assert len(errors) == 9 * 24
    margin.at_most("centroid of the ball against the label", errors.max(), BLOB_LIMIT_PX, "px")


@pytest.fixture(scope="module")
def views(inputs, tmp_path_factory) -> list[Row]:
    """One set of the smallest size."""
    out = tmp_path_factory.mktemp("views")
    return annotated_views(inputs, out, size=(151, 151), rig="h1.2_r1.0")


def wrong_sign_of_t(row: Row) -> Row:
    """Labels of a camera whose translation was taken for its centre: c = R^T t = -centre."""
    (person,) = row["persons"]
    mirrored = row | {"center_world_m": [-x for x in row["center_world_m"]]}
    joints = torch.tensor(person["joints3d_world_m"], dtype=torch.float64).reshape(-1, 3)
    pixels, _ = fisheye_camera(mirrored).project(joints)
    return moved_labels(row, lambda _: pixels.numpy())


SLIPS = {
    "half a pixel": lambda row: moved_labels(row, lambda p: p - 0.5),
    "mirrored": lambda row: moved_labels(row, lambda p: p * [-1, 1] + [row["width"], 0]),
    "upside down": lambda row: moved_labels(row, lambda p: p * [1, -1] + [0, row["height"]]),
    "u and v swapped": lambda row: moved_labels(row, lambda p: p[:, ::-1]),
    "K scaled by integer centres": lambda row: moved_labels(row, lambda p: (p + 0.5) / 5 * 5 - 0.1),
    "focal 0.1 % long": lambda row: moved_labels(
        row, lambda p: (p - row["cx_px"]) * 1.001 + row["cx_px"]
    ),
    "t for the centre": wrong_sign_of_t,
}


@pytest.mark.parametrize("slip", SLIPS)
def test_35_slips_exceed_the_limit(views, slip, margin):
    row = next(row for row in views if row["view"] == "e")
    error = blob_errors([SLIPS[slip](row)]).max()
    margin.mutant_exceeds(slip, error, BLOB_LIMIT_PX, "px")


def test_35_the_rigs_east_is_where_the_compass_says(views):
    """A camera east of the person sees him in the west of its image."""
    for view, sign in (("e", -1), ("w", 1)):
        row = next(row for row in views if row["view"] == view)
        pelvis = row["persons"][0]["keypoints2d_smpl24_px"][:2]
        assert sign * (pelvis[0] - row["cx_px"]) > 10
        assert abs(pelvis[1] - row["cy_px"]) < 1e-4


def rays_of(rows: list[Row], cameras: list[Camera]) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays through the written keypoints, (joint, camera), and their weights."""
    pixels = np.array([row["persons"][0]["keypoints2d_smpl24_px"] for row in rows])
    by_joint = torch.from_numpy(pixels).reshape(len(rows), 24, 2).movedim(0, 1)
    directions, covered = camera_rays(cameras, by_joint)
    return directions, covered.double()


def test_37_nine_views_triangulate_their_own_labels(views, margin):
    cameras = [fisheye_camera(row) for row in views]
    truth = torch.tensor(views[0]["persons"][0]["joints3d_world_m"]).double().reshape(24, 3)
    directions, weights = rays_of(views, cameras)
    found = triangulate(camera_centers(cameras), directions, weights)
    assert found.valid.all()
    error = float((found.points_world - truth).norm(dim=-1).max())
    margin.at_most("labels of nine views", error, 1e-6, "m")
    margin.at_most("their condition", float(found.condition.max()), MAX_CONDITION)
    half = torch.tensor([0.5, 0.5], dtype=torch.float64)
    pixels = torch.stack([camera.project(truth)[0] - half for camera in cameras], -2)
    slipped, _ = camera_rays(cameras, pixels)
    wrong = triangulate(camera_centers(cameras), slipped, weights).points_world
    error = float((wrong - truth).norm(dim=-1).max())
    margin.mutant_exceeds("half a pixel", error, 1e-6, "m")


@pytest.mark.parametrize("beside_m", [0.0, 1e-9, 1e-5])
def test_37_a_point_on_the_baseline_is_flagged(beside_m, margin):
    centers = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]], dtype=torch.float64)
    point = torch.tensor([0.4, 0.0, 1.0 - beside_m], dtype=torch.float64)
    directions = (point - centers) / (point - centers).norm(dim=-1, keepdim=True)
    found = triangulate(centers, directions, torch.ones(2))
    margin.at_least("condition on the baseline", float(found.condition), MAX_CONDITION)
    assert not found.valid
    assert found.points_world.isfinite().all()


def test_37_a_point_a_little_beside_the_baseline_is_fixed(margin):
    centers = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]], dtype=torch.float64)
    point = torch.tensor([0.4, 0.0, 0.99], dtype=torch.float64)
    directions = (point - centers) / (point - centers).norm(dim=-1, keepdim=True)
    found = triangulate(centers, directions, torch.ones(2))
    assert found.valid
    margin.at_most(
        "1 cm beside the baseline", float((found.points_world - point).norm()), 1e-6, "m"
    )


def soft_disc(size: int, *, centre: tuple[float, float], radius: float) -> np.ndarray:
    """Coverage of a disc, 16 x 16 samples per pixel."""
    fine = (np.arange(16 * size) + 0.5) / 16
    inside = np.hypot(fine[None] - centre[0], fine[:, None] - centre[1]) <= radius
    return inside.reshape(size, 16, size, 16).mean((1, 3)).astype(np.float32)


@pytest.mark.parametrize("radius_px", [10.0, 25.0])
def test_40_masks_of_stored_discs_have_the_discs_area(tmp_path, radius_px, margin):
    generator = np.random.default_rng(40)
    errors, any_alpha = [], []
    for centre in generator.uniform(40, 41, (60, 2)):
        alpha = soft_disc(80, centre=tuple(centre), radius=radius_px)
        write_rgba(np.ones((80, 80, 3), np.float32), alpha, path=tmp_path / "a.png")
        stored = read_rgba(tmp_path / "a.png")[..., 3]
        area = np.pi * radius_px**2
        errors.append((stored >= MASK_ALPHA).sum() / area - 1)
        any_alpha.append((stored > 0).sum() / area - 1)
    margin.at_most("area of each disc, relative", np.abs(errors).max(), 0.02)
    margin.at_most("mean bias", abs(np.mean(errors)), 0.002)
    margin.mutant_exceeds("mask = alpha > 0", abs(np.mean(any_alpha)), 0.002)


def test_40_a_half_pixel_slip_of_a_mask_is_seen(margin):
    """The overlap is what the report's mask score would show."""
    aligned, slipped = [], []
    for centre in np.random.default_rng(41).uniform(40, 41, (60, 2)):
        truth = soft_disc(80, centre=tuple(centre), radius=10) >= 0.5
        yy, xx = np.mgrid[:80, :80]
        for found, offset in ((aligned, 0.5), (slipped, 0.0)):
            mask = np.hypot(xx + offset - centre[0], yy + offset - centre[1]) <= 10
            found.append((mask & truth).sum() / (mask | truth).sum())
    margin.at_least("overlap with pixel centres at + 0.5", np.mean(aligned), 0.99)
    margin.mutant_exceeds("1 - overlap with centres at + 0", 1 - np.mean(slipped), 0.01)
