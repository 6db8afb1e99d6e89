"""From a coarse probability image to a sharp soft matte of one person.

The network's segmentation has a pixel of about 1/256 of the person's region, four to five pixels of
the frame. The guided filter (He, Sun and Tang 2013) fits it, window by window, by a linear function
of the frame's colours, so that its edge moves onto the edge in the picture. Where the scene behind
the person is known (plates.py), it first decides what is scene; last, the outline's pixels are
split between person and scene by their colour (edges.py).
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from ntop.masks.edges import disc, mixed_edges
from ntop.masks.plates import MIN_FRAMES, SHOWS_SCENE, Plate, person_log_odds, with_evidence
from ntop.masks.regions import box_around

GUIDE_EPSILON = 1e-4  # colour variance (of [0, 1]) below which a window counts as flat
STEEPNESS = 2.5  # the filter spreads an edge over its window; this narrows it again
MARGIN_WINDOWS = 3  # the filter mixes windows that overlap windows: two radii, and one to spare
MIN_POINT_CONFIDENCE = 0.5
HOLE_SIDE = 1.5  # radii: smaller holes are noise, larger ones show what is behind the person


def sharpen_matte(
    image: UInt8[np.ndarray, "height width 3"],
    person: UInt8[np.ndarray, "height width"],
    *,
    plate: Plate | None,
    radius_px: int,
) -> Float32[np.ndarray, "height width"]:
    """The matte whose edges follow the picture's, from a probability image in 1/255.

    `radius_px` is the reach of the correction: about two pixels of the coarse segmentation.
    """
    matte = np.zeros(person.shape, np.float32)
    box = box_around(person > 255 * SHOWS_SCENE, margin_px=MARGIN_WINDOWS * radius_px)
    if box is None:
        return matte
    coarse = person[box].astype(np.float32) / 255
    scene, known = image[box].astype(np.float32), np.zeros(coarse.shape, bool)
    if plate is not None:
        coarse = with_evidence(coarse, person_log_odds(image, plate, box=box))
        scene, known = plate.colour[box], plate.frames[box] >= MIN_FRAMES
    # half the reach: a wide window takes fingers and wrists away
    half_px = max(1, radius_px // 2)
    guide = image[box].astype(np.float32) / 255
    fitted = cv2.ximgproc.guidedFilter(guide, coarse, half_px, GUIDE_EPSILON)
    sharp = np.clip((fitted - 0.5) * STEEPNESS + 0.5, 0, 1)
    matte[box] = mixed_edges(image[box], sharp, scene=scene, scene_known=known, depth_px=half_px)
    return matte


def keep_person(
    matte: Float32[np.ndarray, "height width"],
    keypoints_px: Float[np.ndarray, "n 2"],
    confidence: Float[np.ndarray, " n"],
    *,
    radius_px: int,
) -> Float32[np.ndarray, "height width"]:
    """The matte without what is not connected to a keypoint, and without pinholes.

    Of the connected parts of matte >= 0.5, those that hold a confident keypoint stay (a limb may be
    cut off by something in front of it), with the soft rim around them.
    """
    solid = matte >= 0.5
    count, labels = cv2.connectedComponents(solid.astype(np.uint8), connectivity=8)
    height, width = matte.shape
    u, v = np.floor(keypoints_px).astype(int).T
    usable = (confidence >= MIN_POINT_CONFIDENCE) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    kept = np.zeros(count, bool)
    kept[labels[v[usable], u[usable]]] = True
    kept[0] = False
    person = kept[labels]
    filled = fill_small_holes(person, area_px=round((HOLE_SIDE * radius_px) ** 2))
    # the soft rim belongs to the part it touches
    reach = cv2.dilate(filled.astype(np.uint8), disc(radius_px)) > 0
    cleaned = np.where(reach & ~(solid & ~person), matte, 0)
    return np.where(filled & ~person, 1, cleaned).astype(np.float32)


def fill_small_holes(
    mask: Bool[np.ndarray, "height width"], *, area_px: int
) -> Bool[np.ndarray, "height width"]:
    """The mask with enclosed holes of at most `area_px` pixels filled."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= area_px
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + stats[:, cv2.CC_STAT_WIDTH], top + stats[:, cv2.CC_STAT_HEIGHT]
    height, width = mask.shape
    small &= (left > 0) & (top > 0) & (right < width) & (bottom < height)
    small[0] = False
    return mask | small[labels]
