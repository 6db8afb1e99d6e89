"""Stage train: frames, mattes, bodies -> one avatar per actor.

| written below `out` | what |
|---|---|
| `avatar.safetensors`, `avatar.json` | the field and its header (ntop.field.interface) |
| `curve.parquet` (schema CURVE) | loss and PSNR per step, watched frames now and then |
| `refinement.parquet` (schema REFINEMENT) | where cameras and people were moved, if refined |
| `provenance.json` | configuration, code and inputs |

`refinement.parquet` is there with `refine_cameras` or `refine_poses`. It has a row per camera
(`action`, `view`; `frame` -1) and one per frame (`view` empty): `rotation_rad`, a turn (axis-angle)
about the camera's centre or the person's pelvis, and `translation_m`, both in world axes; zero for
what is not refined and for frames that only say when to stop.

A stopped training continues at its last checkpoint in the work folder, with the same result.
"""

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import assert_never

import numpy as np
import torch

from ntop.body.model import BodyModel, load_body_model
from ntop.captures.training_views import Tables, training_views
from ntop.config.sections import TrainConfig
from ntop.field.devices import kernel_words
from ntop.field.humannerf.device import compute_device, device_words
from ntop.field.humannerf.settings import HumanNerfSettings
from ntop.field.humannerf.training import train_humannerf
from ntop.field.interface import AnyAvatar, save_avatar
from ntop.field.patches import Perceptual
from ntop.field.progress import Progress, TrainingStoppedError
from ntop.field.refining import SHIFT, TURN, Corrections
from ntop.field.schedule import TrainingSettings
from ntop.field.training import train
from ntop.field.views import TrainingViews
from ntop.metrics.lpips import load_lpips
from ntop.stages import VERSIONS
from ntop.storage import schemas
from ntop.storage.atomic import atomic_folder, write_bytes
from ntop.storage.files import check_files, record_files
from ntop.storage.provenance import code_sha256, file_sha256, provenance, write_provenance
from ntop.storage.tables import Row, write_table
from ntop.storage.work import EXIT_TERMINATED, clear_work, termination_flag, work_folder

STAGE = "train"
CHECKPOINT_NAME = "checkpoint.safetensors"
REPORT_EVERY_S = 5.0
COLOUR_EDGE_WEIGHT = 0.2  # colours along an outline are mixed with the scene behind it


def main(
    config: TrainConfig,
    capture: Path,
    cameras: Path,
    masks: Path,
    bodies: Path,
    work: Path,
    out: Path,
) -> None:
    """Train the avatar of one actor into folder `out`.

    `cameras`, `masks` and `bodies` are tables; each lies with the capture or with the stage that
    made it. Nothing of `config.held_out_views` is read.

    Raises:
        DataError: no usable frame, tables that do not fit together, or a damaged checkpoint.
        SystemExit: with code 143 after SIGTERM; the same command then continues.
    """
    torch.set_num_threads(1)  # the kernels have their own threads
    check_files(capture, cameras.parent, masks.parent, bodies.parent)
    tables = Tables(capture / "frames.parquet", cameras, masks, bodies)
    inputs = {name: file_sha256(path) for name, path in asdict(tables).items()}
    perceptual = None
    if config.perceptual_path:
        perceptual = load_lpips(config.perceptual_path, device=compute_device())
        inputs["lpips_weights"] = file_sha256(config.perceptual_path)
    values = config.model_dump(mode="json")
    model = load_body_model(config.body_path)
    recipe = {"config": values, "inputs": inputs, "code": code_sha256()}
    with work_folder(work, recipe=recipe) as content, termination_flag() as terminated:
        views = training_views(
            tables,
            model,
            held_out_views=config.held_out_views,
            max_person_px=config.max_person_px,
            margin_m=config.reach_m,
        )
        try:
            avatar, curve, corrections = train_field(
                config,
                views,
                model,
                perceptual=perceptual,
                checkpoint_path=content / CHECKPOINT_NAME,
                stop_requested=terminated,
            )
        except TrainingStoppedError as stopped:
            sys.stderr.write(f"train: {stopped}; the same command continues there\n")
            raise SystemExit(EXIT_TERMINATED) from stopped
        with atomic_folder(out) as folder:
            save_avatar(avatar, folder, write=write_bytes)
            rows = [{name: getattr(line, name) for name in schemas.CURVE.names} for line in curve]
            write_table(rows, schema=schemas.CURVE, path=folder / "curve.parquet")
            if corrections is not None:
                moves = _refinement_rows(corrections, views)
                write_table(moves, schema=schemas.REFINEMENT, path=folder / "refinement.parquet")
            record = provenance(stage=STAGE, version=VERSIONS[STAGE], config=values, inputs=inputs)
            write_provenance(record, folder=folder)
            record_files(folder)
        clear_work(work)


def train_field(
    config: TrainConfig,
    views: TrainingViews,
    model: BodyModel,
    *,
    perceptual: Perceptual | None,
    checkpoint_path: Path,
    stop_requested: Callable[[], bool],
) -> tuple[AnyAvatar, Sequence[Progress], Corrections | None]:
    """Train the configured kind of avatar; corrections only where it refines any.

    Raises:
        TrainingStoppedError: `stop_requested` became true; the state is saved.
    """
    betas = tuple(float(value) for value in views.poses.betas[0])
    piece = {
        "perceptual": perceptual,
        "checkpoint_path": checkpoint_path,
        "stop_requested": stop_requested,
    }
    match config.field:
        case "grid":
            sys.stderr.write(f"train: {kernel_words()}\n")
            settings = training_settings(config)
            found: list[Corrections] = []
            avatar, curve = train(
                views,
                model,
                betas,
                settings=settings,
                on_step=_Reporter(settings.steps),
                on_refined=found.append,
                **piece,
            )
            if found:
                sys.stderr.write(f"train: moved {_refinement_words(found[0])}\n")
            return avatar, curve, found[0] if found else None
        case "humannerf":
            sys.stderr.write(f"train: {device_words()}\n")
            avatar, curve = train_humannerf(
                views,
                model,
                betas,
                settings=humannerf_settings(config),
                on_step=_Reporter(config.humannerf.steps),
                **piece,
            )
            return avatar, curve, None
        case _:
            assert_never(config.field)


def humannerf_settings(config: TrainConfig) -> HumanNerfSettings:
    """The twin's settings for a configuration; what it does not say is the paper's."""
    section = config.humannerf
    return HumanNerfSettings(
        steps=section.steps,
        patches=section.patches,
        patch_px=section.patch_px,
        samples=section.samples,
        seed=config.seed,
    )


def training_settings(config: TrainConfig) -> TrainingSettings:
    """The field's settings for a configuration."""
    return TrainingSettings(
        steps=config.steps,
        rays_per_batch=config.rays_per_batch,
        seed=config.seed,
        voxels_m=(0.016, 0.008, config.finest_voxel_mm / 1000),
        sharpness=(1.0, math.sqrt(config.sharpness), config.sharpness),
        outer_m=config.reach_m,
        cell_m=config.warp_cell_mm / 1000,
        density_smoothness=config.density_smoothness,
        colour_smoothness=config.colour_smoothness,
        entropy_weight=config.entropy_weight,
        matte_weight=config.matte_weight,
        band_weights=(COLOUR_EDGE_WEIGHT, config.matte_edge_weight),
        body_weight=config.body_weight,
        camera_colour=config.camera_colour,
        refine_cameras=config.refine_cameras,
        refine_poses=config.refine_poses,
        lpips_weight=config.lpips_weight,
    )


def _refinement_rows(corrections: Corrections, views: TrainingViews) -> list[Row]:
    """Rows of schema REFINEMENT: cameras, then frames."""
    names = [(*name, -1) for name in views.camera_names]
    names += [(action, "", frame) for action, frame in views.pose_names]
    moves = np.concatenate([corrections.cameras, corrections.poses]).tolist()
    return [
        dict(zip(schemas.REFINEMENT.names, (*name, move[:3], move[3:]), strict=True))
        for name, move in zip(names, moves, strict=True)
    ]


def _refinement_words(corrections: Corrections) -> str:
    """Root mean squares and the largest, for the job's log."""
    words = []
    for name, moves in (("cameras", corrections.cameras), ("people", corrections.poses)):
        turns, shifts = (1000 * np.linalg.norm(moves[:, part], axis=1) for part in (TURN, SHIFT))
        words.append(
            f"{name} by {np.sqrt((shifts**2).mean()):.1f} mm (at most {shifts.max():.1f}) and "
            f"{np.sqrt((turns**2).mean()):.2f} mrad (at most {turns.max():.2f})"
        )
    return ", ".join(words)


class _Reporter:
    """Progress lines on stderr: step, loss, PSNR, rate and time left."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._first: tuple[int, float] | None = None
        self._last_s = 0.0

    def __call__(self, line: Progress) -> None:
        now_s = time.monotonic()
        if self._first is None:
            self._first = (line.step, now_s)  # the first step's time is compilation
            return
        if now_s - self._last_s < REPORT_EVERY_S and line.step < self._steps:
            return
        self._last_s = now_s
        rate = (line.step - self._first[0]) / max(now_s - self._first[1], 1e-9)
        left_s = (self._steps - line.step) / rate
        sys.stderr.write(
            f"train: step {line.step}/{self._steps}, loss {line.loss:.4f}, "
            f"{line.psnr_person_db:.1f} dB, {rate:.1f} steps/s, {left_s:.0f} s left\n"
        )
        sys.stderr.flush()
