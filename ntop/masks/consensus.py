"""One set of landmarks from several looks that may be wrong, or call left what is right.

Two failures of the pose network are frequent enough to matter. Where the face does not tell front
from back (a pixelated face, a view from behind) it swaps left and right, for seconds; and a turned
or mirrored look sometimes puts the limbs of both sides between them. The first is undone by
continuity in time and by a vote over the whole sequence, the second by leaving out what is far
from the other looks.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

NUM_LANDMARKS = 35  # 33 keypoints and the two points of the person's circle
# left <-> right
MIRRORED = (
    0, 4, 5, 6, 1, 2, 3, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15, 18, 17, 20, 19, 22, 21, 24, 23,
    26, 25, 28, 27, 30, 29, 32, 31, 33, 34,
)  # fmt: skip
# Head, arms and legs swap on their own: crossing legs fool the network, not the shoulders.
GROUPS = (range(0, 11), range(11, 23), range(23, 33))
MAX_SPREAD = 0.03  # of the region's side: further from the others' median, a look is left out
SWAP_GAIN = 0.7  # a swap must bring a group this much closer, so that noise swaps nothing


@dataclass(frozen=True)
class Consensus:
    """Landmarks in pixels, their confidence, and per group the looks' votes.

    A vote is the number of looks that named left and right as the result does, less those that
    named them the other way round.
    """

    landmarks_px: Float[np.ndarray, "35 2"]
    confidence: Float[np.ndarray, " 35"]
    votes: Int[np.ndarray, " 3"]


def agree(
    looks_px: Float[np.ndarray, "look 35 2"],
    confidences: Float[np.ndarray, "look 35"],
    before_px: Float[np.ndarray, "35 2"] | None,
    *,
    side_px: float,
) -> Consensus:
    """Landmarks on which the looks agree, left and right named as in the frame before.

    `before_px` are the landmarks of the frame before; without them the look that is closest to all
    others names the sides. `side_px` is the size of the region looked at.
    """
    reference = looks_px[_medoid(looks_px)] if before_px is None else before_px
    points, confidence = looks_px.copy(), confidences.copy()
    votes = np.zeros(len(GROUPS), int)
    for look in range(len(points)):
        swapped = swapped_groups(points[look], reference)
        votes += np.where(swapped, -1, 1)
        order = naming(swapped)
        points[look], confidence[look] = points[look][order], confidence[look][order]
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=-1)
    agreeing = distance <= np.maximum(MAX_SPREAD * side_px, np.median(distance, axis=0))
    weights = agreeing * (confidence + 1e-6)  # a point nobody is sure of: plain mean
    landmarks = (points * weights[..., None]).sum(0) / weights.sum(0)[:, None]
    trusted = agreeing & (distance <= MAX_SPREAD * side_px)
    return Consensus(landmarks, (confidence * trusted).mean(0), votes)


def swapped_groups(
    landmarks_px: Float[np.ndarray, "35 2"], reference_px: Float[np.ndarray, "35 2"]
) -> Bool[np.ndarray, " 3"]:
    """Which groups are clearly closer to the reference with left and right swapped."""
    mirrored = landmarks_px[list(MIRRORED)]
    swapped = []
    for group in GROUPS:
        rows = list(group)
        plain_px = np.linalg.norm(landmarks_px[rows] - reference_px[rows], axis=-1).mean()
        swapped_px = np.linalg.norm(mirrored[rows] - reference_px[rows], axis=-1).mean()
        swapped.append(swapped_px < SWAP_GAIN * plain_px)
    return np.array(swapped)


def naming(swapped: Bool[np.ndarray, " 3"]) -> Int[np.ndarray, " 35"]:
    """The order of landmarks that swaps left and right in some groups."""
    order = np.arange(NUM_LANDMARKS)
    for group, swap in zip(GROUPS, swapped, strict=True):
        if swap:
            order[list(group)] = np.array(MIRRORED)[list(group)]
    return order


def _medoid(looks_px: Float[np.ndarray, "look 35 2"]) -> int:
    """The look closest to all others."""
    pairs = np.linalg.norm(looks_px[:, None] - looks_px[None], axis=-1).mean(-1)
    return int(pairs.sum(1).argmin())
