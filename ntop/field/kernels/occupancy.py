"""Which octants of a warp grid's cells may hold density."""

import math

import numba
import numpy as np

from ntop.field.kernels import device, kernel


@device
def any_marked(sums, origin, inverse_spacing, low, high):
    """Is a cell of a grid (origin in metres) marked that the box low..high touches?

    `sums[i, j, k]` counts the marked cells below (i, j, k): eight numbers answer for any box.
    """
    i0 = max(int(math.floor((low[0] - origin[0]) * inverse_spacing)), 0)
    j0 = max(int(math.floor((low[1] - origin[1]) * inverse_spacing)), 0)
    k0 = max(int(math.floor((low[2] - origin[2]) * inverse_spacing)), 0)
    i1 = min(int(math.floor((high[0] - origin[0]) * inverse_spacing)) + 1, sums.shape[0] - 1)
    j1 = min(int(math.floor((high[1] - origin[1]) * inverse_spacing)) + 1, sums.shape[1] - 1)
    k1 = min(int(math.floor((high[2] - origin[2]) * inverse_spacing)) + 1, sums.shape[2] - 1)
    if i0 >= i1 or j0 >= j1 or k0 >= k1:
        return False
    upper = sums[i1, j1, k1] - sums[i1, j0, k1] - sums[i1, j1, k0] + sums[i1, j0, k0]
    lower = sums[i0, j1, k1] - sums[i0, j0, k1] - sums[i0, j1, k0] + sums[i0, j0, k0]
    return upper > lower


@device
def cell_lattice(warp, cell, sheet, points):
    """Canonical images of a cell's corners and of the means between them: `points` (3, 3, 3, 3).

    They are the corners of its octants, as the map is trilinear.
    """
    for corner in range(8):
        node = warp.nodes[warp.sheets[cell, sheet, corner]]
        for axis in range(3):
            points[2 * (corner >> 2), 2 * ((corner >> 1) & 1), 2 * (corner & 1), axis] = node[axis]
    for axis in range(3):
        for j in range(0, 3, 2):
            for k in range(0, 3, 2):
                points[1, j, k, axis] = 0.5 * (points[0, j, k, axis] + points[2, j, k, axis])
        for i in range(3):
            for k in range(0, 3, 2):
                points[i, 1, k, axis] = 0.5 * (points[i, 0, k, axis] + points[i, 2, k, axis])
            for j in range(3):
                points[i, j, 1, axis] = 0.5 * (points[i, j, 0, axis] + points[i, j, 2, axis])


@device
def bounds(points, i, j, k, step, extent, low, high):
    """Bounds of the points (i or i + step, ...), drawn towards their mean by 1 - `extent`.

    A trilinear map sends a box into the hull of its corners' images: nothing lies outside.
    """
    for axis in range(3):
        least, most, total = np.inf, -np.inf, 0.0
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    value = points[i + a * step, j + b * step, k + c * step, axis]
                    least, most = min(least, value), max(most, value)
                    total += value
        mean = total / 8
        low[axis], high[axis] = mean + extent * (least - mean), mean + extent * (most - mean)


@kernel
def octant_occupancy(warp, sums, origin, inverse_spacing, extent, occupancy):
    """Bit c of a cell: does the canonical occupancy allow density in octant c?

    Args:
        warp: Tables. sums: Counts of marked canonical cells, see `any_marked`. origin,
            inverse_spacing: Of these cells (metres, 1/m).
        extent: how much of each octant is looked at: 1 is all of it, so that no density is missed;
            0 is its centre alone, for an occupancy dilated by the half diagonal of an octant.
        occupancy: (cells,) uint8 output.
    """
    for cell in numba.prange(occupancy.shape[0]):
        points, low, high = np.empty((3, 3, 3, 3)), np.empty(3), np.empty(3)
        bits = 0
        for sheet in range(2):
            if warp.sheets[cell, sheet, 0] < 0:
                continue
            cell_lattice(warp, cell, sheet, points)
            bounds(points, 0, 0, 0, 2, 1.0, low, high)
            if not any_marked(sums, origin, inverse_spacing, low, high):
                continue
            for octant in range(8):
                bounds(points, octant >> 2, (octant >> 1) & 1, octant & 1, 1, extent, low, high)
                if any_marked(sums, origin, inverse_spacing, low, high):
                    bits |= 1 << octant
        occupancy[cell] = bits
