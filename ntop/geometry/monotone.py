"""Where an odd lens polynomial can be inverted: numpy only, so that a configuration can ask.

Notation: r(x) = x (1 + k1 x^2 + k2 x^4 + ...); x is an angle (Kannala-Brandt) or a tangent (radial
distortion of a pinhole), r the distorted radius in focal lengths.
"""

import math
from collections.abc import Sequence

import numpy as np

FLAT = 1e-9  # a slope that small counts as zero: nothing is left to invert
NEGLIGIBLE = 1e-60  # a coefficient without influence below x = 1e10; quotients would overflow
FARTHEST = 1e8  # of x^2: beyond any angle or tangent that is asked for
INSIDE = 1 - 1e-6  # of the fold: the slope stays positive up to the limit


def monotone_limit(coefficients: Sequence[float]) -> float:
    """Up to which x the polynomial grows: just below its slope's first zero, or infinity."""
    slope = np.array([1.0, *((2 * i + 3) * k for i, k in enumerate(coefficients))])  # in x^2
    fold = min(_positive_roots(slope), default=math.inf)
    # a slope that only touches zero has a double root, which rounding may make complex
    touching = [s for s in _positive_roots(_derivative(slope)) if _value(slope, s) <= FLAT]
    return math.sqrt(min(fold, *touching, math.inf)) * INSIDE


def steepest(coefficients: Sequence[float], limit: float) -> float:
    """Largest slope on [0, limit], which lies within the monotone range."""
    slope = np.array([1.0, *((2 * i + 3) * k for i, k in enumerate(coefficients))])
    inner = [s for s in _positive_roots(_derivative(slope)) if s < limit**2]
    return max(_value(slope, s) for s in (0.0, limit**2, *inner))


def _derivative(ascending: np.ndarray) -> np.ndarray:
    return ascending[1:] * np.arange(1, len(ascending))


def _value(ascending: np.ndarray, at: float) -> float:
    return float(np.polyval(ascending[::-1], at))


def _positive_roots(ascending: np.ndarray) -> list[float]:
    kept = np.where(np.abs(ascending) < NEGLIGIBLE, 0, ascending)
    roots = np.roots(kept[::-1])  # drops leading zeros
    real = np.abs(roots.imag) <= 1e-12 * np.abs(roots)
    return [float(root) for root in roots.real[real] if 0 < root < FARTHEST]
