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
    "pelvis": 0.155, "hip": 0.120, "spine1": 0.152, "spine2": 0.145, "spine3": 0.148,
    "neck": 0.090, "collar": 0.123, "head": 0.090, "shoulder": 0.075, "elbow": 0.043,
    "wrist": 0.030, "hand": 0.034, "knee": 0.100, "ankle": 0.065, "foot": 0.050, "nose": 0.025,
    "eye": 0.025, "ear": 0.023,
}  # fmt: skip
# A ray that runs along a limb (an arm seen from above) meets its surface further in front.
REACH = 3.0  # of the radius,
REACH_BEYOND_M = 0.12  # but not further than this beyond it: a neck is hidden below its head
# parts that share flesh without being parent and child
TOUCHING = (("neck", "left_collar"), ("neck", "right_collar"), ("left_collar", "right_collar"))
SKIN_POINTS = ("nose", "eye", "ear")
NEIGHBOURS = np.array(
    [[0, 0], *((u, v) for v in (-1, 0, 1) for u in (-1, 0, 1) if (u, v) != (0, 0))]
)


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
    on_skin = np.array([kind in SKIN_POINTS for kind in kinds])
    near = np.eye(len(SMPL24_PARENTS), dtype=bool)
    pairs = [(child, parent) for child, parent in enumerate(SMPL24_PARENTS) if parent >= 0]
    pairs += [(SMPL24_NAMES.index(a), SMPL24_NAMES.index(b)) for a, b in TOUCHING]
    for a, b in pairs:
        near[a, b] = near[b, a] = True
    own_parts = np.pad(near[list(parts)], ((0, 0), (1, 0)))  # the image's 0 is nobody's part
    return Limbs(radius_m, np.where(on_skin, radius_m, reach_m(radius_m)), own_parts)


def reach_m(radius_m: Float[ndarray, " keypoint"]) -> Float[ndarray, " keypoint"]:
    """How far in front of a keypoint the surface of its own limb still shows it."""
    return np.minimum(REACH * radius_m, radius_m + REACH_BEYOND_M)


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

    The keypoint's own pixel decides. Where it shows no surface, any of its eight neighbours does;
    where they show none either, nothing hides the keypoint (a nose's tip beyond the outline).
    """
    height, width = depth_m.shape
    in_view = projected.in_view.numpy()
    own_pixel = np.where(in_view[:, None], projected.pixels.numpy(), 0).astype(np.int64)
    around = own_pixel[:, None] + NEIGHBOURS  # (keypoint, 9, 2); the first is the pixel itself
    u, v = np.clip(around[..., 0], 0, width - 1), np.clip(around[..., 1], 0, height - 1)
    surface_m, part = depth_m[v, u], parts[v, u].astype(np.int64)

    in_front_m = projected.distances_m.numpy()[:, None] - surface_m
    own_limb = np.take_along_axis(limbs.own_parts, part, axis=1)
    shows = in_front_m <= np.where(own_limb, limbs.reach_m[:, None], limbs.radius_m[:, None])
    solid = surface_m > 0
    near = (shows & solid).any(1) | ~solid.any(1)
    visible = np.where(solid[:, 0], shows[:, 0], near)
    return np.where(in_view, np.where(visible, VISIBLE, OCCLUDED), OUTSIDE).astype(np.int8)
