"""The field as the renderer reads it: what belongs together lies together in memory.

A march spends its time waiting for memory: a cell's corners are eight rows of `WarpTables.nodes`,
and a voxel's are eight rows of `GridTables.values` in up to eight bricks. Packed once per avatar
and once per pose, each is one short run of numbers. Training changes values all the time and
reads the tables themselves.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from ntop.field.kernels import device, kernel
from ntop.field.kernels.tables import EMPTY_RAW, VOID_RAW

STRAIGHT_VOXELS = 0.02  # a tenth of a millimetre at most, and far less for most rays
NODES = 5  # along a packed brick: its own four and the first of the next


class PackedDensity(NamedTuple):
    """Raw density of a canonical grid; row 0 is the void's.

    `slots[i >> 2, j >> 2, k >> 2]` is the row of the brick in which voxel (i, j, k) lies, and 0
    where none of its voxels has a node above EMPTY_RAW. `full` says which of a brick's voxels do.
    """

    slots: Int[np.ndarray, "x y z"]
    raw: Float[np.ndarray, "slot 125"]
    full: Bool[np.ndarray, "slot 64"]


class PackedSheets(NamedTuple):
    """Corners of the cells of `WarpTables` that may hold density.

    `rows[cell, sheet]` is the sheet's row, or -1. A row holds the canonical places of the 8 corners
    (in voxels of the canonical grid), then their world normals, by corner number. In a `straight`
    cell a ray is a straight line in canonical space, to STRAIGHT_VOXELS.
    """

    rows: Int[np.ndarray, "cell 2"]
    corners: Float[np.ndarray, "sheet 48"]
    straight: Bool[np.ndarray, " cell"]


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
def trilinear(points, row, first, fx, fy, fz):
    """The mean of 8 points at `points[row, first:first + 24]`, by corner number, at (fx, fy, fz).

    Arrays are indexed, never sliced: a slice counts its references, atomically.
    """
    ex, ey, ez = 1 - fx, 1 - fy, 1 - fz
    x = y = z = fx * 0
    for c in range(8):
        w = (fx if c & 4 else ex) * (fy if c & 2 else ey) * (fz if c & 1 else ez)
        x += w * points[row, first + 3 * c]
        y += w * points[row, first + 3 * c + 1]
        z += w * points[row, first + 3 * c + 2]
    return x, y, z


@device
def brick_of(density, i, j, k):
    """Row of the packed brick in which a voxel lies; 0, the void's, if i < 0."""
    return density.slots[i >> 2, j >> 2, k >> 2] if i >= 0 else 0


@device
def voxel_corners(density, slot, i, j, k):
    """Raw density of the 8 nodes of a voxel, by corner number."""
    n = (NODES * (i & 3) + (j & 3)) * NODES + (k & 3)
    raw, far = density.raw, n + NODES * NODES
    return (
        raw[slot, n], raw[slot, n + 1], raw[slot, n + NODES], raw[slot, n + NODES + 1],
        raw[slot, far], raw[slot, far + 1], raw[slot, far + NODES], raw[slot, far + NODES + 1],
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


@device
def is_full(density, slot, i, j, k):
    """Whether a voxel of a packed brick has a node above EMPTY_RAW."""
    return density.full[slot, ((i & 3) << 4) | ((j & 3) << 2) | (k & 3)]


@kernel
def pack_bricks(grid, bricks, raw, full):
    """Raw density of bricks and of the first nodes of the next ones, and which voxels are full.

    Args:
        grid: Tables. bricks: (slots, 3) coordinates of the bricks. raw: (slots, 125) output.
        full: (slots, 64) output.
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
        for voxel in range(64):
            i, j, k = voxel >> 4, (voxel >> 2) & 3, voxel & 3
            first, found = (NODES * i + j) * NODES + k, False
            for corner in range(8):
                n = first + (NODES * (corner >> 2) + ((corner >> 1) & 1)) * NODES + (corner & 1)
                found = found or not raw[slot, n] <= EMPTY_RAW  # NaN must stay visible
            full[slot, voxel] = found


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


@device
def twist(points, row, edge, other):
    """Length of a face's second difference (voxels), the larger one of two opposite faces.

    Faces are spanned by the corner numbers' bits `edge` and `other`.
    """
    largest = 0.0
    for start in (0, 7 - edge - other):
        squared = 0.0
        for axis in range(3):
            difference = (
                points[row, 3 * start + axis]
                - points[row, 3 * (start + edge) + axis]
                - points[row, 3 * (start + other) + axis]
                + points[row, 3 * (start + edge + other) + axis]
            )
            squared += difference * difference
        largest = max(largest, squared)
    return math.sqrt(largest)


@kernel
def mark_straight(rows, corners, straight):
    """Which cells map every straight line through them to nearly a straight line.

    Along a line through a unit cell the second derivative of a trilinear map is at most twice the
    sum of its faces' second differences, and the line bends by an eighth of it.

    Args:
        rows, corners: see `PackedSheets`. straight: (cells,) output.
    """
    for cell in numba.prange(rows.shape[0]):
        straight[cell] = rows[cell, 0] >= 0
        for sheet in range(2):
            row = rows[cell, sheet]
            if row >= 0:
                bend = twist(corners, row, 4, 2) + twist(corners, row, 4, 1)
                bend += twist(corners, row, 2, 1)
                straight[cell] = straight[cell] and 0.25 * bend <= STRAIGHT_VOXELS
