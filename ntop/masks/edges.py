"""Soft edges from the mixing of colours: how much of a pixel at the outline is person.

At an edge colours mix linearly, I = a F + (1 - a) B (Porter and Duff 1984). With F from the person
a few pixels inside and B from the scene behind, or a few pixels outside, the matte a is one
projection per pixel. That corrects a coarse outline by several pixels, and a coding halo beside a
limb, which has the limb's hue but not its brightness, stays outside.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

OUTSIDE_PX = 2  # the band reaches this far beyond the coarse outline, and into it by `depth_px`
MIN_CONTRAST = 24.0  # distance of F and B (of 255) below which mixing tells nothing
MIN_SEPARATION = 1.5  # of F and B in units of their spread; twice as much is fully trusted
PLATE_SPREAD = 7.0  # of 255: what a known scene colour may be off
STEEPNESS = 1.2  # noise in colour must not leave holes inside nor veils outside
BLUR_SIGMA_PX = 0.8  # of the mixing ratio: coding noise frays the outline
MIN_WEIGHT = 0.01  # share of a window that must be person (or scene) to know its colour


def mixed_edges(
    image: UInt8[np.ndarray, "height width 3"],
    matte: Float32[np.ndarray, "height width"],
    *,
    scene: Float32[np.ndarray, "height width 3"],
    scene_known: Bool[np.ndarray, "height width"],
    depth_px: int,
) -> Float32[np.ndarray, "height width"]:
    """The matte with its edge band replaced by the mixing ratio, as far as colours can tell.

    `scene` is the colour behind the person (0..255) where `scene_known`; elsewhere the colours
    just outside stand for it. `depth_px` is how far inside the outline may lie.
    """
    colour = image.astype(np.float32)
    solid = (matte >= 0.5).astype(np.uint8)
    core = cv2.erode(solid, disc(depth_px))
    near = cv2.dilate(solid, disc(OUTSIDE_PX))
    radius_px = depth_px + OUTSIDE_PX
    person, person_spread, person_weight = _local_colour(colour, core, radius_px)
    outside, outside_spread, outside_weight = _local_colour(colour, 1 - near, radius_px)
    behind = np.where(scene_known[..., None], scene, outside)
    behind_spread = np.where(scene_known, PLATE_SPREAD, outside_spread)

    contrast = person - behind
    squared = (contrast**2).sum(-1)
    ratio = ((colour - behind) * contrast).sum(-1) / np.maximum(squared, 1)
    ratio = cv2.GaussianBlur(np.clip(ratio, -0.5, 1.5), (0, 0), BLUR_SIGMA_PX)
    ratio = np.clip((ratio - 0.5) * STEEPNESS + 0.5, 0, 1)
    distance = np.sqrt(squared)
    separation = distance / np.maximum(np.hypot(person_spread, behind_spread), 1)
    trust = np.clip(separation / MIN_SEPARATION - 1, 0, 1) * (distance > MIN_CONTRAST)
    trust *= (person_weight > MIN_WEIGHT) & (scene_known | (outside_weight > MIN_WEIGHT))
    trust = cv2.GaussianBlur(trust.astype(np.float32), (0, 0), float(OUTSIDE_PX))
    mixed = trust * ratio + (1 - trust) * matte
    return np.where(core > 0, 1, np.where(near > 0, mixed, 0)).astype(np.float32)


def disc(radius_px: int) -> UInt8[np.ndarray, "size size"]:
    """A round structuring element."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1,) * 2)


def _local_colour(
    colour: Float32[np.ndarray, "height width 3"],
    chosen: UInt8[np.ndarray, "height width"],
    radius_px: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, spread and share of the chosen pixels' colours in the window around every pixel."""
    window = (2 * radius_px + 1,) * 2
    weight = chosen.astype(np.float32)
    share = cv2.boxFilter(weight, -1, window)
    safe = np.maximum(share, 1e-6)[..., None]
    mean = cv2.boxFilter(colour * weight[..., None], -1, window) / safe
    squares = cv2.boxFilter(colour**2 * weight[..., None], -1, window) / safe
    return mean, np.sqrt(np.maximum(squares - mean**2, 0).sum(-1)), share
