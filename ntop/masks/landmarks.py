"""33 keypoints and a soft mask of the person in a region: MediaPipe's pose landmark network.

The network sees 256 x 256 pixels. Its regressed landmarks are coarse; the heatmaps that come with
them (64 x 64) correct them by the centre of mass around each (MediaPipe's
RefineLandmarksFromHeatmap; without it the points miss by 9-12 px in a 1080 x 1920 image).

One look errs by a few pixels at random. The region turned a little and mirrored gives other errors,
so `estimate_pose` averages those of six looks that agree.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from ntop.masks.consensus import MIRRORED, agree
from ntop.masks.network import Network
from ntop.masks.regions import (
    Region,
    box_around,
    crop_region,
    region_of_person,
    transform_points,
    warp_back,
)

SIZE = 256
NUM_LANDMARKS, NUM_KEYPOINTS = 39, 33  # six auxiliary landmarks follow the 33 keypoints
HIP, FULL_BODY = 33, 34  # auxiliary landmarks that span the person's circle
LANDMARKS_SHAPE, FLAG_SHAPE = (1, 5 * NUM_LANDMARKS), (1, 1)
MASK_SHAPE, HEATMAP_SHAPE = (1, SIZE, SIZE, 1), (1, 64, 64, NUM_LANDMARKS)
HEATMAP_KERNEL = 7
MIN_HEATMAP_CONFIDENCE = 0.5
TURNS_RAD = (-0.25, 0.0, 0.25)  # rotations of the region, each seen plain and mirrored


@dataclass(frozen=True)
class Look:
    """One answer of the network: 35 landmarks (33 keypoints, two circle points) in crop pixels.

    `confidence` is visibility times presence; `person` the probability that a crop pixel shows the
    person; `pose_score` in [0, 1] says whether there is a person at all.
    """

    landmarks_crop: Float[np.ndarray, "35 2"]
    confidence: Float[np.ndarray, " 35"]
    person: Float32[np.ndarray, "256 256"]
    pose_score: float


@dataclass(frozen=True)
class Pose:
    """The person in a region, averaged over several looks.

    `landmarks_px` are the 33 keypoints and the two points of his circle. `votes` says per group
    (head, arms, legs) how many more looks named left and right as here than the other way round;
    `person` is the probability image in the frame's pixels, in 1/255, inside `box` (zero
    outside), of a frame of `shape` (height, width); `agreement` the mean intersection over
    union of the looks' masks with theirs together, `next_region` where he is now.
    """

    region: Region
    landmarks_px: Float[np.ndarray, "35 2"]
    confidence: Float[np.ndarray, " 35"]
    votes: Int[np.ndarray, " 3"]
    pose_score: float
    person: UInt8[np.ndarray, "rows columns"]
    box: tuple[slice, slice]
    shape: tuple[int, int]
    agreement: float
    next_region: Region

    def person_in_frame(self) -> UInt8[np.ndarray, "height width"]:
        """The probability image as large as the frame."""
        whole = np.zeros(self.shape, np.uint8)
        whole[self.box] = self.person
        return whole


def sigmoid(logits: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """1 / (1 + exp(-x)), clipped where exp would overflow."""
    return 1 / (1 + np.exp(-np.clip(logits, -80.0, 80.0)))


def refine_by_heatmaps(
    points: Float[np.ndarray, "n 2"], heatmaps: Float[np.ndarray, "rows columns n"]
) -> Float[np.ndarray, "n 2"]:
    """Move each point to the centre of mass of its heatmap's neighbourhood.

    `points` and the result are in [0, 1] of the crop; `heatmaps` are probabilities. A point whose
    neighbourhood has no value above one half, or that lies outside the crop, stays. A cell's
    position is its index over the grid size, without half a cell: so MediaPipe was trained, and a
    mirrored image confirms it (bias 0.2 crop pixels; half a cell would be 2).
    """
    rows, columns, _ = heatmaps.shape
    reach = HEATMAP_KERNEL // 2
    refined = points.copy()
    for index, (x, y) in enumerate(points):
        column, row = int(np.floor(x * columns)), int(np.floor(y * rows))
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        top, left = max(0, row - reach), max(0, column - reach)
        patch = heatmaps[top : row + reach + 1, left : column + reach + 1, index]
        if patch.max() < MIN_HEATMAP_CONFIDENCE:
            continue
        total = patch.sum()
        refined[index, 0] = patch.sum(0) @ (left + np.arange(patch.shape[1])) / total / columns
        refined[index, 1] = patch.sum(1) @ (top + np.arange(patch.shape[0])) / total / rows
    return refined


def look(network: Network, crop: UInt8[np.ndarray, "256 256 3"], *, mirrored: bool) -> Look:
    """One answer about a crop; `mirrored` shows it the mirror image and mirrors the answer back."""
    seen = np.ascontiguousarray(crop[:, ::-1]) if mirrored else crop
    outputs = network(seen.astype(np.float32) / 255)
    values = outputs[LANDMARKS_SHAPE].astype(np.float64).reshape(NUM_LANDMARKS, 5)
    heatmaps = sigmoid(outputs[HEATMAP_SHAPE][0].astype(np.float64))
    landmarks = refine_by_heatmaps(values[:, :2] / SIZE, heatmaps)[: len(MIRRORED)] * SIZE
    confidence = (sigmoid(values[:, 3]) * sigmoid(values[:, 4]))[: len(MIRRORED)]
    person = sigmoid(outputs[MASK_SHAPE][0, :, :, 0])
    if mirrored:
        landmarks = (np.array([SIZE, 0.0]) + landmarks * np.array([-1.0, 1.0]))[list(MIRRORED)]
        confidence, person = confidence[list(MIRRORED)], person[:, ::-1]
    return Look(landmarks, confidence, person, float(outputs[FLAG_SHAPE][0, 0]))


def locate_person(
    network: Network, image: UInt8[np.ndarray, "height width 3"], region: Region
) -> tuple[Region, float]:
    """One look: the region centred on the person who is somewhere in `region`, and its score."""
    answer = look(network, crop_region(image, region, size=SIZE), mirrored=False)
    landmarks = transform_points(region.image_from_crop(SIZE), answer.landmarks_crop)
    return region_of_person(landmarks[HIP], landmarks[FULL_BODY]), answer.pose_score


def estimate_pose(
    network: Network,
    image: UInt8[np.ndarray, "height width 3"],
    region: Region,
    *,
    before_px: Float[np.ndarray, "35 2"] | None,
) -> Pose:
    """Keypoints and soft mask of the person in `region` of an RGB image.

    `before_px` are his landmarks in the frame before, if known: they tell left from right.
    """
    points, confidences, scores, people = [], [], [], []
    for turn_rad in TURNS_RAD:
        turned = replace(region, angle_rad=region.angle_rad + turn_rad)
        crop = crop_region(image, turned, size=SIZE)
        for mirrored in (False, True):
            answer = look(network, crop, mirrored=mirrored)
            points.append(transform_points(turned.image_from_crop(SIZE), answer.landmarks_crop))
            confidences.append(answer.confidence)
            scores.append(answer.pose_score)
            people.append(warp_back(answer.person, turned, shape=image.shape[:2]))
    found = agree(np.array(points), np.array(confidences), before_px, side_px=region.side_px)
    mean = np.mean(people, axis=0, dtype=np.float32)
    person = np.rint(255 * np.clip(mean, 0, 1)).astype(np.uint8)
    box = box_around(person > 0, margin_px=0) or (slice(0, 1), slice(0, 1))
    together = mean >= 0.5
    agreement = np.mean([intersection_over_union(one >= 0.5, together) for one in people])
    return Pose(
        region=region,
        landmarks_px=found.landmarks_px,
        confidence=found.confidence,
        votes=found.votes,
        pose_score=float(np.mean(scores)),
        person=person[box].copy(),
        box=box,
        shape=person.shape,
        agreement=float(agreement),
        next_region=region_of_person(found.landmarks_px[HIP], found.landmarks_px[FULL_BODY]),
    )


def intersection_over_union(one: np.ndarray, other: np.ndarray) -> float:
    """Overlap of two boolean masks; 0 where both are empty."""
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 0.0
