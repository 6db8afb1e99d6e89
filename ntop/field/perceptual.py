"""A perceptual distance in the grid's training: one square patch of a photograph per step.

The patch is walked like all rays, shown over one random colour as the photograph's person is, and
compared by a network in torch. What torch says of the colours enters `train_rays` as extra slopes.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ntop.field.humannerf.device import compute_device
from ntop.field.learners import SeenRays, shown_colours
from ntop.field.patches import Patches, PatchSource, Perceptual
from ntop.field.views import RayBatch, TrainingViews, spread

SIDE_PX = 64
INSIDE_SHARE = 0.8  # of the patches' middles, on the person
RANDOM_COUNTER = 1 << 62  # of this module's random numbers, far from those of the steps


@dataclass(frozen=True)
class Patch:
    """A square's rays, row by row, without weights of their own, and the picture to compare."""

    rays: RayBatch
    target: Float[torch.Tensor, "1 row column 3"]


class PerceptualLoss:
    """Draws patches of the views that are trained on, and says how their colours should change."""

    def __init__(
        self,
        views: TrainingViews,
        origins: Float[np.ndarray, "pose 3"],
        *,
        perceptual: Perceptual,
        seed: int,
    ) -> None:
        """`origins`: of the poses' warps, which rays' origins are relative to (world, m).

        Raises:
            DataError: no view is large enough for a patch.
        """
        chosen = np.flatnonzero(~views.watched)
        self._source = PatchSource(views, chosen, side_px=SIDE_PX, inside_share=INSIDE_SHARE)
        self._views, self._origins, self._seed = views, origins, seed
        self._perceptual = perceptual

    def draw(self, step: int) -> Patch:
        """The patch of a step."""
        key = {"key": self._seed, "counter": RANDOM_COUNTER + step}
        generator = np.random.Generator(np.random.Philox(**key))
        patches = self._source.draw(1, generator=generator)
        return Patch(self._rays(patches, generator), patches.targets)

    def _rays(self, patches: Patches, generator: np.random.Generator) -> RayBatch:
        views, count = self._views, SIDE_PX * SIDE_PX
        pose, camera = views.pose_of_view[patches.view], views.camera_of_view[patches.view]
        centre = views.cameras[camera].center_world.double().numpy()
        nothing = np.zeros(count, np.float32)
        return RayBatch(
            poses=np.full(count, pose, np.int64),
            cameras=np.full(count, camera, np.int64),
            origins=np.tile(centre - self._origins[pose], (count, 1)),
            directions=patches.directions[0].double().reshape(-1, 3).numpy(),
            offsets=spread(count, generator),
            backgrounds=np.tile(patches.background.numpy(), (count, 1)),
            targets=patches.targets[0].reshape(-1, 3).numpy(),
            mattes=patches.mattes[0].reshape(-1).numpy(),
            colour_weights=nothing,
            matte_weights=nothing,
        )

    def slopes(
        self, patch: Patch, seen: SeenRays, *, gain: Float[np.ndarray, "camera 2 3"]
    ) -> Float[np.ndarray, "ray 3"]:
        """Slopes of the distance in the colours that the patch shows over its background."""
        device, rays = compute_device(), patch.rays
        shown = shown_colours(seen, rays, gain).reshape(patch.target.shape)
        shown = torch.from_numpy(shown.astype(np.float32)).to(device).requires_grad_()
        # one way to add on a GPU as well
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True):
            distance = self._perceptual(shown, patch.target.to(device)).sum()
            (slopes,) = torch.autograd.grad(distance, shown)
        return slopes.cpu().double().numpy().reshape(-1, 3)
