"""The twin on a tiny studio actor: its warp, its rays, that it learns, resumes and renders."""

import json
import math
from copy import deepcopy
from dataclasses import replace
from itertools import chain, repeat

import numba
import numpy as np
import pytest
import safetensors.torch
import torch

from ntop import cli
from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose, pose_body
from ntop.conventions import DataError
from ntop.field.avatar import load_avatar as load_grid
from ntop.field.humannerf.field import ActorField, warped
from ntop.field.humannerf.march import Interval, box_interval, median_depth
from ntop.field.humannerf.networks import (
    Architecture,
    CanonicalField,
    NonRigidMotion,
    hann_windows,
)
from ntop.field.humannerf.settings import HumanNerfSettings
from ntop.field.humannerf.skeleton import Box, canonical_skeleton, gaussian_bones, posed_skeleton
from ntop.field.humannerf.trainer import HumanNerfTrainer
from ntop.field.humannerf.training import train_humannerf
from ntop.field.interface import load_avatar, pose_avatar, render_view, save_avatar
from ntop.field.progress import TrainingStoppedError
from ntop.metrics.images import Cutout, psnr_box_db, psnr_db, tight_window
from tests.captures.tiny_studio import tiny_capture, tiny_views

SIZES = Architecture(
    canonical_width=48, canonical_depth=4, canonical_bands=6, non_rigid_width=16,
    non_rigid_depth=2, non_rigid_bands=3, latent=16, decoder_channels=(32, 16, 16, 16),
)  # fmt: skip
SETTINGS = HumanNerfSettings(
    steps=5, patches=3, patch_px=16, samples=24, record_every=1, watch_every=2,
    canonical_rate=2e-3, architecture=SIZES,
)  # fmt: skip
BETAS = (0.0,) * 10


@pytest.fixture(scope="module")
def model():
    return load_body_model()


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Four cameras of 96 px around one actor in two poses, everything given."""
    out = tmp_path_factory.mktemp("capture") / "plain"
    return tiny_capture(out, last=20, num_cameras=4, image_size_px=96)


@pytest.fixture(scope="module")
def views(capture, model):
    found = tiny_views(capture, model)
    return replace(found, watched=np.arange(len(found.crops)) == 0)


def shape(views):
    return tuple(float(value) for value in views.poses.betas[0])


def trained(views, model, settings=SETTINGS, **more):
    return train_humannerf(views, model, shape(views), settings=settings, **more)


def posed(elbow_rad=0.0, spin_rad=0.0):
    body = torch.zeros(69, dtype=torch.float64)
    body[3 * 17 + 1] = elbow_rad  # left elbow (joint 18) about y
    return BodyPose(
        torch.zeros(10, dtype=torch.float64),
        torch.tensor([0, 0, spin_rad], dtype=torch.float64),
        body,
        torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64),
    )


def prior_field(skeleton):
    """The field before any training: the bones' Gaussians are the weights."""
    return ActorField(
        gaussian_bones(skeleton, 32)[:-1],
        skeleton.box,
        CanonicalField(SIZES),
        NonRigidMotion(SIZES),
        None,
    )


def test_the_warp_of_the_rest_pose_only_shifts(model):
    skeleton, pose = canonical_skeleton(model, BETAS), posed()
    points = pose_body(model, pose).vertices[::7]
    posed_bones = posed_skeleton(model, pose)
    relative = (points - torch.from_numpy(posed_bones.origin_world)).float()
    found = warped(prior_field(skeleton), posed_bones, relative)
    assert float(found.share.min()) > 1e-4  # somebody claims every point of the skin
    expected = points - pose.transl
    assert float((found.canonical - expected).abs().max()) < 1e-5


def test_a_point_on_a_bone_follows_that_bone(model):
    skeleton, pose = canonical_skeleton(model, BETAS), posed(elbow_rad=1.4, spin_rad=2.0)
    bones = pose_body(model, pose).posed_from_rest
    posed_bones = posed_skeleton(model, pose)
    elbow, wrist = skeleton.joints[18], skeleton.joints[20]
    at_rest = torch.from_numpy(elbow + np.linspace(0.4, 0.8, 5)[:, None] * (wrist - elbow))
    world = at_rest @ bones[18, :3, :3].T + bones[18, :3, 3]
    relative = (world - torch.from_numpy(posed_bones.origin_world)).float()
    found = warped(prior_field(skeleton), posed_bones, relative)
    assert float((found.canonical - at_rest).norm(dim=1).max()) < 2e-3
    assert float(found.share.min()) > 0.3


def test_prior_weights_are_shares_and_the_background_owns_the_corners(model):
    weights = gaussian_bones(canonical_skeleton(model, BETAS), 16)
    torch.testing.assert_close(weights.sum(0), torch.ones(16, 16, 16))
    assert float(weights[-1, 0, 0, 0]) > 0.999


def test_rays_enter_and_leave_boxes_as_dense_samples_say():
    generator = torch.Generator().manual_seed(1)
    box = Box(np.array([-0.4, -0.2, -1.0]), np.array([0.3, 0.5, 0.8]))
    directions = torch.randn(400, 3, dtype=torch.float64, generator=generator)
    directions[:60, 0] = 0  # parallel to faces
    directions[30:60, 1] = 0
    directions = directions / directions.norm(dim=1, keepdim=True)
    depths = torch.linspace(0, 4, 4001, dtype=torch.float64)
    low, high = torch.from_numpy(box.low), torch.from_numpy(box.high)
    for origin in ([0.0, 0.1, 0.0], [0.05, 0.1, -2.0], [-1.0, 0.3, 0.4]):
        start = torch.tensor(origin, dtype=torch.float64)
        points = start + depths[:, None] * directions[:, None]
        inside = ((points >= low) & (points <= high)).all(-1)
        found = box_interval(start, directions, box)
        assert found.hit[inside.any(1)].all()
        length = torch.where(found.hit, found.far - found.near, 0.0)
        torch.testing.assert_close(length, inside.sum(1).double() * 1e-3, atol=2.1e-3, rtol=0)


def test_half_of_the_light_is_gone_where_it_should_be():
    density, pieces = 7.0, 64
    interval = Interval(torch.tensor([1.0, 1.0]), torch.tensor([2.0, 2.0]), torch.ones(2).bool())
    alpha = -math.expm1(-density / pieces)
    alphas = torch.stack([torch.full((pieces,), alpha), torch.full((pieces,), 1e-3)])
    depth, index = median_depth(alphas, interval)
    assert float(depth[0]) == pytest.approx(1 + math.log(2) / density, abs=1e-5)
    assert int(index[0]) == int(math.log(2) / density * pieces)
    assert math.isinf(depth[1])


def test_bands_open_one_after_the_other():
    assert hann_windows(6, 0.0).tolist() == [0] * 6
    half = hann_windows(6, 0.5)
    assert half.tolist() == pytest.approx([1, 1, 1, 0, 0, 0])
    assert hann_windows(6, 1.5 / 6)[1] == pytest.approx(0.5)


def test_every_network_learns_once_non_rigid_motion_has_joined(views, model, tmp_path):
    settings = replace(SETTINGS, non_rigid_steps=(0, 2))
    states = []
    with HumanNerfTrainer(views, model, shape(views), settings=settings) as trainer:
        for path in (tmp_path / "a", tmp_path / "b"):
            trainer.save(path)
            states.append(safetensors.torch.load_file(path))
            for _ in range(3):
                trainer.advance()
    learned = {k for k in states[0] if k.startswith("network.") and "code" not in k}
    assert {key.split(".")[1] for key in learned} == {"canonical", "non_rigid", "motion"}
    same = [key for key in learned if torch.equal(states[0][key], states[1][key])]
    assert same == []


def test_a_stopped_training_ends_with_the_same_bytes_on_any_number_of_threads(
    views, model, tmp_path
):
    threads = numba.get_num_threads()
    whole, curve = trained(views, model)
    path = tmp_path / "checkpoint.safetensors"
    stops = chain([False, False, False], repeat(True))
    try:
        numba.set_num_threads(1)
        with pytest.raises(TrainingStoppedError, match="stopped after step 2 of 5"):
            trained(views, model, checkpoint_path=path, stop_requested=lambda: next(stops))
        again, curve_again = trained(views, model, checkpoint_path=path)
    finally:
        numba.set_num_threads(threads)
    digests = []
    for name, avatar in (("a", whole), ("b", again)):
        digests.append(save_avatar(avatar, tmp_path / name, write=write))
    assert digests[0] == digests[1]
    assert [line.loss for line in curve_again] == [line.loss for line in curve]
    assert [math.isfinite(line.watched_psnr_db) for line in curve] == [
        False, True, False, True, True,
    ]  # fmt: skip


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def test_a_damaged_checkpoint_is_named_and_another_recipe_starts_anew(views, model, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(b"half a file")
    with pytest.raises(DataError, match=r"checkpoint\.safetensors is damaged"):
        trained(views, model, checkpoint_path=path)
    with HumanNerfTrainer(views, model, shape(views), settings=SETTINGS) as trainer:
        trainer.advance()
        trainer.save(path)
    other = replace(SETTINGS, samples=16)
    with HumanNerfTrainer(views, model, shape(views), settings=other) as trainer:
        trainer.restore(path)
        assert trainer.step == 0


def test_pictures_smaller_than_a_patch_are_refused(views, model):
    with pytest.raises(DataError, match="at least 64 x 64 px"):
        trained(views, model, replace(SETTINGS, patch_px=64))


def test_it_learns_the_actor_and_leaves_nothing_visible_out(views, model, tmp_path):
    settings = replace(
        SETTINGS, steps=140, samples=32, canonical_rate=4e-3, other_rate=1e-3, watch_every=140
    )
    avatar, curve = trained(views, model, settings)
    losses = [line.loss for line in curve]
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:20])
    save_avatar(avatar, tmp_path, write=write)
    loaded = load_avatar(tmp_path)
    view = 0  # watched: never trained on
    camera = views.cameras[views.camera_of_view[view]]
    pose = views.poses.at(int(views.pose_of_view[view]))
    picture = render_view(pose_avatar(loaded, model, pose), camera)
    truth = photograph(views, view)
    box = tight_window(truth.mask).of(truth.on_grey())  # no constant does better than its mean
    seen = Cutout(picture.rgb.astype(np.float64), picture.alpha.astype(np.float64))
    assert psnr_box_db(seen, truth) > psnr_db(float(((box - box.mean((0, 1))) ** 2).mean()))
    everything = render_view(pose_avatar(replace(loaded, weight_floor=0.0), model, pose), camera)
    assert everything.evaluations > 2 * picture.evaluations
    # a sample that is left out has less than 1e-4 of opacity
    assert np.abs(everything.alpha - picture.alpha).max() < settings.samples * 1e-4
    assert np.abs(everything.alpha - picture.alpha).max() < 1 / 255
    person = picture.alpha > 0.5
    assert (picture.parts[person] > 0).all()
    distance = float((pose.transl - camera.center_world).norm())
    assert np.abs(picture.depth_m[person] - distance).max() < 1


def photograph(views, view):
    """The view's crop at its place, as a cut-out."""
    lens = views.cameras[views.camera_of_view[view]].lens
    left, top, width, height = views.boxes[view]
    rgba = np.zeros((lens.height, lens.width, 4), np.uint8)
    rgba[top : top + height, left : left + width] = views.crops[view]
    return Cutout.from_rgba(rgba)


@pytest.fixture(scope="module")
def untrained(views, model):
    with HumanNerfTrainer(views, model, shape(views), settings=SETTINGS) as trainer:
        return trainer.avatar()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"canonical": math.nan}, "1 in canonical"),
        ({"non_rigid": math.inf}, "1 in non_rigid"),
        ({"volume": -math.inf}, "1 in volume"),
        ({"betas": (math.nan, *BETAS[1:])}, "1 in betas"),
        ({"open_bands": math.nan}, "1 in open_bands"),
        ({"weight_floor": math.nan}, "1 in weight_floor"),
        ({"box": Box(np.zeros(3), np.array([1.0, math.inf, 1.0]))}, "1 in box"),
        ({"box": Box(np.zeros(3), np.array([1.0, 0.0, 1.0]))}, "1 in box"),
        ({}, ""),
    ],
)
def test_an_avatar_of_a_diverged_training_is_refused(untrained, tmp_path, change, message):
    change = dict(change)
    for name in {"canonical", "non_rigid", "volume"} & set(change):
        part = deepcopy(getattr(untrained, name))
        with torch.no_grad():
            array = part if name == "volume" else next(part.parameters())
            array.flatten()[3] = change[name]
        change[name] = part
    save_avatar(replace(untrained, **change), tmp_path, write=write)
    if not message:
        load_avatar(tmp_path)
        return
    with pytest.raises(DataError, match=f"{message}; its training diverged, train it again"):
        load_avatar(tmp_path)


def run(verb, config, **flags):
    words = [verb, "--config", json.dumps(config)]
    for name, value in flags.items():
        words += [f"--{name}", str(value)]
    assert cli.main(words) == 0


def test_the_stages_train_and_render_it(capture, tmp_path):
    avatar = tmp_path / "avatar"
    small = {"steps": 2, "patches": 1, "patch_px": 16, "samples": 8}
    run(
        "train", {"field": "humannerf", "humannerf": small}, capture=capture,
        cameras=capture / "cameras.parquet", masks=capture / "masks.parquet",
        bodies=capture / "bodies.parquet", work=tmp_path / "work", out=avatar,
    )  # fmt: skip
    header = json.loads((avatar / "avatar.json").read_text())
    assert header["field"] == "humannerf"
    assert header["training"] == {
        "iterations": 2, "planned": 2, "loss": "0.2 MSE", "converged": False,
    }  # fmt: skip
    with pytest.raises(DataError, match="field 'humannerf', expected 'grid'"):
        load_grid(avatar)
    rig = {"height_above_pelvis_m": 1.2, "ring_radius_m": 1.0}
    run(
        "render",
        {"rigs": {"top": rig}, "image": {"width_px": 64, "height_px": 64}},
        source="studio", actor="plain", action="range", rig="top", frames=0, motion="",
        avatar=avatar, bodies=capture / "bodies.parquet", packages=tmp_path,
        work=tmp_path / "work_render", out=tmp_path / "renders",
    )  # fmt: skip
    assert len(list((tmp_path / "renders").rglob("*.png"))) == 27
