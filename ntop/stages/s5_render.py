"""Render: an avatar in recorded or novel poses, seen by a rig -> RGBA, depth and parts per view.

A job is a shard: a run of sets (body poses) of one action and rig. Every finished set is published
in the work folder by one rename, so that a stopped job goes on at its first unfinished set.
"""

import json
import shutil
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from ntop.body.authored_motions import named_motion
from ntop.body.model import BodyModel, load_body_model
from ntop.body.motions import Motion, retarget
from ntop.body.skinning import BodyPose
from ntop.config.rigs import configured_rig
from ntop.config.sections import RenderConfig
from ntop.conventions import VIEWS, ConfigError, DataError
from ntop.field.avatar import ARRAYS_NAME
from ntop.field.interface import AnyAvatar, compute_words, load_avatar, pose_avatar, render_view
from ntop.field.quality import PRESETS
from ntop.field.rendering import Rendering
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.stages import VERSIONS
from ntop.storage import schemas
from ntop.storage.atomic import atomic_folder, write_bytes
from ntop.storage.bodies import body_pose_from_rows, read_bodies
from ntop.storage.files import check_files, find_damage, read_records, record_files
from ntop.storage.images import write_depth, write_parts, write_rgba
from ntop.storage.keys import SetKey
from ntop.storage.provenance import code_sha256, file_sha256, provenance, write_provenance
from ntop.storage.renders import body_columns, image_paths, render_row
from ntop.storage.shards import RENDERS_NAME, store_archive, store_files
from ntop.storage.tables import Row, write_table
from ntop.storage.work import EXIT_TERMINATED, clear_work, termination_flag, work_folder

STAGE = "render"
CLIPS = "pybullet"  # the package that novel motions come from
FRAME_RATE_HZ = 30.0  # of novel motions; recorded ones have the capture's frames
SKIPPED_NAME = "skipped.json"


def main(
    config: RenderConfig,
    source: str,
    actor: str,
    action: str,
    rig: str,
    frames: list[int],
    motion: str,
    avatar: Path,
    bodies: Path,
    packages: Path,
    work: Path,
    out: Path,
) -> None:
    """Render one shard: the sets `frames` of (source, actor, action, rig) into folder `out`.

    `motion` is empty for the recorded poses of `action`, else the name of a motion that is
    retargeted to the actor's shape. `out` gets renders.parquet (schema RENDER), images/, depth/ and
    parts/ (or pictures.tar with `storage: tar`), provenance.json and skipped.json, the frames
    without a usable body and why.

    Raises:
        ConfigError: unknown rig or motion.
        DataError: avatar or bodies cannot be used, or another process renders this shard.
        SystemExit: with code 143 after SIGTERM; the same command then continues.
    """
    torch.set_num_threads(1)  # posing is small; the kernels have their own threads
    check_files(avatar, packages / CLIPS)
    check_files(bodies.parent, only={bodies.name})
    keys = [SetKey(source, actor, action, rig, frame) for frame in sorted(frames)]
    rows = [row for row in read_bodies(bodies) if (row["source"], row["actor"]) == (source, actor)]
    if not rows:
        raise DataError(f"{bodies}: no body of {source}/{actor}; run the fit stage for this actor")
    avatar_sha256 = file_sha256(avatar / ARRAYS_NAME)
    recipe = {
        "config": config.model_dump(mode="json"),
        "sets": [f"{key.folder()}/{key.frame}" for key in keys],
        "motion": motion,
        "avatar": avatar_sha256,
        "bodies": file_sha256(bodies),
        "code": code_sha256(),
    }
    skipped = [] if motion else unusable_frames(keys, rows)
    usable = [key for key in keys if key.frame not in {item["frame"] for item in skipped}]
    with work_folder(work, recipe=recipe) as content, termination_flag() as terminated:
        missing = [key for key in usable if not is_finished(set_folder(content, key))]
        if missing:
            model = load_body_model(config.body_path)
            poses = (
                novel_poses(missing, rows, model, motion=named_motion(motion, packages / CLIPS))
                if motion
                else recorded_poses(missing, rows)
            )
            studio = Studio(
                avatar=load_avatar(avatar),
                model=model,
                rig=rig_of(config, rig),
                avatar_sha256=avatar_sha256,
                config=config,
            )
            sys.stderr.write(f"render: {compute_words(studio.avatar)}\n")
            render_sets(missing, poses, studio, content=content, terminated=terminated)
        inputs = {"avatar": avatar_sha256, "bodies": recipe["bodies"]}
        record = provenance(
            stage=STAGE, version=VERSIONS[STAGE], config=recipe["config"], inputs=inputs
        )
        done = [set_folder(content, key) for key in usable]
        publish(done, skipped, record, storage=config.storage, out=out)
        clear_work(work)


@dataclass(frozen=True)
class Studio:
    """What all sets of a shard share."""

    avatar: AnyAvatar
    model: BodyModel
    rig: Rig
    avatar_sha256: str
    config: RenderConfig


def rig_of(config: RenderConfig, name: str) -> Rig:
    """The named rig with the configured lens.

    Raises:
        ConfigError: there is no such rig.
    """
    if name not in config.rigs:
        raise ConfigError(f"render.rigs has no {name!r}, have {sorted(config.rigs)}")
    return configured_rig(config.rigs[name], config.image)


def unusable_frames(keys: list[SetKey], rows: list[Row]) -> list[Row]:
    """Sets whose recorded frame has no usable body, with the reason the fit gave.

    Raises:
        DataError: a frame has no row at all: the sequences table asks for what was not captured.
    """
    reasons = {(row["action"], row["frame"]): row["reason"] for row in rows}
    absent = [key.frame for key in keys if (key.action, key.frame) not in reasons]
    if absent:
        have = sorted(frame for action, frame in reasons if action == keys[0].action)
        span = f"frames {have[0]} to {have[-1]}" if have else "no frame"
        raise DataError(
            f"{keys[0].folder()}: no body for frames {absent[:10]}, the table has {span} of this "
            "action; declare these frames with use=train or shorten the render line"
        )
    return [
        {**asdict(key), "reason": reasons[key.action, key.frame]}
        for key in keys
        if reasons[key.action, key.frame]
    ]


def recorded_poses(keys: list[SetKey], rows: list[Row]) -> BodyPose:
    """The fitted poses of these sets (set first)."""
    by_frame = {(row["action"], row["frame"]): row for row in rows}
    return body_pose_from_rows([by_frame[key.action, key.frame] for key in keys])


def novel_poses(
    keys: list[SetKey], rows: list[Row], model: BodyModel, *, motion: Motion
) -> BodyPose:
    """The motion on this actor's shape, at the sets' frames (set first)."""
    times_s = torch.tensor([key.frame for key in keys], dtype=torch.float64) / FRAME_RATE_HZ
    betas = torch.tensor(rows[0]["betas"], dtype=torch.float64)
    return retarget(motion, model, betas, frame_times_s=times_s)


def render_sets(
    keys: list[SetKey],
    poses: BodyPose,
    studio: Studio,
    *,
    content: Path,
    terminated: Callable[[], bool],
) -> None:
    """Render sets into the work folder, one rename each; encoding overlaps with rendering.

    Raises:
        SystemExit: with code 143 at the border after the set in which SIGTERM came.
    """
    started = time.monotonic()
    with ThreadPoolExecutor(max_workers=1) as encoder:
        for index, key in enumerate(keys):
            if terminated():
                sys.stderr.write(f"stopped after {index} of {len(keys)} sets; run again to go on\n")
                raise SystemExit(EXIT_TERMINATED)
            with atomic_folder(set_folder(content, key)) as folder:
                pose = BodyPose(
                    poses.betas[index],
                    poses.global_orient[index],
                    poses.body_pose[index],
                    poses.transl[index],
                )
                rows = render_set(key, pose, studio, folder=folder, encoder=encoder)
                write_table(rows, schema=schemas.RENDER, path=folder / RENDERS_NAME)
                record_files(folder)
            views = (index + 1) * len(VIEWS)
            rate = views / (time.monotonic() - started)
            left_s = (len(keys) - index - 1) * len(VIEWS) / rate
            sys.stderr.write(
                f"{key.folder()} set {index + 1}/{len(keys)}, {rate:.1f} views/s, "
                f"{left_s / 60:.1f} min left\n"
            )


def render_set(
    key: SetKey, pose: BodyPose, studio: Studio, *, folder: Path, encoder: ThreadPoolExecutor
) -> list[Row]:
    """Render the nine views of one pose into `folder`; returns their rows."""
    body = body_columns(studio.model, pose)
    pelvis = torch.tensor(body["joints3d_world_m"][:3], dtype=torch.float64)
    cameras = top_view_cameras(studio.rig, pelvis, paper_compat=studio.config.paper_compat)
    settings = PRESETS[studio.config.quality]
    posed = pose_avatar(studio.avatar, studio.model, pose, settings=settings)
    hashes: dict[str, Future[str]] = {}
    for view, camera in cameras.items():
        rendering = render_view(posed, camera, settings=settings)
        paths = {column: folder / path for column, path in image_paths(key, view).items()}
        hashes[view] = encoder.submit(write_view, rendering, paths)
    return [
        render_row(
            key,
            view,
            camera=camera,
            rig=studio.rig,
            body=body,
            image_sha256=hashes[view].result(),
            avatar_sha256=studio.avatar_sha256,
            seed=studio.config.seed,
        )
        for view, camera in cameras.items()
    ]


def write_view(rendering: Rendering, paths: dict[str, Path]) -> str:
    """Write a view's three files; returns the image's SHA-256."""
    write_depth(rendering.depth_m, path=paths["depth_path"])
    write_parts(rendering.parts, path=paths["parts_path"])
    return write_rgba(rendering.rgb, rendering.alpha, path=paths["image_path"])


def publish(
    done: list[Path],
    skipped: list[Row],
    record: dict[str, Any],
    *,
    storage: Literal["files", "tar"],
    out: Path,
) -> None:
    """Make the shard's folder from the folders of its finished sets, by one rename."""
    store = {"files": store_files, "tar": store_archive}[storage]
    with atomic_folder(out) as folder:
        rows, files = store(done, folder=folder)
        write_table(rows, schema=schemas.RENDER, path=folder / RENDERS_NAME)
        text = json.dumps(skipped, indent=1, sort_keys=True) + "\n"
        write_bytes(folder / SKIPPED_NAME, text.encode())
        write_provenance(record, folder=folder)
        record_files(folder, known=files)


def is_finished(folder: Path) -> bool:
    """Whether a set's folder is there and whole; a damaged one is removed, to be made again."""
    if not folder.exists():
        return False
    records = read_records(folder)
    damages = [find_damage(folder, row) for row in records.values()]
    found = [damage for damage in damages if damage is not None]
    if records and not found:
        return True
    for damage in found:
        sys.stderr.write(f"{damage.path} {damage.what}: the set is rendered again\n")
    shutil.rmtree(folder)
    return False


def set_folder(content: Path, key: SetKey) -> Path:
    """Where a finished set lies in the work folder."""
    return content / f"{key.frame:06d}"
