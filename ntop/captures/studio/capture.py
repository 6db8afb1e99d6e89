"""A studio capture as files: pictures, clean plates, and whatever the source is to provide."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from ntop.body.authored_motions import named_motion
from ntop.body.model import load_body_model
from ntop.body.motions import retarget
from ntop.body.skinning import BodyPose, pose_joints
from ntop.captures.studio.actors import Actor, dress_actor, pose_actor
from ntop.captures.studio.recording import disturbed, grown, misplaced, side_cameras
from ntop.captures.studio.room import empty_room
from ntop.captures.studio.truth import TruePose, write_truth
from ntop.captures.studio.views import light_actor, over, see, studio_light
from ntop.config.rigs import configured_rig
from ntop.config.sections import CaptureConfig
from ntop.config.sources import StudioSource
from ntop.config.tables import Sequence
from ntop.conventions import ConfigError
from ntop.geometry.cameras import Camera
from ntop.storage import schemas
from ntop.storage.atomic import write_bytes
from ntop.storage.bodies import body_rows
from ntop.storage.cameras import write_cameras
from ntop.storage.frames import STILL
from ntop.storage.images import eight_bit, write_matte
from ntop.storage.pace import paced
from ntop.storage.png import encode_png
from ntop.storage.tables import Row, write_table

FRAME_RATE_HZ = 30
CLIPS_PACKAGE = "pybullet"
SKELETON = "smpl24"


@dataclass(frozen=True)
class _Tables:
    """Rows gathered while recording."""

    frames: list[Row] = field(default_factory=list)
    masks: list[Row] = field(default_factory=list)
    keypoints2d: list[Row] = field(default_factory=list)
    bodies: list[Row] = field(default_factory=list)


def capture_studio(
    config: CaptureConfig, *, source: str, actor: str, packages: Path, out: Path
) -> None:
    """Write the recording of one actor into the existing folder `out`.

    Always frames.parquet, cameras.parquet, images/ and plates/; what the source provides of
    masks, keypoints2d and bodies; truth/ for sequences that ask for it. The same settings give
    the same bytes.

    Raises:
        ConfigError: unknown actor or motion, nothing to record, or truth without a rig.
        DataError: a clip cannot be read, or a file cannot be written.
    """
    settings = config.source_section
    if not isinstance(settings, StudioSource):
        raise ConfigError(f"{source}: reader {settings.reader!r}, expected 'studio'")
    recorded = [sequence for sequence in config.sequences if sequence.use == "train"]
    if not recorded:
        raise ConfigError(f"{source}/{actor}: no sequence with use=train; add one to the table")
    dressed = dress_actor(actor, load_body_model())
    cameras = side_cameras(settings)
    generator = np.random.default_rng(settings.seed)
    claimed = misplaced(cameras, error_px=settings.calibration_noise_px, generator=generator)
    placed = {(item.action, view): claimed[view] for item in recorded for view in claimed}
    write_cameras(placed, source=source, actor=actor, path=out / "cameras.parquet")
    tables = _Tables()
    for sequence in recorded:
        poses = sequence_poses(sequence, dressed, packages)
        given = disturbed(poses, error_mm=settings.pose_noise_mm, generator=generator)
        tables.bodies.extend(_body_rows(given, truth=poses, sequence=sequence, actor=dressed))
        _record(
            sequence, poses, actor=dressed, cameras=cameras, settings=settings,
            generator=generator, tables=tables, out=out,
        )  # fmt: skip
    write_table(tables.frames, schema=schemas.FRAME, path=out / "frames.parquet")
    if "masks" in settings.provides:
        write_table(tables.masks, schema=schemas.MASK, path=out / "masks.parquet")
    if "keypoints2d" in settings.provides:
        path = out / "keypoints2d.parquet"
        write_table(tables.keypoints2d, schema=schemas.KEYPOINTS2D, path=path)
    if "bodies" in settings.provides:
        write_table(tables.bodies, schema=schemas.BODY, path=out / "bodies.parquet")
    if any(sequence.truth for sequence in config.sequences):
        _write_truth(config, dressed, source=source, packages=packages, out=out / "truth")


def sequence_poses(sequence: Sequence, actor: Actor, packages: Path) -> BodyPose:
    """The true poses of a sequence's frames (frame first), float64."""
    motion = named_motion(sequence.motion, packages / CLIPS_PACKAGE)
    times_s = torch.tensor(list(sequence.frames), dtype=torch.float64) / FRAME_RATE_HZ
    return retarget(motion, actor.model, torch.from_numpy(actor.betas), frame_times_s=times_s)


def one_pose(poses: BodyPose, index: int) -> BodyPose:
    """One of several poses."""
    return BodyPose(
        poses.betas[index],
        poses.global_orient[index],
        poses.body_pose[index],
        poses.transl[index],
    )


def _record(
    sequence: Sequence,
    poses: BodyPose,
    *,
    actor: Actor,
    cameras: dict[str, Camera],
    settings: StudioSource,
    generator: np.random.Generator,
    tables: _Tables,
    out: Path,
) -> None:
    """Write the pictures of a sequence and add its rows to the tables."""
    light = studio_light(settings.light_to_ambient)
    plates = {view: empty_room(camera) for view, camera in cameras.items()}
    for view, plate in plates.items():
        _write_picture(plate, out / f"plates/{sequence.action}_{view}.png")
    what, total = f"capture: {sequence.action}", len(sequence.frames)
    for index, frame in enumerate(paced(sequence.frames, what=what, total=total, unit="frames")):
        posed = pose_actor(actor, one_pose(poses, index))
        scene = light_actor(actor, posed, light)
        for view, camera in cameras.items():
            seen = see(scene, camera, supersampling=settings.supersampling)
            place = f"{sequence.action}/{view}/{frame:06d}.png"
            keys = {
                "source": sequence.source,
                "actor": sequence.actor,
                "action": sequence.action,
                "frame": frame,
                "view": view,
            }
            _write_picture(over(seen, plates[view]), out / "images" / place)
            tables.frames.append(
                keys
                | {
                    "image_path": f"images/{place}",
                    "image_index": STILL,
                    "width": camera.lens.width,
                    "height": camera.lens.height,
                    "reason": "",
                }
            )
            if "masks" in settings.provides:
                matte = grown(seen.alpha, settings.mask_growth_px)
                write_matte(matte, path=out / "masks" / place)
                tables.masks.append(
                    keys
                    | {
                        "mask_path": f"masks/{place}",
                        "confidence": 1.0,
                        "method": "truth",
                        "reason": "",
                    }
                )
            pixels, _ = camera.project(torch.from_numpy(posed.joints_world))
            noise = generator.normal(size=pixels.shape) * settings.keypoint_noise_px
            tables.keypoints2d.append(
                keys
                | {
                    "skeleton": SKELETON,
                    "keypoints_px": (pixels.numpy() + noise).ravel().tolist(),
                    "confidence": [1.0] * len(pixels),
                }
            )


def _body_rows(given: BodyPose, *, truth: BodyPose, sequence: Sequence, actor: Actor) -> list[Row]:
    """Rows of schema BODY; the error is that of the noise added."""
    joints = pose_joints(actor.model, given)
    errors_mm = 1000 * (joints - pose_joints(actor.model, truth)).norm(dim=-1).mean(-1)
    return body_rows(
        given,
        joints,
        source=sequence.source,
        actor=sequence.actor,
        frames=[(sequence.action, frame) for frame in sequence.frames],
        errors_mm=errors_mm.tolist(),
        reasons=[""] * len(errors_mm),
    )


def _write_truth(
    config: CaptureConfig, actor: Actor, *, source: str, packages: Path, out: Path
) -> None:
    settings = config.source_section
    if not config.rigs:
        raise ConfigError(f"{source}/{actor.name}: truth is asked for, but render.rigs is empty")
    rigs = {name: configured_rig(place, config.image) for name, place in config.rigs.items()}
    wanted = []
    for sequence in config.sequences:
        if sequence.truth:
            poses = sequence_poses(sequence, actor, packages)
            wanted += [
                TruePose(sequence.action, frame, one_pose(poses, index))
                for index, frame in enumerate(sequence.frames)
            ]
    write_truth(
        wanted,
        actor,
        source=source,
        rigs=rigs,
        light=studio_light(settings.light_to_ambient),
        supersampling=settings.truth_supersampling,
        seed=settings.seed,
        out=out,
    )


def _write_picture(rgb: np.ndarray, path: Path) -> None:
    write_bytes(path, encode_png(eight_bit(rgb)))
