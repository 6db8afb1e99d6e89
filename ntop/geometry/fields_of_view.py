"""What a lens sees and how finely, in figures for people and tests.

Angles in radians; theta is the angle from the axis. "Outwards" is along the image radius, "around"
across it: a fisheye's pixels cover different angles in the two directions.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.geometry.cameras import Lens

RELATIVE_STEP = 1e-4  # of theta: the difference's third-order error stays below 1e-7


@dataclass(frozen=True)
class FieldOfView:
    """Angles between the rays at opposite borders of the image, or of the image circle inside."""

    horizontal: float
    vertical: float
    diagonal: float


def field_of_view(lens: Lens) -> FieldOfView:
    """The field of view through the principal point, and the larger one across corners."""
    right, bottom = float(lens.width), float(lens.height)
    angles = _thetas(
        lens,
        [
            (0.0, lens.cy), (right, lens.cy), (lens.cx, 0.0), (lens.cx, bottom),
            (0.0, 0.0), (right, bottom), (right, 0.0), (0.0, bottom),
        ],
    )  # fmt: skip
    # a border beyond which the principal point lies counts against the one opposite
    left = math.copysign(angles[0], lens.cx)
    upper = math.copysign(angles[2], lens.cy)
    return FieldOfView(
        horizontal=left + math.copysign(angles[1], right - lens.cx),
        vertical=upper + math.copysign(angles[3], bottom - lens.cy),
        diagonal=max(angles[4] + angles[5], angles[6] + angles[7]),
    )


def pixels_per_radian(lens: Lens, theta: float) -> tuple[float, float]:
    """Pixels per radian outwards and around, at an angle in (0, `max_theta`] to the right."""
    step = RELATIVE_STEP * theta
    inwards = theta - step * torch.arange(3, dtype=torch.float64)
    out = _pixels(lens, inwards, torch.zeros_like(inwards))
    # one-sided, second order: nothing is seen beyond the rim
    outwards = (1.5 * out[0] - 2 * out[1] + 0.5 * out[2]) / step
    turn = torch.tensor([-RELATIVE_STEP, RELATIVE_STEP], dtype=torch.float64)
    side = _pixels(lens, torch.full_like(turn, theta), turn)
    around = (side[1] - side[0]) / (2 * RELATIVE_STEP * math.sin(theta))
    return float(outwards.norm()), float(around.norm())


def _thetas(lens: Lens, pixels: list[tuple[float, float]]) -> list[float]:
    """Angles of pixels from the axis; `max_theta` for those outside the image circle."""
    rays, valid = lens.unproject(torch.tensor(pixels, dtype=torch.float64))
    angles = torch.atan2(torch.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    return torch.where(valid, angles, torch.full_like(angles, lens.max_theta)).tolist()


def _pixels(
    lens: Lens, thetas: Float[Tensor, " ray"], azimuths: Float[Tensor, " ray"]
) -> Float[Tensor, "ray 2"]:
    across = thetas.sin()
    rays = torch.stack([across * azimuths.cos(), across * azimuths.sin(), thetas.cos()], -1)
    return lens.project(rays)[0]
