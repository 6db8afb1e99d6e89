"""What fisheye lenses share: the law of their angle becomes pixels, pixels become offsets.

Notation: a ray at angle theta from the axis lands r(theta) focal lengths from the principal point;
h = hypot(x, y), q = h^2. A lens is its `gain` r(theta) / h, by which x and y are scaled, and the
way back. Neither divides by zero on the axis, at 90 degrees or behind (decision 0003).
"""

import math
from collections.abc import Callable
from typing import Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.geometry.guards import guarded_offsets, guarded_points, require_domain, require_lens

WIDEST = math.pi * (1 - 1e-9)  # the point behind the camera has no single image
ANTIPODE_Q = 1e-30  # of a direction of order one: straight back, where no lens sees anything
ANTIPODE = "the direction straight back is imaged as a whole circle"

Gain = Callable[[Tensor, Tensor], Tensor]  # q, z -> r(theta) / h


class Intrinsics(Protocol):
    """What all fisheye lenses have: pixels, and the largest angle (radians) from the axis."""

    model: str
    cx: float
    cy: float
    width: int
    height: int
    max_theta: float

    @property
    def fx(self) -> float:
        """Horizontal focal length, px."""

    @property
    def fy(self) -> float:
        """Vertical focal length, px."""


def projected(
    points: Float[Tensor, "*batch 3"], lens: Intrinsics, gain: Gain
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Pixels of camera-frame points; seen = within the lens's `max_theta` of the axis."""
    scaled, usable = guarded_points(points)
    z = scaled[..., 2]
    q = (scaled[..., :2] * scaled[..., :2]).sum(-1)
    focal, center = scaled.new_tensor([lens.fx, lens.fy]), scaled.new_tensor([lens.cx, lens.cy])
    pixels = focal * scaled[..., :2] * gain(q, z)[..., None] + center
    exact = scaled.detach().double()  # what is seen does not depend on the precision
    h = torch.hypot(exact[..., 0], exact[..., 1])
    within = torch.atan2(h, exact[..., 2]) <= lens.max_theta
    return pixels, usable & within & ((h > 0) | (z > 0))


def offsets_within(
    pixels: Float[Tensor, "*batch 2"], lens: Intrinsics, *, rim: float
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Offsets from the principal point in focal lengths; valid = within radius `rim`."""
    return guarded_offsets(pixels, focal=(lens.fx, lens.fy), center=(lens.cx, lens.cy), rim=rim)


def require_fisheye(lens: Intrinsics, *, below: float, why: str) -> None:
    """Refuse a lens whose image circle is not a one-to-one map.

    Raises:
        DataError: bad intrinsics, or a `max_theta` that is not in (0, below].
    """
    require_lens(
        lens.model,
        focal=(lens.fx, lens.fy),
        center=(lens.cx, lens.cy),
        size=(lens.width, lens.height),
    )
    require_domain(lens.model, lens.max_theta, below=below, why=why)


def theta_over_h(
    q: Float[Tensor, "*batch"], z: Float[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Ratio theta / h, and theta^2; by series near the axis, where the quotient is 0/0."""
    small = (q < 1e-8 * z * z) & (z > 0)
    z_safe = torch.where(small, z, torch.ones_like(z))
    h_safe = torch.where(small | (q < ANTIPODE_Q), torch.ones_like(q), q).sqrt()
    tangent2 = torch.where(small, q, torch.zeros_like(q)) / (z_safe * z_safe)
    theta = torch.atan2(h_safe, z)
    ratio = torch.where(small, (1 - tangent2 / 3) / z_safe, theta / h_safe)
    return ratio, torch.where(small, tangent2 * (1 - 2 * tangent2 / 3), theta * theta)


def sinc_and_cosine(
    squared: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """sin(t) / t and cos(t) from t^2, exact in value and gradient at zero."""
    small = squared < 1e-6
    t = torch.where(small, torch.ones_like(squared), squared).sqrt()
    sinc = torch.where(small, 1 - squared / 6 * (1 - squared / 20), torch.sin(t) / t)
    return sinc, torch.where(small, 1 - squared / 2 * (1 - squared / 12), torch.cos(t))
