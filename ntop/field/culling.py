"""Which pixels of a view may see a posed avatar."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.field.kernels.tiles import TILE_PX, mark_tiles
from ntop.field.warp import PoseWarp
from ntop.geometry.cameras import Camera, Lens


def body_pixels(warp: PoseWarp, camera: Camera) -> Bool[np.ndarray, "height width"]:
    """Pixels that may see an occupied cell (conservative; whole tiles)."""
    width, height = camera.lens.width, camera.lens.height
    tables, cell_m = warp.tables, warp.cell_m
    cells = tables.cells
    full = np.flatnonzero((cells >= 0) & (tables.occupancy[np.maximum(cells, 0)] != 0))
    index = np.stack(np.unravel_index(full, tables.dims[0]), 1)
    centres = torch.from_numpy((index + 0.5) * cell_m + warp.origin_world)
    offsets = (centres - camera.center_world) @ camera.rotation.T
    distances = offsets.norm(dim=-1)
    radius = cell_m * math.sqrt(3) / 2
    marked = np.zeros((-(-height // TILE_PX), -(-width // TILE_PX)), np.uint8)
    if len(full) and float(distances.min()) < 2 * radius:
        marked[:] = 1  # the camera is inside the body: every pixel may see it
    else:
        pixels, radii_px, usable = _blots(offsets, torch.asin(radius / distances), camera.lens)
        mark_tiles(pixels.numpy(), radii_px.numpy(), usable.numpy(), marked)
    return np.repeat(np.repeat(marked, TILE_PX, 0), TILE_PX, 1)[:height, :width].astype(bool)


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
