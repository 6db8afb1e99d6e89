"""The optimiser over bricks: gather the blocks' gradients, add smoothness, take an Adam step."""

import math

import numba

from ntop.field.kernels import device, kernel

NEIGHBOURS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


@device
def neighbour_row(bricks, position, i, j, k):
    """Row of node (i, j, k) from a brick's first node on, -1 beyond the grid or in the void."""
    x, y, z = 4 * position[0] + i, 4 * position[1] + j, 4 * position[2] + k
    if x < 0 or y < 0 or z < 0:
        return -1
    if x >= 4 * bricks.shape[0] or y >= 4 * bricks.shape[1] or z >= 4 * bricks.shape[2]:
        return -1
    slot = bricks[x >> 2, y >> 2, z >> 2]
    if slot == 0:
        return -1
    return slot * 64 + (((x & 3) << 4) | ((y & 3) << 2) | (z & 3))


@device
def add_priors(
    values, bricks, positions, slot, node, smoothness, edge, anchors, anchor_weight, gradient
):  # fmt: skip
    """Add the priors' slopes in one node's values to `gradient` (4,); arguments as of `gather`."""
    row = slot * 64 + node
    off = values[row, 0] - anchors[row]
    gradient[0] += anchor_weight * off / math.sqrt(off * off + edge[0] ** 2)
    for n in range(6):
        dx, dy, dz = NEIGHBOURS[n]
        other = neighbour_row(
            bricks, positions[slot], (node >> 4) + dx, ((node >> 2) & 3) + dy, (node & 3) + dz
        )
        if other >= 0:
            for channel in range(4):
                d = values[row, channel] - values[other, channel]
                gradient[channel] += smoothness[channel] * d / math.sqrt(d * d + edge[channel] ** 2)


@device
def adam_value(value, gradient, mean, square, corrections, rate, beta1, beta2, low, high):
    """One value after an Adam step, and its moments; `corrections` are 1 - beta ** steps."""
    mean = beta1 * mean + (1 - beta1) * gradient
    square = beta2 * square + (1 - beta2) * gradient * gradient
    move = rate * (mean / corrections[0]) / (math.sqrt(square / corrections[1]) + 1e-10)
    return min(max(value - move, low), high), mean, square


@kernel
def gather(
    values, bricks, positions, active, gradients, touched, smoothness, edge, anchors, anchor_weight
):  # fmt: skip
    """Sum each active brick's gradients into block 0 and add the smoothness prior's.

    The prior is sum over neighbours of sqrt(difference^2 + edge^2) per channel: total variation
    with a rounded tip. The same form pulls raw density towards its anchor, so that what no ray
    sees stays the body itself. Only reads `values`, so bricks may run in any order.

    Args:
        positions: (bricks, 3) brick coordinates. active: (any,) slots to visit.
        gradients: (blocks, rows, 4); blocks other than 0 are left zero. touched: likewise.
        smoothness: (4,) weight per channel. edge: (4,) width of the rounded tip per channel.
        anchors: (rows,) raw density of the body itself. anchor_weight: of the pull to it.
    """
    blocks = gradients.shape[0]
    for a in numba.prange(active.shape[0]):
        slot = active[a]
        for b in range(1, blocks):
            if touched[b, slot]:
                for row in range(slot * 64, slot * 64 + 64):
                    for channel in range(4):
                        gradients[0, row, channel] += gradients[b, row, channel]
                        gradients[b, row, channel] = 0
            touched[b, slot] = 0
        touched[0, slot] = 0
        for node in range(64):
            add_priors(
                values, bricks, positions, slot, node, smoothness, edge, anchors, anchor_weight,
                gradients[0, slot * 64 + node],
            )  # fmt: skip


@kernel
def adam_step(values, active, gradients, first, second, counts, rates, beta1, beta2, low, high):
    """One Adam step (Kingma and Ba 2015) on the active bricks; clears their gradients.

    Moments of bricks that no ray touched are left alone (lazy Adam), so the bias correction counts
    each brick's own steps.

    Args:
        first, second: (rows, 4) moments. counts: (bricks,) steps taken. rates: (4,) step sizes.
        low, high: (4,) bounds of the values.
    """
    for a in numba.prange(active.shape[0]):
        slot = active[a]
        counts[slot] += 1
        corrections = (1 - beta1 ** counts[slot], 1 - beta2 ** counts[slot])
        for row in range(slot * 64, slot * 64 + 64):
            for channel in range(4):
                g = gradients[0, row, channel]
                gradients[0, row, channel] = 0
                values[row, channel], first[row, channel], second[row, channel] = adam_value(
                    values[row, channel], g, first[row, channel], second[row, channel],
                    corrections, rates[channel], beta1, beta2, low[channel], high[channel],
                )  # fmt: skip
