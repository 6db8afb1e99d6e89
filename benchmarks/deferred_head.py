"""A deferred head: a tiny network that corrects every rendered pixel of a trained grid.

It knows a pixel's colour and, by choice, the surface's normal, the direction of the ray in the
world and relative to the body, the pose, and where on the person the pixel lies. It learns from
the photographs that the grid was trained on, and those set aside choose its best state; before
its first step it changes nothing. An ablation, not a part of the package:
docs/decisions/0022-no-deferred-head.md.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from benchmarks.first_surfaces import first_surfaces
from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.field.avatar import Avatar
from ntop.field.kernels.adjoint import ROBUST_WIDTH
from ntop.field.posing import PosedAvatar, pose_avatar
from ntop.field.rendering import Rendering, render_view
from ntop.field.views import MATTE_INSIDE, TrainingViews
from ntop.geometry.cameras import Camera
from ntop.geometry.rotations import matrix_from_axis_angle

PIXELS_PER_VIEW = 4096
POSE_NUMBERS = 6  # principal components of the training's joint rotations
POSE_BOUND = 3.0  # standard deviations; novel poses lie beyond the training's
OCTAVES = 4  # of the canonical place: 2 m down to 25 cm
WIDTH = 32
BATCH = 8192
RATES = (3e-3, 3e-4)
WATCH_EVERY = 25

GROUPS = ("normal", "view", "body", "pose", "place")  # beside the colour, which is always known

Spent = Callable[[], float]  # share of a budget that is spent; 1 and more: stop


@dataclass(frozen=True)
class PoseCode:
    """Few numbers of a pose: principal components of the joints' rotations, of unit variance."""

    mean: Float[np.ndarray, "207"]
    axes: Float[np.ndarray, "207 number"]

    @classmethod
    def of(cls, poses: BodyPose) -> "PoseCode":
        """Of the poses of a training."""
        rotations = _joint_rotations(poses)
        mean = rotations.mean(0)
        _, lengths, axes = np.linalg.svd(rotations - mean, full_matrices=False)
        kept = min(POSE_NUMBERS, int((lengths > 1e-6).sum()))
        scale = np.sqrt(len(rotations)) / lengths[:kept]
        return cls(mean, axes[:kept].T * scale)

    def __call__(self, pose: BodyPose) -> Float[np.ndarray, " number"]:
        """Of one pose, bounded."""
        code = (_joint_rotations(pose)[0] - self.mean) @ self.axes
        return np.clip(code, -POSE_BOUND, POSE_BOUND)


def _joint_rotations(poses: BodyPose) -> Float[np.ndarray, "pose 207"]:
    return matrix_from_axis_angle(poses.body_pose.double().reshape(-1, 23, 3)).flatten(1).numpy()


@dataclass(frozen=True)
class Pixels:
    """Rendered pixels: what the head knows of them, their own colour and the photograph's."""

    features: Float[Tensor, "pixel feature"]
    colours: Float[Tensor, "pixel 3"]
    targets: Float[Tensor, "pixel 3"]


class DeferredHead(nn.Module):
    """Two hidden layers that predict what to add to a pixel's colour; at first nothing."""

    def __init__(self, features: Float[Tensor, "pixel feature"], *, seed: int = 0) -> None:
        """A head for features distributed like these."""
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.layers = nn.Sequential(
                nn.Linear(features.shape[1], WIDTH), nn.ReLU(),
                nn.Linear(WIDTH, WIDTH), nn.ReLU(),
                nn.Linear(WIDTH, 3),
            )  # fmt: skip
        nn.init.zeros_(self.layers[-1].weight)
        nn.init.zeros_(self.layers[-1].bias)
        self.register_buffer("mean", features.mean(0))
        self.register_buffer("scale", 1 / features.std(0).clamp(min=1e-3))

    def forward(self, features: Float[Tensor, "pixel feature"]) -> Float[Tensor, "pixel 3"]:
        """What to add to the colours."""
        return self.layers((features - self.mean) * self.scale)


def train_head(
    seen: Pixels, watched: Pixels, *, spent: Spent, seed: int = 0
) -> tuple[DeferredHead, int]:
    """Fit a head to pixels until the budget is spent; its state that is best on others.

    Returns the head and the step of that state; 0: no step made the watched pixels better.
    """
    head = DeferredHead(seen.features, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    adam = torch.optim.Adam(head.parameters(), lr=RATES[0])
    best, best_step, best_state = _squared_error(head, watched), 0, copy.deepcopy(head.state_dict())
    step = 0
    while (share := spent()) < 1:
        for group in adam.param_groups:
            group["lr"] = RATES[0] * (RATES[1] / RATES[0]) ** share
        chosen = torch.randint(len(seen.features), (BATCH,), generator=generator)
        error = seen.colours[chosen] + head(seen.features[chosen]) - seen.targets[chosen]
        loss = ((error**2 + ROBUST_WIDTH**2).sqrt() - ROBUST_WIDTH).sum(1).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        step += 1
        if step % WATCH_EVERY == 0 and (found := _squared_error(head, watched)) < best:
            best, best_step, best_state = found, step, copy.deepcopy(head.state_dict())
    head.load_state_dict(best_state)
    return head, best_step


@torch.no_grad()
def _squared_error(head: DeferredHead, pixels: Pixels) -> float:
    shown = (pixels.colours + head(pixels.features)).clamp(0, 1)
    return float(((shown - pixels.targets) ** 2).mean())


@dataclass(frozen=True)
class Describer:
    """What a head knows of rendered pixels; `groups` are some of `GROUPS`."""

    code: PoseCode
    groups: tuple[str, ...] = GROUPS

    def __call__(
        self, posed: PosedAvatar, pose: BodyPose, camera: Camera, rendering: Rendering
    ) -> tuple[tuple[Int[np.ndarray, " pixel"], ...], Float[Tensor, "pixel feature"]]:
        """The pixels of the mask, as rows and columns, and their features."""
        rows, columns = np.nonzero(rendering.depth_m > 0)
        centres = torch.from_numpy(np.stack([columns, rows], 1) + PIXEL_CENTRE)
        directions = camera.rays(centres)[0].double().numpy()
        depth_m = rendering.depth_m[rows, columns, None].astype(np.float64)
        points_world = camera.center_world.double().numpy() + depth_m * directions
        places, normals = first_surfaces(posed, points_world)
        world_from_body = matrix_from_axis_angle(pose.global_orient.double()).numpy()
        towards_eye = -(normals * directions).sum(1, keepdims=True)
        waves = (np.pi * 2.0 ** np.arange(OCTAVES) * places[..., None]).reshape(len(rows), -1)
        groups = {
            "normal": [normals],
            "view": [directions, towards_eye],
            "body": [directions @ world_from_body, normals @ world_from_body],
            "pose": [np.broadcast_to(self.code(pose), (len(rows), self.code.axes.shape[1]))],
            "place": [places, np.sin(waves), np.cos(waves)],
        }
        known = [rendering.rgb[rows, columns]]
        known += [values for name in self.groups for values in groups[name]]
        return (rows, columns), torch.from_numpy(np.concatenate(known, 1).astype(np.float32))


def corrected(
    head: DeferredHead,
    describer: Describer,
    posed: PosedAvatar,
    *,
    pose: BodyPose,
    camera: Camera,
    rendering: Rendering,
) -> Rendering:
    """The same view with the head's correction of every pixel of the mask."""
    place, features = describer(posed, pose, camera, rendering)
    rgb = rendering.rgb.copy()
    with torch.no_grad():
        rgb[place] = np.clip(rgb[place] + head(features).numpy(), 0, 1)
    return replace(rendering, rgb=rgb)


def photographed(
    avatar: Avatar,
    model: BodyModel,
    views: TrainingViews,
    describer: Describer,
    *,
    watched: bool,
    spent: Spent = lambda: 0.0,
) -> Pixels:
    """Pixels well inside the person of the views that are trained on, or that are set aside.

    All views of one random pose after the other, until the budget is spent; at least of one.

    Raises:
        DataError: there is no such view.
    """
    generator = np.random.default_rng(0)
    found = []
    for p in generator.permutation(len(views.poses.transl)):
        if found and spent() >= 1:
            break
        pose = views.poses.at(int(p))
        chosen = np.flatnonzero((views.pose_of_view == p) & (views.watched == watched))
        posed = pose_avatar(avatar, model, pose) if len(chosen) else None
        for v in chosen:
            camera = views.cameras[views.camera_of_view[v]]
            rendering = render_view(posed, camera)
            (rows, columns), features = describer(posed, pose, camera, rendering)
            left, top, width, height = views.boxes[v]
            photograph = np.zeros((*rendering.alpha.shape, 4), np.uint8)
            photograph[top : top + height, left : left + width] = views.crops[v]
            true = photograph[rows, columns]
            inside = np.flatnonzero(true[:, 3] >= MATTE_INSIDE)
            kept = generator.permutation(inside)[:PIXELS_PER_VIEW]
            targets = torch.from_numpy(true[kept, :3].astype(np.float32) / 255)
            colours = torch.from_numpy(rendering.rgb[rows, columns][kept])
            found.append(Pixels(features[torch.from_numpy(kept)], colours, targets))
    if not found:
        raise DataError(
            f"{'no' if watched else 'only'} watched views among {len(views.watched)}: the head "
            "needs views to learn from and others to watch; record more frames"
        )
    return Pixels(*(torch.cat([getattr(p, n) for p in found]) for n in Pixels.__dataclass_fields__))
