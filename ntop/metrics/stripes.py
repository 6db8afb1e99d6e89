"""Stripes that a sampler leaves in an image: the phase-shift self-test and lock-in detection.

A ray marcher's error depends on where between two samples it meets the surface. That *phase* of a
pixel is its depth in steps, so pixels of equal phase are contour lines, and an error that depends
on it shows as "wood grain". Two detectors (design: NUMERICS section 5):

* phase shift: render twice, samples half a step apart. The error is measured without a reference:
  for samples at equal distances half the rms difference is 0.74 of what varies of it, for every
  step and lens. Where faces of voxels cut the steps as well it is 0.4 to 0.9 (docs/numerics.md).
* lock-in: correlate an image with exp(i 2 pi phase). What is not periodic in the phase (texture,
  noise) averages out, so it tells stripes from noise of equal rms, which jitter turns them into.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

LEVELS = 255.0
MAX_PHASE_SHIFT = 0.37  # grey levels; of equal steps, times 1.35, an error of 0.5 levels
MAX_Z = 4.0
MAX_AMPLITUDE = 0.1  # grey levels
MIN_PIXELS = 500
HARMONICS = 3
ROUNDING = 1 / math.sqrt(12)  # standard deviation of what rounding to whole levels adds
# other step lengths, as shares of the suspected one's frequency; near 1 and its harmonics none
DECOYS = np.concatenate([np.linspace(0.55, 0.92, 40), np.linspace(1.08, 1.45, 40)])


@dataclass(frozen=True)
class LockIn:
    """What is periodic in the phase: `amplitude` in grey levels (of 255), and its significance.

    `z` is the amplitude over the standard deviation of one component of it, as found in the rest
    of the signal at other periods, and as the rounding to eight bits alone would cause it; noise
    exceeds 4 in about one of 2,000 images.
    """

    amplitude: float
    z: float
    pixels: int

    @property
    def judged(self) -> bool:
        """Whether there were pixels enough to say anything; if not, both figures are 0."""
        return self.pixels >= MIN_PIXELS


@dataclass(frozen=True)
class StripeScores:
    """Both detectors on two renders of a view, half a step apart; grey levels (of 255)."""

    phase_rms: float
    amplitude: float
    z: float
    pixels: int

    @property
    def met(self) -> bool:
        """Whether all limits are kept."""
        return (
            self.phase_rms <= MAX_PHASE_SHIFT and self.amplitude < MAX_AMPLITUDE and self.z < MAX_Z
        )


def score_pair(
    first: Float[np.ndarray, "height width 3"],
    second: Float[np.ndarray, "height width 3"],
    phase: Float[np.ndarray, "height width"],
    mask: Bool[np.ndarray, "height width"],
) -> StripeScores:
    """Both detectors on two renders whose samples are half a step apart.

    Half their difference holds the stripes' first harmonic and none of the texture, so it is
    searched for what is periodic in `phase` (of the surface's depth, in periods).
    """
    half = (first.astype(np.float64) - second) / 2
    found = lock_in(half, phase, mask)
    rms = phase_shift_rms(first, second, mask)
    return StripeScores(rms, found.amplitude, found.z, found.pixels)


def phase_shift_rms(
    first: Float[np.ndarray, "height width 3"],
    second: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
) -> float:
    """Half the rms difference (grey levels) of two renders whose samples are half a step apart.

    Colours in [0, 1]; 0 where the mask is empty.
    """
    if not mask.any():
        return 0.0
    difference = first[mask].astype(np.float64) - second[mask]
    return float(LEVELS * np.sqrt((difference**2).mean()) / 2)


def lock_in(
    signal: Float[np.ndarray, "height width 3"],
    phase: Float[np.ndarray, "height width"],
    mask: Bool[np.ndarray, "height width"],
) -> LockIn:
    """Correlate a signal's grey value with its phase (in periods).

    Args:
        signal: Difference from a reference or a high-passed image, colours in units of 1.
        phase: Depth over the suspected step length, whole periods included: they tell the
            suspected period from its neighbours.
        mask: Pixels to use, those well inside the person.
    """
    count = int(mask.sum())
    if count < MIN_PIXELS:
        return LockIn(0.0, 0.0, count)
    grey = LEVELS * signal[mask].astype(np.float64).mean(-1)
    grey -= grey.mean()
    angle = 2 * math.pi * phase[mask].astype(np.float64)
    found = _amplitude(grey, angle)
    # stripes leak into neighbouring periods where depths are few: they are taken out first
    rest = grey - _periodic_part(grey, angle)
    power = np.mean([_amplitude(rest, share * angle) ** 2 for share in DECOYS]) / 2
    noise = math.sqrt(power + 2 * ROUNDING**2 / count)
    return LockIn(found, found / noise, count)


def high_passed(
    image: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
    *,
    width_px: int = 15,
) -> Float[np.ndarray, "height width 3"]:
    """An image less the mean of its neighbours inside the mask; zero outside.

    Without a reference, this is what can be searched for stripes; broad texture is taken out.
    """
    weight = _box_sum(mask[..., None].astype(np.float64), width_px)
    mean = _box_sum(image * mask[..., None], width_px) / np.maximum(weight, 1)
    return np.where(mask[..., None], image - mean, 0)


def _amplitude(grey: Float[np.ndarray, " pixel"], angle: Float[np.ndarray, " pixel"]) -> float:
    return 2 * math.hypot((grey * np.cos(angle)).mean(), (grey * np.sin(angle)).mean())


def _periodic_part(
    grey: Float[np.ndarray, " pixel"], angle: Float[np.ndarray, " pixel"]
) -> Float[np.ndarray, " pixel"]:
    """The best fit of a constant and the first harmonics of the phase (least squares)."""
    waves = [np.ones_like(angle)]
    for harmonic in range(1, HARMONICS + 1):
        waves += [np.cos(harmonic * angle), np.sin(harmonic * angle)]
    basis = np.stack(waves, 1)
    coefficients, *_ = np.linalg.lstsq(basis.T @ basis, basis.T @ grey, rcond=1e-9)
    return basis @ coefficients


def _box_sum(values: Float[np.ndarray, "height width c"], width_px: int) -> np.ndarray:
    """Sum over a centred square of odd width, zero beyond the image."""
    half = width_px // 2
    for axis in (0, 1):
        pads = [(0, 0)] * 3
        pads[axis] = (half + 1, half)
        total = np.cumsum(np.pad(values, pads), axis)
        upper = np.take(total, range(2 * half + 1, total.shape[axis]), axis)
        values = upper - np.take(total, range(total.shape[axis] - 2 * half - 1), axis)
    return values
