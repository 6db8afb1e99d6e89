"""Occlusion-true visibility of keypoints, from a view's depth and part images.

A joint lies inside flesh, so the first surface on its ray is nearer than the joint even where
nothing hides it. It counts as visible if that surface is its own limb's: no further in front than
the limb's radius, or of the same or an adjacent body part and within the part's reach. Points on
the skin (nose, eyes, ears) have a small radius and no reach: the back of the head is the same part.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int8, UInt8
from numpy import ndarray

from ntop.annotation.keypoints import ProjectedKeypoints
from ntop.body.skeletons import (
    COCO17_NAMES,
    COCO17_PARTS,
    SMPL24_NAMES,
    SMPL24_PARENTS,
    SMPL24_PARTS,
)

OUTSIDE, OCCLUDED, VISIBLE = 0, 1, 2

# Metres of own flesh and clothing between a keypoint and the surface that shows it.
LIMB_RADIUS_M = {
    "pelvis": 0.15, "hip": 0.14, "spine1": 0.15, "spine2": 0.15, "spine3": 0.15, "neck": 0.10,
    "collar": 0.11, "head": 0.13, "shoulder": 0.09, "elbow": 0.07, "wrist": 0.06, "hand": 0.06,
    "knee": 0.09, "ankle": 0.08, "foot": 0.07, "nose": 0.03, "eye": 0.03, "ear": 0.03,
}  # fmt: skip
# A ray that runs along a limb (a thigh seen from above) meets its surface further in front.
REACH = 1.6  # of the radius
SKIN_POINTS = ("nose", "eye", "ear")


@dataclass(frozen=True)
class Limbs:
    """Per keypoint of a skeleton: which parts are its own, and how deep in them it lies."""

    radius_m: Float[ndarray, " keypoint"]
    reach_m: Float[ndarray, " keypoint"]
    own_parts: Bool[ndarray, "keypoint 25"]  # indexed by the value in the part image


def limbs(names: tuple[str, ...], parts: tuple[int, ...]) -> Limbs:
    """The limbs of a skeleton's keypoints, from their names and the bones they sit on."""
    kinds = [name.removeprefix("left_").removeprefix("right_") for name in names]
    radius_m = np.array([LIMB_RADIUS_M[kind] for kind in kinds])
    reach = np.array([1.0 if kind in SKIN_POINTS else REACH for kind in kinds])
    own_parts = np.zeros((len(names), len(SMPL24_PARENTS) + 1), bool)
    for keypoint, part in enumerate(parts):
        for other, parent in enumerate(SMPL24_PARENTS):
            near = part in (other, parent) or SMPL24_PARENTS[part] == other
            own_parts[keypoint, other + 1] = near
    return Limbs(radius_m, radius_m * reach, own_parts)


SMPL24_LIMBS = limbs(SMPL24_NAMES, SMPL24_PARTS)
COCO17_LIMBS = limbs(COCO17_NAMES, COCO17_PARTS)


def keypoint_visibility(
    projected: ProjectedKeypoints,
    limbs: Limbs,
    *,
    depth_m: Float[ndarray, "height width"],
    parts: UInt8[ndarray, "height width"],
) -> Int8[ndarray, " keypoint"]:
    """0 outside the image circle or the image, 1 occluded, 2 visible.

    The keypoint's pixel and its eight neighbours are asked (5 mm at 1.5 m): any of them that shows
    the keypoint's own limb makes it visible, and so does the absence of any surface, which is the
    case of a nose's tip beyond the outline.
    """
    height, width = depth_m.shape
    pixels = projected.pixels.numpy()
    in_view = projected.in_view.numpy()
    centre = np.where(in_view[:, None], pixels, 0).astype(np.int64)  # floor: pixels are >= 0
    offsets = np.arange(-1, 2)
    u = np.clip(centre[:, 0, None] + np.tile(offsets, 3), 0, width - 1)
    v = np.clip(centre[:, 1, None] + np.repeat(offsets, 3), 0, height - 1)
    surface_m, part = depth_m[v, u], parts[v, u]

    in_front_m = projected.distances_m.numpy()[:, None] - surface_m
    own = np.take_along_axis(limbs.own_parts, part.astype(np.int64), axis=1)
    shows = (in_front_m <= limbs.radius_m[:, None]) | (own & (in_front_m <= limbs.reach_m[:, None]))
    empty = surface_m == 0
    visible = (shows & ~empty).any(1) | empty.all(1)
    return np.where(in_view, np.where(visible, VISIBLE, OCCLUDED), OUTSIDE).astype(np.int8)
