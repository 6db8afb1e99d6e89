"""Cameras and people that were put a little wrong move back while the actor is trained."""

from dataclasses import replace
from itertools import chain, repeat

import numpy as np
import pytest
import torch

from ntop.body.model import load_body_model
from ntop.body.skinning import pose_body
from ntop.captures.studio.recording import misplaced
from ntop.captures.training_views import Tables, training_views
from ntop.config.sections import CaptureConfig
from ntop.config.sources import StudioSource
from ntop.config.tables import Sequence
from ntop.field.checkpoints import Twists
from ntop.field.progress import TrainingStoppedError
from ntop.field.refining import SHIFT, TURN, Refiner
from ntop.field.schedule import TrainingSettings
from ntop.field.training import train
from ntop.field.watching import ray_source
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.stages import s1_capture

SETTINGS = TrainingSettings(
    steps=120, rays_per_batch=1536, views_per_batch=12, voxels_m=(0.016, 0.01),
    level_starts=(0.0, 0.2), sharpness=(1.0, 4.0), watch_every=60, occupancy_every=40,
    checkpoint_every=10,
)  # fmt: skip
WRONG_CAMERA, WRONG_FRAME, WATCHED_FRAME = 2, 1, 2
MOVED_PX, MOVED_MM = 2.5, 15.0


@pytest.fixture(scope="module")
def model():
    return load_body_model()


@pytest.fixture(scope="module")
def views(model, tmp_path_factory):
    """Six cameras of 160 px around one actor in four poses, of which one says how good it is."""
    out = tmp_path_factory.mktemp("capture") / "plain"
    source = StudioSource(
        reader="studio", provides=("masks", "keypoints2d", "bodies"), num_cameras=6,
        image_size_px=160, supersampling=2, seed=3,
    )  # fmt: skip
    sequence = Sequence(
        source="studio", actor="plain", action="range", first=0, last=60, step=20, use="train",
        motion="authored:range",
    )  # fmt: skip
    config = CaptureConfig(source_section=source, sequences=(sequence,))
    s1_capture.main(config, "studio", "plain", packages=out.parent, out=out)
    names = ("frames", "cameras", "masks", "bodies")
    tables = Tables(*(out / f"{name}.parquet" for name in names))
    found = training_views(tables, model, held_out_views=(), max_person_px=500, margin_m=0.05)
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


@pytest.fixture(scope="module")
def true_training(views, model):
    return trained(views, model, refine_cameras=True, refine_poses=True)


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


def test_a_camera_moves_back_and_pictures_get_better(views, model):
    wrong = dict(enumerate(views.cameras))
    one = {WRONG_CAMERA: wrong[WRONG_CAMERA]}
    wrong |= misplaced(one, error_px=MOVED_PX, generator=np.random.default_rng(1))
    given = replace(views, cameras=tuple(wrong.values()))
    _, without_db, nothing = trained(given, model)
    assert nothing is None
    _, with_db, found = trained(given, model, refine_cameras=True)
    before = pixels_off(views, model, given.cameras)
    after = pixels_off(
        views, model, [turned(*pair) for pair in zip(given.cameras, found.cameras, strict=True)]
    )
    print(before, after, without_db, with_db)
    assert before[WRONG_CAMERA] > 2
    assert after[WRONG_CAMERA] < 0.5 * before[WRONG_CAMERA]
    assert max(after) < 0.5 * before[WRONG_CAMERA]
    assert with_db > without_db
    assert not found.poses.any()


def test_a_person_moves_back_and_pictures_get_better(views, model):
    shift = np.zeros((4, 3))
    shift[WRONG_FRAME] = MOVED_MM / 1000 * np.array([0.6, 0.0, 0.8])
    poses = replace(views.poses, transl=views.poses.transl + torch.from_numpy(shift))
    given = replace(views, poses=poses)
    _, without_db, _ = trained(given, model)
    _, with_db, found = trained(given, model, refine_poses=True)
    left = 1000 * np.linalg.norm(shift + found.poses[:, SHIFT], axis=1)
    print(left, without_db, with_db)
    assert left[WRONG_FRAME] < 0.5 * MOVED_MM
    assert with_db > without_db
    assert not found.cameras.any()
    assert not found.poses[WATCHED_FRAME].any()


def test_what_is_true_stays(views, model, true_training):
    _, _, found = true_training
    moved = [turned(*pair) for pair in zip(views.cameras, found.cameras, strict=True)]
    print(pixels_off(views, model, moved), np.abs(found.poses).max(0))
    assert max(pixels_off(views, model, moved)) < 0.3
    assert np.abs(found.poses[:, SHIFT]).max() < 0.002
    assert np.abs(found.poses[:, TURN]).max() < 0.005
    assert found.cameras.any(1).all()  # but it was free to move
    assert np.abs(found.cameras[:, TURN].mean(0)).max() < 1e-12  # all together it was not


def test_a_stopped_refinement_ends_with_the_same_bytes(views, model, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    options = {"refine_cameras": True, "refine_poses": True, "steps": 24}
    whole, _, found = trained(views, model, **options)
    stops = chain([False] * 14, repeat(True))
    with pytest.raises(TrainingStoppedError):
        trained(
            views, model, checkpoint_path=path, stop_requested=lambda: next(stops), **options
        )  # fmt: skip
    again, _, found_again = trained(views, model, checkpoint_path=path, **options)
    assert found.cameras.any(1).all()
    assert again.grid.values.tobytes() == whole.grid.values.tobytes()
    assert found_again.cameras.tobytes() == found.cameras.tobytes()
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
