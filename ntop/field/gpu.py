"""Rendering and learning on an NVIDIA GPU: what is sent, launched and fetched.

Import this module only where `ntop.field.devices.kernel_device` says that there is a GPU.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numba import cuda

from ntop.conventions import DataError
from ntop.field.checkpoints import TrainingState
from ntop.field.kernels.cuda import (
    THREADS,
    UNITS,
    adam_step,
    gather,
    march_rays,
    see_rays,
    train_rays,
)
from ntop.field.kernels.tables import WarpTables
from ntop.field.learners import NO_SLOPES, SeenRays, StepRule, StepSums
from ntop.field.marching import MarchRule, Rays, Scene, Seen
from ntop.field.views import RayBatch


class Uploads:
    """Arrays on the GPU by name; one is sent again only when the host's is another object."""

    def __init__(self) -> None:
        """Nothing is on the GPU yet."""
        self._held: dict[str, tuple[np.ndarray, Any]] = {}

    def array(self, name: str, host: np.ndarray) -> Any:
        """The array on the GPU. Its content must not change on the host."""
        held = self._held.get(name)
        if held is None or held[0] is not host:
            self._held.pop(name, None)  # free before the new one is there
            self._held[name] = held = (host, _sent(host))
        return held[1]

    def tables(self, host: Any) -> Any:
        """The same named tuple with its arrays on the GPU."""
        kind = type(host)
        return kind(
            *(
                self.array(f"{kind.__name__}.{name}", value)
                if isinstance(value, np.ndarray)
                else value
                for name, value in zip(kind._fields, host, strict=True)
            )
        )


def _sent(host: np.ndarray) -> Any:
    return cuda.to_device(np.ascontiguousarray(host))


def _launch(kernel: Any, count: int, *arguments: Any) -> None:
    if count:
        kernel[-(-count // THREADS), THREADS](*arguments)


_SCENE = Uploads()  # an avatar is sent once, a pose once for all its views


class ReadyMarch:
    """A march whose rays are on the GPU; one launch for all of them.

    Beside the scene it holds 32 bytes of input per ray (24 more with an origin per ray, 16
    with a span, 8 with a pose) and 21 bytes of output.
    """

    def __init__(self, scene: Scene, rays: Rays, rule: MarchRule) -> None:
        """Send what is not there yet."""
        count = len(rays.directions)
        self._outputs = (
            cuda.device_array((count, 3), np.float32), cuda.device_array(count, np.float32),
            cuda.device_array(count, np.float32), cuda.device_array(count, np.uint8),
        )  # fmt: skip
        self._evaluations = _zeros(2)
        self._arguments = (
            _SCENE.tables(scene.grid), _SCENE.tables(scene.warp),
            _SCENE.tables(scene.density), _SCENE.tables(scene.sheets),
            _SCENE.array("light", scene.light), _SCENE.array("labels", scene.labels.values),
            _SCENE.array("labels_origin", scene.labels.origin), 1 / scene.labels.spacing_m,
            *(_sent(array) for array in rays), *rule, *self._outputs, self._evaluations,
        )  # fmt: skip
        self._count = count

    def launch(self) -> None:
        """Start it; returns at once."""
        _launch(march_rays, self._count, *self._arguments)

    def fetch(self) -> Seen:
        """What was seen, after all launches."""
        voxels, samples = (int(sum_) for sum_ in self._evaluations.copy_to_host())
        return Seen(*(array.copy_to_host() for array in self._outputs), voxels, samples)


def march_on_gpu(scene: Scene, rays: Rays, rule: MarchRule) -> Seen:
    """As `ntop.field.marching.march_rays`."""
    march = ReadyMarch(scene, rays, rule)
    march.launch()
    return march.fetch()


class GpuLearner:
    """A learner whose values, moments and gradients stay on the GPU until they are settled."""

    def __init__(
        self, state: TrainingState, tables: WarpTables, anchors: Float[np.ndarray, " row"]
    ) -> None:
        """Send the state; `anchors`: raw density of the body itself at each row."""
        self._state, self._uploads = state, Uploads()
        self._warp = self._uploads.tables(tables)
        self._grid = self._uploads.tables(state.grid.tables())
        self._first, self._second = _sent(state.first), _sent(state.second)
        self._positions, self._anchors = _sent(state.grid.positions), _sent(anchors)
        self._gradients = cuda.device_array(state.grid.values.shape, np.float32)
        self._sums = _sent(np.zeros(state.grid.values.shape, np.int64))
        self._touched = _sent(np.zeros(len(state.grid.positions), np.uint8))

    def accumulate(
        self,
        batch: RayBatch,
        rule: StepRule,
        extra_slopes: Float[np.ndarray, "any 3"] = NO_SLOPES,
    ) -> StepSums:
        """See `Learner`.

        Raises:
            DataError: a gradient is no number, or too large for the sums.
        """
        state = self._state
        light, gain = _zeros((9, 3)), _zeros(state.gain.shape)
        losses, broken = _zeros(3), _sent(np.zeros(1, np.uint8))
        _launch(
            train_rays, len(batch.poses), self._grid, self._warp, _sent(state.light),
            _sent(state.gain), _sent(batch.poses), _sent(batch.cameras), _sent(batch.origins),
            _sent(batch.directions), _sent(batch.offsets), _sent(batch.targets),
            _sent(batch.mattes), _sent(batch.colour_weights),
            _sent(batch.matte_weights * rule.matte_weight), _sent(batch.backgrounds),
            _sent(extra_slopes), rule.step_m, rule.stop, rule.entropy_weight, self._sums,
            self._touched, light, gain, losses, broken,
        )  # fmt: skip
        if broken.copy_to_host()[0]:
            raise DataError(
                "training: gradients are not finite or above 1e6, expected the order of 1; the "
                "bodies or cameras hold broken values: check the fit, then train again"
            )
        return StepSums(_summed(losses), _summed(light), _summed(gain))

    def seen(self, batch: RayBatch, rule: StepRule) -> SeenRays:
        """See `Learner`."""
        seen = cuda.device_array((len(batch.poses), 4), np.float64)
        _launch(
            see_rays, len(batch.poses), self._grid, self._warp, _sent(self._state.light),
            _sent(batch.poses), _sent(batch.origins), _sent(batch.directions),
            _sent(batch.offsets), rule.step_m, rule.stop, seen,
        )  # fmt: skip
        return seen.copy_to_host()

    def touched(self) -> Int[np.ndarray, " brick"]:
        """See `Learner`."""
        return np.flatnonzero(self._touched.copy_to_host())

    def learn(self, active: Int[np.ndarray, " brick"], rule: StepRule) -> None:
        """See `Learner`."""
        state, values = self._state, self._grid.values
        state.counts[active] += 1
        bricks = _sent(active)
        _launch(
            gather, 64 * len(active), values, self._grid.bricks, self._positions, bricks,
            self._sums, self._touched, _sent(rule.smoothness), _sent(rule.edge), self._anchors,
            rule.body_weight, self._gradients,
        )  # fmt: skip
        _launch(
            adam_step, 64 * len(active), values, bricks, _sent(state.counts[active]),
            self._gradients, self._first, self._second, _sent(rule.rates), *rule.betas,
            _sent(rule.low), _sent(rule.high),
        )  # fmt: skip

    def see(self, tables: WarpTables) -> None:
        """See `Learner`."""
        self._warp = self._uploads.tables(tables)

    def settle(self) -> None:
        """See `Learner`."""
        state = self._state
        self._grid.values.copy_to_host(state.grid.values)
        self._first.copy_to_host(state.first)
        self._second.copy_to_host(state.second)


def _zeros(shape: tuple[int, ...] | int) -> Any:
    return _sent(np.zeros(shape, np.int64))


def _summed(sums: Any) -> np.ndarray:
    return sums.copy_to_host() / UNITS
