"""OpenCV's camera parameters and ours: integer pixel centres become +0.5, coefficients stay.

Pinhole: k1, k2, p1, p2[, k3]. Longer vectors (rational, thin prism, tilt) are refused unless their
further terms are zero. Fisheye: k1..k4, which is Kannala and Brandt's model.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.geometry.fisheye_rays import WIDEST
from ntop.geometry.fisheyes import Fisheye
from ntop.geometry.ideal_fisheyes import Equidistant
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.monotone import monotone_limit
from ntop.geometry.pinhole import Pinhole

MAX_MISFIT_PX = 0.1
NODES, PROBES = 256, 2049  # angles at which a polynomial is fitted and judged

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


def fisheye_polynomial(lens: Fisheye) -> tuple[KannalaBrandt, float]:
    """OpenCV's fisheye that is closest to a lens, and by how many pixels it is off at most.

    Equidistant and Kannala-Brandt lenses it has exactly. To the others it is the least-squares fit
    of k1..k4 at Chebyshev's nodes of the domain, which stays the lens's own.

    Raises:
        DataError: off by more than MAX_MISFIT_PX, as for a stereographic lens far beyond 90
            degrees, or a polynomial that folds within the domain.
    """
    if isinstance(lens, KannalaBrandt):
        return lens, 0.0
    intrinsics = (lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height, lens.max_theta)
    if isinstance(lens, Equidistant):
        return KannalaBrandt(*intrinsics), 0.0
    share = torch.cos(math.pi * (torch.arange(NODES, dtype=torch.float64) + 0.5) / (2 * NODES))
    odd = 2 * torch.arange(1, 5) + 1
    wanted = _radii(lens, share * lens.max_theta) / lens.max_theta - share
    powers = torch.linalg.lstsq(share[:, None] ** odd, wanted[:, None]).solution[:, 0]
    k1, k2, k3, k4 = (powers / lens.max_theta ** (odd - 1)).tolist()
    found = KannalaBrandt(*intrinsics, (k1, k2, k3, k4))
    probes = torch.linspace(0, 1, PROBES, dtype=torch.float64) * lens.max_theta
    miss = (_radii(found, probes) - _radii(lens, probes)).abs().max()
    misfit_px = max(lens.fx, lens.fy) * float(miss)
    if misfit_px > MAX_MISFIT_PX:
        raise DataError(
            f"{lens.model} lens up to {math.degrees(lens.max_theta):g} degrees: OpenCV's fisheye "
            f"polynomial is off by {misfit_px:.2g} px, expected at most {MAX_MISFIT_PX} px; it "
            "follows this lens over a narrower field of view only"
        )
    return found, misfit_px


def _radii(lens: Fisheye, thetas: Float[Tensor, " angle"]) -> Float[Tensor, " angle"]:
    """Distances from the principal point in focal lengths, of angles within the domain."""
    rays = torch.stack([thetas.sin(), torch.zeros_like(thetas), thetas.cos()], -1)
    return (lens.project(rays)[0][:, 0] - lens.cx) / lens.fx


def _intrinsics(matrix: Matrix) -> tuple[float, float, float, float]:
    (fx, skew, cx), (below, fy, cy), last = ([float(n) for n in row] for row in matrix)
    if skew or below or last != [0.0, 0.0, 1.0]:
        raise DataError(
            f"OpenCV camera matrix {[list(row) for row in matrix]}: expected "
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; calibrate without skew (CALIB_FIX_SKEW)"
        )
    return fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE
