"""One training step's rays: march, composite, compare with the photograph, and walk back.

With loss L, g = dL/dC (3) and a = dL/dA of a ray's colour C (over a background) and opacity A:
    dL/dw_i   = g . c_i + a
    dL/dtau_i = T_(i+1) dL/dw_i - sum_(j>i) w_j dL/dw_j - T_N g . background
Twin: `ntop.field.twin.ray_losses` with autograd.
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
    next_sample,
    shade,
    sigmoid,
    softplus,
    start_ray,
    surface_normal,
)

MAX_SAMPLES = 512  # occupied samples kept per ray; at 4 mm that is 2 m of solid body
ROBUST_WIDTH = 0.1  # colour errors beyond this count linearly (Charbonnier)
MIN_SHADE = 0.02  # as in `shade`


@device
def densest_sheet(grid, warp, cell, fx, fy, fz, rows, weights):
    """Raw density of a sample and the sheet it comes from: the denser of its two.

    `rows` and `weights` (2, 8) hold each sheet's corners afterwards. Sheet -1: nothing here.
    """
    best, chosen = VOID_RAW, -1
    for sheet in range(2):
        if warp.sheets[cell, sheet, 0] >= 0:
            x, y, z = canonical_point(warp, cell, sheet, fx, fy, fz)
            if grid_corners(grid, x, y, z, rows[sheet], weights[sheet]):
                raw = interpolate(grid, 0, rows[sheet], weights[sheet])
                if raw > best:
                    best, chosen = raw, sheet
    return best, chosen


@kernel
def train_rays(
    grid, warp, light, camera_gain, poses, cameras, origins, directions, offsets, targets, mattes,
    colour_weights, matte_weights, backgrounds, step, stop, entropy_weight, gradients, touched,
    light_gradients, gain_gradients, losses,
):  # fmt: skip
    """Add the gradients of the rays' losses to the blocks' buffers.

    Block b owns rays [b * rays / blocks, (b + 1) * rays / blocks) and row b of every gradient
    buffer, so sums do not depend on the number of threads.

    Args:
        grid, warp, light, origins (rays, 3), directions, offsets, step, stop: see `render_rays`.
        camera_gain: (cameras, 2, 3) log gain and bias of each camera's colours.
        poses, cameras: (rays,) which warp table and which camera.
        targets: (rays, 3) photograph's colour. mattes: (rays,) its opacity.
        colour_weights, matte_weights: (rays,). backgrounds: (rays, 3) random colours, laid behind
            both the field and the photograph's person, so that the field cannot imitate the scene.
        entropy_weight: pushes the opacity of rays away from one half.
        gradients: (blocks, rows, 4). touched: (blocks, bricks) uint8.
        light_gradients: (blocks, 9, 3). gain_gradients: (blocks, cameras, 2, 3).
        losses: (blocks, 3) sums: colour, squared colour error of person rays, matte.
    """
    blocks, count = gradients.shape[0], directions.shape[0]
    for block in numba.prange(blocks):
        real = grid.values.dtype
        rows = np.empty((2, 8), np.int64)
        weights = np.empty((2, 8), real)
        kept_rows = np.empty((MAX_SAMPLES, 8), np.int64)
        kept_weights = np.empty((MAX_SAMPLES, 8), real)
        kept = np.empty((MAX_SAMPLES, 12), np.float64)
        # columns: d tau / d raw, tau, weight, T after, albedo (3), normal (3), -, -
        for r in range(block * count // blocks, (block + 1) * count // blocks):
            ray, near, far = start_ray(warp, poses[r], origins[r], directions[r])
            sample = max(0, int(math.ceil(near / step - offsets[r])))
            samples = 0
            thickness, transmittance = 0.0, 1.0
            red = green = blue = 0.0
            while transmittance >= stop and samples < MAX_SAMPLES:
                sample, cell, fx, fy, fz = next_sample(
                    warp, poses[r], ray, far, step, offsets[r], sample
                )
                if cell < 0:
                    break
                raw, sheet = densest_sheet(grid, warp, cell, fx, fy, fz, rows, weights)
                if sheet >= 0:
                    tau = DENSITY_SCALE * softplus(raw) * step
                    weight = transmittance * -math.expm1(-tau)
                    thickness += tau
                    transmittance = math.exp(-thickness)
                    keep = kept[samples]
                    for c in range(8):
                        kept_rows[samples, c] = rows[sheet, c]
                        kept_weights[samples, c] = weights[sheet, c]
                    keep[0] = DENSITY_SCALE * sigmoid(raw) * step
                    keep[1], keep[2], keep[3] = tau, weight, transmittance
                    nx, ny, nz = surface_normal(warp, cell, sheet, fx, fy, fz)
                    keep[7], keep[8], keep[9] = nx, ny, nz
                    for channel in range(3):
                        keep[4 + channel] = sigmoid(
                            interpolate(grid, 1 + channel, rows[sheet], weights[sheet])
                        )
                    red += weight * keep[4] * shade(light, 0, nx, ny, nz)
                    green += weight * keep[5] * shade(light, 1, nx, ny, nz)
                    blue += weight * keep[6] * shade(light, 2, nx, ny, nz)
                    samples += 1
                sample += 1

            opacity = 1 - transmittance
            matte, camera = mattes[r], cameras[r]
            # loss and its derivatives
            gain = camera_gain[camera]
            back = backgrounds[r]
            scales = (math.exp(gain[0, 0]), math.exp(gain[0, 1]), math.exp(gain[0, 2]))
            field = (red, green, blue)
            g0 = g1 = g2 = 0.0
            slope_opacity = matte_weights[r] * 2 * (opacity - matte)
            losses[block, 2] += matte_weights[r] * (opacity - matte) ** 2
            slope_opacity += entropy_weight * (1 - 2 * opacity)
            for channel in range(3):
                premultiplied = field[channel] * scales[channel] + gain[1, channel] * opacity
                seen = premultiplied + transmittance * back[channel]
                wanted = matte * targets[r, channel] + (1 - matte) * back[channel]
                error = seen - wanted
                root = math.sqrt(error * error + ROBUST_WIDTH * ROBUST_WIDTH)
                losses[block, 0] += colour_weights[r] * (root - ROBUST_WIDTH)
                if matte > 0.5:
                    losses[block, 1] += error * error
                slope = colour_weights[r] * error / root
                gain_gradients[block, camera, 0, channel] += (
                    slope * field[channel] * scales[channel]
                )
                gain_gradients[block, camera, 1, channel] += slope * opacity
                # d seen / d opacity beside the weights' own colours
                slope_opacity += slope * (gain[1, channel] - back[channel])
                if channel == 0:
                    g0 = slope * scales[0]
                elif channel == 1:
                    g1 = slope * scales[1]
                else:
                    g2 = slope * scales[2]

            behind = 0.0  # sum over later samples of weight * dL/dweight
            for s in range(samples - 1, -1, -1):
                keep = kept[s]
                nx, ny, nz = keep[7], keep[8], keep[9]
                shade0 = shade(light, 0, nx, ny, nz)
                shade1 = shade(light, 1, nx, ny, nz)
                shade2 = shade(light, 2, nx, ny, nz)
                weight = keep[2]
                slope_weight = (
                    g0 * keep[4] * shade0
                    + g1 * keep[5] * shade1
                    + g2 * keep[6] * shade2
                    + slope_opacity
                )
                slope_raw = (keep[3] * slope_weight - behind) * keep[0]
                behind += weight * slope_weight
                slope0 = g0 * weight * shade0 * keep[4] * (1 - keep[4])
                slope1 = g1 * weight * shade1 * keep[5] * (1 - keep[5])
                slope2 = g2 * weight * shade2 * keep[6] * (1 - keep[6])
                for c in range(8):
                    row, share = kept_rows[s, c], kept_weights[s, c]
                    gradients[block, row, 0] += share * slope_raw
                    gradients[block, row, 1] += share * slope0
                    gradients[block, row, 2] += share * slope1
                    gradients[block, row, 3] += share * slope2
                    touched[block, row >> 6] = 1
                if weight > 1e-3:
                    for channel in range(3):
                        slope = (g0, g1, g2)[channel] * weight * keep[4 + channel]
                        if shade(light, channel, nx, ny, nz) > MIN_SHADE:
                            row_light = light_gradients[block]
                            row_light[0, channel] += slope
                            row_light[1, channel] += slope * nx
                            row_light[2, channel] += slope * ny
                            row_light[3, channel] += slope * nz
                            row_light[4, channel] += slope * nx * ny
                            row_light[5, channel] += slope * ny * nz
                            row_light[6, channel] += slope * (3 * nz * nz - 1)
                            row_light[7, channel] += slope * nx * nz
                            row_light[8, channel] += slope * (nx * nx - ny * ny)
