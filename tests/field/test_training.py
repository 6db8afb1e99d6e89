"""Training on a ball: it learns, forgets nothing when interrupted, and saves what it learned."""

import math
from dataclasses import replace
from itertools import chain, repeat

import numpy as np
import pytest
import torch

from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose, pose_body
from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.field.avatar import ARRAYS_NAME, load_avatar, save_avatar
from ntop.field.posing import pose_avatar
from ntop.field.progress import TrainingStoppedError
from ntop.field.quality import RenderSettings
from ntop.field.rendering import render_view
from ntop.field.schedule import TrainingSettings
from ntop.field.training import train
from ntop.field.views import TrainingViews
from ntop.field.watching import ray_source
from ntop.geometry.cameras import Camera, Pinhole

SETTINGS = TrainingSettings(
    steps=36, rays_per_batch=512, views_per_batch=4, watch_every=12, checkpoint_every=5,
    occupancy_every=8, voxels_m=(0.03, 0.02, 0.015), ray_blocks=4,
)  # fmt: skip


def standing_pose():
    zeros = torch.zeros(1, 3, dtype=torch.float64)
    upright = torch.tensor([[math.pi / 2, 0, 0]], dtype=torch.float64)  # y up -> z up
    transl = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    return BodyPose(
        torch.zeros(1, 10, dtype=torch.float64), upright, zeros.new_zeros(1, 69), transl
    )


def first(poses):
    names = ("betas", "global_orient", "body_pose", "transl")
    return BodyPose(*(getattr(poses, name)[0] for name in names))


def side_camera(azimuth, size=96):
    centre = torch.tensor([3 * math.cos(azimuth), 3 * math.sin(azimuth), 1.0], dtype=torch.float64)
    forward = -centre / centre.norm() * torch.tensor([1, 1, 0], dtype=torch.float64)
    forward = forward / forward.norm()
    down = torch.tensor([0, 0, -1.0], dtype=torch.float64)
    right = torch.linalg.cross(down, forward)
    lens = Pinhole(1.2 * size, 1.2 * size, size / 2, size / 2, size, size)
    return Camera(lens, centre, torch.stack([right, down, forward]))


@pytest.fixture(scope="module")
def model():
    return load_body_model()


@pytest.fixture(scope="module")
def views(model):
    """A red standing body, seen from four sides: disc splats of its vertices."""
    pose = standing_pose()
    vertices = pose_body(model, pose).vertices[0]
    cameras = tuple(side_camera(k * math.pi / 2) for k in range(4))
    crops = []
    for camera in cameras:
        pixels, _ = camera.project(vertices)
        index = pixels.round().long().clamp(0, camera.lens.width - 1).numpy()
        matte = np.zeros((96, 96), np.uint8)
        matte[index[:, 1], index[:, 0]] = 255
        matte = np.maximum(matte, np.roll(matte, 1, 0))
        colour = np.broadcast_to(np.array([200, 40, 30], np.uint8), (96, 96, 3))
        crops.append(np.concatenate([colour, matte[..., None]], -1))
    return TrainingViews(
        cameras=cameras, crops=tuple(crops), boxes=np.array([[0, 0, 96, 96]] * 4),
        camera_of_view=np.arange(4), pose_of_view=np.zeros(4, int), poses=pose,
        watched=np.array([False, False, False, True]),
    )  # fmt: skip


def trained(views, model, **more):
    return train(views, model, (0.0,) * 10, settings=SETTINGS, **more)


def test_a_ray_goes_through_the_centre_of_the_pixel_whose_colour_it_is_told(views):
    """Anywhere else in the pixel it would be told the mean of all of it: a blur (decision 0021)."""
    v, u = np.indices((60, 40), np.uint8)  # its own place in the crop as its colour
    crop = np.stack([u, v, np.zeros_like(u), np.full_like(u, 255)], -1)
    corner, camera = np.array([230, 200]), side_camera(0.0, size=512)
    one = replace(
        views, cameras=(camera,), crops=(crop,), boxes=np.array([[*corner, 40, 60]]),
        camera_of_view=np.zeros(1, int), pose_of_view=np.zeros(1, int), watched=np.array([False]),
    )  # fmt: skip
    source = ray_source(one, ~one.watched, np.zeros((1, 3)), settings=SETTINGS)
    rays = source.draw(400, num_views=1, generator=np.random.default_rng(0))
    pixels, _ = camera.project(camera.center_world + torch.from_numpy(rays.directions))
    told = np.rint(255 * rays.targets[:, :2]) + corner + PIXEL_CENTRE
    assert len(np.unique(told, axis=0)) > 300
    assert np.abs(pixels.numpy() - told).max() < 0.01


def test_it_learns_the_colour_of_the_body(views, model):
    avatar, curve = trained(views, model)
    assert curve[-1].loss < 0.5 * curve[0].loss
    picture = render_view(pose_avatar(avatar, model, first(views.poses)), side_camera(0.7))
    body = picture.alpha > 0.9
    assert body.sum() > 200
    red, green, _ = picture.rgb[body].mean(0)
    assert red > 0.5 > 2 * green


def test_skipping_stays_within_its_bound(views, model):
    avatar, _ = trained(views, model)
    camera, pose = side_camera(0.7), first(views.poses)

    def picture(settings):
        posed = pose_avatar(avatar, model, pose, settings=settings)
        return render_view(posed, camera, settings=settings)

    exact = picture(RenderSettings(crop=False, intervals=False, cells=False, stop_transmittance=0))
    skipping = picture(RenderSettings())
    assert np.abs(exact.alpha - skipping.alpha).max() <= 1e-6 + 1e-3  # the light left at the end
    assert exact.evaluations > skipping.evaluations


def test_a_stopped_training_ends_with_the_same_bytes(views, model, tmp_path):
    whole, curve = trained(views, model)
    path = tmp_path / "checkpoint.safetensors"
    stops = chain([False] * 9, repeat(True))
    with pytest.raises(TrainingStoppedError):
        trained(views, model, checkpoint_path=path, stop_requested=lambda: next(stops))
    again, curve_again = trained(views, model, checkpoint_path=path)
    assert again.grid.values.tobytes() == whole.grid.values.tobytes()
    assert again.light.tobytes() == whole.light.tobytes()
    assert [line.loss for line in curve_again] == [line.loss for line in curve]


def test_a_damaged_checkpoint_is_named(views, model, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(b"half a file")
    with pytest.raises(DataError, match=r"checkpoint\.safetensors is damaged"):
        trained(views, model, checkpoint_path=path)


def test_a_changed_byte_of_a_checkpoint_is_noticed(views, model, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    with pytest.raises(TrainingStoppedError):
        trained(views, model, checkpoint_path=path, stop_requested=lambda: True)
    content = bytearray(path.read_bytes())
    for place in (len(content) // 2, len(content) - 1):
        content[place] ^= 1
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"damaged.*not what was saved.*delete it"):
            trained(views, model, checkpoint_path=path)
        content[place] ^= 1


def test_a_checkpoint_that_cannot_be_written_says_so(views, model, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match=r"cannot write checkpoint .*File exists.*free space"):
        trained(views, model, checkpoint_path=tmp_path / "file/checkpoint.safetensors")


def test_an_avatar_survives_the_disk_and_damage_is_noticed(views, model, tmp_path):
    avatar, _ = trained(views, model)
    save_avatar(avatar, tmp_path, write=lambda path, content: path.write_bytes(content))
    loaded = load_avatar(tmp_path)
    assert np.abs(loaded.grid.values - avatar.grid.values).max() < 0.01  # float16 of raw <= 30
    assert (loaded.grid.bricks == avatar.grid.bricks).all()
    assert loaded.betas == avatar.betas
    content = bytearray((tmp_path / ARRAYS_NAME).read_bytes())
    content[-1] ^= 1
    (tmp_path / ARRAYS_NAME).write_bytes(content)
    with pytest.raises(DataError, match="train it again"):
        load_avatar(tmp_path)
