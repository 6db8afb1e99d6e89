"""Avatars of either field behind one interface: load, save, pose once, render many views.

The union is closed: a third field is a third case of each function, and a type checker finds the
cases that lack it.
"""

from pathlib import Path
from typing import Any, assert_never

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.conventions import DataError
from ntop.field import avatar as grid
from ntop.field import posing, rendering
from ntop.field.avatar import Avatar, read_avatar_files
from ntop.field.devices import kernel_words
from ntop.field.humannerf import avatar as humannerf
from ntop.field.humannerf.avatar import HumanNerfAvatar
from ntop.field.humannerf.device import device_words
from ntop.field.humannerf.rendering import PosedHumanNerf, pose_humannerf, render_humannerf
from ntop.field.posing import PosedAvatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import Rendering
from ntop.geometry.cameras import Camera

AnyAvatar = Avatar | HumanNerfAvatar
AnyPosed = PosedAvatar | PosedHumanNerf


def load_avatar(folder: Path) -> AnyAvatar:
    """Read an avatar of either field.

    Raises:
        DataError: a file is missing, broken, of another format, or of an unknown field.
    """
    files = read_avatar_files(folder)
    match files.field:
        case grid.FIELD:
            return grid.grid_from_files(files)
        case humannerf.FIELD:
            return humannerf.humannerf_from_files(files)
        case other:
            raise DataError(
                f"avatar {folder}: field {other!r}, expected {grid.FIELD!r} or "
                f"{humannerf.FIELD!r}; it was trained by another version: train it again"
            )


def compute_words(avatar: AnyAvatar) -> str:
    """What an avatar is rendered on, in words for a job's log."""
    match avatar:
        case Avatar():
            return kernel_words()
        case HumanNerfAvatar():
            return device_words()
        case _:
            assert_never(avatar)


def save_avatar(avatar: AnyAvatar, folder: Path, *, write: Any) -> str:
    """Write both files through `write(path, bytes)` and return the arrays' sha256."""
    match avatar:
        case Avatar():
            return grid.save_avatar(avatar, folder, write=write)
        case HumanNerfAvatar():
            return humannerf.save_humannerf(avatar, folder, write=write)
        case _:
            assert_never(avatar)


def pose_avatar(
    avatar: AnyAvatar,
    model: BodyModel,
    pose: BodyPose,
    *,
    settings: RenderSettings | None = None,
) -> AnyPosed:
    """The per-pose work, once for all views, of a single pose.

    `settings` choose how exactly the grid is marched; the twin marches as it was trained.
    """
    match avatar:
        case Avatar():
            return posing.pose_avatar(avatar, model, pose, settings=settings)
        case HumanNerfAvatar():
            return pose_humannerf(avatar, model, pose)
        case _:
            assert_never(avatar)


def render_view(
    posed: AnyPosed, camera: Camera, *, settings: RenderSettings | None = None
) -> Rendering:
    """One view through any lens; pixels outside the lens's valid circle stay empty.

    `settings` as for `pose_avatar`.
    """
    match posed:
        case PosedAvatar():
            return rendering.render_view(posed, camera, settings=settings)
        case PosedHumanNerf():
            return render_humannerf(posed, camera)
        case _:
            assert_never(posed)
