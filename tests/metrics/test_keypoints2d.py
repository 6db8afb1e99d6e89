"""OKS, AP and PCK: analytic cases, then all ten figures against pycocotools."""

import contextlib
import io
from dataclasses import asdict

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from ntop.metrics.keypoints2d import (
    DetectedPerson,
    LabelledPerson,
    average_precision,
    object_keypoint_similarity,
    share_correct,
)

SIGMAS = np.array(
    [26, 25, 25, 35, 35, 79, 79, 72, 72, 62, 62, 107, 107, 87, 87, 89, 89], float
) / 1000  # fmt: skip


def person(image_id=1, *, shift=0.0, area=5000.0, labelled=None):
    points = np.arange(34, dtype=float).reshape(17, 2) * 3 + shift
    labelled = np.ones(17, bool) if labelled is None else labelled
    return LabelledPerson(image_id, points, labelled, area, (0.0, 0.0, 100.0, 100.0))


def test_oks_of_a_constant_displacement():
    truth = person()
    detected = DetectedPerson(1, truth.keypoints_px + np.array([3.0, 4.0]), 1.0)
    expected = np.mean(np.exp(-25 / (2 * 5000 * (2 * SIGMAS) ** 2)))
    got = object_keypoint_similarity(detected, truth, sigmas=SIGMAS)
    assert got == pytest.approx(expected, abs=1e-12)


def test_oks_counts_labelled_keypoints_only():
    labelled = np.ones(17, bool)
    labelled[4:] = False
    truth = person(labelled=labelled)
    points = truth.keypoints_px.copy()
    points[4:] += 500
    assert object_keypoint_similarity(
        DetectedPerson(1, points, 1.0), truth, sigmas=SIGMAS
    ) == pytest.approx(1.0)


def test_truth_against_itself_is_one_and_empty_classes_are_none():
    people = [person(1), person(2, shift=50.0)]
    detections = [DetectedPerson(p.image_id, p.keypoints_px, 1.0) for p in people]
    scores = average_precision(people, detections, sigmas=SIGMAS)
    assert (scores.ap, scores.ap50, scores.ar, scores.ap_medium) == pytest.approx((1, 1, 1, 1))
    assert scores.ap_large is None
    assert average_precision(people, [], sigmas=SIGMAS).ap == 0.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_all_ten_figures_equal_pycocotools(seed):
    generator = np.random.default_rng(seed)
    people, detections, images, annotations, results = [], [], [], [], []
    for image_id in range(1, 41):
        images.append({"id": image_id, "width": 640, "height": 640, "file_name": f"{image_id}"})
        for _ in range(generator.integers(0, 4)):
            size = generator.uniform(20, 220)
            origin = generator.uniform(0, 400, 2)
            points = origin + generator.uniform(0, size, (17, 2))
            visibility = generator.choice([0, 1, 2], 17, p=[0.2, 0.3, 0.5])
            if generator.random() < 0.1:
                visibility[:] = 0
            area = size**2 * generator.uniform(0.3, 0.9)
            box = (*origin, size, size)
            people.append(LabelledPerson(image_id, points, visibility > 0, area, box))
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": image_id,
                    "category_id": 1,
                    "iscrowd": 0,
                    "area": area,
                    "bbox": list(box),
                    "num_keypoints": int((visibility > 0).sum()),
                    "keypoints": np.c_[points, visibility].ravel().tolist(),
                }
            )
            for _ in range(generator.integers(0, 3)):
                noisy = points + generator.normal(0, size * generator.uniform(0, 0.1), (17, 2))
                score = round(float(generator.random()), 2)  # ties happen
                detections.append(DetectedPerson(image_id, noisy, score))
        for _ in range(generator.integers(0, 25) if image_id % 7 == 0 else 1):
            stray = generator.uniform(0, 640, (17, 2))
            detections.append(DetectedPerson(image_id, stray, float(generator.random())))
    for found in detections:
        triples = np.c_[found.keypoints_px, np.ones(17)].ravel().tolist()
        results.append(
            {
                "image_id": found.image_id,
                "category_id": 1,
                "keypoints": triples,
                "score": found.score,
            }
        )
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO()
        truth.dataset = {
            "images": images,
            "annotations": annotations,
            "categories": [{"id": 1, "name": "person"}],
        }
        truth.createIndex()
        reference = COCOeval(truth, truth.loadRes(results), "keypoints")
        reference.params.kpt_oks_sigmas = SIGMAS
        reference.evaluate()
        reference.accumulate()
        reference.summarize()
    ours = list(asdict(average_precision(people, detections, sigmas=SIGMAS)).values())
    assert ours == pytest.approx(reference.stats.tolist(), abs=1e-9)
    assert 0.05 < ours[0] < 0.95  # the case is neither trivial nor empty


def test_pck_is_relative_to_the_box_and_counts_labelled_points():
    reference = np.zeros((2, 4, 2))
    detected = reference.copy()
    detected[0, :, 0] = [0, 5, 10, 11]
    detected[1, :, 0] = [0, 10, 20, 22]
    labelled = np.ones((2, 4), bool)
    labelled[1, 3] = False
    got = share_correct(
        detected, reference, labelled=labelled, scale_px=np.array([100.0, 200.0]), threshold=0.1
    )
    assert got == pytest.approx(6 / 7)
    nothing = share_correct(
        detected, reference, labelled=labelled & False, scale_px=np.ones(2), threshold=0.1
    )
    assert np.isnan(nothing)
