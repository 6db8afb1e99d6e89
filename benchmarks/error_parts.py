"""What the error of a picture consists of: outline and inside, slow and fine, shifted and blurred.

The core is the person's mask eroded by `CORE_PX`: there no pixel mixes with the background.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from ntop.metrics.images import (
    Cutout,
    mask_iou,
    psnr_box_db,
    psnr_db,
    psnr_person_db,
    tight_window,
)

CORE_PX = 3
SLOW_SIGMA_PX = 8.0  # about 4 cm on the person: shading, not texture
BLURS_PX = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4, 1.7, 2.0)
FLOW_MARGIN_PX = 16


@dataclass(frozen=True)
class Scores:
    """Of one picture or, as a mean, of several."""

    psnr_box_db: float
    psnr_person_db: float
    psnr_core_db: float
    mask_iou: float


@dataclass(frozen=True)
class Diagnosis:
    """Where an error lies and what would mend it, in the box or the core.

    `outline_share`: squared error in the box outside the core. `slow_db`, `fine_db`: PSNR in the
    core if only the slow (sigma `SLOW_SIGMA_PX`), or only the remaining, error were there.
    `blur_gain_db`: gain in the core against the truth blurred by `blur_px`, the best of some.
    `flow_gain_db`: gain in the core once optical flow has aligned the picture with the truth,
    `flow_px` its median length there.
    """

    outline_share: float
    slow_db: float
    fine_db: float
    blur_px: float
    blur_gain_db: float
    flow_px: float
    flow_gain_db: float


def scores(image: Cutout, truth: Cutout) -> Scores:
    """PSNR in the box, on the person, in his core; mask overlap."""
    error = (image.on_grey() - truth.on_grey())[core(truth)]
    return Scores(
        psnr_box_db=psnr_box_db(image, truth),
        psnr_person_db=psnr_person_db(image, truth),
        psnr_core_db=psnr_db(float(np.mean(error**2))),
        mask_iou=mask_iou(image.mask, truth.mask),
    )


def core(truth: Cutout) -> Bool[np.ndarray, "height width"]:
    """The mask without its outermost pixels."""
    square = np.ones((2 * CORE_PX + 1, 2 * CORE_PX + 1), np.uint8)
    return cv2.erode(truth.mask.astype(np.uint8), square).astype(bool)


def diagnosis(image: Cutout, truth: Cutout) -> Diagnosis:
    """One picture's error taken apart."""
    window = tight_window(truth.mask)
    seen, true, inside = image.on_grey(), truth.on_grey(), core(truth)
    error = seen - true
    slow = _mean_around(error, inside)
    whole_db = _psnr(error[inside])
    gains = [_psnr((seen - _blurred(true, sigma))[inside]) - whole_db for sigma in BLURS_PX]
    aligned, lengths = _aligned(seen, true, inside)
    return Diagnosis(
        outline_share=1 - float((error[inside] ** 2).sum() / (window.of(error) ** 2).sum()),
        slow_db=_psnr(slow[inside]),
        fine_db=_psnr((error - slow)[inside]),
        blur_px=BLURS_PX[int(np.argmax(gains))],
        blur_gain_db=max(gains),
        flow_px=float(np.median(lengths[inside])),
        flow_gain_db=_psnr((aligned - true)[inside]) - whole_db,
    )


def _psnr(error: np.ndarray) -> float:
    return psnr_db(float(np.mean(error**2)))


def _blurred(image: np.ndarray, sigma_px: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), sigma_px)


def _mean_around(
    error: Float[np.ndarray, "height width 3"], inside: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    """The error's Gaussian mean over pixels of the core."""
    weight = _blurred(inside.astype(np.float64), SLOW_SIGMA_PX)
    total = _blurred(np.where(inside[..., None], error, 0), SLOW_SIGMA_PX)
    return total / np.maximum(weight, 1e-9)[..., None]


def _aligned(
    seen: Float[np.ndarray, "height width 3"],
    true: Float[np.ndarray, "height width 3"],
    inside: Bool[np.ndarray, "height width"],
) -> tuple[np.ndarray, np.ndarray]:
    """The picture moved onto the truth by dense optical flow (DIS), and the flow's lengths (px)."""
    window = tight_window(inside)
    rows = slice(max(window.top - FLOW_MARGIN_PX, 0), window.bottom + FLOW_MARGIN_PX)
    columns = slice(max(window.left - FLOW_MARGIN_PX, 0), window.right + FLOW_MARGIN_PX)
    pair = [
        cv2.cvtColor(np.rint(255 * part[rows, columns]).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        for part in (true, seen)
    ]
    finder = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    finder.setFinestScale(0)
    flow = finder.calc(*pair, None)
    v, u = np.indices(flow.shape[:2], dtype=np.float32)
    moved = cv2.remap(
        np.ascontiguousarray(seen[rows, columns], np.float32),
        u + flow[..., 0],
        v + flow[..., 1],
        cv2.INTER_CUBIC,
    )
    aligned, lengths = seen.copy(), np.zeros(seen.shape[:2])
    aligned[rows, columns] = moved
    lengths[rows, columns] = np.linalg.norm(flow, axis=-1)
    return aligned, lengths
