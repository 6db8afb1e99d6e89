"""Lenses under test, directions at given angles, and the formulas that people get wrong."""

import math

import torch
from torch import Tensor

from ntop.geometry.fisheyes import Fisheye
from ntop.geometry.ideal_fisheyes import Equidistant, Equisolid, Stereographic
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.pinhole import Pinhole

SIZE = 1000
CENTRE = SIZE / 2
FOCALS = (50.0, 318.0, 2000.0)
PRECISIONS = (torch.float64, torch.float32)
WIDE = math.radians(170)
TABLE_1_DEGREES = (0, math.degrees(1e-8), math.degrees(1e-4), 1, 45, 80, 89, 89.99, 90, 100, 130)

# distortions k1..k4 of Kannala-Brandt lenses
MILD = (0.05, 0.08, -0.03, 0.004)  # plausible, invented; theta_d > pi / 2 inside 90 degrees
TUM_VI = (0.0034823894022493, 0.00071503484521623, -0.0020532361418706, 0.00020293673591811)
WIDE_ANGLE = (-0.0285, 0.0096, -0.0053, 0.0008)  # as action cameras have
BARREL = (-0.12, 0.0, 0.0, 0.0)  # folds at 95 degrees
STRONG = (9.0, 0.0, 0.0, 0.0)  # OpenCV's own stress case (opencv PR 17454)
OPENCV_23961 = (-0.99137234, -0.1205525, 0.36863644, -1.0656211)  # folds at 32 degrees
FOLDING = (-0.5, 0.1, -0.02, 0.003)  # folds at 57 degrees


def family(focal: float, *, max_theta: float = WIDE, size: int = SIZE) -> list[Fisheye]:
    """Every fisheye model with this focal length, the principal point amid a square image."""
    place = {"cx": size / 2, "cy": size / 2, "width": size, "height": size}
    return [
        Equidistant(focal, **place, max_theta=max_theta),
        Equisolid(focal, **place, max_theta=max_theta),
        Stereographic(focal, **place, max_theta=max_theta),
        *(
            KannalaBrandt(
                focal, focal, **place, max_theta=min(max_theta, math.radians(limit)), distortion=k
            )
            for k, limit in ((MILD, 100), (TUM_VI, 110))
        ),
    ]


def pinhole(focal: float) -> Pinhole:
    """A calibrated lens with all five coefficients."""
    return Pinhole(focal, focal, CENTRE, CENTRE, SIZE, SIZE, (-0.05, 0.14, 1e-3, -2e-3, 0.01))


def directions(theta: Tensor | float, azimuth: Tensor) -> Tensor:
    """Unit vectors at angle theta from the axis."""
    theta, azimuth = torch.broadcast_tensors(torch.as_tensor(theta, dtype=torch.float64), azimuth)
    return torch.stack([theta.sin() * azimuth.cos(), theta.sin() * azimuth.sin(), theta.cos()], -1)


def azimuths(count: int) -> Tensor:
    """All around, none of them special."""
    return torch.arange(count, dtype=torch.float64) / count * 2 * math.pi + 0.01


def ulp(value: float, precision: torch.dtype) -> float:
    """Spacing of numbers at a value."""
    return 2.0 ** math.floor(math.log2(value)) * torch.finfo(precision).eps


def condition(theta: Tensor) -> Tensor:
    """theta / sin(theta), at least 1: by how much the projection magnifies a ray's rounding."""
    return (theta / theta.sin().clamp(min=1e-30)).clamp(min=1)


def paper_rays(pixels: Tensor, focal: float, centre: float) -> Tensor:
    """NToP's backward formula: q = (f tan(theta) cos(phi), f tan(theta) sin(phi), f)."""
    offset = pixels - centre
    rho = offset.norm(dim=-1, keepdim=True)
    radial = focal * torch.tan(rho / focal) / rho
    return torch.cat([offset * radial, torch.full_like(rho, focal)], -1)


def acos_projection(points: Tensor, focal: float, centre: float) -> Tensor:
    """theta = acos(z / |p|): half of the digits are lost near the axis."""
    theta = torch.acos(points[..., 2] / points.norm(dim=-1))
    rho = points[..., :2].norm(dim=-1)
    return focal * points[..., :2] * (theta / rho)[..., None] + centre


def plane_projection(points: Tensor, focal: float, centre: float) -> Tensor:
    """theta = atan(|(x, y) / z|), as cv2.fisheye, kornia and others: wrong from 90 degrees on."""
    plane = points[..., :2] / points[..., 2:]
    radius = plane.norm(dim=-1, keepdim=True)
    return focal * torch.atan(radius) * plane / radius + centre
