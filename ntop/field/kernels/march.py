"""March rays through a posed avatar and composite: what every rendered pixel is made of.

Notation: sample i covers [t_i - step/2, t_i + step/2], optical depth tau_i = density_i * step,
S_i = tau_0 + ... + tau_(i-1) (exclusive), transmittance T_i = exp(-S_i), weight
w_i = T_i * (1 - exp(-tau_i)). Twin: `ntop.field.twin.composite`.
"""

import math

import numba
import numpy as np

from ntop.field.kernels import device, kernel
from ntop.field.kernels.tables import (
    DENSITY_SCALE,
    VOID_RAW,
    canonical_point,
    grid_corners,
    interpolate,
    next_occupied,
    shade,
    sigmoid,
    softplus,
    start_ray,
    surface_normal,
)

RAYS_PER_CHUNK = 128
MEDIAN_DEPTH = math.log(2.0)  # optical depth at which half of the light is gone


@device
def densest_sheet(grid, warp, cell, state, rows, weights):
    """Raw density of a sample and the sheet it comes from: the denser of its two.

    `rows` and `weights` (2, 8) hold each sheet's corners afterwards. Sheet -1: nothing here.
    """
    best, chosen = VOID_RAW, -1
    for sheet in range(2):
        if warp.sheets[cell, sheet, 0] >= 0:
            x, y, z = canonical_point(warp, cell, sheet, state[1], state[2], state[3])
            if grid_corners(grid, x, y, z, rows[sheet], weights[sheet]):
                raw = interpolate(grid, 0, rows[sheet], weights[sheet])
                if raw > best:
                    best, chosen = raw, sheet
    return best, chosen


@device
def part_at(labels, labels_origin, inverse_spacing, x, y, z):
    """Part value (label + 1) of the label node nearest to a canonical point."""
    i = int((x - labels_origin[0]) * inverse_spacing + 0.5)
    j = int((y - labels_origin[1]) * inverse_spacing + 0.5)
    k = int((z - labels_origin[2]) * inverse_spacing + 0.5)
    i = min(max(i, 0), labels.shape[0] - 1)
    j = min(max(j, 0), labels.shape[1] - 1)
    k = min(max(k, 0), labels.shape[2] - 1)
    return labels[i, j, k]


@kernel
def render_rays(
    grid, warp, light, labels, labels_origin, inverse_spacing, poses, origins, directions, offsets,
    step, stop, colour_floor, colours, opacity, depth, parts, evaluations,
):  # fmt: skip
    """Colour, opacity, median depth and part of each ray.

    Args:
        grid, warp: Tables. light: (9, 3) see `shade`. labels: part values on a canonical grid.
        labels_origin, inverse_spacing: Of that grid (metres, 1/m).
        poses: (1 or rays,) which pose of `warp`.
        origins: (1 or rays, 3) relative to the warp grid's origin. directions: (rays, 3) unit.
        offsets: (rays,) in steps; 0.5 puts samples at interval midpoints from the camera.
        step: metres. stop: transmittance below which a ray ends.
        colour_floor: weight below which a sample's colour is not looked up.
        colours, opacity, depth, parts: Outputs; colours are premultiplied, depth is metres along
            the ray where half of the light is gone (where less than half is lost: the sample of
            largest weight), 0 where there is nothing.
        evaluations: (chunks,) density look-ups, for the cost reports.
    """
    count = directions.shape[0]
    for chunk in numba.prange((count + RAYS_PER_CHUNK - 1) // RAYS_PER_CHUNK):
        ray = np.empty(12, np.float64)
        state = np.empty(4, np.float64)
        rows = np.empty((2, 8), np.int64)
        weights = np.empty((2, 8), grid.values.dtype)
        looked_up = 0
        for r in range(chunk * RAYS_PER_CHUNK, min(count, (chunk + 1) * RAYS_PER_CHUNK)):
            origin = origins[r if origins.shape[0] > 1 else 0]
            pose = poses[r if poses.shape[0] > 1 else 0]
            start_ray(warp, pose, origin, directions[r], step, offsets[r], ray, state)
            red = green = blue = 0.0
            thickness, transmittance = 0.0, 1.0
            heaviest, median_t = 0.0, 0.0
            median_cell, median_sheet = -1, 0
            mx = my = mz = 0.0
            while transmittance >= stop:
                cell = next_occupied(warp, pose, ray, state)
                if cell < 0:
                    break
                looked_up += 1
                raw, sheet = densest_sheet(grid, warp, cell, state, rows, weights)
                if sheet >= 0:
                    tau = DENSITY_SCALE * softplus(raw) * step
                    weight = transmittance * -math.expm1(-tau)
                    t = (state[0] + offsets[r]) * step
                    crosses = thickness < MEDIAN_DEPTH <= thickness + tau
                    if crosses or (weight > heaviest and thickness < MEDIAN_DEPTH):
                        median_t = t
                        if crosses:
                            median_t = t + step * ((MEDIAN_DEPTH - thickness) / tau - 0.5)
                        heaviest = weight
                        median_cell, median_sheet = cell, sheet
                        mx, my, mz = state[1], state[2], state[3]
                    if weight >= colour_floor:
                        nx, ny, nz = surface_normal(warp, cell, sheet, state[1], state[2], state[3])
                        corner_rows, corner_weights = rows[sheet], weights[sheet]
                        red += (
                            weight
                            * shade(light, 0, nx, ny, nz)
                            * sigmoid(interpolate(grid, 1, corner_rows, corner_weights))
                        )
                        green += (
                            weight
                            * shade(light, 1, nx, ny, nz)
                            * sigmoid(interpolate(grid, 2, corner_rows, corner_weights))
                        )
                        blue += (
                            weight
                            * shade(light, 2, nx, ny, nz)
                            * sigmoid(interpolate(grid, 3, corner_rows, corner_weights))
                        )
                    thickness += tau
                    transmittance = math.exp(-thickness)
                state[0] += 1
            colours[r, 0], colours[r, 1], colours[r, 2] = red, green, blue
            opacity[r] = -math.expm1(-thickness)
            depth[r] = median_t
            parts[r] = 0
            if median_cell >= 0:
                x, y, z = canonical_point(warp, median_cell, median_sheet, mx, my, mz)
                parts[r] = part_at(labels, labels_origin, inverse_spacing, x, y, z)
        evaluations[chunk] = looked_up
