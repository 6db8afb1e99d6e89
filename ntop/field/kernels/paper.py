"""The paper's quadrature, for measurements only: see `ntop.field.paper_sampler`."""

import math

import numba
import numpy as np

from ntop.field.kernels import device, kernel
from ntop.field.kernels.tables import (
    DENSITY_SCALE,
    EMPTY_DENSITY,
    VOID_RAW,
    canonical_point,
    grid_corners,
    interpolate,
    shade,
    sigmoid,
    softplus,
    surface_normal,
)

RAYS_PER_CHUNK = 64
TRANSMITTANCE_FLOOR = 1e-10  # HumanNeRF adds it to 1 - alpha
LAST_DELTA_M = 1e10  # and closes the last interval there


@device
def occupied_cell(warp, pose, x, y, z, state):
    """The cell of a point (in cells) whose octant may hold density, or -1; fills its fractions."""
    nx, ny, nz = warp.dims[pose, 0], warp.dims[pose, 1], warp.dims[pose, 2]
    if not (x >= 0 and y >= 0 and z >= 0 and x < nx and y < ny and z < nz):
        return -1
    i, j, n = int(x), int(y), int(z)
    cell = warp.cells[warp.cell_offset[pose] + (i * ny + j) * nz + n]
    if cell < 0:
        return -1
    state[1], state[2], state[3] = x - i, y - j, z - n
    octant = 4 * (state[1] >= 0.5) + 2 * (state[2] >= 0.5) + 1 * (state[3] >= 0.5)
    return cell if (warp.occupancy[cell] >> octant) & 1 else -1


@kernel
def paper_rays(grid, warp, light, origin, directions, near, step, shift, samples, colours, opacity):
    """Composite samples near + (k + shift) * step, k < samples, of each ray as HumanNeRF does.

    Args:
        grid, warp, light: see `render_rays`; the pose is the first.
        origin: (3,) metres relative to the warp grid. directions: (rays, 3) unit.
        near, step: (rays,) metres; rays of step 0 see nothing. shift: (rays,) in steps.
        samples: per ray. colours: (rays, 3) output, premultiplied. opacity: (rays,) output.
    """
    count = directions.shape[0]
    scale = warp.inverse_cell
    for chunk in numba.prange((count + RAYS_PER_CHUNK - 1) // RAYS_PER_CHUNK):
        state = np.empty(4, np.float64)
        rows = np.empty((2, 8), np.int64)
        weights = np.empty((2, 8), grid.values.dtype)
        for r in range(chunk * RAYS_PER_CHUNK, min(count, (chunk + 1) * RAYS_PER_CHUNK)):
            colours[r, 0] = colours[r, 1] = colours[r, 2] = opacity[r] = 0
            passing = 1.0
            for k in range(samples if step[r] > 0 else 0):
                t = near[r] + (k + shift[r]) * step[r]
                cell = occupied_cell(
                    warp,
                    0,
                    (origin[0] + t * directions[r, 0]) * scale,
                    (origin[1] + t * directions[r, 1]) * scale,
                    (origin[2] + t * directions[r, 2]) * scale,
                    state,
                )
                if cell < 0:
                    continue
                raw, sheet = VOID_RAW, -1
                for claim in range(2):
                    if warp.sheets[cell, claim, 0] >= 0:
                        x, y, z = canonical_point(warp, cell, claim, state[1], state[2], state[3])
                        if grid_corners(grid, x, y, z, rows[claim], weights[claim]):
                            found = interpolate(grid, 0, rows[claim], weights[claim])
                            if found > raw:
                                raw, sheet = found, claim
                if sheet < 0:
                    continue
                density = max(softplus(raw) - EMPTY_DENSITY, 0.0)
                delta = step[r] if k < samples - 1 else LAST_DELTA_M
                alpha = 1 - math.exp(-DENSITY_SCALE * density * delta)
                x, y, z = surface_normal(warp, cell, sheet, state[1], state[2], state[3])
                for channel in range(3):
                    albedo = sigmoid(interpolate(grid, 1 + channel, rows[sheet], weights[sheet]))
                    colours[r, channel] += passing * alpha * albedo * shade(light, channel, x, y, z)
                opacity[r] += passing * alpha
                passing *= 1 - alpha + TRANSMITTANCE_FLOOR
