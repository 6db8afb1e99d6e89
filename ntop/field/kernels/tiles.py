"""Which pixels of an image can see the posed body: its occupied cells, projected and grown."""

import math

import numba

from ntop.field.kernels import kernel

TILE_PX = 8


@kernel
def mark_tiles(pixels, distances, usable, radius_m, px_per_rad, marked):
    """Mark the tiles that the projections of small spheres touch.

    Args:
        pixels: (cells, 2). distances: (cells,) from the camera (m). usable: (cells,) bool.
        radius_m: sphere radius. px_per_rad: upper bound of the lens's scale, pixels per radian.
        marked: (rows, columns) uint8 of tiles, output; only ever writes 1.
    """
    for n in numba.prange(pixels.shape[0]):
        if usable[n]:
            angle = math.asin(min(1.0, radius_m / max(distances[n], 1e-6)))
            radius = px_per_rad * angle + 1.0
            first_row = max(0, int(math.floor((pixels[n, 1] - radius) / TILE_PX)))
            last_row = min(marked.shape[0] - 1, int(math.floor((pixels[n, 1] + radius) / TILE_PX)))
            first = max(0, int(math.floor((pixels[n, 0] - radius) / TILE_PX)))
            last = min(marked.shape[1] - 1, int(math.floor((pixels[n, 0] + radius) / TILE_PX)))
            for row in range(first_row, last_row + 1):
                for column in range(first, last + 1):
                    marked[row, column] = 1
