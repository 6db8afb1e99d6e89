"""Anchors and the suppression of double detections."""

import numpy as np

from ntop.masks.detection import anchor_centres, box_overlap, merge_overlapping


def test_anchors_are_cell_centres_in_the_networks_order():
    centres = anchor_centres()
    assert centres.shape == (2254, 2)
    assert np.allclose(centres[0], 0.5 / 28) and np.allclose(centres[1], 0.5 / 28)
    assert np.allclose(centres[2], [1.5 / 28, 0.5 / 28])  # row-major: u runs first
    assert np.allclose(centres[1568], 0.5 / 14)
    assert np.allclose(centres[1568 + 392 : 1568 + 392 + 6], 0.5 / 7)
    assert np.allclose(centres[-1], 6.5 / 7)


def test_overlap_of_known_boxes():
    box = np.array([0.0, 0.0, 2.0, 2.0])
    others = np.array([[0, 0, 2, 2], [1, 0, 3, 2], [2, 0, 4, 2], [5, 5, 6, 6], [1, 1, 1, 1]], float)
    assert np.allclose(box_overlap(box, others), [1, 2 / 6, 0, 0, 0])


def test_two_people_stay_two_and_their_candidates_average():
    boxes = np.array([[0, 0, 1, 1], [0.1, 0, 1.1, 1], [5, 5, 6, 6], [0, 0.1, 1, 1.1]])
    scores = np.array([0.6, 0.9, 0.7, 0.5])
    first, second = merge_overlapping(scores, boxes, max_overlap=0.3)
    assert np.allclose(first, np.array([0.6, 0.9, 0, 0.5]) / 2.0)
    assert np.allclose(second, [0, 0, 1, 0])
    assert np.isclose(first @ boxes[:, 0], 0.09 / 2.0)


def test_a_degenerate_box_is_still_a_person():
    (weights,) = merge_overlapping(np.array([0.8]), np.zeros((1, 4)), max_overlap=0.3)
    assert weights.tolist() == [1.0]
