"""Rays of the views set aside: how well the grid shows what it does not train on."""

import math

import numpy as np

from ntop.field.canonical import PartLabels
from ntop.field.checkpoints import TrainingState
from ntop.field.kernels.tables import WarpTables
from ntop.field.marching import MarchRule, Rays, march_on_cpu
from ntop.field.packing import packed_scene
from ntop.field.progress import GridProgress, psnr_db
from ntop.field.schedule import TrainingSettings, march_step_m
from ntop.field.views import RayBatch, RaySource, TrainingViews

WATCHED_RAYS = 16384
STOP_TRANSMITTANCE = 1e-3


def ray_source(
    views: TrainingViews, mask: np.ndarray, origins: np.ndarray, *, settings: TrainingSettings
) -> RaySource:
    """Rays of the views that `mask` names; `origins` are those of the poses' warps."""
    return RaySource(
        views, np.flatnonzero(mask), origins, band_px=settings.band_px, shares=settings.shares,
        band_weights=settings.band_weights,
    )  # fmt: skip


def watched_rays(
    views: TrainingViews, origins: np.ndarray, *, settings: TrainingSettings
) -> RayBatch | None:
    """The same rays at every step; None where no view is set aside."""
    if not views.watched.any():
        return None
    generator = np.random.Generator(np.random.Philox(key=settings.seed, counter=1 << 60))
    source = ray_source(views, views.watched, origins, settings=settings)
    return source.draw(WATCHED_RAYS, num_views=int(views.watched.sum()), generator=generator)


def watched_psnr(
    state: TrainingState, tables: WarpTables, batch: RayBatch, *, settings: TrainingSettings
) -> float:
    """PSNR of rays of the views set aside, over black."""
    unlabelled = PartLabels(np.zeros((1, 1, 1), np.uint8), np.zeros(3), 1.0)
    light = state.light.astype(np.float32)
    scene = packed_scene(state.grid, tables, light, unlabelled, poses=batch.poses)
    offsets = np.full(len(batch.poses), 0.5)
    rays = Rays(batch.poses, batch.origins, batch.directions, offsets)
    rule = MarchRule(
        step_m=march_step_m(state.grid.voxel_m, settings),
        piece_depth=math.inf,
        stop=STOP_TRANSMITTANCE,
        colour_floor=0.0,
        skipping=True,
    )
    seen = march_on_cpu(scene, rays, rule)  # the state's arrays may change where they are
    gain = state.gain[batch.cameras]
    colours = seen.colours * np.exp(gain[:, 0]) + gain[:, 1] * seen.opacity[:, None]
    person = batch.mattes > 0.98
    return psnr_db(float(((colours - batch.targets)[person] ** 2).mean()))


def stalled(curve: list[GridProgress], settings: TrainingSettings) -> bool:
    """No watched gain over the last `patience` measurements, all of them at the finest level."""
    finest = round(settings.level_starts[-1] * settings.steps)
    scores = [
        p.watched_psnr_db for p in curve if p.step > finest and np.isfinite(p.watched_psnr_db)
    ]
    recent, earlier = scores[-settings.patience :], scores[: -settings.patience]
    return bool(earlier) and max(recent) < max(earlier)
