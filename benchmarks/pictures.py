"""Studio captures in memory: any poses, cameras and light, as training sees them, and their truth.

The studio's own functions make them; what is made lies in a work folder by its content's hash, so
that no picture is made twice.
"""

import functools
import hashlib
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

from benchmarks.environment import ROOT
from benchmarks.studio import CLIPS, MARGIN_M, SOURCE, have_clips
from ntop.body.authored_motions import named_motion
from ntop.body.model import load_body_model
from ntop.body.motions import retarget
from ntop.body.skinning import BodyPose
from ntop.captures.studio.actors import Actor, dress_actor, pose_actor
from ntop.captures.studio.capture import FRAME_RATE_HZ, sequence_poses
from ntop.captures.studio.recording import side_cameras
from ntop.captures.studio.room import empty_room
from ntop.captures.studio.truth import TruePose, write_truth
from ntop.captures.studio.views import light_actor, over, see, studio_light
from ntop.captures.training_views import WATCH_EVERY
from ntop.config.rigs import configured_rig
from ntop.config.run import Run, load_files
from ntop.config.sources import StudioSource
from ntop.field.views import TrainingViews
from ntop.geometry.cameras import Camera
from ntop.metrics.images import tight_window
from ntop.storage.atomic import atomic_folder, atomic_path
from ntop.storage.images import eight_bit

ACTOR = "plain"
MARGIN_PX = 4  # beyond MARGIN_M
PROCESSES = 2


@dataclass(frozen=True)
class Studio:
    """The pinned studio (config/studio.yaml) and its actor `plain`."""

    run: Run
    actor: Actor
    packages: Path
    work: Path

    @property
    def settings(self) -> StudioSource:
        """The pinned settings."""
        return self.run.config.sources[SOURCE]

    @property
    def betas(self) -> tuple[float, ...]:
        """The actor's shape."""
        return tuple(float(value) for value in self.actor.betas)


def open_studio(packages: Path, work: Path) -> Studio:
    """The studio; pictures and truth will lie below `work`."""
    have_clips(packages)
    run = load_files([ROOT / "config/studio.yaml"], directory=ROOT)
    return Studio(run, dress_actor(ACTOR, load_body_model()), packages, work)


def motion_poses(studio: Studio, count: int) -> BodyPose:
    """So many poses, evenly spaced over one round of the pinned training motion; 20 are its own.

    Of counts that divide each other, the poses of one are among those of the other.
    """
    row = next(row for row in _sequences(studio) if row.use == "train")
    motion = named_motion(row.motion, studio.packages / CLIPS)
    round_s = len(row.frames) * row.step / FRAME_RATE_HZ
    times_s = row.first / FRAME_RATE_HZ + round_s / count * torch.arange(count).double()
    betas = torch.from_numpy(studio.actor.betas)
    return retarget(motion, studio.actor.model, betas, frame_times_s=times_s)


def novel_poses(studio: Studio, *, sets: int) -> list[TruePose]:
    """Of each pinned sequence with truth the middle `sets` poses, as `chosen_rows` chooses them."""
    found = []
    for row in (row for row in _sequences(studio) if row.truth):
        poses = sequence_poses(row, studio.actor, studio.packages)
        spare = max(len(row.frames) - sets, 0) // 2
        chosen = range(spare, min(spare + sets, len(row.frames)))
        found += [TruePose(row.action, row.frames[k], poses.at(k)) for k in chosen]
    return found


def true_views(
    studio: Studio, poses: Sequence[TruePose], *, rigs: int, settings: StudioSource
) -> Path:
    """A folder that has the truth from above of these poses, in the first `rigs` rigs."""
    keys = [(item.action, item.frame, *_numbers(item.pose)) for item in poses]
    name = f"{settings.light_to_ambient}, {settings.truth_supersampling}, {rigs}"
    folder = studio.work / f"truth_{_digest(name, keys)}"
    if not folder.exists():
        render = studio.run.config.render
        names = sorted(render.rigs)[:rigs]
        with atomic_folder(folder) as partial:
            write_truth(
                poses,
                studio.actor,
                source=SOURCE,
                rigs={name: configured_rig(render.rigs[name], render.image) for name in names},
                light=studio_light(settings.light_to_ambient),
                supersampling=settings.truth_supersampling,
                seed=settings.seed,
                out=partial / "truth",
            )
    return folder


def recorded_views(studio: Studio, poses: BodyPose, settings: StudioSource) -> TrainingViews:
    """What the side cameras see of the poses (frame first): crops around the person."""
    frames = len(poses.transl)
    cameras = tuple(side_cameras(settings).values())
    recipe = settings.model_dump_json(
        include={
            "num_cameras", "image_size_px", "camera_radius_m", "supersampling", "light_to_ambient",
        }
    )  # fmt: skip
    path = studio.work / f"pictures_{_digest(recipe, _numbers(poses))}.npz"
    if not path.exists():
        each = [[getattr(poses, name)[k].numpy() for name in _POSE_FIELDS] for k in range(frames)]
        with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool:
            film = functools.partial(_filmed, settings.model_dump_json())
            found = [item for frame in pool.map(film, each) for item in frame]
        pixels = np.concatenate([crop.reshape(-1, 4) for _, crop in found])
        with atomic_path(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, boxes=np.array([box for box, _ in found]), pixels=pixels)
    with np.load(path) as kept:
        boxes, pixels = kept["boxes"], kept["pixels"]
    ends = np.cumsum(boxes[:, 2] * boxes[:, 3])
    crops = [
        part.reshape(box[3], box[2], 4)
        for box, part in zip(boxes, np.split(pixels, ends[:-1]), strict=True)
    ]
    pose_of_view = np.repeat(np.arange(frames), len(cameras))
    return TrainingViews(
        cameras=cameras,
        crops=tuple(crops),
        boxes=boxes,
        camera_of_view=np.tile(np.arange(len(cameras)), frames),
        pose_of_view=pose_of_view,
        poses=poses,
        watched=pose_of_view % WATCH_EVERY == WATCH_EVERY // 2,
    )


_POSE_FIELDS = ("betas", "global_orient", "body_pose", "transl")


@dataclass(frozen=True)
class _Room:
    """Where a process films."""

    actor: Actor
    settings: StudioSource
    cameras: tuple[Camera, ...]
    plates: tuple[np.ndarray, ...]


@functools.lru_cache(maxsize=1)
def _room(settings_json: str) -> _Room:
    settings = StudioSource.model_validate_json(settings_json)
    cameras = tuple(side_cameras(settings).values())
    plates = tuple(empty_room(camera) for camera in cameras)
    return _Room(dress_actor(ACTOR, load_body_model()), settings, cameras, plates)


def _filmed(
    settings_json: str, pose: list[np.ndarray]
) -> list[tuple[tuple[int, int, int, int], np.ndarray]]:
    """Boxes and crops of one pose, given as arrays: a tensor's memory moves when it is sent."""
    room = _room(settings_json)
    posed = pose_actor(room.actor, BodyPose(*map(torch.from_numpy, pose)))
    scene = light_actor(room.actor, posed, studio_light(room.settings.light_to_ambient))
    found = []
    for camera, plate in zip(room.cameras, room.plates, strict=True):
        seen = see(scene, camera, supersampling=room.settings.supersampling)
        left, top, width, height = box = _box(seen.alpha, camera, room.settings)
        layers = np.concatenate([over(seen, plate), seen.alpha[..., None]], -1)
        found.append((box, eight_bit(layers[top : top + height, left : left + width])))
    return found


def _box(alpha: np.ndarray, camera: Camera, settings: StudioSource) -> tuple[int, int, int, int]:
    """Left, top, width and height of the person with a margin."""
    grow = round(MARGIN_M * camera.lens.fx / settings.camera_radius_m) + MARGIN_PX
    window = tight_window(alpha > 0)
    left, top = max(window.left - grow, 0), max(window.top - grow, 0)
    right = min(window.right + grow, camera.lens.width)
    bottom = min(window.bottom + grow, camera.lens.height)
    return left, top, right - left, bottom - top


def _sequences(studio: Studio) -> list:
    return [row for row in studio.run.sequences if (row.source, row.actor) == (SOURCE, ACTOR)]


def _numbers(pose: BodyPose) -> list:
    return [getattr(pose, name).tolist() for name in _POSE_FIELDS]


def _digest(recipe: str, numbers: list) -> str:
    return hashlib.sha256((recipe + json.dumps(numbers)).encode()).hexdigest()[:12]
