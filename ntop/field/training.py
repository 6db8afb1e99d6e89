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
    PartLabels,
    body_density,
    canonical_body,
    initial_grid,
    occupied_cells,
    refined_grid,
)
from ntop.field.checkpoints import TrainingState, load_checkpoint, save_checkpoint
from ntop.field.devices import kernel_device
from ntop.field.kernels.tables import WarpTables
from ntop.field.learners import CpuLearner, Learner, StepRule, StepSums
from ntop.field.marching import MarchRule, Rays, march_on_cpu
from ntop.field.packing import packed_scene
from ntop.field.views import RayBatch, RaySource, TrainingViews
from ntop.field.warp import joined, occupied, octant_radius_m, pose_warp

WATCHED_RAYS = 16384
BETAS = (0.9, 0.99)
VALUE_BOUNDS = ((-12.0, -8.0, -8.0, -8.0), (30.0, 8.0, 8.0, 8.0))
PRIOR_RAYS = 8192  # rays per step for which the priors' weights are stated; losses are sums
PRIOR_EDGE = (0.5, 0.1, 0.1, 0.1)  # width of the smoothness prior's rounded tip per channel
STOP_TRANSMITTANCE = 1e-3
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
            trainer.settle()
            save_checkpoint(state, checkpoint_path, settings)
        if stop_requested():
            raise TrainingStoppedError(f"stopped after step {state.step} of {settings.steps}")
    trainer.settle()
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
        self._learner = self._new_learner()

    def _new_learner(self) -> Learner:
        settings, state = self._settings, self.state
        anchors = body_density(
            self._body_grid, state.grid, sharpness=settings.sharpness[state.level]
        )
        if kernel_device().gpu:
            from ntop.field.gpu import GpuLearner  # numba.cuda only where it is used

            return GpuLearner(state, self._tables, anchors)
        return CpuLearner(state, self._tables, anchors, blocks=settings.ray_blocks)

    def settle(self) -> None:
        """Make the state's arrays hold what was learned."""
        self._learner.settle()

    def step(self, source: RaySource, watched: RayBatch | None) -> None:
        """One step: rays, gradients, update, and what is due at this step's number."""
        settings, state = self._settings, self.state
        generator = np.random.Generator(np.random.Philox(key=settings.seed, counter=state.step))
        batch = source.draw(
            settings.rays_per_batch, num_views=settings.views_per_batch, generator=generator
        )
        rule = self._rule()
        sums = self._learner.accumulate(batch, rule)
        active = self._learner.touched()
        if (state.step + 1) % settings.smooth_all_every == 0:
            active = np.arange(1, len(state.grid.positions))
        self._learner.learn(active, rule)
        self._learn_colours(sums)
        step = state.step + 1
        person = max(float((batch.mattes > 0.5).sum()), 1.0)
        due = watched is not None and (step % settings.watch_every == 0 or step == settings.steps)
        progress = Progress(
            step=step,
            loss=float(sums.losses[0] + sums.losses[2]) / len(batch.mattes),
            psnr_person_db=psnr_db(float(sums.losses[1]) / person / 3),
            watched_psnr_db=self._watched_psnr(watched) if due else float("nan"),
            active_bricks=len(active),
        )
        self.state = replace(state, step=step, curve=[*state.curve, progress])
        self._reshape()

    def _rule(self) -> StepRule:
        settings, state = self._settings, self.state
        share = state.step / settings.steps
        colour = _decayed(settings.colour_rate, share)
        prior = settings.rays_per_batch / PRIOR_RAYS
        smooth = np.array([settings.density_smoothness, *[settings.colour_smoothness] * 3])
        return StepRule(
            step_m=_march_step(state, settings),
            stop=STOP_TRANSMITTANCE,
            matte_weight=settings.matte_weight,
            entropy_weight=settings.entropy_weight,
            smoothness=prior * smooth,
            edge=np.array(PRIOR_EDGE),
            body_weight=prior * settings.body_weight,
            rates=np.array([_decayed(settings.density_rate, share), colour, colour, colour]),
            betas=BETAS,
            low=np.array(VALUE_BOUNDS[0]),
            high=np.array(VALUE_BOUNDS[1]),
        )

    def _learn_colours(self, sums: StepSums) -> None:
        """Light and cameras' colours, the few values that every ray sees."""
        settings, state = self._settings, self.state
        rate = _decayed(settings.light_rate, state.step / settings.steps)
        if settings.light:
            _small_adam(state.light, sums.light, state.light_moments, state.step, rate)
        if settings.camera_colour:
            gradient = sums.gain + 0.01 * settings.rays_per_batch * state.gain
            _small_adam(state.gain, gradient, state.gain_moments, state.step, 0.3 * rate)

    def _watched_psnr(self, batch: RayBatch) -> float:
        self.settle()
        return watched_psnr(self.state, self._tables, batch, self._settings)

    def _reshape(self) -> None:
        """Refine the grid where a level begins, and look again at what may hold density."""
        settings, state = self._settings, self.state
        level = level_at(state.step, settings)
        finer = level > state.level
        if finer or state.step % settings.occupancy_every == 0:
            self.settle()
            occupancy = _occupancy(state.grid, settings)
            if finer:
                grid = refined_grid(state.grid, occupancy, voxel_m=settings.voxels_m[level])
                steeper = settings.sharpness[level] / settings.sharpness[state.level]
                low, high = VALUE_BOUNDS[0][0], VALUE_BOUNDS[1][0]
                grid.values[:, 0] = np.clip(steeper * grid.values[:, 0], low, high)
                self.state = state.with_grid(grid, level=level)
            self.state = replace(self.state, occupancy=occupancy)
            self._tables = occupied(self._tables, occupancy)
            if finer:
                self._learner = self._new_learner()
            else:
                self._learner.see(self._tables)


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
    unlabelled = PartLabels(np.zeros((1, 1, 1), np.uint8), np.zeros(3), 1.0)
    light = state.light.astype(np.float32)
    scene = packed_scene(state.grid, tables, light, unlabelled, poses=batch.poses)
    offsets = np.full(len(batch.poses), 0.5)
    rays = Rays(batch.poses, batch.origins, batch.directions, offsets)
    rule = MarchRule(_march_step(state, settings), STOP_TRANSMITTANCE, 0.0, skipping=True)
    seen = march_on_cpu(scene, rays, rule)  # the state's arrays may change where they are
    gain = state.gain[batch.cameras]
    colours = seen.colours * np.exp(gain[:, 0]) + gain[:, 1] * seen.opacity[:, None]
    person = batch.mattes > 0.98
    return psnr_db(float(((colours - batch.targets)[person] ** 2).mean()))


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
