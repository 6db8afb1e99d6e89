"""March rays through a posed avatar and composite: what every rendered pixel is made of.

Inside an octant of the warp grid, and inside a whole cell that bends nothing, a ray is a straight
line in canonical space, and between two faces of canonical voxels raw density is smooth along it. A
ray is therefore cut into *pieces*, at the faces of octants (or cells) and voxels, at the nodes t =
(k + offset) * step of a lattice that bounds their lengths, and where one would take too much of the
light that is left. No kink of the field lies inside a piece, so two Gauss points give its optical
depth tau. With S the depth before it and T = exp(-S), its weight is w = T * (1 - exp(-tau)), and
its colour that of the mean place at which it takes its light. Specification: `ntop.field.twin`, the
same integral by brute force.

Everything up to `march_ray` is scalar code over arrays and tuples without memory of its own, so
that every compiler of numba can take it.
"""

import math

import numba

from ntop.field.kernels import device, kernel
from ntop.field.kernels.exponentials import expm1_of_minus, logistic
from ntop.field.kernels.packed import (
    brick_of,
    is_full,
    raw_colour,
    raw_density,
    trilinear,
    voxel_corners,
    voxel_of,
)
from ntop.field.kernels.pieces import (
    ON_FACE,
    along,
    mean_place,
    path_between,
    raw_on_path,
    rendered_density,
    stays_empty,
    to_next_voxel,
)
from ntop.field.kernels.tables import (
    DENSITY_SCALE,
    TINY_M,
    leave_cell,
    next_octant,
    shade,
    start_ray,
)

RAYS_PER_CHUNK = 128
MEDIAN_DEPTH = math.log(2.0)  # optical depth at which half of the light is gone
GAUSS_POINT = 1 / math.sqrt(3)  # of two, on [-1, 1]


@device
def sheet_place(sheets, cell, sheet, fx, fy, fz):
    """Canonical place (3, voxels) of a point of a cell on one of its sheets."""
    return trilinear(sheets.corners, sheets.rows[cell, sheet], 0, fx, fy, fz)


@device
def surface_normal(sheets, cell, sheet, fx, fy, fz):
    """World normal (3) at a point of a cell, of unit length."""
    x, y, z = trilinear(sheets.corners, sheets.rows[cell, sheet], 24, fx, fy, fz)
    scale = 1 / math.sqrt(x * x + y * y + z * z + 1e-12)  # opposite normals may cancel
    return x * scale, y * scale, z * scale


@device
def denser_place(grid, density, first, second, two, s):
    """Which of a ray's one or two sheets is the denser after `s` metres, and the place there."""
    x, y, z = along(first, s)
    if two:
        other_x, other_y, other_z = along(second, s)
        if raw_density(grid, density, other_x, other_y, other_z) > raw_density(
            grid, density, x, y, z
        ):
            return 1, other_x, other_y, other_z
    return 0, x, y, z


@device
def part_at(grid, labels, labels_origin, inverse_spacing, x, y, z):
    """Part value (label + 1) of the label node nearest to a canonical place (voxels)."""
    x = grid.origin[0] + x / grid.inverse_voxel
    y = grid.origin[1] + y / grid.inverse_voxel
    z = grid.origin[2] + z / grid.inverse_voxel
    i = int((x - labels_origin[0]) * inverse_spacing + 0.5)
    j = int((y - labels_origin[1]) * inverse_spacing + 0.5)
    k = int((z - labels_origin[2]) * inverse_spacing + 0.5)
    i = min(max(i, 0), labels.shape[0] - 1)
    j = min(max(j, 0), labels.shape[1] - 1)
    k = min(max(k, 0), labels.shape[2] - 1)
    return labels[i, j, k]


@device
def march_ray(
    grid, warp, density, sheets, light, labels, labels_origin, inverse_spacing, pose, origin,
    direction, offset, span, step, piece_depth, stop, colour_floor, skipping,
):  # fmt: skip
    """One ray; arguments as of `render_rays`.

    Returns red, green, blue (premultiplied), opacity, depth, part, and the numbers of voxels looked
    up and of samples, densities computed in them.
    """
    ray, t, far = start_ray(warp, pose, origin, direction)
    t, far = max(t, span[0]), min(far, span[1])
    red = green = blue = 0.0
    coloured = carried = 0.0
    thickness, transmittance = 0.0, 1.0
    depth, part = 0.0, 0
    voxels = samples = 0
    last_cell, last_t = -1, -1.0
    end_a = end_b = (0.0, 0.0, 0.0)
    while transmittance >= stop:
        t, leave, cell, fx, fy, fz = next_octant(warp, pose, ray, t, far, skipping)
        if cell == -1:
            break
        if cell == -2:
            voxels += 1
            t = leave
            continue
        if sheets.straight[cell]:
            leave = leave_cell(ray, t, far, fx, fy, fz)
        length = leave - t
        two = sheets.rows[cell, 1] >= 0
        if cell == last_cell and t == last_t:
            start_a, start_b = end_a, end_b
        else:
            start_a = sheet_place(sheets, cell, 0, fx, fy, fz)
            start_b = start_a
            if two:
                start_b = sheet_place(sheets, cell, 1, fx, fy, fz)
        gx, gy, gz = fx + length * ray[3], fy + length * ray[4], fz + length * ray[5]
        end_a = sheet_place(sheets, cell, 0, gx, gy, gz)
        last_cell, last_t = cell, leave
        path_a = path_between(start_a, end_a, length)
        path_b = path_a
        if two:
            end_b = sheet_place(sheets, cell, 1, gx, gy, gz)
            path_b = path_between(start_b, end_b, length)
        s = 0.0
        while s < length and transmittance >= stop:
            # to the next face of a voxel
            border = to_next_voxel(path_a, s)
            if two:
                border = min(border, to_next_voxel(path_b, s))
            border = min(s + max(border, TINY_M), length)
            x, y, z = along(path_a, 0.5 * (s + border))
            i, j, k = voxel_of(grid, x, y, z)
            slot = brick_of(density, i, j, k)
            voxels += 1
            if not two and not is_full(density, slot, i, j, k):
                s = border
                continue
            c0, c1, c2, c3, c4, c5, c6, c7 = voxel_corners(density, slot, i, j, k)
            x, y, z = along(path_a, s)
            raw_0, raw_1, raw_2, raw_3 = raw_on_path(
                (c0, c1, c2, c3, c4, c5, c6, c7), (x - i, y - j, z - k), path_a
            )
            if not two and stays_empty(raw_0, raw_1, raw_2, raw_3, border - s):
                s = border
                continue
            entry = s
            while s < border and transmittance >= stop:
                # to the next node of the lattice
                node = (math.floor((t + s) / step - offset + ON_FACE) + 1 + offset) * step - t
                end = max(min(node, border), s + TINY_M)
                u = s - entry
                piece_0 = raw_0 + u * (raw_1 + u * (raw_2 + u * raw_3))
                piece_1 = raw_1 + u * (2 * raw_2 + u * 3 * raw_3)
                piece_2 = raw_2 + 3 * u * raw_3
                if not two and stays_empty(piece_0, piece_1, piece_2, raw_3, end - s):
                    s = end
                    continue
                # and not through more than so much light, by the denser end
                u = end - s
                highest = max(piece_0, piece_0 + u * (piece_1 + u * (piece_2 + u * raw_3)))
                light_ahead = transmittance * DENSITY_SCALE * max(highest, 0.0) * u
                if light_ahead > piece_depth:
                    end = s + max(u / math.ceil(light_ahead / piece_depth), TINY_M)
                half = 0.5 * (end - s)
                u, q = half * (1 - GAUSS_POINT), half * (1 + GAUSS_POINT)
                raw_u = piece_0 + u * (piece_1 + u * (piece_2 + u * raw_3))
                raw_q = piece_0 + q * (piece_1 + q * (piece_2 + q * raw_3))
                if two:
                    x, y, z = along(path_b, s + u)
                    raw_u = max(raw_u, raw_density(grid, density, x, y, z))
                    x, y, z = along(path_b, s + q)
                    raw_q = max(raw_q, raw_density(grid, density, x, y, z))
                samples += 2
                density_u, density_q = rendered_density(raw_u), rendered_density(raw_q)
                mass, slope = density_u + density_q, density_q - density_u
                if not mass <= 0:  # NaN must stay visible
                    tau = DENSITY_SCALE * mass * half
                    if thickness < MEDIAN_DEPTH <= thickness + tau:
                        q = s + (end - s) * (MEDIAN_DEPTH - thickness) / tau
                        _, x, y, z = denser_place(grid, density, path_a, path_b, two, q)
                        part = part_at(grid, labels, labels_origin, inverse_spacing, x, y, z)
                        depth = t + q
                    # the halves of the piece, with a density that rises or falls evenly
                    first = tau * (0.5 - 0.25 / GAUSS_POINT * slope / mass)
                    first = min(max(first, 0.0), tau)
                    second = tau - first
                    lost_first, lost_second = expm1_of_minus(first), expm1_of_minus(second)
                    weight_first = transmittance * -lost_first
                    weight_second = (transmittance - weight_first) * -lost_second
                    weight = weight_first + weight_second
                    # a little light takes the colour of what comes next on its ray
                    if carried + weight > colour_floor:
                        q = s + half * (
                            weight_first * mean_place(first, lost_first)
                            + weight_second * (1 + mean_place(second, lost_second))
                        ) / weight  # fmt: skip
                        sheet, x, y, z = denser_place(grid, density, path_a, path_b, two, q)
                        raw_red, raw_green, raw_blue = raw_colour(grid, x, y, z)
                        nx, ny, nz = surface_normal(
                            sheets, cell, sheet, fx + q * ray[3], fy + q * ray[4], fz + q * ray[5]
                        )
                        weight += carried
                        red += weight * logistic(raw_red) * shade(light, 0, nx, ny, nz)
                        green += weight * logistic(raw_green) * shade(light, 1, nx, ny, nz)
                        blue += weight * logistic(raw_blue) * shade(light, 2, nx, ny, nz)
                        coloured += weight
                        carried = 0.0
                    else:
                        carried += weight
                    thickness += tau
                    transmittance *= (1 + lost_first) * (1 + lost_second)
                s = end
            s = max(s, border)
        t = leave
    if coloured > 0:  # what is still carried takes the colour of what came before
        share = 1 + carried / coloured
        red, green, blue = red * share, green * share, blue * share
    return red, green, blue, -expm1_of_minus(thickness), depth, part, voxels, samples


@kernel
def render_rays(
    grid, warp, density, sheets, light, labels, labels_origin, inverse_spacing, poses, origins,
    directions, offsets, spans, step, piece_depth, stop, colour_floor, skipping, colours, opacity,
    depth, parts, evaluations,
):  # fmt: skip
    """Colour, opacity, median depth and part of each ray.

    Args:
        grid, warp: Tables. density, sheets: The same, packed. light: (9, 3) see `shade`.
        labels: part values on a canonical grid. labels_origin, inverse_spacing: Of that
            grid (metres, 1/m).
        poses: (1 or rays,) which pose of `warp`.
        origins: (1 or rays, 3) relative to the warp grid's origin. directions: (rays, 3) unit.
        offsets: (rays,) of the lattice that bounds pieces, in steps. step: of it, metres.
        spans: (1 or rays, 2) lengths (m) before the first and after the second of which the scene
            is known to be empty.
        piece_depth: optical depth that a piece may have by its denser end, while all the light is
            there; the less light is left, the deeper.
        stop: transmittance below which a ray ends.
        colour_floor: light up to which pieces share the colour of the next one that is looked up.
        skipping: whether rays jump over octants that are not occupied.
        colours, opacity, depth, parts: Outputs; colours are premultiplied, depth is metres along
            the ray where half of the light is gone, 0 where less is lost.
        evaluations: (chunks, 2) voxels looked up and samples, for the cost reports.
    """
    count = directions.shape[0]
    for chunk in numba.prange((count + RAYS_PER_CHUNK - 1) // RAYS_PER_CHUNK):
        voxels = samples = 0
        for r in range(chunk * RAYS_PER_CHUNK, min(count, (chunk + 1) * RAYS_PER_CHUNK)):
            red, green, blue, opaque, median, part, looked_up, sampled = march_ray(
                grid, warp, density, sheets, light, labels, labels_origin, inverse_spacing,
                poses[r if poses.shape[0] > 1 else 0], origins[r if origins.shape[0] > 1 else 0],
                directions[r], offsets[r], spans[r if spans.shape[0] > 1 else 0], step,
                piece_depth, stop, colour_floor, skipping,
            )  # fmt: skip
            colours[r, 0], colours[r, 1], colours[r, 2] = red, green, blue
            opacity[r], depth[r], parts[r] = opaque, median, part
            voxels += looked_up
            samples += sampled
        evaluations[chunk, 0], evaluations[chunk, 1] = voxels, samples
