"""The arrays the kernels share, and the scalar functions that read them.

Canonical grid
    Nodes of a regular grid in bricks of 4 x 4 x 4. `bricks[i >> 2, j >> 2, k >> 2]` is a brick's
    slot; slot 0 is the void, whose 64 rows hold `VOID_RAW` and never learn. A row of `values` is
    [raw density, raw red, raw green, raw blue]: interpolated first, then activated.
Warp tables
    Per pose a grid of cells around the posed body. `cells` gives a cell's number or -1; a cell has
    one or two *sheets* of 8 nodes (two where two body parts are near each other), and a node holds
    [canonical position (metres), world normal of the nearest surface]. Bit c of `occupancy` says
    whether octant c of the cell may hold density; `away` says of all cells, as of `cells`, how many
    cells away the nearest one with such an octant is at least: 0 where it is that cell itself.
    Corner and octant number c counts x in bit 2, y in bit 1, z in bit 0.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from ntop.field.kernels import device

VOID_RAW = -12.0
DENSITY_SCALE = 400.0  # 1/m per unit of softplus(raw): raw 8 is opaque within a millimetre
EMPTY_RAW = -4.0  # space of no more raw density than this is empty, by definition
EMPTY_DENSITY = math.log1p(math.exp(EMPTY_RAW))  # per DENSITY_SCALE; taken off all densities
HUGE = 1e30
TINY_M = 1e-9  # what a ray steps over where rounding would keep it in place
BOX_STEP_M = 1e-6  # the same where rounding has put it just outside the grid


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
    inverse_cell: float
    cells: Int[np.ndarray, " any"]
    sheets: Int[np.ndarray, "cell 2 8"]
    nodes: Float[np.ndarray, "node 6"]
    occupancy: UInt8[np.ndarray, " cell"]
    away: UInt8[np.ndarray, " any"]


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
def start_ray(warp, pose, origin, direction):
    """A ray in cells, and the lengths (m) between which it is inside the warp grid's box.

    The ray: origin in cells (3), direction in cells per metre (3), its inverse (3). One with a
    number that is none, or without a direction, is over before it begins.
    """
    ox, oy, oz = (
        origin[0] * warp.inverse_cell,
        origin[1] * warp.inverse_cell,
        origin[2] * warp.inverse_cell,
    )
    dx, dy, dz = (
        direction[0] * warp.inverse_cell,
        direction[1] * warp.inverse_cell,
        direction[2] * warp.inverse_cell,
    )
    ix, iy, iz = safe_inverse(dx), safe_inverse(dy), safe_inverse(dz)
    near, far = 0.0, HUGE
    near, far = clip_slab(ox, dx, ix, 1.0 * warp.dims[pose, 0], near, far)
    near, far = clip_slab(oy, dy, iy, 1.0 * warp.dims[pose, 1], near, far)
    near, far = clip_slab(oz, dz, iz, 1.0 * warp.dims[pose, 2], near, far)
    size = abs(ox) + abs(oy) + abs(oz) + abs(dx) + abs(dy) + abs(dz)
    if not size < HUGE or abs(dx) + abs(dy) + abs(dz) == 0:
        near, far = 0.0, -1.0
    return (ox, oy, oz, dx, dy, dz, ix, iy, iz), near, far


@device
def safe_inverse(d):
    """1 / d, and a huge number instead of infinity: infinity times zero is NaN."""
    return 1 / d if abs(d) > 1 / HUGE else HUGE


@device
def clip_slab(o, d, inverse, size, near, far):
    """The part of [near, far] in which o + t d lies in [0, size]; far < near if there is none."""
    if abs(d) > 1 / HUGE:
        t0, t1 = -o * inverse, (size - o) * inverse
        return max(near, min(t0, t1)), min(far, max(t0, t1))
    if o < 0 or o > size:
        return near, -1.0
    return near, far


@device
def next_octant(warp, pose, ray, t, far, skipping):
    """The first octant at length >= t that may hold density.

    Returns the length at which the ray is in it, the one at which it leaves it, the cell (-1: the
    ray's end is reached) and the place in the cell (3). Without `skipping`, space without cells
    is walked through octant by octant too, and those octants are returned as cell -2.
    """
    nx, ny, nz = warp.dims[pose, 0], warp.dims[pose, 1], warp.dims[pose, 2]
    while t < far:
        px, py, pz = ray[0] + t * ray[3], ray[1] + t * ray[4], ray[2] + t * ray[5]
        i, j, k = int(px), int(py), int(pz)
        # on a face, a ray is on the side it is going to
        i -= px == i and ray[3] < 0
        j -= py == j and ray[4] < 0
        k -= pz == k and ray[5] < 0
        if px < 0 or py < 0 or pz < 0 or i < 0 or j < 0 or k < 0 or i >= nx or j >= ny or k >= nz:
            t += BOX_STEP_M
            continue
        found = -1
        fx, fy, fz = px - i, py - j, pz - k
        n = warp.cell_offset[pose] + (i * ny + j) * nz + k
        away = warp.away[n]
        if away > 0 and skipping:
            # no cell is occupied that is less than `away` cells from this one
            reach = 1.0 * (away - 1)
            low_x, low_y, low_z = i - reach, j - reach, k - reach
            size = 1.0 + 2 * reach
        else:
            cell = warp.cells[n]
            high_x = fx > 0.5 or (fx == 0.5 and not ray[3] < 0)
            high_y = fy > 0.5 or (fy == 0.5 and not ray[4] < 0)
            high_z = fz > 0.5 or (fz == 0.5 and not ray[5] < 0)
            low_x, low_y, low_z = i + 0.5 * high_x, j + 0.5 * high_y, k + 0.5 * high_z
            size = 0.5
            if cell < 0:
                found = -1 if skipping else -2
            elif (warp.occupancy[cell] >> (4 * high_x + 2 * high_y + 1 * high_z)) & 1:
                found = cell
        leave = min(
            exit_length(ray[0], ray[6], low_x, size),
            min(exit_length(ray[1], ray[7], low_y, size), exit_length(ray[2], ray[8], low_z, size)),
        )
        leave = max(leave, t + TINY_M)
        if found != -1:
            return t, min(leave, far), found, fx, fy, fz
        t = leave
    return far, far, -1, 0.0, 0.0, 0.0


@device
def leave_cell(ray, t, far, fx, fy, fz):
    """Length at which a ray leaves the cell in which it is at place (fx, fy, fz) after `t`."""
    low_x = math.floor(ray[0] + t * ray[3] - fx + 0.5)
    low_y = math.floor(ray[1] + t * ray[4] - fy + 0.5)
    low_z = math.floor(ray[2] + t * ray[5] - fz + 0.5)
    leave = min(
        exit_length(ray[0], ray[6], low_x, 1.0),
        min(exit_length(ray[1], ray[7], low_y, 1.0), exit_length(ray[2], ray[8], low_z, 1.0)),
    )
    return min(max(leave, t + TINY_M), far)


@device
def next_sample(warp, pose, ray, far, step, offset, k):
    """The first sample >= k in an occupied octant, and where it is; cell -1 if there is none.

    Samples lie at t = (k + offset) * step whatever is skipped, so skipping changes none.
    """
    while True:
        t = max((k + offset) * step, 0.0)
        t, _, cell, fx, fy, fz = next_octant(warp, pose, ray, t, far, True)
        if cell < 0 or t == (k + offset) * step:
            return k, cell, fx, fy, fz
        k = max(k + 1, int(math.ceil(t / step - offset)))
