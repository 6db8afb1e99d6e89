"""The arrays the kernels share, and the scalar functions that read them.

Canonical grid
    Nodes of a regular grid in bricks of 4 x 4 x 4. `bricks[i >> 2, j >> 2, k >> 2]` is a brick's
    slot; slot 0 is the void, whose 64 rows hold `VOID_RAW` and never learn. A row of `values` is
    [raw density, raw red, raw green, raw blue]: interpolated first, then activated.
Warp tables
    Per pose a grid of cells around the posed body. `cells` gives a cell's number or -1; a cell has
    one or two *sheets* of 8 nodes (two where two body parts are near each other), and a node holds
    [canonical position (metres), world normal of the nearest surface]. Bit c of `occupancy` says
    whether octant c of the cell may hold density; `blocks` says so for 4 x 4 x 4 cells. Corner and
    octant number c counts x in bit 2, y in bit 1, z in bit 0.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from ntop.field.kernels import device

VOID_RAW = -12.0
DENSITY_SCALE = 400.0  # 1/m per unit of softplus(raw): raw 8 is opaque within a millimetre
HUGE = 1e30


class GridTables(NamedTuple):
    """The canonical grid; `origin` (metres) is node (0, 0, 0)."""

    values: Float[np.ndarray, "row 4"]
    bricks: Int[np.ndarray, "x y z"]
    origin: Float[np.ndarray, " 3"]
    inverse_voxel: float


class WarpTables(NamedTuple):
    """Warp grids of one or several poses, concatenated; index p is the pose.

    `origin` (world, metres) is kept in float64; rays come relative to it.
    """

    dims: Int[np.ndarray, "pose 3"]
    cell_offset: Int[np.ndarray, " pose"]
    block_offset: Int[np.ndarray, " pose"]
    inverse_cell: float
    cells: Int[np.ndarray, " any"]
    sheets: Int[np.ndarray, "cell 2 8"]
    nodes: Float[np.ndarray, "node 6"]
    occupancy: UInt8[np.ndarray, " cell"]
    blocks: UInt8[np.ndarray, " any"]


@device
def softplus(x):
    """log(1 + exp(x)) without overflow."""
    return max(x, 0.0) + math.log1p(math.exp(-abs(x)))


@device
def sigmoid(x):
    """1 / (1 + exp(-x)) without overflow."""
    if x >= 0:
        return 1.0 / (1.0 + math.exp(-x))
    e = math.exp(x)
    return e / (1.0 + e)


@device
def canonical_point(warp, cell, sheet, fx, fy, fz):
    """Trilinear canonical position (metres) inside a cell of one sheet."""
    x = y = z = fx * 0
    for c in range(8):
        n = warp.sheets[cell, sheet, c]
        w = (fx if c & 4 else 1 - fx) * (fy if c & 2 else 1 - fy) * (fz if c & 1 else 1 - fz)
        x += w * warp.nodes[n, 0]
        y += w * warp.nodes[n, 1]
        z += w * warp.nodes[n, 2]
    return x, y, z


@device
def surface_normal(warp, cell, sheet, fx, fy, fz):
    """Trilinear world normal inside a cell of one sheet, of unit length."""
    x = y = z = fx * 0
    for c in range(8):
        n = warp.sheets[cell, sheet, c]
        w = (fx if c & 4 else 1 - fx) * (fy if c & 2 else 1 - fy) * (fz if c & 1 else 1 - fz)
        x += w * warp.nodes[n, 3]
        y += w * warp.nodes[n, 4]
        z += w * warp.nodes[n, 5]
    scale = 1 / math.sqrt(x * x + y * y + z * z + 1e-12)  # opposite normals may cancel
    return x * scale, y * scale, z * scale


@device
def grid_corners(grid, x, y, z, rows, weights):
    """Rows and trilinear weights of the 8 nodes around a canonical point (metres).

    Returns False outside the grid, where there is nothing.
    """
    gx = (x - grid.origin[0]) * grid.inverse_voxel
    gy = (y - grid.origin[1]) * grid.inverse_voxel
    gz = (z - grid.origin[2]) * grid.inverse_voxel
    if not (gx >= 0 and gy >= 0 and gz >= 0):  # also refuses NaN
        return False
    i, j, k = int(gx), int(gy), int(gz)
    bricks = grid.bricks
    if i + 1 >= 4 * bricks.shape[0] or j + 1 >= 4 * bricks.shape[1] or k + 1 >= 4 * bricks.shape[2]:
        return False
    fx, fy, fz = gx - i, gy - j, gz - k
    for c in range(8):
        ii, jj, kk = i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)
        slot = bricks[ii >> 2, jj >> 2, kk >> 2]
        rows[c] = slot * 64 + (((ii & 3) << 4) | ((jj & 3) << 2) | (kk & 3))
        weights[c] = (
            (fx if c & 4 else 1 - fx) * (fy if c & 2 else 1 - fy) * (fz if c & 1 else 1 - fz)
        )
    return True


@device
def interpolate(grid, channel, rows, weights):
    """One raw channel at the point whose corners are given."""
    total = weights[0] * 0
    for c in range(8):
        total += weights[c] * grid.values[rows[c], channel]
    return total


@device
def shade(light, channel, x, y, z):
    """Light on a surface with unit normal (x, y, z): a quadratic, as second-order harmonics are.

    Ramamoorthi and Hanrahan 2001: nine numbers carry 99 % of diffuse light. Never negative.
    """
    value = (
        light[0, channel]
        + light[1, channel] * x
        + light[2, channel] * y
        + light[3, channel] * z
        + light[4, channel] * x * y
        + light[5, channel] * y * z
        + light[6, channel] * (3 * z * z - 1)
        + light[7, channel] * x * z
        + light[8, channel] * (x * x - y * y)
    )
    return max(value, 0.02)


@device
def exit_length(o, inverse_d, low, size):
    """Ray length at which one coordinate leaves [low, low + size] (cell units)."""
    return ((low + size if inverse_d > 0 else low) - o) * inverse_d


@device
def next_occupied(warp, pose, ray, state):
    """Advance a ray to its next sample in an occupied octant; returns its cell, or -1 at the end.

    `ray`: origin in cells (3), direction in cells per metre (3), its inverse (3), step (m), offset
    (steps), far end (m). `state`: sample index k; on return also the fractions in the cell (3).
    Samples lie at t = (k + offset) * step whatever is skipped, so skipping changes no image.
    """
    nx, ny, nz = warp.dims[pose, 0], warp.dims[pose, 1], warp.dims[pose, 2]
    mx, my = (ny + 3) >> 2, (nz + 3) >> 2
    step, offset, far = ray[9], ray[10], ray[11]
    k = int(state[0])
    while True:
        t = (k + offset) * step
        if not t < far:
            return -1
        px, py, pz = ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5]
        i, j, n = int(px), int(py), int(pz)
        if px < 0 or py < 0 or pz < 0 or i >= nx or j >= ny or n >= nz:
            k += 1  # rounding at the box's faces
            continue
        block = warp.blocks[warp.block_offset[pose] + ((i >> 2) * mx + (j >> 2)) * my + (n >> 2)]
        if block == 0:
            low_x, low_y, low_z = 1.0 * (i & ~3), 1.0 * (j & ~3), 1.0 * (n & ~3)
            size = 4.0
        else:
            cell = warp.cells[warp.cell_offset[pose] + (i * ny + j) * nz + n]
            low_x, low_y, low_z = 1.0 * i, 1.0 * j, 1.0 * n
            size = 1.0
            if cell >= 0 and warp.occupancy[cell] != 0:
                fx, fy, fz = px - i, py - j, pz - n
                octant = 4 * (fx >= 0.5) + 2 * (fy >= 0.5) + 1 * (fz >= 0.5)
                if (warp.occupancy[cell] >> octant) & 1:
                    state[0] = k
                    state[1], state[2], state[3] = fx, fy, fz
                    return cell
                low_x += 0.5 * (fx >= 0.5)
                low_y += 0.5 * (fy >= 0.5)
                low_z += 0.5 * (fz >= 0.5)
                size = 0.5
        leave = min(
            exit_length(ray[0], ray[6], low_x, size),
            min(exit_length(ray[1], ray[7], low_y, size), exit_length(ray[2], ray[8], low_z, size)),
        )
        k = max(k + 1, int(math.ceil(leave / step - offset)))


@device
def start_ray(warp, pose, origin, direction, step, offset, ray, state):
    """Fill `ray` and `state` for `next_occupied`: clip the ray to the warp grid's box.

    A ray with a number that is none, or without a direction, is over before it begins.
    """
    near, far, length = 0.0, HUGE, 0.0
    for a in range(3):
        o = origin[a] * warp.inverse_cell
        d = direction[a] * warp.inverse_cell
        inverse = 1 / d if abs(d) > 1 / HUGE else HUGE
        ray[a], ray[3 + a], ray[6 + a] = o, d, inverse
        size = 1.0 * warp.dims[pose, a]
        length += abs(d)
        if not (abs(d) < HUGE and abs(o) < HUGE):
            far = -1.0
            continue
        if abs(d) > 1 / HUGE:
            t0, t1 = -o * inverse, (size - o) * inverse
            near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
        elif o < 0 or o > size:
            far = -1.0
    if length == 0:
        far = -1.0
    ray[9], ray[10], ray[11] = step, offset, far
    state[0] = max(0.0, math.ceil(near / step - offset))
