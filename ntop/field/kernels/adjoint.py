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
RAYS_PER_CHUNK = 128
FAINT = 1e-3  # weight up to which a sample says nothing about the light


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


@device
def next_dense(grid, warp, pose, ray, far, step, offset, sample, rows, weights):
    """The first sample >= `sample` that the field reaches; see `next_sample`, `densest_sheet`.

    Returns its number, its cell (-1: there is none), the place in it (3), raw density and sheet.
    """
    while True:
        sample, cell, fx, fy, fz = next_sample(warp, pose, ray, far, step, offset, sample)
        if cell < 0:
            return sample, -1, fx, fy, fz, VOID_RAW, -1
        raw, sheet = densest_sheet(grid, warp, cell, fx, fy, fz, rows, weights)
        if sheet >= 0:
            return sample, cell, fx, fy, fz, raw, sheet
        sample += 1


@device
def albedo(grid, rows, weights):
    """Red, green and blue of the surface at the point whose corners are given."""
    return (
        sigmoid(interpolate(grid, 1, rows, weights)),
        sigmoid(interpolate(grid, 2, rows, weights)),
        sigmoid(interpolate(grid, 3, rows, weights)),
    )


@device
def seen_ray(grid, warp, light, pose, ray, far, step, offset, first, stop, rows, weights):
    """Walk a ray from its sample `first` on and keep nothing.

    Returns red, green, blue (premultiplied), transmittance, and the number of samples.
    """
    sample, samples = first, 0
    thickness, transmittance = 0.0, 1.0
    red = green = blue = 0.0
    while transmittance >= stop and samples < MAX_SAMPLES:
        sample, cell, fx, fy, fz, raw, sheet = next_dense(
            grid, warp, pose, ray, far, step, offset, sample, rows, weights
        )
        if cell < 0:
            break
        tau = DENSITY_SCALE * softplus(raw) * step
        weight = transmittance * -math.expm1(-tau)
        thickness += tau
        transmittance = math.exp(-thickness)
        surface = albedo(grid, rows[sheet], weights[sheet])
        nx, ny, nz = surface_normal(warp, cell, sheet, fx, fy, fz)
        red += weight * surface[0] * shade(light, 0, nx, ny, nz)
        green += weight * surface[1] * shade(light, 1, nx, ny, nz)
        blue += weight * surface[2] * shade(light, 2, nx, ny, nz)
        samples += 1
        sample += 1
    return red, green, blue, transmittance, samples


@device
def channel_loss(colour, opacity, gain, bias, target, matte, back):
    """Robust loss of one channel, its slope in the colour that is seen, and the error."""
    seen = colour * math.exp(gain) + bias * opacity + (1 - opacity) * back
    error = seen - (matte * target + (1 - matte) * back)
    root = math.sqrt(error * error + ROBUST_WIDTH * ROBUST_WIDTH)
    return root - ROBUST_WIDTH, error / root, error


@device
def sample_slopes(light, surface, normal, weight, after, behind, slopes, slope_opacity):
    """Slopes of the loss in one sample's values.

    Args:
        light: (9, 3). surface: albedo (3). normal: (3). weight: of the sample.
        after: transmittance behind the sample. behind: sum over later samples of their weight
            times dL/dweight. slopes: dL/dC (3) of the field's colour. slope_opacity: dL/dA.

    Returns:
        dL/dtau, slopes of the three raw colours, and weight times dL/dweight.
    """
    nx, ny, nz = normal
    shade0 = shade(light, 0, nx, ny, nz)
    shade1 = shade(light, 1, nx, ny, nz)
    shade2 = shade(light, 2, nx, ny, nz)
    slope_weight = (
        slopes[0] * surface[0] * shade0
        + slopes[1] * surface[1] * shade1
        + slopes[2] * surface[2] * shade2
        + slope_opacity
    )
    return (
        after * slope_weight - behind,
        slopes[0] * weight * shade0 * surface[0] * (1 - surface[0]),
        slopes[1] * weight * shade1 * surface[1] * (1 - surface[1]),
        slopes[2] * weight * shade2 * surface[2] * (1 - surface[2]),
        weight * slope_weight,
    )


@device
def add_light_slopes(light, surface, normal, weight, slopes, light_slopes):
    """Add a sample's slopes in the light to `light_slopes` (9, 3), unless it is too faint."""
    if weight <= FAINT:
        return
    nx, ny, nz = normal
    for channel in range(3):
        slope = slopes[channel] * weight * surface[channel]
        if shade(light, channel, nx, ny, nz) > MIN_SHADE:
            light_slopes[0, channel] += slope
            light_slopes[1, channel] += slope * nx
            light_slopes[2, channel] += slope * ny
            light_slopes[3, channel] += slope * nz
            light_slopes[4, channel] += slope * nx * ny
            light_slopes[5, channel] += slope * ny * nz
            light_slopes[6, channel] += slope * (3 * nz * nz - 1)
            light_slopes[7, channel] += slope * nx * nz
            light_slopes[8, channel] += slope * (nx * nx - ny * ny)


@kernel
def see_rays(grid, warp, light, poses, origins, directions, offsets, step, stop, seen):
    """What `train_rays` sees of each ray: `seen` (rays, 4), premultiplied colour and opacity."""
    count = directions.shape[0]
    for chunk in numba.prange((count + RAYS_PER_CHUNK - 1) // RAYS_PER_CHUNK):
        rows = np.empty((2, 8), np.int64)
        weights = np.empty((2, 8), grid.values.dtype)
        for r in range(chunk * RAYS_PER_CHUNK, min(count, (chunk + 1) * RAYS_PER_CHUNK)):
            ray, near, far = start_ray(warp, poses[r], origins[r], directions[r])
            first = max(0, int(math.ceil(near / step - offsets[r])))
            red, green, blue, transmittance, _ = seen_ray(
                grid, warp, light, poses[r], ray, far, step, offsets[r], first, stop, rows, weights
            )
            seen[r, 0], seen[r, 1], seen[r, 2] = red, green, blue
            seen[r, 3] = 1 - transmittance


@kernel
def train_rays(
    grid, warp, light, camera_gain, poses, cameras, origins, directions, offsets, targets, mattes,
    colour_weights, matte_weights, backgrounds, extra_slopes, step, stop, entropy_weight, gradients,
    touched, light_gradients, gain_gradients, losses,
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
        extra_slopes: (rays, 3) of another loss in the colour over the background, or (0, 3).
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
        # columns: d tau / d raw, weight, T after, albedo (3), normal (3)
        kept = np.empty((MAX_SAMPLES, 9), np.float64)
        for r in range(block * count // blocks, (block + 1) * count // blocks):
            ray, near, far = start_ray(warp, poses[r], origins[r], directions[r])
            sample = max(0, int(math.ceil(near / step - offsets[r])))
            samples = 0
            thickness, transmittance = 0.0, 1.0
            red = green = blue = 0.0
            while transmittance >= stop and samples < MAX_SAMPLES:
                sample, cell, fx, fy, fz, raw, sheet = next_dense(
                    grid, warp, poses[r], ray, far, step, offsets[r], sample, rows, weights
                )
                if cell < 0:
                    break
                tau = DENSITY_SCALE * softplus(raw) * step
                weight = transmittance * -math.expm1(-tau)
                thickness += tau
                transmittance = math.exp(-thickness)
                keep = kept[samples]
                for c in range(8):
                    kept_rows[samples, c] = rows[sheet, c]
                    kept_weights[samples, c] = weights[sheet, c]
                keep[0] = DENSITY_SCALE * sigmoid(raw) * step
                keep[1], keep[2] = weight, transmittance
                keep[3], keep[4], keep[5] = albedo(grid, rows[sheet], weights[sheet])
                nx, ny, nz = surface_normal(warp, cell, sheet, fx, fy, fz)
                keep[6], keep[7], keep[8] = nx, ny, nz
                red += weight * keep[3] * shade(light, 0, nx, ny, nz)
                green += weight * keep[4] * shade(light, 1, nx, ny, nz)
                blue += weight * keep[5] * shade(light, 2, nx, ny, nz)
                samples += 1
                sample += 1

            # loss and its derivatives
            opacity = 1 - transmittance
            matte, camera = mattes[r], cameras[r]
            gain, back = camera_gain[camera], backgrounds[r]
            losses[block, 2] += matte_weights[r] * (opacity - matte) ** 2
            slope_opacity = matte_weights[r] * 2 * (opacity - matte)
            slope_opacity += entropy_weight * (1 - 2 * opacity)
            colour, slopes = (red, green, blue), (0.0, 0.0, 0.0)
            for channel in range(3):
                loss, slope, error = channel_loss(
                    colour[channel], opacity, gain[0, channel], gain[1, channel],
                    targets[r, channel], matte, back[channel],
                )  # fmt: skip
                losses[block, 0] += colour_weights[r] * loss
                if matte > 0.5:
                    losses[block, 1] += error * error
                slope *= colour_weights[r]
                if extra_slopes.shape[0] > 0:
                    slope += extra_slopes[r, channel]
                scale = math.exp(gain[0, channel])
                gain_gradients[block, camera, 0, channel] += slope * colour[channel] * scale
                gain_gradients[block, camera, 1, channel] += slope * opacity
                # d seen / d opacity beside the weights' own colours
                slope_opacity += slope * (gain[1, channel] - back[channel])
                slopes = (slopes[1], slopes[2], slope * scale)

            behind = 0.0  # sum over later samples of weight * dL/dweight
            for s in range(samples - 1, -1, -1):
                keep = kept[s]
                surface, normal = (keep[3], keep[4], keep[5]), (keep[6], keep[7], keep[8])
                slope_tau, slope0, slope1, slope2, own = sample_slopes(
                    light, surface, normal, keep[1], keep[2], behind, slopes, slope_opacity
                )
                behind += own
                slope_raw = slope_tau * keep[0]
                for c in range(8):
                    row, share = kept_rows[s, c], kept_weights[s, c]
                    gradients[block, row, 0] += share * slope_raw
                    gradients[block, row, 1] += share * slope0
                    gradients[block, row, 2] += share * slope1
                    gradients[block, row, 3] += share * slope2
                    touched[block, row >> 6] = 1
                add_light_slopes(light, surface, normal, keep[1], slopes, light_gradients[block])
