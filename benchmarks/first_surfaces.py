"""Where on the person a rendered point lies: its canonical place and its surface's normal."""

import math

import numba
import numpy as np
from jaxtyping import Float

from ntop.field.kernels import kernel
from ntop.field.kernels.tables import (
    VOID_RAW,
    canonical_point,
    grid_corners,
    interpolate,
    surface_normal,
)
from ntop.field.posing import PosedAvatar


def first_surfaces(
    posed: PosedAvatar, points_world: Float[np.ndarray, "point 3"]
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point 3"]]:
    """Canonical places (metres) and unit world normals; zeros where no warp cell is.

    Of two sheets the denser is taken, as rendering does.
    """
    points = np.ascontiguousarray(points_world - posed.warp.origin_world)
    places, normals = np.zeros_like(points), np.zeros_like(points)
    places_and_normals(posed.grid.tables(), posed.warp.tables, points, places, normals)
    return places, normals


@kernel
def places_and_normals(grid, warp, points, places, normals):
    """See `first_surfaces`; `points` (metres) come relative to the origin of the only pose."""
    nx, ny, nz = warp.dims[0, 0], warp.dims[0, 1], warp.dims[0, 2]
    for p in numba.prange(points.shape[0]):
        rows, weights = np.empty(8, np.int64), np.empty(8)
        x, y, z = (
            points[p, 0] * warp.inverse_cell,
            points[p, 1] * warp.inverse_cell,
            points[p, 2] * warp.inverse_cell,
        )
        i, j, k = math.floor(x), math.floor(y), math.floor(z)
        if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
            cell = warp.cells[(i * ny + j) * nz + k]
            densest = -math.inf
            for sheet in range(2 if cell >= 0 else 0):
                if warp.sheets[cell, sheet, 0] >= 0:
                    place = canonical_point(warp, cell, sheet, x - i, y - j, z - k)
                    raw = VOID_RAW
                    if grid_corners(grid, place[0], place[1], place[2], rows, weights):
                        raw = interpolate(grid, 0, rows, weights)
                    if raw > densest:
                        densest = raw
                        normal = surface_normal(warp, cell, sheet, x - i, y - j, z - k)
                        for axis in range(3):
                            places[p, axis], normals[p, axis] = place[axis], normal[axis]
