"""Train a grid to its last step, in as many pieces as it takes: see `trainer` for one step."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.conventions import ConfigError
from ntop.field.avatar import Avatar
from ntop.field.canonical import CanonicalBody, canonical_body
from ntop.field.checkpoints import load_checkpoint, save_checkpoint
from ntop.field.kernels.tables import WarpTables
from ntop.field.patches import Perceptual
from ntop.field.perceptual import PerceptualLoss
from ntop.field.progress import GridProgress, TrainingStoppedError
from ntop.field.refining import Corrections, Refiner
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
    perceptual: Perceptual | None = None,
    on_step: Callable[[GridProgress], None] | None = None,
    on_refined: Callable[[Corrections], None] | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> tuple[Avatar, list[GridProgress]]:
    """Train to the end, or until the watched views stop improving.

    Continues from `checkpoint_path` if it exists. `perceptual` compares patches where the settings
    weigh it; `on_refined` is told where cameras and people ended, if the settings refine any.

    Raises:
        TrainingStoppedError: `stop_requested` became true; the state is saved.
        DataError: the checkpoint is damaged, or cannot be written; a patch is larger than any crop.
        ConfigError: `settings` weigh a perceptual distance and none is given.
    """
    body = canonical_body(model, betas)
    tables, origins = _warps(views.poses, body, model, settings)
    source = ray_source(views, ~views.watched, origins, settings=settings)
    watched = watched_rays(views, origins, settings=settings)
    refiner = loss = None
    if settings.refine_cameras or settings.refine_poses:
        refiner = Refiner(views, model, origins, settings=settings)
    if settings.lpips_weight > 0 and perceptual is None:
        raise ConfigError(
            f"training: lpips_weight is {settings.lpips_weight:g} and there is no network; give "
            "`perceptual` or set it to 0"
        )
    if settings.lpips_weight > 0:
        loss = PerceptualLoss(views, origins, perceptual=perceptual, seed=settings.seed)
    state = checkpoint_path and load_checkpoint(checkpoint_path, settings, GridProgress)
    num_twists = refiner.num_twists if refiner else 0
    state = state or initial_state(body, len(views.cameras), settings, num_twists=num_twists)
    trainer = GridTrainer(
        state, tables, settings=settings, body=body, refiner=refiner, perceptual=loss
    )
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
    if refiner is not None and on_refined is not None:
        on_refined(refiner.corrections(state.twists))
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
