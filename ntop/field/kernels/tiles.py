"""Which pixels of an image can see the posed body: its occupied cells, projected and grown."""

import math

import numba

from ntop.field.kernels import kernel

TILE_PX = 8


@kernel
def mark_tiles(pixels, radii_px, usable, marked):
    """Mark the tiles that the projections of small spheres touch.

    Args:
        pixels: (cells, 2). radii_px: (cells,) bound of each projection. usable: (cells,) bool.
        marked: (rows, columns) uint8 of tiles, output; only ever writes 1.
    """
    for n in numba.prange(pixels.shape[0]):
        if usable[n]:
            radius = radii_px[n] + 1.0
            first_row = max(0, int(math.floor((pixels[n, 1] - radius) / TILE_PX)))
            last_row = min(marked.shape[0] - 1, int(math.floor((pixels[n, 1] + radius) / TILE_PX)))
            first = max(0, int(math.floor((pixels[n, 0] - radius) / TILE_PX)))
            last = min(marked.shape[1] - 1, int(math.floor((pixels[n, 0] + radius) / TILE_PX)))
            for row in range(first_row, last_row + 1):
                for column in range(first, last + 1):
                    marked[row, column] = 1
