"""The ablation's head learns what it should, changes nothing before, and knows where pixels lie."""

import numpy as np
import pytest
import torch

from benchmarks.deferred_head import (
    DeferredHead,
    Describer,
    Pixels,
    PoseCode,
    corrected,
    train_head,
)
from benchmarks.first_surfaces import first_surfaces
from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose, pose_body
from ntop.conventions import NUM_BETAS
from ntop.field.avatar import Avatar
from ntop.field.canonical import canonical_body
from ntop.field.posing import PosedAvatar, pose_avatar
from ntop.field.rendering import render_view
from ntop.field.schedule import TrainingSettings
from ntop.field.trainer import initial_state
from ntop.geometry.cameras import Camera
from ntop.geometry.ideal_fisheyes import Equidistant

STEPS = 150


def pixels(seed: int, *, tint: float, noise: float = 0.0) -> Pixels:
    """Random colours seen from random directions; red depends on the direction's height."""
    generator = torch.Generator().manual_seed(seed)
    colours = 0.2 + 0.6 * torch.rand(20_000, 3, generator=generator)
    directions = torch.randn(20_000, 3, generator=generator)
    directions /= directions.norm(dim=1, keepdim=True)
    targets = colours + noise * torch.randn(20_000, 3, generator=generator)
    targets[:, 0] += tint * directions[:, 2]
    return Pixels(torch.cat([colours, directions], 1), colours, targets)


def spending(steps: int):
    """A budget of so many steps."""
    taken = iter(range(steps + 1))
    return lambda: next(taken) / steps


def error(head: DeferredHead, of: Pixels) -> float:
    with torch.no_grad():
        return float(((of.colours + head(of.features) - of.targets) ** 2).mean().sqrt())


def test_a_new_head_changes_nothing():
    seen = pixels(0, tint=0.1)
    assert (DeferredHead(seen.features)(seen.features) == 0).all()


def test_a_head_learns_a_tint_that_depends_on_the_direction():
    seen, watched = pixels(0, tint=0.1), pixels(1, tint=0.1)
    before = error(DeferredHead(watched.features), watched)
    head, step = train_head(seen, watched, spent=spending(STEPS))
    assert 0 < step <= STEPS
    assert error(head, watched) < 0.1 * before


def test_a_head_that_makes_watched_pixels_worse_stays_at_zero():
    seen, watched = pixels(0, tint=0.1), pixels(1, tint=-0.1)
    head, step = train_head(seen, watched, spent=spending(STEPS))
    assert step == 0
    assert (head(watched.features) == 0).all()


def turned_pose(seed: int) -> BodyPose:
    generator = torch.Generator().manual_seed(seed)
    return BodyPose(
        betas=torch.zeros(NUM_BETAS, dtype=torch.float64),
        global_orient=torch.tensor([1.4, 0.3, 0.2], dtype=torch.float64),
        body_pose=0.15 * torch.randn(69, generator=generator, dtype=torch.float64),
        transl=torch.tensor([0.4, -0.3, 1.0], dtype=torch.float64),
    )


def test_a_pose_code_has_unit_variance_and_bounds_what_was_never_seen():
    every = [turned_pose(seed) for seed in range(20)]
    names = BodyPose.__dataclass_fields__
    poses = BodyPose(*(torch.stack([getattr(pose, name) for pose in every]) for name in names))
    code = PoseCode.of(poses)
    codes = np.stack([code(pose) for pose in every])
    assert np.abs(codes.mean(0)).max() < 0.1
    assert 0.9 < codes.std(0).min() <= codes.std(0).max() < 1.01
    far = BodyPose(every[0].betas, every[0].global_orient, 10 * every[0].body_pose, every[0].transl)
    assert np.abs(code(far)).max() <= 3


@pytest.fixture(scope="module")
def posed() -> PosedAvatar:
    """The body's own shape in grey, before its first step."""
    model, pose = load_body_model(), turned_pose(0)
    betas = tuple(pose.betas.tolist())
    settings = TrainingSettings(voxels_m=(0.016,))
    state = initial_state(canonical_body(model, betas), 1, settings)
    light = state.light.astype(np.float32)
    return pose_avatar(Avatar(state.grid, light, betas, settings.outer_m, 0), model, pose)


def test_points_of_the_surface_are_taken_back_to_their_canonical_place(posed):
    model, pose = load_body_model(), turned_pose(0)
    vertices = pose_body(model, pose).vertices.numpy()
    places, normals = first_surfaces(posed, vertices)
    body = canonical_body(model, tuple(pose.betas.tolist()))
    off_m = np.linalg.norm(places - body.vertices, axis=1)
    assert np.quantile(off_m, 0.9) < 0.002  # folds of the armpits have two places
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-3)
    beyond = first_surfaces(posed, vertices + 10.0)
    assert not beyond[0].any()
    assert not beyond[1].any()


def test_a_head_corrects_the_pixels_of_the_mask_from_what_they_show(posed):
    pose = turned_pose(0)
    centre = pose.transl + torch.tensor([0.2, 0.1, 1.5], dtype=torch.float64)
    lens = Equidistant(focal=60.0, cx=64.0, cy=64.0, width=128, height=128)
    camera = Camera(lens, centre, torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)))
    rendering = render_view(posed, camera)
    describer = Describer(PoseCode(np.zeros(207), np.zeros((207, 0))), ("normal", "view"))
    (rows, columns), features = describer(posed, pose, camera, rendering)
    assert len(rows) > 300
    facing = -(features[:, 3:6] * features[:, 6:9]).sum(1)
    assert torch.allclose(features[:, 9], facing, atol=1e-5)
    assert (facing > 0).float().mean() > 0.95  # the rest is along the outline
    assert features[:, 8].max() < 0  # the camera looks down
    head = DeferredHead(features)
    with torch.no_grad():
        head.layers[-1].bias[0] = 0.1
    shown = corrected(head, describer, posed, pose=pose, camera=camera, rendering=rendering)
    change = shown.rgb - rendering.rgb
    assert np.allclose(change[rows, columns], [0.1, 0, 0], atol=1e-6)
    change[rows, columns] = 0
    assert not change.any()
