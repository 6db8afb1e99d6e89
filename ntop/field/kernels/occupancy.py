"""Which octants of a warp grid's cells may hold density."""

import math

import numba
import numpy as np

from ntop.field.kernels import device, kernel

CHUNK = 512  # cells that share their scratch memory: allocating it costs as much as a plain cell
COARSE = 4  # canonical cells along a block, in the table that is asked first


@device
def touched_range(lows, highs, origin, inverse_spacing, axis, i, j, k):
    """Cells of a grid (origin in metres) that the box (i, j, k) touches along an axis: [a, b)."""
    return (
        int(math.floor((lows[axis, i, j, k] - origin[axis]) * inverse_spacing)),
        int(math.floor((highs[axis, i, j, k] - origin[axis]) * inverse_spacing)) + 1,
    )


@device
def marked_in(sums, i0, i1, j0, j1, k0, k1):
    """How many cells of a range are marked; it may go beyond the grid.

    `sums[i, j, k]` counts the marked cells below (i, j, k): eight numbers answer for any range.
    """
    i0, j0, k0 = max(i0, 0), max(j0, 0), max(k0, 0)
    i1 = min(i1, sums.shape[0] - 1)
    j1 = min(j1, sums.shape[1] - 1)
    k1 = min(k1, sums.shape[2] - 1)
    if i0 >= i1 or j0 >= j1 or k0 >= k1:
        return 0
    upper = sums[i1, j1, k1] - sums[i1, j0, k1] - sums[i1, j1, k0] + sums[i1, j0, k0]
    lower = sums[i0, j1, k1] - sums[i0, j0, k1] - sums[i0, j1, k0] + sums[i0, j0, k0]
    return upper - lower


@device
def cell_corners(warp, cell, sheet, points, lows, highs):
    """Canonical images of a cell's corners, in the corners of `points` (3, 3, 3, 3).

    Their bounds go to [:, 2, 2, 2] of `lows` and `highs` (3, 3, 3, 3).
    """
    for axis in range(3):
        lows[axis, 2, 2, 2], highs[axis, 2, 2, 2] = np.inf, -np.inf
    for corner in range(8):
        node = warp.sheets[cell, sheet, corner]
        i, j, k = 2 * (corner >> 2), 2 * ((corner >> 1) & 1), 2 * (corner & 1)
        for axis in range(3):
            value = warp.nodes[node, axis]
            points[axis, i, j, k] = value
            lows[axis, 2, 2, 2] = min(lows[axis, 2, 2, 2], value)
            highs[axis, 2, 2, 2] = max(highs[axis, 2, 2, 2], value)


@device
def octant_bounds(points, extent, sums, lows, highs):
    """Bounds of a cell's octants, each drawn towards its mean by 1 - `extent`.

    A trilinear map sends a box into the hull of its corners' images: nothing lies outside. Octants
    have corners in common, and are bounded along one axis of the cell after the other.

    Args:
        points: (3, 3, 3, 3) axis, then images of the octants' corners: those of the cell's corners
            are given, the others become the means between them. sums: (3, 3, 3) scratch.
        lows, highs: (3, 3, 3, 3) output, octants in the first two places of each direction.
    """
    for axis in range(3):
        for j in range(0, 3, 2):
            for k in range(0, 3, 2):
                points[axis, 1, j, k] = 0.5 * (points[axis, 0, j, k] + points[axis, 2, j, k])
        for i in range(3):
            for k in range(0, 3, 2):
                points[axis, i, 1, k] = 0.5 * (points[axis, i, 0, k] + points[axis, i, 2, k])
            for j in range(3):
                points[axis, i, j, 1] = 0.5 * (points[axis, i, j, 0] + points[axis, i, j, 2])
        for i in range(3):
            for j in range(3):
                for k in range(2):
                    one, other = points[axis, i, j, k], points[axis, i, j, k + 1]
                    lows[axis, i, j, k], highs[axis, i, j, k] = min(one, other), max(one, other)
                    sums[i, j, k] = one + other
            for j in range(2):
                for k in range(2):
                    lows[axis, i, j, k] = min(lows[axis, i, j, k], lows[axis, i, j + 1, k])
                    highs[axis, i, j, k] = max(highs[axis, i, j, k], highs[axis, i, j + 1, k])
                    sums[i, j, k] += sums[i, j + 1, k]
        for i in range(2):
            for j in range(2):
                for k in range(2):
                    mean = (sums[i, j, k] + sums[i + 1, j, k]) / 8
                    low = min(lows[axis, i, j, k], lows[axis, i + 1, j, k])
                    high = max(highs[axis, i, j, k], highs[axis, i + 1, j, k])
                    lows[axis, i, j, k] = mean + extent * (low - mean)
                    highs[axis, i, j, k] = mean + extent * (high - mean)


@kernel
def octant_occupancy(warp, sums, coarse_sums, origin, inverse_spacing, extent, occupancy):
    """Bit c of a cell: does the canonical occupancy allow density in octant c?

    Args:
        warp: Tables. sums: Counts of marked canonical cells, see `marked_in`. coarse_sums: Those
            at the corners of blocks of `COARSE` cells. origin, inverse_spacing: Of the cells
            (metres, 1/m).
        extent: how much of each octant is looked at: 1 is all of it, so that no density is missed;
            0 is its centre alone, for an occupancy dilated by the half diagonal of an octant.
        occupancy: (cells,) uint8 output.
    """
    cells = occupancy.shape[0]
    for chunk in numba.prange((cells + CHUNK - 1) // CHUNK):
        points, partial = np.empty((3, 3, 3, 3)), np.empty((3, 3, 3))
        lows, highs = np.empty((3, 3, 3, 3)), np.empty((3, 3, 3, 3))
        for cell in range(chunk * CHUNK, min(cells, (chunk + 1) * CHUNK)):
            bits = 0
            for sheet in range(2):
                if warp.sheets[cell, sheet, 0] < 0:
                    continue
                cell_corners(warp, cell, sheet, points, lows, highs)
                i0, i1 = touched_range(lows, highs, origin, inverse_spacing, 0, 2, 2, 2)
                j0, j1 = touched_range(lows, highs, origin, inverse_spacing, 1, 2, 2, 2)
                k0, k1 = touched_range(lows, highs, origin, inverse_spacing, 2, 2, 2, 2)
                near = marked_in(
                    coarse_sums, i0 // COARSE, (i1 + COARSE - 1) // COARSE, j0 // COARSE,
                    (j1 + COARSE - 1) // COARSE, k0 // COARSE, (k1 + COARSE - 1) // COARSE,
                )  # fmt: skip
                if near == 0:
                    continue
                marked = marked_in(sums, i0, i1, j0, j1, k0, k1)
                if marked == 0:
                    continue
                if marked == (i1 - i0) * (j1 - j0) * (k1 - k0):  # so are those its octants touch
                    bits = 255
                    break
                octant_bounds(points, extent, partial, lows, highs)
                for octant in range(8):
                    i, j, k = octant >> 2, (octant >> 1) & 1, octant & 1
                    i0, i1 = touched_range(lows, highs, origin, inverse_spacing, 0, i, j, k)
                    j0, j1 = touched_range(lows, highs, origin, inverse_spacing, 1, i, j, k)
                    k0, k1 = touched_range(lows, highs, origin, inverse_spacing, 2, i, j, k)
                    if marked_in(sums, i0, i1, j0, j1, k0, k1) > 0:
                        bits |= 1 << octant
            occupancy[cell] = bits
