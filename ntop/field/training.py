"""Train a grid to its last step, in as many pieces as it takes: see `trainer` for one step."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.field.avatar import Avatar
from ntop.field.canonical import CanonicalBody, canonical_body
from ntop.field.checkpoints import load_checkpoint, save_checkpoint
from ntop.field.kernels.tables import WarpTables
from ntop.field.progress import GridProgress, TrainingStoppedError
from ntop.field.schedule import TrainingSettings
from ntop.field.trainer import GridTrainer, initial_state
from ntop.field.views import TrainingViews
from ntop.field.warp import joined, pose_warp
from ntop.field.watching import ray_source, stalled, watched_rays


def train(
    views: TrainingViews,
    model: BodyModel,
    betas: tuple[float, ...],
    *,
    settings: TrainingSettings,
    checkpoint_path: Path | None = None,
    on_step: Callable[[GridProgress], None] | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> tuple[Avatar, list[GridProgress]]:
    """Train to the end, or until the watched views stop improving.

    Continues from `checkpoint_path` if it exists.

    Raises:
        TrainingStoppedError: `stop_requested` became true; the state is saved.
        DataError: the checkpoint is damaged, or cannot be written.
    """
    body = canonical_body(model, betas)
    tables, origins = _warps(views.poses, body, model, settings)
    source = ray_source(views, ~views.watched, origins, settings=settings)
    watched = watched_rays(views, origins, settings=settings)
    state = checkpoint_path and load_checkpoint(checkpoint_path, settings, GridProgress)
    state = state or initial_state(body, len(views.cameras), settings)
    trainer = GridTrainer(state, tables, settings=settings, body=body)
    while trainer.state.step < settings.steps and not stalled(trainer.state.curve, settings):
        trainer.step(source, watched)
        state = trainer.state
        if on_step is not None:
            on_step(state.curve[-1])
        saving = state.step % settings.checkpoint_every == 0 or stop_requested()
        if checkpoint_path is not None and saving:
            trainer.settle()
            save_checkpoint(state, checkpoint_path, settings)
        if stop_requested():
            raise TrainingStoppedError(f"stopped after step {state.step} of {settings.steps}")
    trainer.settle()
    state = trainer.state
    avatar = Avatar(state.grid, state.light.astype(np.float32), betas, settings.outer_m, state.step)
    return avatar, state.curve


def _warps(
    poses: BodyPose, body: CanonicalBody, model: BodyModel, settings: TrainingSettings
) -> tuple[WarpTables, np.ndarray]:
    """The warps of all poses in one, and the world origin (metres) of each."""
    tables, origins = [], []
    for p in range(len(poses.transl)):
        warp = pose_warp(body, model, poses.at(p), cell_m=settings.cell_m, reach_m=settings.outer_m)
        tables.append(warp.tables)
        origins.append(warp.origin_world)
    return joined(tables), np.stack(origins)
