"""Image scores against closed forms, and SSIM against a double loop."""

import math

import numpy as np
import pytest

from ntop.conventions import DataError
from ntop.metrics.images import (
    GREY,
    PSNR_CEILING_DB,
    Cutout,
    Window,
    mask_iou,
    psnr_box_db,
    psnr_person_db,
    ssim_box,
    ssim_map,
    tight_window,
)


def person(rgb=(0.5, 0.5, 0.5), *, left=10, right=30, top=5, bottom=45, size=(50, 40)):
    """A rectangle of one colour; colour outside is deliberately wild."""
    generator = np.random.default_rng(0)
    image = generator.random((*size, 3))
    image[top:bottom, left:right] = rgb
    alpha = np.zeros(size)
    alpha[top:bottom, left:right] = 1
    return Cutout(image, alpha)


def test_a_constant_error_gives_its_psnr():
    reference, image = person((0.5, 0.5, 0.5)), person((0.6, 0.6, 0.6))
    assert psnr_person_db(image, reference) == pytest.approx(20.0, abs=1e-9)  # -20 log10(0.1)
    assert psnr_box_db(image, reference) == pytest.approx(20.0, abs=1e-9)


def test_truth_scores_best():
    reference = person()
    assert psnr_person_db(reference, reference) == PSNR_CEILING_DB
    assert psnr_box_db(reference, reference) == PSNR_CEILING_DB
    assert ssim_box(reference, reference) == pytest.approx(1.0, abs=1e-12)
    assert mask_iou(reference.mask, reference.mask) == 1.0


def test_person_score_ignores_alpha_and_surroundings_but_box_score_does_not():
    reference = person()
    missing = Cutout(reference.rgb, np.zeros_like(reference.alpha))
    assert psnr_person_db(missing, reference) == PSNR_CEILING_DB
    expected = -20 * math.log10(abs(0.5 - GREY))  # the box then shows bare grey
    assert psnr_box_db(missing, reference) == pytest.approx(expected, abs=1e-9)


def test_halves_of_a_box_average_their_squared_errors():
    reference = person()
    rgb = reference.rgb.copy()
    rgb[5:45, 10:20] += 0.2
    expected = -10 * math.log10(0.5 * 0.2**2)
    assert psnr_box_db(Cutout(rgb, reference.alpha), reference) == pytest.approx(expected, abs=1e-9)


def test_mask_threshold_is_one_half_of_eight_bits():
    rgba = np.zeros((1, 2, 4), np.uint8)
    rgba[0, :, 3] = 127, 128
    assert Cutout.from_rgba(rgba).mask.tolist() == [[False, True]]


def test_window_and_empty_reference():
    reference = person()
    assert tight_window(reference.mask) == Window(10, 5, 30, 45)
    empty = Cutout(reference.rgb, np.zeros_like(reference.alpha))
    for score in (psnr_person_db, psnr_box_db, ssim_box):
        with pytest.raises(DataError, match="empty reference mask"):
            score(reference, empty)


def test_iou_of_shifted_squares():
    a, b = np.zeros((20, 20), bool), np.zeros((20, 20), bool)
    a[0:10, 0:10], b[0:10, 5:15] = True, True
    assert mask_iou(a, b) == pytest.approx(50 / 150)
    assert mask_iou(a, ~a) == 0.0
    assert mask_iou(a & ~a, a & ~a) == 1.0


def test_ssim_of_two_constants_is_the_luminance_term():
    a, b = np.full((30, 30, 1), 0.2), np.full((30, 30, 1), 0.6)
    expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2**2 + 0.6**2 + 1e-4)
    assert np.allclose(ssim_map(a, b), expected, atol=1e-9)


def test_ssim_equals_a_double_loop_inside():
    generator = np.random.default_rng(1)
    a, b = generator.random((2, 24, 20, 1))
    offset = np.arange(11) - 5
    kernel = np.exp(-0.5 * (offset / 1.5) ** 2)
    weights = np.outer(kernel, kernel) / kernel.sum() ** 2
    got = ssim_map(a, b)
    for row in range(5, 19):
        for column in range(5, 15):
            x = a[row - 5 : row + 6, column - 5 : column + 6, 0]
            y = b[row - 5 : row + 6, column - 5 : column + 6, 0]
            mx, my = (weights * x).sum(), (weights * y).sum()
            vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
            cov = (weights * (x - mx) * (y - my)).sum()
            expected = ((2 * mx * my + 1e-4) * (2 * cov + 9e-4)) / (
                (mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)
            )
            assert got[row, column, 0] == pytest.approx(expected, abs=1e-9)
