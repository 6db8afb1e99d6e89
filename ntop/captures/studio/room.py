"""The empty studio: a box with a plain floor and painted walls, seen by any camera."""

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from ntop.geometry.cameras import Camera, pixel_grid

HALF_WIDTH_M = 4.2  # along x and y
HEIGHT_M = 3.4
FLOOR = (0.60, 0.575, 0.54)
WALLS = ((0.70, 0.72, 0.74), (0.66, 0.69, 0.72), (0.73, 0.73, 0.73), (0.68, 0.70, 0.71))
CEILING = (0.86, 0.86, 0.85)
SKIRTING = (0.42, 0.40, 0.38)
SKIRTING_M = 0.12


def empty_room(camera: Camera) -> Float[ndarray, "height width 3"]:
    """The clean plate of a camera inside the room, sRGB 0..1."""
    grid = pixel_grid(camera.lens.width, camera.lens.height, torch.float64)
    directions = camera.rays(grid)[0].numpy()
    origin = camera.center_world.numpy()
    low = np.array([-HALF_WIDTH_M, -HALF_WIDTH_M, 0.0])
    high = np.array([HALF_WIDTH_M, HALF_WIDTH_M, HEIGHT_M])
    # from inside a box, the nearest of the three planes ahead is hit
    ahead = np.where(directions > 0, high, low) - origin
    distance = ahead / np.where(np.abs(directions) > 1e-12, directions, 1e-12)
    axis = distance.argmin(-1)
    place = origin + directions * distance.min(-1)[..., None]
    positive = np.take_along_axis(directions, axis[..., None], -1)[..., 0] > 0

    from_centre = np.hypot(place[..., 0], place[..., 1]) / HALF_WIDTH_M
    height = place[..., 2] / HEIGHT_M
    floor = np.array(FLOOR) * (1.08 - 0.22 * from_centre[..., None] ** 2)
    ceiling = np.array(CEILING) * (1.0 - 0.08 * from_centre[..., None])
    wall = np.array(WALLS)[2 * np.minimum(axis, 1) + positive]
    wall = wall * (0.90 + 0.16 * height[..., None])
    wall = np.where((place[..., 2] < SKIRTING_M)[..., None], np.array(SKIRTING), wall)
    level = np.where(positive[..., None], ceiling, floor)
    return np.clip(np.where((axis == 2)[..., None], level, wall), 0, 1)
