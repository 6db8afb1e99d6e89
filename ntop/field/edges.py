"""Pixels that one ray does not do justice, and the four rays that they get."""

import numpy as np
from jaxtyping import Bool, Float, Int

# four rays of a pixel on a rotated grid: distinct rows and columns, unbiased about the centre
EDGE_OFFSETS_PX = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))
EDGE_ALPHA = (0.02, 0.98)
EDGE_CONTRAST = 0.3  # colour difference to a neighbour from which a pixel counts as an edge


def middle_ray(
    alpha: Float[np.ndarray, " ray"], depth_m: Float[np.ndarray, " ray"]
) -> Int[np.ndarray, " pixel"]:
    """Which of a pixel's four rays speaks for it: the nearer median of those that meet the body."""
    depths = np.where(alpha >= 0.5, depth_m, np.inf).reshape(-1, 4)
    order = np.argsort(depths, axis=1, kind="stable")
    middle = (np.maximum(np.isfinite(depths).sum(1), 1) - 1) // 2
    return np.take_along_axis(order, middle[:, None], 1)[:, 0]


def edge_pixels(
    premultiplied: Float[np.ndarray, "height width 3"], alpha: Float[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Pixels that are partly covered, or differ from a neighbour in opacity or colour."""
    edges = (alpha > EDGE_ALPHA[0]) & (alpha < EDGE_ALPHA[1])
    layers = np.concatenate([premultiplied, alpha[..., None]], -1)
    for axis in (0, 1):
        step = np.abs(np.diff(layers, axis=axis)).max(-1) > EDGE_CONTRAST
        first = tuple(slice(None, -1) if a == axis else slice(None) for a in (0, 1))
        second = tuple(slice(1, None) if a == axis else slice(None) for a in (0, 1))
        edges[first] |= step
        edges[second] |= step
    return edges
