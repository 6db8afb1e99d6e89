"""A ray inside an octant: a straight path in canonical space, its voxels and its pieces.

Lengths are metres along the ray, places are in voxels of the canonical grid.
"""

import math

from ntop.field.kernels import device
from ntop.field.kernels.exponentials import softplus_of
from ntop.field.kernels.tables import EMPTY_DENSITY, EMPTY_RAW, HUGE, safe_inverse

THIN = 1e-3  # optical depth below which a series replaces a difference that cancels
ON_FACE = 1e-6  # how near a face or node counts as on it, in voxels or steps


@device
def path_between(start, end, length):
    """A straight path: place on entry (3, voxels), voxels per metre (3), and their inverse (3)."""
    inverse = 1 / length
    dx, dy, dz = (
        (end[0] - start[0]) * inverse,
        (end[1] - start[1]) * inverse,
        (end[2] - start[2]) * inverse,
    )
    return (
        start[0], start[1], start[2], dx, dy, dz,
        safe_inverse(dx), safe_inverse(dy), safe_inverse(dz),
    )  # fmt: skip


@device
def along(path, s):
    """The place (3, voxels) after `s` metres of a path."""
    return path[0] + s * path[3], path[1] + s * path[4], path[2] + s * path[5]


@device
def to_next_face(place, velocity, inverse):
    """Metres until a coordinate in voxels crosses a face; far away where it stands still."""
    if velocity > 0:
        return (math.floor(place + ON_FACE) + 1 - place) * inverse
    if velocity < 0:
        return (math.ceil(place - ON_FACE) - 1 - place) * inverse
    return HUGE


@device
def to_next_voxel(path, s):
    """Metres until a path that has gone `s` leaves its voxel."""
    x, y, z = along(path, s)
    return min(
        to_next_face(x, path[3], path[6]),
        min(to_next_face(y, path[4], path[7]), to_next_face(z, path[5], path[8])),
    )


@device
def raw_on_path(corners, place, path):
    """Raw density on a straight path through a voxel, as a cubic of the metres gone in it.

    Args:
        corners: (8,) raw density of its nodes. place: (3,) where the path enters, in voxels from
            the first node. path: see `path_between`.

    Returns:
        The four coefficients, from the constant one up.
    """
    c0, c1, c2, c3, c4, c5, c6, c7 = corners
    # of 1, z, y, yz, x, xz, xy, xyz
    c7 = c7 - c6 - c5 + c4 - c3 + c2 + c1 - c0
    c6 = c6 - c4 - c2 + c0
    c5 = c5 - c4 - c1 + c0
    c3 = c3 - c2 - c1 + c0
    c4, c2, c1 = c4 - c0, c2 - c0, c1 - c0
    x, y, z = place
    dx, dy, dz = path[3], path[4], path[5]
    return (
        c0 + x * (c4 + y * (c6 + z * c7) + z * c5) + y * (c2 + z * c3) + z * c1,
        dx * (c4 + y * (c6 + z * c7) + z * c5)
        + dy * (c2 + x * (c6 + z * c7) + z * c3)
        + dz * (c1 + x * (c5 + y * c7) + y * c3),
        dx * dy * (c6 + z * c7) + dx * dz * (c5 + y * c7) + dy * dz * (c3 + x * c7),
        c7 * dx * dy * dz,
    )


@device
def stays_empty(raw_0, raw_1, raw_2, raw_3, length):
    """Is a cubic nowhere above EMPTY_RAW on [0, length]? Its Bernstein coefficients bound it."""
    first, second, third = raw_1 * length, raw_2 * length * length, raw_3 * length**3
    return (
        raw_0 <= EMPTY_RAW
        and raw_0 + first / 3 <= EMPTY_RAW
        and raw_0 + (2 * first + second) / 3 <= EMPTY_RAW
        and raw_0 + first + second + third <= EMPTY_RAW
    )


@device
def mean_place(tau, lost):
    """Where a homogeneous piece of optical depth tau takes its light on average, as a share.

    `lost` is exp(-tau) - 1, so that 1 / tau - 1 / (exp(tau) - 1) needs no exponential of its own.
    """
    if tau < THIN:
        return 0.5 - tau / 12
    return 1 / tau + (1 + lost) / lost


@device
def rendered_density(raw):
    """Density per DENSITY_SCALE of a raw value: softplus less what is empty, and NaN for NaN."""
    return 0.0 if raw <= EMPTY_RAW else softplus_of(raw) - EMPTY_DENSITY
