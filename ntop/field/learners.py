"""The buffers of one training level and the kernels over them, on CPU cores.

`ntop.field.gpu.GpuLearner` is the same on a GPU.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Int

from ntop.field.checkpoints import TrainingState
from ntop.field.kernels.adjoint import see_rays, train_rays
from ntop.field.kernels.learn import adam_step, gather
from ntop.field.kernels.tables import WarpTables
from ntop.field.views import RayBatch

NO_SLOPES = np.zeros((0, 3))
SeenRays = Float[np.ndarray, "ray 4"]  # premultiplied colour and opacity


@dataclass(frozen=True)
class StepRule:
    """What one step's gradients and update depend on beside the rays.

    `step_m` and `stop` are of the march; `smoothness`, `edge` (value units) and the weights are of
    the priors; `rates`, `betas` and the bounds `low`, `high` of the optimiser. Per channel: raw
    density, red, green, blue.
    """

    step_m: float
    stop: float
    matte_weight: float
    entropy_weight: float
    smoothness: Float[np.ndarray, " 4"]
    edge: Float[np.ndarray, " 4"]
    body_weight: float
    rates: Float[np.ndarray, " 4"]
    betas: tuple[float, float]
    low: Float[np.ndarray, " 4"]
    high: Float[np.ndarray, " 4"]


@dataclass(frozen=True)
class StepSums:
    """Sums over a batch: losses (colour, squared error of person rays, matte), small gradients."""

    losses: Float[np.ndarray, " 3"]
    light: Float[np.ndarray, "9 3"]
    gain: Float[np.ndarray, "camera 2 3"]


def shown_colours(
    seen: SeenRays, rays: RayBatch, gain: Float[np.ndarray, "camera 2 3"]
) -> Float[np.ndarray, "ray 3"]:
    """What the photograph's camera makes of what rays see, over their backgrounds."""
    opacity = seen[:, 3:]
    scale, bias = np.exp(gain[rays.cameras, 0]), gain[rays.cameras, 1]
    return seen[:, :3] * scale + opacity * bias + (1 - opacity) * rays.backgrounds


class Learner(Protocol):
    """Holds one level's gradients; `settle` makes the state's arrays hold what was learned."""

    def accumulate(
        self,
        batch: RayBatch,
        rule: StepRule,
        extra_slopes: Float[np.ndarray, "any 3"] = NO_SLOPES,
    ) -> StepSums:
        """Add the gradients of a batch.

        `extra_slopes`, one row per ray or none, are another loss' in the colours that the camera
        sees over the background; they join the slopes of the batch's own loss.
        """

    def seen(self, batch: RayBatch, rule: StepRule) -> SeenRays:
        """What the loss of a batch sees, before the cameras' gain."""

    def touched(self) -> Int[np.ndarray, " brick"]:
        """Bricks, but for the void, that have gradients."""

    def learn(self, active: Int[np.ndarray, " brick"], rule: StepRule) -> None:
        """Update the active bricks' values and clear all gradients."""

    def see(self, tables: WarpTables) -> None:
        """March through these warps from now on."""

    def settle(self) -> None:
        """Bring the state's arrays up to date."""


class CpuLearner:
    """A learner whose arrays are the state's own; sums are kept per block of rays."""

    def __init__(
        self,
        state: TrainingState,
        tables: WarpTables,
        anchors: Float[np.ndarray, " row"],
        *,
        blocks: int,
    ) -> None:
        """Empty gradients. `anchors`: raw density of the body itself at each row."""
        self._state, self._tables, self._anchors = state, tables, anchors
        self._gradients = np.zeros((blocks, *state.grid.values.shape), np.float32)
        self._touched = np.zeros((blocks, len(state.grid.positions)), np.uint8)

    def accumulate(
        self,
        batch: RayBatch,
        rule: StepRule,
        extra_slopes: Float[np.ndarray, "any 3"] = NO_SLOPES,
    ) -> StepSums:
        """See `Learner`."""
        state, blocks = self._state, len(self._gradients)
        light, gain = np.zeros((blocks, 9, 3)), np.zeros((blocks, *state.gain.shape))
        losses = np.zeros((blocks, 3))
        train_rays(
            state.grid.tables(), self._tables, state.light, state.gain, batch.poses,
            batch.cameras, batch.origins, batch.directions, batch.offsets, batch.targets,
            batch.mattes, batch.colour_weights, batch.matte_weights * rule.matte_weight,
            batch.backgrounds, extra_slopes, rule.step_m, rule.stop, rule.entropy_weight,
            self._gradients, self._touched, light, gain, losses,
        )  # fmt: skip
        return StepSums(losses.sum(0), light.sum(0), gain.sum(0))

    def seen(self, batch: RayBatch, rule: StepRule) -> SeenRays:
        """See `Learner`."""
        seen = np.empty((len(batch.poses), 4))
        see_rays(
            self._state.grid.tables(), self._tables, self._state.light, batch.poses, batch.origins,
            batch.directions, batch.offsets, rule.step_m, rule.stop, seen,
        )  # fmt: skip
        return seen

    def touched(self) -> Int[np.ndarray, " brick"]:
        """See `Learner`."""
        active = np.flatnonzero(self._touched.any(0))
        return active[active > 0]

    def learn(self, active: Int[np.ndarray, " brick"], rule: StepRule) -> None:
        """See `Learner`."""
        state = self._state
        gather(
            state.grid.values, state.grid.bricks, state.grid.positions, active, self._gradients,
            self._touched, rule.smoothness, rule.edge, self._anchors, rule.body_weight,
        )  # fmt: skip
        adam_step(
            state.grid.values, active, self._gradients, state.first, state.second, state.counts,
            rule.rates, *rule.betas, rule.low, rule.high,
        )  # fmt: skip
        self._gradients[:, :64] = 0  # the void does not learn
        self._touched[:, 0] = 0

    def see(self, tables: WarpTables) -> None:
        """See `Learner`."""
        self._tables = tables

    def settle(self) -> None:
        """Nothing to do."""
