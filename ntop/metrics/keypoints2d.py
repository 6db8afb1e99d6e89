"""2D keypoint scores: OKS, COCO's average precision and recall, PCK.

Own numpy implementation of COCO's keypoint protocol (published definition; checked in the tests
against pycocotools): object keypoint similarity

    OKS = mean over labelled keypoints of exp(-d^2 / (2 area (2 sigma)^2)),

greedy matching per image by score, precision interpolated at 101 recalls, mean over the OKS
thresholds 0.50:0.05:0.95, at most 20 detections per image.
"""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

OKS_THRESHOLDS = np.linspace(0.5, 0.95, 10)
RECALLS = np.linspace(0.0, 1.0, 101)
MAX_DETECTIONS = 20
AREA_RANGES_PX = {
    "all": (0.0, 1e10),
    "medium": (32.0**2, 96.0**2),
    "large": (96.0**2, 1e10),
}
SPACING = np.spacing(1.0)  # keeps 0/0 at zero where nothing is labelled


@dataclass(frozen=True)
class LabelledPerson:
    """A person in the ground truth. `labelled` marks the keypoints with v > 0."""

    image_id: int
    keypoints_px: Float[np.ndarray, "keypoint 2"]
    labelled: Bool[np.ndarray, " keypoint"]
    area_px: float
    box_xywh_px: tuple[float, float, float, float]


@dataclass(frozen=True)
class DetectedPerson:
    """A detector's answer."""

    image_id: int
    keypoints_px: Float[np.ndarray, "keypoint 2"]
    score: float

    @property
    def area_px(self) -> float:
        """Area of the box around the keypoints, which COCO uses to bin unmatched detections."""
        width, height = np.ptp(self.keypoints_px, axis=0)
        return float(width * height)


@dataclass(frozen=True)
class AveragePrecision:
    """COCO's ten figures in [0, 1]; None where no person falls into the class."""

    ap: float | None
    ap50: float | None
    ap75: float | None
    ap_medium: float | None
    ap_large: float | None
    ar: float | None
    ar50: float | None
    ar75: float | None
    ar_medium: float | None
    ar_large: float | None


def object_keypoint_similarity(
    detected: DetectedPerson, person: LabelledPerson, *, sigmas: Float[np.ndarray, " keypoint"]
) -> float:
    """OKS of one pair.

    Where nothing is labelled COCO measures how far the keypoints lie outside the doubled box.
    """
    if person.labelled.any():
        squared = ((detected.keypoints_px - person.keypoints_px) ** 2).sum(-1)
        counted = person.labelled
    else:
        x, y, width, height = person.box_xywh_px
        low = np.array([x - width, y - height])
        high = np.array([x + 2 * width, y + 2 * height])
        outside = np.maximum(0, low - detected.keypoints_px) + np.maximum(
            0, detected.keypoints_px - high
        )
        squared = (outside**2).sum(-1)
        counted = np.ones(len(squared), bool)
    exponent = squared / ((2 * sigmas) ** 2 * 2 * (person.area_px + SPACING))
    return float(np.exp(-exponent[counted]).mean())


def average_precision(
    people: list[LabelledPerson],
    detections: list[DetectedPerson],
    *,
    sigmas: Float[np.ndarray, " keypoint"],
) -> AveragePrecision:
    """COCO's ten keypoint figures over all images."""
    by_image: dict[int, tuple[list[LabelledPerson], list[DetectedPerson]]] = defaultdict(
        lambda: ([], [])
    )
    for person in people:
        by_image[person.image_id][0].append(person)
    for detection in detections:
        by_image[detection.image_id][1].append(detection)
    images = []
    for image_id in sorted(by_image):
        image_people, found = by_image[image_id]
        # a stable sort, so that equal scores keep the file's order as in COCO
        found = sorted(found, key=lambda d: -d.score)[:MAX_DETECTIONS]
        similarity = [
            [object_keypoint_similarity(d, p, sigmas=sigmas) for p in image_people] for d in found
        ]
        shape = (len(found), len(image_people))  # either may be empty
        images.append((image_people, found, np.array(similarity).reshape(shape)))
    curves = {
        name: _precision_and_recall(images, area_range)
        for name, area_range in AREA_RANGES_PX.items()
    }
    index_50, index_75 = 0, 5

    def at(name: str, which: int, threshold: int | slice = slice(None)) -> float | None:
        curve = curves[name]
        return None if curve is None else float(np.mean(curve[which][threshold]))

    precision, recall = 0, 1
    return AveragePrecision(
        ap=at("all", precision),
        ap50=at("all", precision, index_50),
        ap75=at("all", precision, index_75),
        ap_medium=at("medium", precision),
        ap_large=at("large", precision),
        ar=at("all", recall),
        ar50=at("all", recall, index_50),
        ar75=at("all", recall, index_75),
        ar_medium=at("medium", recall),
        ar_large=at("large", recall),
    )


def share_correct(
    detected_px: Float[np.ndarray, "*batch keypoint 2"],
    reference_px: Float[np.ndarray, "*batch keypoint 2"],
    *,
    labelled: Bool[np.ndarray, "*batch keypoint"],
    scale_px: Float[np.ndarray, "*batch"],
    threshold: float,
) -> float:
    """PCK: share of labelled keypoints within `threshold * scale_px` (the longer box side)."""
    distance = np.linalg.norm(detected_px - reference_px, axis=-1)
    correct = distance <= threshold * np.asarray(scale_px)[..., None]
    return float(correct[labelled].mean()) if labelled.any() else float("nan")


def _precision_and_recall(
    images: list[tuple[list[LabelledPerson], list[DetectedPerson], np.ndarray]],
    area_range: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean interpolated precision and final recall per threshold; None without any person."""
    scores, matched, ignored = [], [], []
    num_people = 0
    for people, found, similarity in images:
        skip = np.array(
            [not p.labelled.any() or not _inside(p.area_px, area_range) for p in people], bool
        )
        num_people += int((~skip).sum())
        hit, discounted = _match(similarity, skip, found=found, area_range=area_range)
        scores += [d.score for d in found]
        matched.append(hit)
        ignored.append(discounted)
    if not num_people:
        return None
    order = np.argsort(-np.array(scores), kind="mergesort")
    hits = np.concatenate(matched, 1)[:, order]
    counted = ~np.concatenate(ignored, 1)[:, order]
    true_positives = np.cumsum(hits & counted, 1)
    false_positives = np.cumsum(~hits & counted, 1)
    precision, recall = np.zeros(len(OKS_THRESHOLDS)), np.zeros(len(OKS_THRESHOLDS))
    for index, (right, wrong) in enumerate(zip(true_positives, false_positives, strict=True)):
        if not len(right):
            continue
        recalls = right / num_people
        envelope = right / (right + wrong + SPACING)
        envelope = np.maximum.accumulate(envelope[::-1])[::-1]
        at = np.searchsorted(recalls, RECALLS, side="left")
        reached = at < len(envelope)
        precision[index] = envelope[at[reached]].sum() / len(RECALLS)
        recall[index] = recalls[-1]
    return precision, recall


def _match(
    similarity: Float[np.ndarray, "detection person"],
    skip: Bool[np.ndarray, " person"],
    *,
    found: list[DetectedPerson],
    area_range: tuple[float, float],
) -> tuple[Bool[np.ndarray, "threshold detection"], Bool[np.ndarray, "threshold detection"]]:
    """Greedy matching of one image: which detections hit, and which count for nothing.

    Skipped people come last: a detection goes to one only if no counted person is left for it.
    """
    hit = np.zeros((len(OKS_THRESHOLDS), len(found)), bool)
    discounted = np.zeros_like(hit)
    order = np.argsort(skip, kind="mergesort")
    for row, threshold in enumerate(OKS_THRESHOLDS):
        taken = np.zeros(len(skip), bool)
        for column in range(len(found)):
            best, chosen = min(threshold, 1 - 1e-10), -1
            for person in order:
                if taken[person]:
                    continue
                if chosen >= 0 and not skip[chosen] and skip[person]:
                    break  # a counted person was found; the skipped ones follow
                if similarity[column, person] < best:
                    continue
                best, chosen = similarity[column, person], person
            if chosen >= 0:
                taken[chosen] = True
                hit[row, column] = True
                discounted[row, column] = skip[chosen]
            else:
                discounted[row, column] = not _inside(found[column].area_px, area_range)
    return hit, discounted


def _inside(area_px: float, area_range: tuple[float, float]) -> bool:
    return area_range[0] <= area_px <= area_range[1]
