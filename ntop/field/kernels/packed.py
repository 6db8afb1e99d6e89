"""The field as the renderer reads it: what belongs together lies together in memory.

A march spends its time waiting for memory: a cell's corners are eight rows of `WarpTables.nodes`,
and a voxel's are eight rows of `GridTables.values` in up to eight bricks. Packed once per avatar
and once per pose, each is one short run of numbers. Training changes values all the time and
reads the tables themselves.
"""

from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float, Int

from ntop.field.kernels import device, kernel
from ntop.field.kernels.tables import VOID_RAW

NODES = 5  # along a packed brick: its own four and the first of the next


class PackedDensity(NamedTuple):
    """Raw density of a canonical grid; row 0 is the void's.

    `slots[i >> 2, j >> 2, k >> 2]` is the row of the brick in which voxel (i, j, k) lies, and 0
    where none of its voxels has a node above the threshold it was packed with.
    """

    slots: Int[np.ndarray, "x y z"]
    raw: Float[np.ndarray, "slot 125"]


class PackedSheets(NamedTuple):
    """Corners of the cells of `WarpTables` that may hold density.

    `rows[cell, sheet]` is the sheet's row, or -1. A row holds the canonical places of the 8 corners
    (in voxels of the canonical grid), then their world normals, by corner number.
    """

    rows: Int[np.ndarray, "cell 2"]
    corners: Float[np.ndarray, "sheet 48"]


@device
def voxel_of(grid, x, y, z):
    """Index (3) of a canonical place in voxels; -1 first where it is outside the grid."""
    if not (x >= 0 and y >= 0 and z >= 0):  # also refuses NaN
        return -1, 0, 0
    i, j, k = int(x), int(y), int(z)
    shape = grid.bricks.shape
    if i + 1 >= 4 * shape[0] or j + 1 >= 4 * shape[1] or k + 1 >= 4 * shape[2]:
        return -1, 0, 0
    return i, j, k


@device
def row_of(grid, i, j, k):
    """Row of a node's values."""
    return grid.bricks[i >> 2, j >> 2, k >> 2] * 64 + (((i & 3) << 4) | ((j & 3) << 2) | (k & 3))


@device
def trilinear(row, first, fx, fy, fz):
    """The mean of 8 points at `row[first:first + 24]`, by corner number, at (fx, fy, fz)."""
    ex, ey, ez = 1 - fx, 1 - fy, 1 - fz
    w0, w1, w2, w3 = ex * ey * ez, ex * ey * fz, ex * fy * ez, ex * fy * fz
    w4, w5, w6, w7 = fx * ey * ez, fx * ey * fz, fx * fy * ez, fx * fy * fz
    x = (
        w0 * row[first] + w1 * row[first + 3] + w2 * row[first + 6] + w3 * row[first + 9]
        + w4 * row[first + 12] + w5 * row[first + 15] + w6 * row[first + 18] + w7 * row[first + 21]
    )  # fmt: skip
    first += 1
    y = (
        w0 * row[first] + w1 * row[first + 3] + w2 * row[first + 6] + w3 * row[first + 9]
        + w4 * row[first + 12] + w5 * row[first + 15] + w6 * row[first + 18] + w7 * row[first + 21]
    )  # fmt: skip
    first += 1
    z = (
        w0 * row[first] + w1 * row[first + 3] + w2 * row[first + 6] + w3 * row[first + 9]
        + w4 * row[first + 12] + w5 * row[first + 15] + w6 * row[first + 18] + w7 * row[first + 21]
    )  # fmt: skip
    return x, y, z


@device
def brick_of(density, i, j, k):
    """Row of the packed brick in which a voxel lies; 0, the void's, if i < 0."""
    return density.slots[i >> 2, j >> 2, k >> 2] if i >= 0 else 0


@device
def voxel_corners(density, slot, i, j, k):
    """Raw density of the 8 nodes of a voxel, by corner number."""
    n = (NODES * (i & 3) + (j & 3)) * NODES + (k & 3)
    raw = density.raw[slot]
    return (
        raw[n], raw[n + 1], raw[n + NODES], raw[n + NODES + 1], raw[n + NODES * NODES],
        raw[n + NODES * NODES + 1], raw[n + NODES * NODES + NODES],
        raw[n + NODES * NODES + NODES + 1],
    )  # fmt: skip


@device
def raw_density(grid, density, x, y, z):
    """Raw density at a canonical place in voxels; the void's outside the grid."""
    i, j, k = voxel_of(grid, x, y, z)
    slot = brick_of(density, i, j, k)
    if slot == 0:
        return VOID_RAW
    c0, c1, c2, c3, c4, c5, c6, c7 = voxel_corners(density, slot, i, j, k)
    x, y, z = x - i, y - j, z - k
    c0, c2, c4, c6 = c0 + z * (c1 - c0), c2 + z * (c3 - c2), c4 + z * (c5 - c4), c6 + z * (c7 - c6)
    c0, c4 = c0 + y * (c2 - c0), c4 + y * (c6 - c4)
    return c0 + x * (c4 - c0)


@device
def raw_colour(grid, x, y, z):
    """Raw red, green and blue at a canonical place in voxels."""
    i, j, k = voxel_of(grid, x, y, z)
    if i < 0:
        return 0.0, 0.0, 0.0
    fx, fy, fz = x - i, y - j, z - k
    red = green = blue = 0.0
    for c in range(8):
        row = row_of(grid, i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1))
        w = (fx if c & 4 else 1 - fx) * (fy if c & 2 else 1 - fy) * (fz if c & 1 else 1 - fz)
        red += w * grid.values[row, 1]
        green += w * grid.values[row, 2]
        blue += w * grid.values[row, 3]
    return red, green, blue


@kernel
def pack_bricks(grid, bricks, raw):
    """Raw density of bricks and of the first nodes of the next ones.

    Args:
        grid: Tables. bricks: (slots, 3) coordinates of the bricks. raw: (slots, 125) output.
    """
    shape = grid.bricks.shape
    for slot in numba.prange(bricks.shape[0]):
        for n in range(NODES**3):
            i = 4 * bricks[slot, 0] + n // (NODES * NODES)
            j = 4 * bricks[slot, 1] + n // NODES % NODES
            k = 4 * bricks[slot, 2] + n % NODES
            if i < 4 * shape[0] and j < 4 * shape[1] and k < 4 * shape[2]:
                raw[slot, n] = grid.values[row_of(grid, i, j, k), 0]
            else:
                raw[slot, n] = VOID_RAW


@kernel
def pack_sheets(grid, warp, sheets, corners):
    """Places and normals of the corners of some sheets of cells.

    Args:
        grid, warp: Tables. sheets: (sheets, 2) cell and sheet. corners: (sheets, 48) output.
    """
    for n in numba.prange(sheets.shape[0]):
        for corner in range(8):
            node = warp.nodes[warp.sheets[sheets[n, 0], sheets[n, 1], corner]]
            for axis in range(3):
                corners[n, 3 * corner + axis] = (node[axis] - grid.origin[axis]) * (
                    grid.inverse_voxel
                )
                corners[n, 24 + 3 * corner + axis] = node[3 + axis]
