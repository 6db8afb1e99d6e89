"""Train an avatar: coarse to fine, on random rays, with Adam on the bricks that rays touch.

A step depends on the seed and its number only, so a training that continues from a checkpoint
gives the same bytes as one that was never interrupted.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.field.avatar import Avatar
from ntop.field.canonical import (
    CanonicalBody,
    body_density,
    canonical_body,
    initial_grid,
    occupied_cells,
    refined_grid,
)
from ntop.field.checkpoints import TrainingState, load_checkpoint, save_checkpoint
from ntop.field.kernels.adjoint import train_rays
from ntop.field.kernels.learn import adam_step, gather
from ntop.field.kernels.march import RAYS_PER_CHUNK, render_rays
from ntop.field.kernels.tables import WarpTables
from ntop.field.views import RayBatch, RaySource, TrainingViews
from ntop.field.warp import joined, occupied, octant_radius_m, pose_warp

WATCHED_RAYS = 16384
BETAS = (0.9, 0.99)
VALUE_BOUNDS = ((-12.0, -8.0, -8.0, -8.0), (30.0, 8.0, 8.0, 8.0))
PRIOR_RAYS = 8192  # rays per step for which the priors' weights are stated; losses are sums
TINY_MSE = 1e-10
BODY_VOXEL_M = 0.008  # of the body's own density, which others are anchored to


@dataclass(frozen=True)
class TrainingSettings:
    """How an avatar is trained. Lengths in metres; weights are per ray, a prior's per node.

    `voxels_m`, `level_starts` (share of all steps) and `sharpness` are the coarse-to-fine
    schedule: in a level, raw density is `sharpness` times as steep as the body's was at first, and
    the surface that much harder. A rate falls exponentially from the first to the second value.
    `light`: learn light that depends on the surface's direction in the world. `camera_colour`:
    learn a gain and bias per camera.
    """

    steps: int = 800
    rays_per_batch: int = 8192
    views_per_batch: int = 32
    seed: int = 0
    voxels_m: tuple[float, ...] = (0.016, 0.008, 0.005)
    level_starts: tuple[float, ...] = (0.0, 0.12, 0.4)
    sharpness: tuple[float, ...] = (1.0, 4.0, 16.0)
    outer_m: float = 0.05
    inner_m: float = 0.03
    cell_m: float = 0.012
    min_step_m: float = 0.003
    density_rate: tuple[float, float] = (0.3, 0.03)
    colour_rate: tuple[float, float] = (0.15, 0.015)
    light_rate: tuple[float, float] = (0.01, 0.001)
    light: bool = True
    camera_colour: bool = False
    matte_weight: float = 1.0
    band_weights: tuple[float, float] = (0.2, 0.5)
    band_px: int = 2
    shares: tuple[float, float] = (0.6, 0.25)
    entropy_weight: float = 0.02
    density_smoothness: float = 3e-5
    colour_smoothness: float = 2e-4
    smooth_all_every: int = 25
    body_weight: float = 0.0
    occupancy_every: int = 100
    occupied_raw: float = -4.0
    watch_every: int = 250
    patience: int = 3
    ray_blocks: int = 4
    checkpoint_every: int = 50


@dataclass(frozen=True)
class Progress:
    """One line of the curve. Watched PSNR is NaN where it was not measured."""

    step: int
    loss: float
    psnr_person_db: float
    watched_psnr_db: float
    active_bricks: int


def train(
    views: TrainingViews,
    model: BodyModel,
    betas: tuple[float, ...],
    *,
    settings: TrainingSettings,
    checkpoint_path: Path | None = None,
    on_step: Callable[[Progress], None] | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> tuple[Avatar, list[Progress]]:
    """Train to the end, or until the watched views stop improving.

    Continues from `checkpoint_path` if it exists. When `stop_requested` becomes true the state is
    saved and `TrainingStoppedError` is raised.
    """
    body = canonical_body(model, betas)
    tables, origins = _warps(views.poses, body, model, settings)
    source = _ray_source(views, ~views.watched, origins, settings)
    watched = _watched_rays(views, origins, settings)
    state = checkpoint_path and load_checkpoint(checkpoint_path, settings, Progress)
    state = state or initial_state(body, len(views.cameras), settings)
    trainer = _Trainer(state, tables, settings, body)
    while trainer.state.step < settings.steps and not _stalled(trainer.state.curve, settings):
        trainer.step(source, watched)
        state = trainer.state
        if on_step is not None:
            on_step(state.curve[-1])
        saving = state.step % settings.checkpoint_every == 0 or stop_requested()
        if checkpoint_path is not None and saving:
            save_checkpoint(state, checkpoint_path, settings)
        if stop_requested():
            raise TrainingStoppedError(f"stopped after step {state.step} of {settings.steps}")
    state = trainer.state
    avatar = Avatar(state.grid, state.light.astype(np.float32), betas, settings.outer_m, state.step)
    return avatar, state.curve


class TrainingStoppedError(Exception):
    """Training was asked to stop and has saved its state."""


def _warps(
    poses: BodyPose, body: CanonicalBody, model: BodyModel, settings: TrainingSettings
) -> tuple[WarpTables, np.ndarray]:
    """The warps of all poses in one, and the world origin (metres) of each."""
    tables, origins = [], []
    for p in range(len(poses.transl)):
        warp = pose_warp(
            body, model, single_pose(poses, p), cell_m=settings.cell_m, reach_m=settings.outer_m
        )
        tables.append(warp.tables)
        origins.append(warp.origin_world)
    return joined(tables), np.stack(origins)


def single_pose(poses: BodyPose, index: int) -> BodyPose:
    """One pose of a batch."""
    return BodyPose(
        betas=poses.betas[index],
        global_orient=poses.global_orient[index],
        body_pose=poses.body_pose[index],
        transl=poses.transl[index],
    )


def initial_state(
    body: CanonicalBody, num_cameras: int, settings: TrainingSettings
) -> TrainingState:
    """Step 0: the body's own shape in grey, under even light."""
    grid = initial_grid(
        body, voxel_m=settings.voxels_m[0], outer_m=settings.outer_m, inner_m=settings.inner_m
    )
    light = np.zeros((9, 3))
    light[0] = 1
    return TrainingState.fresh(
        grid=grid,
        occupancy=_occupancy(grid, settings),
        light=light,
        gain=np.zeros((num_cameras, 2, 3)),
    )


class _Trainer:
    """The buffers of one level and the loop over them; `state` is all that a checkpoint needs."""

    def __init__(
        self,
        state: TrainingState,
        tables: WarpTables,
        settings: TrainingSettings,
        body: CanonicalBody,
    ) -> None:
        self.state = state
        self._body_grid = initial_grid(
            body, voxel_m=BODY_VOXEL_M, outer_m=settings.outer_m, inner_m=settings.inner_m
        )
        self._settings = settings
        self._tables = occupied(tables, state.occupancy)
        self._allocate()

    def _allocate(self) -> None:
        rows, slots = len(self.state.grid.values), len(self.state.grid.positions)
        blocks = self._settings.ray_blocks
        self._gradients = np.zeros((blocks, rows, 4), np.float32)
        sharpness = self._settings.sharpness[self.state.level]
        self._anchors = body_density(self._body_grid, self.state.grid, sharpness=sharpness)
        self._touched = np.zeros((blocks, slots), np.uint8)

    def step(self, source: RaySource, watched: RayBatch | None) -> None:
        """One step: rays, gradients, update, and what is due at this step's number."""
        settings, state = self._settings, self.state
        generator = np.random.Generator(np.random.Philox(key=settings.seed, counter=state.step))
        batch = source.draw(
            settings.rays_per_batch, num_views=settings.views_per_batch, generator=generator
        )
        losses = self._accumulate(batch)
        active = np.flatnonzero(self._touched.any(0))
        active = active[active > 0]
        if (state.step + 1) % settings.smooth_all_every == 0:
            active = np.arange(1, len(state.grid.positions))
        self._learn(active)
        step = state.step + 1
        person = max(float((batch.mattes > 0.5).sum()), 1.0)
        due = watched is not None and (step % settings.watch_every == 0 or step == settings.steps)
        progress = Progress(
            step=step,
            loss=float(losses[0] + losses[2]) / len(batch.mattes),
            psnr_person_db=psnr_db(float(losses[1]) / person / 3),
            watched_psnr_db=self._watched_psnr(watched) if due else float("nan"),
            active_bricks=len(active),
        )
        self.state = replace(state, step=step, curve=[*state.curve, progress])
        self._reshape()

    def _accumulate(self, batch: RayBatch) -> np.ndarray:
        settings, state = self._settings, self.state
        blocks = settings.ray_blocks
        self._light_gradients = np.zeros((blocks, 9, 3))
        self._gain_gradients = np.zeros((blocks, *state.gain.shape))
        losses = np.zeros((blocks, 3))
        train_rays(
            state.grid.tables(), self._tables, state.light, state.gain, batch.poses,
            batch.cameras, batch.origins, batch.directions, batch.offsets, batch.targets,
            batch.mattes, batch.colour_weights, batch.matte_weights * settings.matte_weight,
            batch.backgrounds, _march_step(state, settings), 1e-3, settings.entropy_weight,
            self._gradients, self._touched, self._light_gradients, self._gain_gradients, losses,
        )  # fmt: skip
        return losses.sum(0)

    def _learn(self, active: np.ndarray) -> None:
        settings, state = self._settings, self.state
        share = state.step / settings.steps
        colour = _decayed(settings.colour_rate, share)
        rates = np.array([_decayed(settings.density_rate, share), colour, colour, colour])
        prior = settings.rays_per_batch / PRIOR_RAYS
        smooth = np.array([settings.density_smoothness, *[settings.colour_smoothness] * 3])
        gather(
            state.grid.values, state.grid.bricks, state.grid.positions, active, self._gradients,
            self._touched, prior * smooth, np.array([0.5, 0.1, 0.1, 0.1]), self._anchors,
            prior * settings.body_weight,
        )  # fmt: skip
        low, high = (np.array(bound) for bound in VALUE_BOUNDS)
        adam_step(
            state.grid.values, active, self._gradients, state.first, state.second, state.counts,
            rates, *BETAS, low, high,
        )  # fmt: skip
        self._gradients[0, :64] = 0  # the void does not learn
        self._gradients[1:, :64] = 0
        self._touched[:, 0] = 0
        rate = _decayed(settings.light_rate, share)
        if settings.light:
            _small_adam(
                state.light, self._light_gradients.sum(0), state.light_moments, state.step, rate
            )
        if settings.camera_colour:
            gradient = self._gain_gradients.sum(0) + 0.01 * settings.rays_per_batch * state.gain
            _small_adam(state.gain, gradient, state.gain_moments, state.step, 0.3 * rate)

    def _watched_psnr(self, batch: RayBatch) -> float:
        return watched_psnr(self.state, self._tables, batch, self._settings)

    def _reshape(self) -> None:
        """Refine the grid where a level begins, and look again at what may hold density."""
        settings, state = self._settings, self.state
        level = level_at(state.step, settings)
        finer = level > state.level
        if finer or state.step % settings.occupancy_every == 0:
            occupancy = _occupancy(state.grid, settings)
            if finer:
                grid = refined_grid(state.grid, occupancy, voxel_m=settings.voxels_m[level])
                steeper = settings.sharpness[level] / settings.sharpness[state.level]
                low, high = VALUE_BOUNDS[0][0], VALUE_BOUNDS[1][0]
                grid.values[:, 0] = np.clip(steeper * grid.values[:, 0], low, high)
                self.state = state.with_grid(grid, level=level)
                self._allocate()
            self.state = replace(self.state, occupancy=occupancy)
            self._tables = occupied(self._tables, occupancy)


def level_at(step: int, settings: TrainingSettings) -> int:
    """Which of the grid levels a step belongs to."""
    starts = [round(share * settings.steps) for share in settings.level_starts]
    return max(level for level, start in enumerate(starts) if step >= start)


def psnr_db(mean_squared_error: float) -> float:
    """PSNR of values in 0..1."""
    return float(-10 * np.log10(max(mean_squared_error, TINY_MSE)))


def watched_psnr(
    state: TrainingState, tables: WarpTables, batch: RayBatch, settings: TrainingSettings
) -> float:
    """PSNR of rays of the views set aside, over black."""
    count = len(batch.poses)
    colours, opacity = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    render_rays(
        state.grid.tables(), tables, state.light.astype(np.float32), np.zeros((1, 1, 1), np.uint8),
        np.zeros(3), 1.0, batch.poses, batch.origins, batch.directions, np.full(count, 0.5),
        _march_step(state, settings), 1e-3, 0.0, True, colours, opacity,
        np.empty(count, np.float32), np.empty(count, np.uint8),
        np.zeros(-(-count // RAYS_PER_CHUNK), np.int64),
    )  # fmt: skip
    gain = state.gain[batch.cameras]
    seen = colours * np.exp(gain[:, 0]) + gain[:, 1] * opacity[:, None]
    person = batch.mattes > 0.98
    return psnr_db(float(((seen - batch.targets)[person] ** 2).mean()))


def _ray_source(
    views: TrainingViews, mask: np.ndarray, origins: np.ndarray, settings: TrainingSettings
) -> RaySource:
    return RaySource(
        views, np.flatnonzero(mask), origins, band_px=settings.band_px, shares=settings.shares,
        band_weights=settings.band_weights,
    )  # fmt: skip


def _watched_rays(
    views: TrainingViews, origins: np.ndarray, settings: TrainingSettings
) -> RayBatch | None:
    if not views.watched.any():
        return None
    generator = np.random.Generator(np.random.Philox(key=settings.seed, counter=1 << 60))
    source = _ray_source(views, views.watched, origins, settings)
    return source.draw(WATCHED_RAYS, num_views=int(views.watched.sum()), generator=generator)


def _stalled(curve: list[Progress], settings: TrainingSettings) -> bool:
    """No watched gain over the last `patience` measurements, all of them at the finest level."""
    finest = round(settings.level_starts[-1] * settings.steps)
    scores = [
        p.watched_psnr_db for p in curve if p.step > finest and np.isfinite(p.watched_psnr_db)
    ]
    recent, earlier = scores[-settings.patience :], scores[: -settings.patience]
    return bool(earlier) and max(recent) < max(earlier)


def _occupancy(grid, settings: TrainingSettings):
    margin_m = octant_radius_m(settings.cell_m)
    return occupied_cells(grid, raw_threshold=settings.occupied_raw, margin_m=margin_m)


def _march_step(state: TrainingState, settings: TrainingSettings) -> float:
    return max(settings.min_step_m, 0.5 * state.grid.voxel_m)


def _decayed(rate: tuple[float, float], share: float) -> float:
    return rate[0] * (rate[1] / rate[0]) ** share


def _small_adam(
    values: np.ndarray, gradient: np.ndarray, moments: np.ndarray, step: int, rate: float
) -> None:
    """Adam for the few values that every ray sees; changes `values` and `moments` in place."""
    moments[0] = BETAS[0] * moments[0] + (1 - BETAS[0]) * gradient
    moments[1] = BETAS[1] * moments[1] + (1 - BETAS[1]) * gradient**2
    mean = moments[0] / (1 - BETAS[0] ** (step + 1))
    scale = np.sqrt(moments[1] / (1 - BETAS[1] ** (step + 1)))
    values -= rate * mean / (scale + 1e-12)
