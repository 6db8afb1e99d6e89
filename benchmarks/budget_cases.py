"""What the error budget substitutes truth for: captures, truths, fields and renderings.

A case is a choice of each; cases that share a capture, a truth or a field share it on disk too.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.filled import clothed_model, filled_avatar
from benchmarks.pictures import Studio, motion_poses, novel_poses, recorded_views
from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.captures.studio.truth import TruePose
from ntop.config.sections import TrainConfig
from ntop.config.sources import StudioSource
from ntop.field.avatar import Avatar
from ntop.field.culling import body_pixels, pixel_window
from ntop.field.posing import PosedAvatar
from ntop.field.quality import PRESETS
from ntop.field.rendering import render_view
from ntop.field.schedule import TrainingSettings
from ntop.field.training import train
from ntop.geometry.cameras import Camera
from ntop.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ntop.geometry.windows import cropped, resized
from ntop.metrics.images import Cutout
from ntop.stages.s4_train import training_settings

FRAMES = 20  # of the pinned capture
TURNS = 20  # orientations of the one pose that is only turned
TILT_RAD = math.radians(30)  # so that side cameras see the top as well
GOLDEN_RAD = math.radians(137.5)
DENSE = 4  # rays per pixel and axis
FINE_SCALE = 2


@dataclass(frozen=True)
class Case:
    """Truth in place of what the base has; gains are counted against the case named `against`.

    `even`: even light in capture and truth. `rigid`: both show one body pose, turned;
    `rigid_truth`: the truth alone. `surface`: the warp follows the clothed surface itself.
    `fine`: pictures of twice the size, voxels of half, twice the rays. `filled`: nothing is
    trained, the true textures are written into the grid. `look`: how pictures are rendered.
    """

    name: str
    part: str
    words: str
    against: str = ""
    even: bool = False
    rigid: bool = False
    rigid_truth: bool = False
    surface: bool = False
    fine: bool = False
    filled: bool = False
    look: str = "default"

    @property
    def field_name(self) -> str:
        """What decides about the field, as a folder's name."""
        names = ("even", "rigid", "surface", "fine", "filled")
        if self.filled:  # knows no pictures, and no pose
            names = ("filled", "fine")
        return "_".join(name for name in names if getattr(self, name)) or "base"


CASES = (
    Case("base", "", "nothing"),
    Case("even light", "light", "capture and truth under even light", "base", even=True),
    Case("base, turned", "", "nothing; the truth is one pose of the training, turned",
         rigid_truth=True),
    Case("turned", "skinning", "capture and truth are one pose, turned: skinning is rigid",
         "base, turned", rigid=True, rigid_truth=True),
    Case("true surface", "skinning", "the warp follows the clothed surface, not the body's",
         "base", surface=True),
    Case("fine", "resolution", "pictures of twice the size, voxels of half, twice the rays",
         "base", fine=True),
    Case("reference", "quadrature", "preset `reference`", "base", look="reference"),
    Case("dense", "quadrature", "preset `reference` and 16 rays in every pixel",
         "base", look="dense"),
    Case("all", "all", "even light, true surface, fine and dense", "base",
         even=True, surface=True, fine=True, look="dense"),
    Case("filled", "learning", "true textures written into the grid; even light", "even light",
         even=True, filled=True),
    Case("filled, true surface", "skinning", "the same, the warp follows the clothed surface",
         "filled", even=True, filled=True, surface=True),
    Case("filled, fine", "resolution", "the same in voxels of half the size", "filled",
         even=True, filled=True, fine=True),
    Case("filled, dense", "quadrature", "the same with 16 rays in every pixel", "filled",
         even=True, filled=True, look="dense"),
    Case("filled, all", "all", "true surface, fine and dense", "filled",
         even=True, filled=True, surface=True, fine=True, look="dense"),
)  # fmt: skip


def light_settings(studio: Studio, case: Case) -> StudioSource:
    """The studio under the case's light."""
    return studio.settings.model_copy(update={"light_to_ambient": 0.0} if case.even else {})


def case_model(studio: Studio, case: Case) -> BodyModel:
    """What drives the warp."""
    return clothed_model(studio.actor) if case.surface else studio.actor.model


def case_truth(studio: Studio, case: Case) -> list[TruePose]:
    """The poses that are scored: the pinned novel ones, or one pose in four novel orientations."""
    if not case.rigid_truth:
        return novel_poses(studio, sets=1)
    headings = (np.arange(4) * TURNS / 4 + 0.5) * 2 * math.pi / TURNS
    tilts = np.full(4, TILT_RAD / 2)
    poses = _turned(studio, headings, tilts, math.pi / 4 + np.arange(4) * math.pi / 2)
    return [TruePose("turned", k, poses.at(k)) for k in range(4)]


def case_avatar(studio: Studio, case: Case, *, steps: int, checkpoint: Path) -> Avatar:
    """The case's field, trained (on from the checkpoint, if there is one) or filled."""
    settings = field_settings(case, steps=steps)
    if case.filled:
        return filled_avatar(studio.actor, studio.betas, voxel_m=settings.voxels_m[-1])
    poses = motion_poses(studio, FRAMES)
    if case.rigid:
        poses = _turned(
            studio,
            np.arange(TURNS) * 2 * math.pi / TURNS,
            np.full(TURNS, TILT_RAD),
            np.arange(TURNS) * GOLDEN_RAD,
        )
    source = light_settings(studio, case)
    if case.fine:
        size = FINE_SCALE * source.image_size_px
        source = source.model_copy(update={"image_size_px": size})
    views = recorded_views(studio, poses, source)
    model, betas = case_model(studio, case), studio.betas
    return train(views, model, betas, settings=settings, checkpoint_path=checkpoint)[0]


def field_settings(case: Case, *, steps: int) -> TrainingSettings:
    """The defaults, finer where the case is; even light is known, not learned."""
    settings = replace(training_settings(TrainConfig(steps=steps)), light=not case.even)
    if not case.fine:
        return settings
    return replace(
        settings,
        voxels_m=tuple(voxel / FINE_SCALE for voxel in settings.voxels_m),
        min_step_m=settings.min_step_m / FINE_SCALE,
        rays_per_batch=2 * settings.rays_per_batch,
    )


def seen(posed: PosedAvatar, camera: Camera, *, look: str) -> Cutout:
    """One view; `look` is a preset, or `dense`: `reference` with a grid of rays in every pixel."""
    if look != "dense":
        rendering = render_view(posed, camera, settings=PRESETS[look])
        return Cutout(rendering.rgb.astype(np.float64), rendering.alpha.astype(np.float64))
    left, top, width, height = pixel_window(body_pixels(posed.warp, camera))
    part = cropped(camera.lens, left=left, top=top, width=width, height=height)
    lens = resized(part, width=DENSE * width, height=DENSE * height)
    one_ray = replace(PRESETS["reference"], edge_rays=1)
    rendering = render_view(posed, replace(camera, lens=lens), settings=one_ray)
    alpha = rendering.alpha.astype(np.float64)[..., None]
    layers = np.concatenate([rendering.rgb * alpha, alpha], -1)
    mean = layers.reshape(height, DENSE, width, DENSE, 4).mean((1, 3))
    whole = np.zeros((camera.lens.height, camera.lens.width, 4))
    whole[top : top + height, left : left + width] = mean
    return Cutout(whole[..., :3] / np.maximum(whole[..., 3:], 1e-6), whole[..., 3])


def _turned(
    studio: Studio, headings: np.ndarray, tilts: np.ndarray, tilt_azimuths: np.ndarray
) -> BodyPose:
    """The first pose of the training motion about its pelvis: about z, then leaning over."""
    first = motion_poses(studio, FRAMES).at(0)
    count = len(headings)
    zero = np.zeros(count)
    yaw = matrix_from_axis_angle(torch.from_numpy(np.stack([zero, zero, headings], -1)))
    axis = np.stack([np.cos(tilt_azimuths), np.sin(tilt_azimuths), zero], -1)
    lean = matrix_from_axis_angle(torch.from_numpy(axis * tilts[:, None]))
    orientation = lean @ yaw @ matrix_from_axis_angle(first.global_orient)
    return BodyPose(
        betas=first.betas.expand(count, -1),
        global_orient=axis_angle_from_matrix(orientation),
        body_pose=first.body_pose.expand(count, -1),
        transl=first.transl.expand(count, -1),
    )
