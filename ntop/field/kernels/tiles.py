"""Which pixels of an image can see the posed body: its occupied cells, projected and grown."""

import math

import numba

from ntop.field.kernels import device, kernel

TILE_PX = 4


@kernel
def outer_cells(cells, occupancy, dims, outer):
    """Which cells are occupied while one of their six neighbours is not.

    Args:
        cells: (any,) cell numbers, -1 where there is none. occupancy: see `WarpTables`.
        dims: (3,) cells. outer: (any,) bool output.
    """
    nx, ny, nz = dims[0], dims[1], dims[2]
    for i in numba.prange(nx):
        for j in range(ny):
            for k in range(nz):
                n = (i * ny + j) * nz + k
                outer[n] = False
                if cells[n] < 0 or occupancy[cells[n]] == 0:
                    continue
                if i == 0 or j == 0 or k == 0 or i + 1 == nx or j + 1 == ny or k + 1 == nz:
                    outer[n] = True
                    continue
                for other in (n - ny * nz, n + ny * nz, n - nz, n + nz, n - 1, n + 1):
                    if cells[other] < 0 or occupancy[cells[other]] == 0:
                        outer[n] = True


@device  # tiles are shared, so cells go one by one
def mark_tiles(pixels, radii_px, usable, near_m, far_m, spans):
    """Between which lengths rays through a tile meet small spheres that project onto it.

    Args:
        pixels: (cells, 2). radii_px: (cells,) bound of each projection. usable: (cells,) bool.
        near_m, far_m: (cells,) nearest and farthest point of each.
        spans: (rows, columns, 2) of tiles; output, lowered and raised (an empty one is inf, -inf).
    """
    for n in range(pixels.shape[0]):
        if usable[n]:
            radius = radii_px[n] + 1.0
            first_row = max(0, int(math.floor((pixels[n, 1] - radius) / TILE_PX)))
            last_row = min(spans.shape[0] - 1, int(math.floor((pixels[n, 1] + radius) / TILE_PX)))
            first = max(0, int(math.floor((pixels[n, 0] - radius) / TILE_PX)))
            last = min(spans.shape[1] - 1, int(math.floor((pixels[n, 0] + radius) / TILE_PX)))
            for row in range(first_row, last_row + 1):
                for column in range(first, last + 1):
                    spans[row, column, 0] = min(spans[row, column, 0], near_m[n])
                    spans[row, column, 1] = max(spans[row, column, 1], far_m[n])
