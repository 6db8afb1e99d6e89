"""OpenCV's camera parameters and ours: integer pixel centres become +0.5, coefficients stay.

Pinhole: k1, k2, p1, p2[, k3]. Longer vectors (rational, thin prism, tilt) are refused unless their
further terms are zero. Fisheye: k1..k4, which is Kannala and Brandt's model.
"""

import math
from collections.abc import Sequence

from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.geometry.fisheye_rays import WIDEST
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.monotone import monotone_limit
from ntop.geometry.pinhole import Pinhole

Matrix = Sequence[Sequence[float]]


def pinhole_from_opencv(
    matrix: Matrix, distortion: Sequence[float], *, width: int, height: int
) -> Pinhole:
    """The lens of `cv2.calibrateCamera`'s results.

    Raises:
        DataError: skew, or distortion terms that our model does not have.
    """
    fx, fy, cx, cy = _intrinsics(matrix)
    if len(distortion) not in (0, 4, 5, 8, 12, 14) or any(distortion[5:]):
        raise DataError(
            f"OpenCV distortion {list(distortion)}: expected k1, k2, p1, p2[, k3] and zeros; "
            "calibrate without CALIB_RATIONAL_MODEL, CALIB_THIN_PRISM_MODEL and CALIB_TILTED_MODEL"
        )
    five = tuple(float(k) for k in (*distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5])
    return Pinhole(fx, fy, cx, cy, width, height, five)


def fisheye_from_opencv(
    matrix: Matrix,
    distortion: Sequence[float],
    *,
    width: int,
    height: int,
    max_theta: float = math.radians(170),
) -> KannalaBrandt:
    """The lens of `cv2.fisheye.calibrate`'s results, up to `max_theta` or its polynomial's fold.

    A calibration knows nothing of angles beyond its data: give the `max_theta` (radians) that the
    lens is made for.

    Raises:
        DataError: skew, or not four coefficients.
    """
    fx, fy, cx, cy = _intrinsics(matrix)
    four = tuple(float(k) for k in distortion)
    if len(four) != 4:
        raise DataError(f"OpenCV fisheye distortion {list(four)}: expected k1, k2, k3, k4")
    domain = min(max_theta, monotone_limit(four), WIDEST)
    return KannalaBrandt(fx, fy, cx, cy, width, height, domain, four)


def opencv_parameters(
    lens: Pinhole | KannalaBrandt,
) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]:
    """Camera matrix (integer pixel centres) and distortion coefficients."""
    matrix = (
        (lens.fx, 0.0, lens.cx - PIXEL_CENTRE),
        (0.0, lens.fy, lens.cy - PIXEL_CENTRE),
        (0.0, 0.0, 1.0),
    )
    return matrix, lens.distortion


def _intrinsics(matrix: Matrix) -> tuple[float, float, float, float]:
    (fx, skew, cx), (below, fy, cy), last = ([float(n) for n in row] for row in matrix)
    if skew or below or last != [0.0, 0.0, 1.0]:
        raise DataError(
            f"OpenCV camera matrix {[list(row) for row in matrix]}: expected "
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; calibrate without skew (CALIB_FIX_SKEW)"
        )
    return fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE
