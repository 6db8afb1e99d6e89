"""Band-limited building blocks of the solid textures: edges, stripes, discs, strokes.

Every edge is a smooth step over `EDGE_M`, so that no texture holds detail finer than a capture of
this size can show. Lengths are metres, colours sRGB in 0..1.
"""

from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray

EDGE_M = 0.008  # full width of an edge: 10 % to 90 % in about 5 mm
Colour = tuple[float, float, float]


def inside(distance_m: Float[ndarray, "*point"], edge_m: float = EDGE_M) -> ndarray:
    """1 where a signed distance is positive, 0 where negative, a smooth step between."""
    t = np.clip(distance_m / edge_m + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def stripes(
    coordinate_m: Float[ndarray, "*point"], *, period_m: float, width_m: float
) -> Float[ndarray, "*point"]:
    """1 on lines of the given width, centred on the multiples of the period."""
    from_line = np.abs(_from_multiple(coordinate_m, period_m))
    return inside(width_m / 2 - from_line)


def _from_multiple(
    coordinate_m: Float[ndarray, "*point"], period_m: float, *, shift: float = 0.0
) -> Float[ndarray, "*point"]:
    """Signed distance to the nearest multiple of the period, less `shift` periods."""
    return ((coordinate_m / period_m + shift + 0.5) % 1.0 - 0.5) * period_m


def dots(
    u_m: Float[ndarray, "*point"],
    v_m: Float[ndarray, "*point"],
    *,
    period_m: tuple[float, float],
    radius_m: float,
) -> Float[ndarray, "*point"]:
    """1 on discs in a staggered grid with the given period along u and v."""
    distances = []
    for shift in (0.0, 0.5):
        du = _from_multiple(u_m, period_m[0], shift=shift)
        dv = _from_multiple(v_m, period_m[1], shift=shift)
        distances.append(np.hypot(du, dv))
    return inside(radius_m - np.minimum(*distances))


def box(
    u_m: Float[ndarray, "*point"],
    v_m: Float[ndarray, "*point"],
    *,
    half_size_m: tuple[float, float],
    radius_m: float,
) -> Float[ndarray, "*point"]:
    """Signed distance to a rounded rectangle around the origin, positive inside."""
    du = np.abs(u_m) - (half_size_m[0] - radius_m)
    dv = np.abs(v_m) - (half_size_m[1] - radius_m)
    outside = np.hypot(np.maximum(du, 0), np.maximum(dv, 0))
    return radius_m - outside - np.minimum(np.maximum(du, dv), 0)


def strokes(
    u: Float[ndarray, "*point"],
    v: Float[ndarray, "*point"],
    lines: list[list[tuple[float, float]]],
) -> Float[ndarray, "*point"]:
    """Distance to the nearest of several polylines."""
    nearest = np.full(u.shape, np.inf, dtype=u.dtype)
    for line in lines:
        for (u0, v0), (u1, v1) in pairwise(line):
            du, dv = u1 - u0, v1 - v0
            along = np.clip(((u - u0) * du + (v - v0) * dv) / (du * du + dv * dv), 0, 1)
            np.minimum(nearest, np.hypot(u - u0 - along * du, v - v0 - along * dv), out=nearest)
    return nearest


def ripple(points_m: Float[ndarray, "*point 3"], *, wavelength_m: float, seed: int) -> ndarray:
    """Smooth noise in about -1..1: five plane waves with fixed random directions and phases."""
    generator = np.random.default_rng(seed)
    total = np.zeros(points_m.shape[:-1], dtype=points_m.dtype)
    for _ in range(5):
        direction = generator.normal(size=3)
        direction *= 2 * np.pi / (wavelength_m * np.linalg.norm(direction))
        phase = generator.uniform(0, 2 * np.pi)
        total += np.sin(points_m @ direction.astype(points_m.dtype) + points_m.dtype.type(phase))
    return total / 3


def paint(
    colours: Float[ndarray, "point 3"], weight: Float[ndarray, " point"], colour: Colour
) -> None:
    """Lay a colour over the colours where the weight is positive, in place."""
    chosen = np.flatnonzero(weight > 0)
    below = colours[chosen]
    below += weight[chosen, None] * (np.asarray(colour, dtype=colours.dtype) - below)
    colours[chosen] = below
