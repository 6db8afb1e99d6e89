"""Which pixels of a view may see a posed avatar, and how far along their rays."""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ntop.field.kernels.tables import HUGE
from ntop.field.kernels.tiles import TILE_PX, mark_tiles
from ntop.field.warp import PoseWarp
from ntop.geometry.cameras import Camera, Lens


@dataclass(frozen=True)
class Sight:
    """What of an image may see a posed body, and how far along its rays (conservative).

    `spans_m` are the nearest and the farthest length of tiles of TILE_PX, inf and -inf where
    nothing is seen.
    """

    spans_m: Float[np.ndarray, "row column 2"]
    width: int
    height: int

    @functools.cached_property
    def mask(self) -> Bool[np.ndarray, "height width"]:
        """Pixels that may see the body; whole tiles."""
        marked = self.spans_m[..., 1] >= self.spans_m[..., 0]
        return np.repeat(np.repeat(marked, TILE_PX, 0), TILE_PX, 1)[: self.height, : self.width]

    def of_pixels(
        self, v: Int[np.ndarray, " ray"], u: Int[np.ndarray, " ray"]
    ) -> Float[np.ndarray, "ray 2"]:
        """The lengths (m) between which the rays of pixels (row v, column u) may meet the body."""
        return self.spans_m[v // TILE_PX, u // TILE_PX]


def body_sight(warp: PoseWarp, camera: Camera) -> Sight:
    """Where an image may see an occupied cell, by the cells that are not wholly inside others."""
    width, height = camera.lens.width, camera.lens.height
    offsets = (torch.from_numpy(warp.outer_centres_world) - camera.center_world) @ camera.rotation.T
    distances = offsets.norm(dim=-1)
    radius = warp.cell_m * math.sqrt(3) / 2
    spans = np.empty((-(-height // TILE_PX), -(-width // TILE_PX), 2))
    if len(offsets) and float(distances.min()) < 2 * radius:
        spans[:] = 0.0, HUGE  # the camera is inside the body: every pixel may see it
    else:
        spans[:] = math.inf, -math.inf
        pixels, radii_px, usable = _blots(offsets, torch.asin(radius / distances), camera.lens)
        mark_tiles(
            pixels.numpy(), radii_px.numpy(), usable.numpy(), (distances - radius).numpy(),
            (distances + radius).numpy(), spans,
        )  # fmt: skip
    return Sight(spans, width, height)


def body_pixels(warp: PoseWarp, camera: Camera) -> Bool[np.ndarray, "height width"]:
    """Pixels that may see an occupied cell (conservative; whole tiles)."""
    return body_sight(warp, camera).mask


def _blots(
    offsets: Float[Tensor, "cell 3"], angles: Float[Tensor, " cell"], lens: Lens
) -> tuple[Float[Tensor, "cell 2"], Float[Tensor, " cell"], Bool[Tensor, " cell"]]:
    """Discs in the image that hold those of small spheres, for any lens: centres, radii, which.

    `angles` are the spheres' angular radii. A sphere whose centre the lens does not image stands
    for itself on the rim, at most its own angle away, so that its disc is twice as large. Seen
    from the camera's frame, beyond 90 degrees as well.
    """
    across = torch.hypot(offsets[:, 0], offsets[:, 1])
    theta = torch.atan2(across, offsets[:, 2])
    rim = lens.max_theta * (1 - 1e-9)  # inside whatever the rounding
    outside = theta > rim
    azimuth = torch.atan2(offsets[:, 1], offsets[:, 0])
    sine, cosine = math.sin(rim), torch.full_like(theta, math.cos(rim))
    on_rim = torch.stack([sine * azimuth.cos(), sine * azimuth.sin(), cosine], -1)
    pixels, _ = lens.project(torch.where(outside[:, None], on_rim, offsets))
    radii_px = lens.max_px_per_rad * angles * (1 + outside.double())
    return pixels, radii_px, theta - angles <= lens.max_theta


def pixel_window(mask: Bool[np.ndarray, "height width"]) -> tuple[int, int, int, int]:
    """Left, top, width and height of what is marked; all 0 if nothing is."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return 0, 0, 0, 0
    left, top = int(columns[0]), int(rows[0])
    return left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top
