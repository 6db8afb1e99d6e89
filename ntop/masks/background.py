"""The person as what differs from the empty scene: background subtraction with soft edges.

For a fixed camera and a plate: a picture of the empty scene, or the temporal median where the
person moves enough. Colours mix linearly at an edge, I = a F + (1 - a) B; with B from the plate and
F from the person just inside, the matte a is one projection per pixel.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from ntop.masks.edges import disc
from ntop.masks.mattes import fill_small_holes
from ntop.masks.regions import box_around

MIN_DIFFERENCE = 0.04  # colour distance (of [0, 1] per channel) that counts whatever the noise
NOISE_FACTOR = 6.0  # standard deviations of the scene's noise that count as a difference
MIN_PART = 0.02  # of the largest part's area: smaller ones are noise
MIN_CONTRAST = 0.08  # colour distance of person and plate below which mixing tells nothing
MAD_TO_SIGMA = 1.4826  # median absolute deviation of a normal distribution
GUIDE_EPSILON = 1e-4
SIDE_PER_RADIUS = 170  # image side in pixels per pixel of the edge band's half width


def temporal_median(
    images: list[UInt8[np.ndarray, "height width 3"]],
) -> UInt8[np.ndarray, "height width 3"]:
    """The plate where none was taken: the median of every pixel over time."""
    return np.rint(np.median(np.stack(images), axis=0)).astype(np.uint8)


def subtract_background(
    image: UInt8[np.ndarray, "height width 3"], plate: UInt8[np.ndarray, "height width 3"]
) -> Float32[np.ndarray, "height width"]:
    """Soft matte in [0, 1] of what stands in front of `plate`; all zero where nothing does."""
    colour, scene = image.astype(np.float32) / 255, plate.astype(np.float32) / 255
    difference = np.abs(colour - scene).max(-1)
    # most of the picture is scene: its median deviation is the noise
    noise = MAD_TO_SIGMA * float(np.median(difference))
    radius_px = max(1, round(max(difference.shape) / SIDE_PER_RADIUS))
    solid = _main_parts(difference > max(MIN_DIFFERENCE, NOISE_FACTOR * noise), radius_px)
    matte = np.zeros_like(difference)
    box = box_around(solid, margin_px=4 * radius_px)
    if box is not None:
        matte[box] = _soft_edges(colour[box], scene[box], solid[box], radius_px)
    return matte


def _main_parts(
    different: Bool[np.ndarray, "height width"], radius_px: int
) -> Bool[np.ndarray, "height width"]:
    """The large connected parts, closed and filled."""
    closed = cv2.morphologyEx(different.astype(np.uint8), cv2.MORPH_CLOSE, disc(radius_px))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    large = (areas > 0) & (areas >= MIN_PART * areas.max())
    return fill_small_holes(large[labels], area_px=(4 * radius_px) ** 2)


def _soft_edges(
    colour: Float32[np.ndarray, "height width 3"],
    scene: Float32[np.ndarray, "height width 3"],
    solid: Bool[np.ndarray, "height width"],
    radius_px: int,
) -> Float32[np.ndarray, "height width"]:
    """One inside, zero outside, the mixing ratio of person and scene in a band between."""
    inside = cv2.erode(solid.astype(np.uint8), disc(radius_px))
    near = cv2.dilate(solid.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    window = (4 * radius_px + 1,) * 2
    weight = cv2.boxFilter(inside.astype(np.float32), -1, window)
    person = cv2.boxFilter(colour * inside[..., None], -1, window)
    person /= np.maximum(weight, 1e-6)[..., None]

    contrast = person - scene
    strength = (contrast**2).sum(-1)
    mixing = ((colour - scene) * contrast).sum(-1) / np.maximum(strength, 1e-6)
    # without contrast, or in a part too thin to have an inside: the picture's own edges decide
    fitted = cv2.ximgproc.guidedFilter(colour, solid.astype(np.float32), radius_px, GUIDE_EPSILON)
    usable = (weight > 1e-3) & (strength > MIN_CONTRAST**2)
    matte = np.clip(np.where(usable, mixing, fitted), 0, 1)
    return np.where(inside > 0, 1, np.where(near, matte, 0)).astype(np.float32)
