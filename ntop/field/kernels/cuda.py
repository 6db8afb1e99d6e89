"""The kernels on NVIDIA GPUs: one thread per ray, or per row of values.

The arithmetic is that of the CPU's kernels, function for function: numba compiles the same source
for the GPU. What differs is memory. A CPU's ray keeps its samples until it walks back; a GPU's ray
keeps nothing and walks twice, as the sum over later samples is the whole sum, known after the first
walk, less that over earlier ones. And where the CPU adds up blocks in order, the GPU adds whole
numbers, which give the same sum in any order (docs/decisions/0019-gpu-kernels.md).

Import this module only where a GPU is used; NUMBA_ENABLE_CUDASIM=1 stands in for one in tests.
"""

import math

import numba.core.config
from numba import cuda, float32, float64, int64

from ntop.field.kernels.adjoint import (
    add_light_slopes,
    albedo,
    channel_loss,
    next_dense,
    sample_slopes,
    seen_ray,
)
from ntop.field.kernels.learn import adam_value, add_priors
from ntop.field.kernels.march import march_ray
from ntop.field.kernels.tables import (
    DENSITY_SCALE,
    sigmoid,
    softplus,
    start_ray,
    surface_normal,
)

# NVIDIA's own package of this target reads its own settings
cuda.config.CACHE_DIR = numba.core.config.CACHE_DIR

THREADS = 64  # per block; a thread of the march needs some 190 registers
UNITS = 2.0**40  # of a sum per 1: steps of 1e-12, and sums up to 8e6
LARGEST = 2.0**20  # of what is added; a ray's slopes are of the order of 1


@cuda.jit(cache=True)
def march_rays(
    grid, warp, density, sheets, light, labels, labels_origin, inverse_spacing, poses, origins,
    directions, offsets, spans, step, piece_depth, stop, colour_floor, skipping, colours, opacity,
    depth, parts, evaluations,
):  # fmt: skip
    """As `march.render_rays`, but `evaluations` (2,) int64 are sums over all rays."""
    r = cuda.grid(1)
    if r >= directions.shape[0]:
        return
    red, green, blue, opaque, median, part, voxels, samples = march_ray(
        grid, warp, density, sheets, light, labels, labels_origin, inverse_spacing,
        poses[r if poses.shape[0] > 1 else 0], origins[r if origins.shape[0] > 1 else 0],
        directions[r], offsets[r], spans[r if spans.shape[0] > 1 else 0], step, piece_depth, stop,
        colour_floor, skipping,
    )  # fmt: skip
    colours[r, 0], colours[r, 1], colours[r, 2] = red, green, blue
    opacity[r], depth[r], parts[r] = opaque, median, part
    cuda.atomic.add(evaluations, 0, voxels)
    cuda.atomic.add(evaluations, 1, samples)


@cuda.jit(device=True)
def add_exactly(sums, index, value, broken):
    """Add to one of `sums` (int64, in 1 / UNITS); what is no number, or too large, is reported."""
    if abs(value) < LARGEST:  # false for NaN
        cuda.atomic.add(sums, index, int(math.floor(value * UNITS + 0.5)))
    else:
        broken[0] = 1


@cuda.jit(cache=True)
def see_rays(grid, warp, light, poses, origins, directions, offsets, step, stop, seen):
    """As `adjoint.see_rays`."""
    r = cuda.grid(1)
    if r >= directions.shape[0]:
        return
    rows = cuda.local.array((2, 8), int64)
    weights = cuda.local.array((2, 8), float32)
    ray, near, far = start_ray(warp, poses[r], origins[r], directions[r])
    first = max(0, int(math.ceil(near / step - offsets[r])))
    red, green, blue, transmittance, _ = seen_ray(
        grid, warp, light, poses[r], ray, far, step, offsets[r], first, stop, rows, weights
    )
    seen[r, 0], seen[r, 1], seen[r, 2] = red, green, blue
    seen[r, 3] = 1 - transmittance


@cuda.jit(cache=True)
def train_rays(
    grid, warp, light, camera_gain, poses, cameras, origins, directions, offsets, targets, mattes,
    colour_weights, matte_weights, backgrounds, extra_slopes, step, stop, entropy_weight, gradients,
    touched, light_gradients, gain_gradients, losses, broken,
):  # fmt: skip
    """As `adjoint.train_rays`, without blocks.

    Args:
        gradients, light_gradients, gain_gradients, losses: int64 sums in 1 / UNITS.
        touched: (bricks,) uint8. broken: (1,) uint8, set where a sum is of no use.
    """
    r = cuda.grid(1)
    if r >= directions.shape[0]:
        return
    rows = cuda.local.array((2, 8), int64)
    weights = cuda.local.array((2, 8), float32)
    light_slopes = cuda.local.array((9, 3), float64)
    for i in range(9):
        for channel in range(3):
            light_slopes[i, channel] = 0.0
    pose, camera = poses[r], cameras[r]
    ray, near, far = start_ray(warp, pose, origins[r], directions[r])
    first = max(0, int(math.ceil(near / step - offsets[r])))

    # the first walk: what the ray sees
    red, green, blue, transmittance, samples = seen_ray(
        grid, warp, light, pose, ray, far, step, offsets[r], first, stop, rows, weights
    )

    # loss and its derivatives
    opacity, matte = 1 - transmittance, mattes[r]
    gain, back = camera_gain[camera], backgrounds[r]
    add_exactly(losses, 2, matte_weights[r] * (opacity - matte) ** 2, broken)
    slope_opacity = matte_weights[r] * 2 * (opacity - matte)
    slope_opacity += entropy_weight * (1 - 2 * opacity)
    colour, slopes = (red, green, blue), (0.0, 0.0, 0.0)
    for channel in range(3):
        loss, slope, error = channel_loss(
            colour[channel], opacity, gain[0, channel], gain[1, channel], targets[r, channel],
            matte, back[channel],
        )  # fmt: skip
        add_exactly(losses, 0, colour_weights[r] * loss, broken)
        if matte > 0.5:
            add_exactly(losses, 1, error * error, broken)
        slope *= colour_weights[r]
        if extra_slopes.shape[0] > 0:
            slope += extra_slopes[r, channel]
        scale = math.exp(gain[0, channel])
        add_exactly(gain_gradients, (camera, 0, channel), slope * colour[channel] * scale, broken)
        add_exactly(gain_gradients, (camera, 1, channel), slope * opacity, broken)
        slope_opacity += slope * (gain[1, channel] - back[channel])
        slopes = (slopes[1], slopes[2], slope * scale)

    # the second walk: samples' slopes, with `behind` from the whole sum downwards
    behind = slopes[0] * red + slopes[1] * green + slopes[2] * blue + slope_opacity * opacity
    sample, thickness, transmittance = first, 0.0, 1.0
    for _ in range(samples):
        sample, cell, fx, fy, fz, raw, sheet = next_dense(
            grid, warp, pose, ray, far, step, offsets[r], sample, rows, weights
        )
        tau = DENSITY_SCALE * softplus(raw) * step
        weight = transmittance * -math.expm1(-tau)
        thickness += tau
        transmittance = math.exp(-thickness)
        surface = albedo(grid, rows[sheet], weights[sheet])
        normal = surface_normal(warp, cell, sheet, fx, fy, fz)
        slope_tau, slope0, slope1, slope2, own = sample_slopes(
            light, surface, normal, weight, transmittance, behind, slopes, slope_opacity
        )
        behind -= own  # which `slope_tau` has taken off too much
        slope_raw = (slope_tau + own) * (DENSITY_SCALE * sigmoid(raw) * step)
        for c in range(8):
            row, share = rows[sheet, c], weights[sheet, c]
            if row >= 64:  # the void does not learn
                add_exactly(gradients, (row, 0), share * slope_raw, broken)
                add_exactly(gradients, (row, 1), share * slope0, broken)
                add_exactly(gradients, (row, 2), share * slope1, broken)
                add_exactly(gradients, (row, 3), share * slope2, broken)
                touched[row >> 6] = 1
        add_light_slopes(light, surface, normal, weight, slopes, light_slopes)
        sample += 1
    for i in range(9):
        for channel in range(3):
            if light_slopes[i, channel] != 0:
                add_exactly(light_gradients, (i, channel), light_slopes[i, channel], broken)


@cuda.jit(cache=True)
def gather(
    values, bricks, positions, active, sums, touched, smoothness, edge, anchors, anchor_weight,
    gradients,
):  # fmt: skip
    """As `learn.gather`: from `sums` (rows, 4), which are cleared, to `gradients` (rows, 4)."""
    n = cuda.grid(1)
    if n >= 64 * active.shape[0]:
        return
    slot, node = active[n >> 6], n & 63
    row = slot * 64 + node
    for channel in range(4):
        gradients[row, channel] = sums[row, channel] / UNITS
        sums[row, channel] = 0
    add_priors(
        values, bricks, positions, slot, node, smoothness, edge, anchors, anchor_weight,
        gradients[row],
    )  # fmt: skip
    touched[slot] = 0


@cuda.jit(cache=True)
def adam_step(
    values, active, counts, gradients, first, second, rates, beta1, beta2, low, high
):  # fmt: skip
    """As `learn.adam_step`; `counts` (active,) are each brick's steps, this one counted."""
    n = cuda.grid(1)
    if n >= 64 * active.shape[0]:
        return
    row = active[n >> 6] * 64 + (n & 63)
    corrections = (1 - beta1 ** counts[n >> 6], 1 - beta2 ** counts[n >> 6])
    for channel in range(4):
        values[row, channel], first[row, channel], second[row, channel] = adam_value(
            values[row, channel], gradients[row, channel], first[row, channel],
            second[row, channel], corrections, rates[channel], beta1, beta2, low[channel],
            high[channel],
        )  # fmt: skip
