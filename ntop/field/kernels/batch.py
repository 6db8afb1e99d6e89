"""Turn random numbers into training rays: pick a view's pixels, look up colours and directions."""

import math

import numba

from ntop.conventions import PIXEL_CENTRE
from ntop.field.kernels import kernel


@kernel
def gather_rays(
    draws, views, view_pose, view_camera, view_box, pixel_offset, pixels, inside_offset, inside,
    band_offset, band, shares, lookup_offset, lookup_size, lookup, spacing, centres, pose_origins,
    poses, cameras, origins, directions, targets, mattes, colour_weights, matte_weights,
    band_weights, zones,
):  # fmt: skip
    """Rays of one step; each ray uses only its own draws, so order does not matter.

    Args:
        draws: (rays, 2) uniform: zone, pixel. views: (rays,) view of each.
        view_pose, view_camera: (views,). view_box: (views, 4) left, top, width, height of the crop.
        pixel_offset: (views,) first pixel of the crop in `pixels` (any, 4) uint8 RGB + matte.
        inside_offset, inside, band_offset, band: (views + 1,) and crop pixel numbers, per zone.
        shares: (2,) share of rays inside the person, and in the band along its edge.
        lookup_offset, lookup_size (cameras, 2: rows, columns), lookup (any, 3): unit directions on
            a grid of `spacing` px from the image's corner. centres: (cameras, 3) world.
        pose_origins: (poses, 3) world. band_weights: (2,) colour and matte weight in the band.
        zones: (rays,) output: 0 outside, 1 inside, 2 band. Other names: outputs per ray.
    """
    for r in numba.prange(draws.shape[0]):
        view = views[r]
        left, top = view_box[view, 0], view_box[view, 1]
        width, height = view_box[view, 2], view_box[view, 3]
        count_inside = inside_offset[view + 1] - inside_offset[view]
        count_band = band_offset[view + 1] - band_offset[view]
        pick = draws[r, 1]
        if draws[r, 0] < shares[0] and count_inside > 0:
            pixel = inside[inside_offset[view] + min(int(pick * count_inside), count_inside - 1)]
            zone = 1
        elif draws[r, 0] < shares[0] + shares[1] and count_band > 0:
            pixel = band[band_offset[view] + min(int(pick * count_band), count_band - 1)]
            zone = 2
        else:
            pixel = min(int(pick * width * height), width * height - 1)
            zone = 0
        colour = pixels[pixel_offset[view] + pixel]
        matte = colour[3] / 255.0
        if zone == 0 and matte > 0.02:
            zone = 1 if matte > 0.98 else 2
        for c in range(3):
            targets[r, c] = colour[c] / 255.0
        mattes[r] = matte
        colour_weights[r] = band_weights[0] if zone == 2 else 1.0
        matte_weights[r] = band_weights[1] if zone == 2 else 1.0
        zones[r] = zone
        camera = view_camera[view]
        poses[r], cameras[r] = view_pose[view], camera
        # Through the centre: rays elsewhere in the pixel would be told the mean of all of it, and
        # the field would learn the photograph blurred once more (decision 0021).
        u = (left + pixel % width + PIXEL_CENTRE) / spacing
        v = (top + pixel // width + PIXEL_CENTRE) / spacing
        i = min(max(int(v), 0), lookup_size[camera, 0] - 2)
        j = min(max(int(u), 0), lookup_size[camera, 1] - 2)
        fv, fu = v - i, u - j
        row = lookup_offset[camera] + i * lookup_size[camera, 1] + j
        below = row + lookup_size[camera, 1]
        length = 0.0
        for a in range(3):
            d = (1 - fv) * ((1 - fu) * lookup[row, a] + fu * lookup[row + 1, a]) + fv * (
                (1 - fu) * lookup[below, a] + fu * lookup[below + 1, a]
            )
            directions[r, a] = d
            length += d * d
            origins[r, a] = centres[camera, a] - pose_origins[view_pose[view], a]
        for a in range(3):
            directions[r, a] /= math.sqrt(length)
