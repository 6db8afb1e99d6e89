"""Image scores: PSNR on the person and in his box, SSIM, mask overlap.

A `Cutout` is a person without a background: straight colour in [0, 1] (sRGB values, as stored) and
alpha in [0, 1]. The reference's matte decides which pixels are judged:

* `psnr_person_db`: the pixels whose reference matte is >= 0.5, colours as they are, uncomposited;
* `psnr_box_db`, `ssim_box`: the tight box of those pixels, both cutouts composited on grey 127;
* `mask_iou`: both mattes thresholded as everywhere (`MASK_ALPHA`).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ntop.conventions import MASK_ALPHA, DataError

GREY = 127 / 255
PSNR_CEILING_DB = 100.0  # identical images; 8-bit rounding alone already limits to 58.9 dB
SSIM_SIGMA_PX = 1.5  # Wang et al. 2004: 11 x 11 Gaussian window, K1 = 0.01, K2 = 0.03
SSIM_WINDOW_PX = 11
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class Window:
    """Half-open pixel ranges [top, bottom) x [left, right)."""

    left: int
    top: int
    right: int
    bottom: int

    def of(self, image: np.ndarray) -> np.ndarray:
        """That part of an image."""
        return image[self.top : self.bottom, self.left : self.right]


@dataclass(frozen=True)
class Cutout:
    """A person cut out of an image: straight colour and alpha, both in [0, 1]."""

    rgb: Float[np.ndarray, "height width 3"]
    alpha: Float[np.ndarray, "height width"]

    @classmethod
    def from_rgba(cls, rgba: UInt8[np.ndarray, "height width 4"]) -> "Cutout":
        """From a stored image (straight alpha, 8 bit)."""
        unit = rgba.astype(np.float64) / 255
        return cls(unit[..., :3], unit[..., 3])

    @property
    def mask(self) -> Bool[np.ndarray, "height width"]:
        """The person's pixels."""
        return self.alpha >= MASK_ALPHA / 255

    def within(self, window: Window) -> "Cutout":
        """That part of the cut-out."""
        return Cutout(window.of(self.rgb), window.of(self.alpha))

    def on_grey(self) -> Float[np.ndarray, "height width 3"]:
        """Composited on grey 127, in the stored (gamma) space."""
        alpha = self.alpha[..., None]
        return self.rgb * alpha + GREY * (1 - alpha)


def tight_window(mask: Bool[np.ndarray, "height width"]) -> Window:
    """The smallest window that holds all true pixels.

    Raises:
        DataError: the mask is empty, so there is nobody to judge.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        raise DataError(
            "an empty reference mask: expected a person in the picture; "
            "leave frames without one out of the comparison"
        )
    return Window(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)


def psnr_db(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio of values in [0, 1], at most `PSNR_CEILING_DB`.

    Raises:
        DataError: the error is NaN or infinite, as one pixel of the images was.
    """
    if not math.isfinite(mean_squared_error):
        raise DataError(
            f"mean squared error {mean_squared_error}: a pixel of the compared images is not finite"
        )
    if mean_squared_error <= 0:
        return PSNR_CEILING_DB
    return min(-10 * math.log10(mean_squared_error), PSNR_CEILING_DB)


def psnr_person_db(image: Cutout, reference: Cutout) -> float:
    """PSNR over the reference's person pixels, without compositing."""
    tight_window(reference.mask)  # refuses an empty reference
    difference = (image.rgb - reference.rgb)[reference.mask]
    return psnr_db(float(np.mean(difference**2)))


def psnr_box_db(image: Cutout, reference: Cutout) -> float:
    """PSNR in the tight box of the reference's mask, both on grey 127."""
    window = tight_window(reference.mask)
    difference = window.of(image.on_grey()) - window.of(reference.on_grey())
    return psnr_db(float(np.mean(difference**2)))


def ssim_box(image: Cutout, reference: Cutout) -> float:
    """Mean structural similarity (Wang et al. 2004) in that box, mean over the three channels.

    The window is mirrored at the box's border, so that small boxes are judged as well.
    """
    window = tight_window(reference.mask)
    return float(np.mean(ssim_map(window.of(image.on_grey()), window.of(reference.on_grey()))))


def ssim_map(
    a: Float[np.ndarray, "height width channel"], b: Float[np.ndarray, "height width channel"]
) -> Float[np.ndarray, "height width channel"]:
    """Structural similarity of each pixel's neighbourhood; values in [0, 1] in, [-1, 1] out."""
    mean_a, mean_b = _blur(a), _blur(b)
    # clip: the difference of two blurred images may fall below zero by rounding
    variance_a = np.clip(_blur(a * a) - mean_a**2, 0, None)
    variance_b = np.clip(_blur(b * b) - mean_b**2, 0, None)
    covariance = _blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)
    return luminance * structure


def mask_iou(
    mask: Bool[np.ndarray, "height width"], reference: Bool[np.ndarray, "height width"]
) -> float:
    """Intersection over union; two empty masks agree perfectly."""
    union = np.count_nonzero(mask | reference)
    return np.count_nonzero(mask & reference) / union if union else 1.0


def _blur(image: np.ndarray) -> np.ndarray:
    size = (SSIM_WINDOW_PX, SSIM_WINDOW_PX)
    blurred = cv2.GaussianBlur(image, size, SSIM_SIGMA_PX, borderType=cv2.BORDER_REFLECT)
    return blurred.reshape(image.shape)  # OpenCV drops a single channel's axis
