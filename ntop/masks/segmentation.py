"""The matte of one frame with its confidence, by either method, or an empty one with the reason."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from ntop.conventions import MASK_ALPHA
from ntop.masks.background import subtract_background
from ntop.masks.landmarks import NUM_KEYPOINTS, SIZE, Pose
from ntop.masks.mattes import MIN_POINT_CONFIDENCE, keep_person, sharpen_matte
from ntop.masks.plates import Plate
from ntop.masks.tracking import Sighting

RADIUS_CROP_PX = 2  # reach of the edge correction, in pixels of the network's crop
MIN_ON_MASK = 0.6  # of the confident keypoints; fewer: mask and points are not of one person
REACH_PX = 3  # a keypoint this close to the mask counts as on it

Image = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Segmentation:
    """Soft matte in [0, 1], confidence in [0, 1], and the reason why it is not usable, or ''."""

    matte: Float32[np.ndarray, "height width"]
    confidence: float
    reason: str


def edge_radius_px(pose: Pose) -> int:
    """How far the network's mask may be off in the frame."""
    return max(1, round(RADIUS_CROP_PX * pose.region.side_px / SIZE))


def segment_person(image: Image, sighting: Sighting, *, plate: Plate | None) -> Segmentation:
    """The matte of the person the pose network sees, edges on the picture's edges."""
    pose = sighting.pose
    if pose is None:
        return unusable(image.shape[:2], sighting.reason)
    radius_px = edge_radius_px(pose)
    matte = sharpen_matte(image, pose.person_in_frame(), plate=plate, radius_px=radius_px)
    points, confidence = pose.landmarks_px[:NUM_KEYPOINTS], pose.confidence[:NUM_KEYPOINTS]
    matte = keep_person(matte, points, confidence, radius_px=radius_px)
    if not has_person(matte):
        return unusable(image.shape[:2], "empty mask")
    share = share_on_mask(matte, points, confidence)
    if share < MIN_ON_MASK:
        return unusable(image.shape[:2], f"only {share:.0%} of the keypoints lie on the mask")
    return Segmentation(matte, pose.pose_score * pose.agreement, "")


def segment_difference(image: Image, plate: Image) -> Segmentation:
    """The matte of what stands in front of the empty scene."""
    matte = subtract_background(image, plate)
    return (
        Segmentation(matte, 1.0, "")
        if has_person(matte)
        else unusable(image.shape[:2], "empty mask")
    )


def has_person(matte: Float32[np.ndarray, "height width"]) -> bool:
    """Whether any pixel belongs to the person once stored with 8 bits."""
    return bool((matte * 255 >= MASK_ALPHA - 0.5).any())


def share_on_mask(
    matte: Float32[np.ndarray, "height width"],
    keypoints_px: Float[np.ndarray, "n 2"],
    confidence: Float[np.ndarray, " n"],
) -> float:
    """The share of the confident keypoints that lie on the mask; 1 if there are none."""
    height, width = matte.shape
    u, v = np.floor(keypoints_px).astype(int).T
    usable = (confidence >= MIN_POINT_CONFIDENCE) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    hits = [
        (matte[max(0, y - REACH_PX) : y + REACH_PX + 1, max(0, x - REACH_PX) : x + REACH_PX + 1]
         >= 0.5).any()
        for x, y in zip(u[usable], v[usable], strict=True)
    ]  # fmt: skip
    return float(np.mean(hits)) if hits else 1.0


def unusable(shape: tuple[int, int], reason: str) -> Segmentation:
    """An empty matte of (height, width) and why."""
    return Segmentation(np.zeros(shape, np.float32), 0.0, reason)
