"""Where people stand: MediaPipe's pose detector, decoded to one region per person.

The network sees the image letter-boxed to 224 x 224 and answers at 2254 anchors with a score, a
box, and four points, of which the first two matter here: the mid-hip and the full-body point that
spans the circle around the person (BlazePose, Bazarevsky et al. 2020).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ntop.masks.network import Network
from ntop.masks.regions import Region, region_of_person

SIZE = 224
ANCHOR_GRIDS = ((28, 2), (14, 2), (7, 6))  # cells per side, anchors per cell
SCORES_SHAPE, BOXES_SHAPE = (1, 2254, 1), (1, 2254, 12)
MIN_SCORE = 0.5
MAX_OVERLAP = 0.3  # of two boxes (intersection over union), above which they are one person
LOGIT_LIMIT = 100.0  # beyond it exp overflows in float32


@dataclass(frozen=True)
class Detection:
    """One person seen: the region around him, his box (u0, v0, u1, v1) in pixels, a score."""

    region: Region
    box_px: Float[np.ndarray, " 4"]
    score: float


def anchor_centres() -> Float[np.ndarray, "anchor 2"]:
    """Anchor centres (u, v) in [0, 1], cell after cell, row-major, coarse grids last."""
    grids = []
    for cells, per_cell in ANCHOR_GRIDS:
        line = (np.arange(cells) + 0.5) / cells
        v, u = np.meshgrid(line, line, indexing="ij")
        grids.append(np.repeat(np.stack([u.ravel(), v.ravel()], -1), per_cell, axis=0))
    return np.concatenate(grids)


def box_overlap(
    box: Float[np.ndarray, " 4"], boxes: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, " n"]:
    """Intersection over union of one box with others, (u0, v0, u1, v1) each."""
    low, high = np.maximum(box[:2], boxes[:, :2]), np.minimum(box[2:], boxes[:, 2:])
    intersection = np.prod(np.clip(high - low, 0, None), axis=1)
    area = np.prod(box[2:] - box[:2])
    areas = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    return intersection / np.maximum(area + areas - intersection, 1e-12)


def merge_overlapping(
    scores: Float[np.ndarray, " n"], boxes: Float[np.ndarray, "n 4"], *, max_overlap: float
) -> list[Float[np.ndarray, " n"]]:
    """Weighted non-maximum suppression: per person, the weights of the candidates that are him.

    The best remaining candidate takes all that overlap it; weights are their scores, summing to
    one, so that positions average instead of jumping between anchors.
    """
    remaining = np.argsort(-scores, kind="stable")
    people = []
    while len(remaining):
        same = box_overlap(boxes[remaining[0]], boxes[remaining]) > max_overlap
        same[0] = True  # a degenerate box does not even overlap itself
        weights = np.zeros_like(scores)
        weights[remaining[same]] = scores[remaining[same]]
        people.append(weights / weights.sum())
        remaining = remaining[~same]
    return people


def detect_people(network: Network, image: UInt8[np.ndarray, "height width 3"]) -> list[Detection]:
    """Everybody the detector finds in an RGB image, best score first."""
    height, width = image.shape[:2]
    side = max(height, width)
    scale = SIZE / side
    inner = cv2.resize(
        image, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA
    )
    left, top = (SIZE - inner.shape[1]) // 2, (SIZE - inner.shape[0]) // 2
    padded = np.zeros((SIZE, SIZE, 3), np.float32)
    padded[top : top + inner.shape[0], left : left + inner.shape[1]] = inner
    outputs = network(padded / 127.5 - 1.0)

    logits = np.clip(outputs[SCORES_SHAPE][0, :, 0].astype(np.float64), -LOGIT_LIMIT, LOGIT_LIMIT)
    scores = 1 / (1 + np.exp(-logits))
    chosen = scores >= MIN_SCORE
    if not chosen.any():
        return []
    scores = scores[chosen]
    values = outputs[BOXES_SHAPE][0].astype(np.float64).reshape(-1, 6, 2)[chosen]
    centres = anchor_centres()[chosen]
    middle, extent = values[:, 0] / SIZE + centres, values[:, 1] / SIZE
    boxes = np.concatenate([middle - extent / 2, middle + extent / 2], axis=1)
    points = values[:, 2:] / SIZE + centres[:, None]

    padding = np.array([left, top]) / SIZE
    stretch = np.array([width / inner.shape[1], height / inner.shape[0]]) * SIZE
    people = []
    for weights in merge_overlapping(scores, boxes, max_overlap=MAX_OVERLAP):
        hip, full_body = (np.tensordot(weights, points, 1)[:2] - padding) * stretch
        box = (np.tensordot(weights, boxes, 1).reshape(2, 2) - padding) * stretch
        best = float(scores[weights > 0].max())
        people.append(Detection(region_of_person(hip, full_body), box.ravel(), best))
    return people
