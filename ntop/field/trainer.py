"""One step of a grid's training: rays, gradients, update; and its state.

A step depends on the seed and its number only, so a training that continues from a checkpoint
gives the same bytes as one that was never interrupted.
"""

from dataclasses import replace

import numpy as np

from ntop.field.canonical import (
    CanonicalBody,
    CanonicalGrid,
    Occupancy,
    body_density,
    initial_grid,
    occupied_cells,
    refined_grid,
)
from ntop.field.checkpoints import TrainingState, Twists
from ntop.field.devices import kernel_device
from ntop.field.kernels.tables import WarpTables
from ntop.field.learners import CpuLearner, Learner, StepRule, StepSums
from ntop.field.perceptual import PerceptualLoss
from ntop.field.progress import GridProgress, psnr_db
from ntop.field.refining import Refiner
from ntop.field.schedule import TrainingSettings, decayed, level_at, march_step_m
from ntop.field.views import RayBatch, RaySource
from ntop.field.warp import occupied, octant_radius_m
from ntop.field.watching import STOP_TRANSMITTANCE, watched_psnr

BETAS = (0.9, 0.99)
VALUE_BOUNDS = ((-12.0, -8.0, -8.0, -8.0), (30.0, 8.0, 8.0, 8.0))
PRIOR_RAYS = 8192  # rays per step for which the priors' weights are stated; losses are sums
PRIOR_EDGE = (0.5, 0.1, 0.1, 0.1)  # width of the smoothness prior's rounded tip per channel
BODY_VOXEL_M = 0.008  # of the body's own density, which others are anchored to


def initial_state(
    body: CanonicalBody, num_cameras: int, settings: TrainingSettings, *, num_twists: int = 0
) -> TrainingState:
    """Step 0: the body's own shape in grey, under even light; nothing has moved."""
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
        num_twists=num_twists,
    )


class GridTrainer:
    """The buffers of one level and the loop over them; `state` is all that a checkpoint needs."""

    def __init__(
        self,
        state: TrainingState,
        tables: WarpTables,
        *,
        settings: TrainingSettings,
        body: CanonicalBody,
        refiner: Refiner | None = None,
        perceptual: PerceptualLoss | None = None,
    ) -> None:
        """Go on from a state; `tables` are the poses' warps, whatever may be occupied."""
        self.state = state
        self._refiner, self._perceptual = refiner, perceptual
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
        batch = self._placed(
            source.draw(
                settings.rays_per_batch, num_views=settings.views_per_batch, generator=generator
            )
        )
        rule = self._rule()
        sums = self._learner.accumulate(batch, rule)
        if self._perceptual is not None:
            sums = self._with_patch(sums, self._perceptual, rule)
        active = self._learner.touched()
        if (state.step + 1) % settings.smooth_all_every == 0:
            active = np.arange(1, len(state.grid.positions))
        self._learner.learn(active, rule)
        self._learn_colours(sums)
        twists = self._learned_twists(source, rule)
        step = state.step + 1
        person = max(float((batch.mattes > 0.5).sum()), 1.0)
        due = watched is not None and (step % settings.watch_every == 0 or step == settings.steps)
        progress = GridProgress(
            step=step,
            loss=float(sums.losses[0] + sums.losses[2]) / len(batch.mattes),
            psnr_person_db=psnr_db(float(sums.losses[1]) / person / 3),
            watched_psnr_db=self._watched_psnr(watched) if due else float("nan"),
            active_bricks=len(active),
        )
        self.state = replace(state, step=step, curve=[*state.curve, progress], twists=twists)
        self._reshape()

    def _placed(self, batch: RayBatch) -> RayBatch:
        """The rays from where their cameras stand by now."""
        if self._refiner is None:
            return batch
        return self._refiner.moved(batch, self.state.twists)

    def _learned_twists(self, source: RaySource, rule: StepRule) -> Twists:
        state = self.state
        if self._refiner is None:
            return state.twists
        return self._refiner.learn(
            state.twists, source, self._learner, gain=state.gain, rule=rule, step=state.step
        )

    def _with_patch(self, sums: StepSums, loss: PerceptualLoss, rule: StepRule) -> StepSums:
        """Add the gradients of the step's patch; the losses that are told stay those of rays."""
        patch = loss.draw(self.state.step)
        patch = replace(patch, rays=self._placed(patch.rays))
        slopes = loss.slopes(patch, self._learner.seen(patch.rays, rule), gain=self.state.gain)
        weight = self._settings.lpips_weight * self._settings.rays_per_batch
        rule = replace(rule, entropy_weight=0.0)
        more = self._learner.accumulate(patch.rays, rule, weight * slopes)
        return StepSums(sums.losses, sums.light + more.light, sums.gain + more.gain)

    def _rule(self) -> StepRule:
        settings, state = self._settings, self.state
        share = state.step / settings.steps
        colour = decayed(settings.colour_rate, share)
        prior = settings.rays_per_batch / PRIOR_RAYS
        smooth = np.array([settings.density_smoothness, *[settings.colour_smoothness] * 3])
        return StepRule(
            step_m=march_step_m(state.grid.voxel_m, settings),
            stop=STOP_TRANSMITTANCE,
            matte_weight=settings.matte_weight,
            entropy_weight=settings.entropy_weight,
            smoothness=prior * smooth,
            edge=np.array(PRIOR_EDGE),
            body_weight=prior * settings.body_weight,
            rates=np.array([decayed(settings.density_rate, share), colour, colour, colour]),
            betas=BETAS,
            low=np.array(VALUE_BOUNDS[0]),
            high=np.array(VALUE_BOUNDS[1]),
        )

    def _learn_colours(self, sums: StepSums) -> None:
        """Light and cameras' colours, the few values that every ray sees."""
        settings, state = self._settings, self.state
        rate = decayed(settings.light_rate, state.step / settings.steps)
        if settings.light:
            _small_adam(state.light, sums.light, state.light_moments, state.step, rate)
        if settings.camera_colour:
            gradient = sums.gain + 0.01 * settings.rays_per_batch * state.gain
            _small_adam(state.gain, gradient, state.gain_moments, state.step, 0.3 * rate)

    def _watched_psnr(self, batch: RayBatch) -> float:
        self.settle()
        batch = self._placed(batch)
        return watched_psnr(self.state, self._tables, batch, settings=self._settings)

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


def _occupancy(grid: CanonicalGrid, settings: TrainingSettings) -> Occupancy:
    """Where the grid may hold density, with a margin for the warp's octants."""
    margin_m = octant_radius_m(settings.cell_m)
    return occupied_cells(grid, raw_threshold=settings.occupied_raw, margin_m=margin_m)


def _small_adam(
    values: np.ndarray, gradient: np.ndarray, moments: np.ndarray, step: int, rate: float
) -> None:
    """Adam for the few values that every ray sees; changes `values` and `moments` in place."""
    moments[0] = BETAS[0] * moments[0] + (1 - BETAS[0]) * gradient
    moments[1] = BETAS[1] * moments[1] + (1 - BETAS[1]) * gradient**2
    mean = moments[0] / (1 - BETAS[0] ** (step + 1))
    scale = np.sqrt(moments[1] / (1 - BETAS[1] ** (step + 1)))
    values -= rate * mean / (scale + 1e-12)
