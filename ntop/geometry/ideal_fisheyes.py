"""Fisheye lenses with a fixed law: equidistant, equisolid, stereographic.

Notation: as in `ntop.geometry.fisheye_rays`; n = |(x, y, z)|. Each is defined up to a declared
`max_theta` < pi. The last two have closed forms both ways, without an angle.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.geometry.fisheye_rays import (
    ANTIPODE,
    ANTIPODE_Q,
    WIDEST,
    offsets_within,
    projected,
    require_fisheye,
    sinc_and_cosine,
    theta_over_h,
)


@dataclass(frozen=True)
class IdealFisheye:
    """Parameters of a lens with a fixed law: `focal` is in pixels per radian on the axis.

    `aspect` is the vertical focal over the horizontal one, as in Blender's equidistant camera,
    whose image circle becomes an ellipse where the image is not square.
    """

    focal: float
    cx: float
    cy: float
    width: int
    height: int
    max_theta: float = math.pi / 2
    aspect: float = 1.0

    model = ""

    def __post_init__(self) -> None:
        """Refuse a lens whose image circle is not a one-to-one map."""
        require_fisheye(self, below=WIDEST, why=ANTIPODE)

    @property
    def fx(self) -> float:
        """Horizontal focal length, px."""
        return self.focal

    @property
    def fy(self) -> float:
        """Vertical focal length, px."""
        return self.focal * self.aspect


@dataclass(frozen=True)
class Equidistant(IdealFisheye):
    """r = theta (NToP eq. 2)."""

    model = "equidistant"

    @property
    def max_px_per_rad(self) -> float:
        """Upper bound of the image distance per angle between two rays of the domain."""
        return max(self.fx, self.fy) * self.max_theta / math.sin(self.max_theta)

    def project(
        self, points_camera: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of camera-frame points; seen = within `max_theta` of the axis."""
        return projected(points_camera, self, lambda q, z: theta_over_h(q, z)[0])

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Unit directions through pixels; valid = inside the image circle of `max_theta`."""
        offsets, valid = offsets_within(pixels, self, rim=self.max_theta)
        squared = (offsets * offsets).sum(-1)
        sinc, cosine = sinc_and_cosine(squared)
        return torch.cat([offsets * sinc[..., None], cosine[..., None]], -1), valid


@dataclass(frozen=True)
class Equisolid(IdealFisheye):
    """r = 2 sin(theta / 2): equal solid angles cover equal areas."""

    model = "equisolid"

    @property
    def max_px_per_rad(self) -> float:
        """Upper bound of the image distance per angle between two rays of the domain."""
        return max(self.fx, self.fy) / math.cos(0.5 * self.max_theta)

    def project(
        self, points_camera: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of camera-frame points; seen = within `max_theta` of the axis."""
        return projected(points_camera, self, _double_half_sine_over_h)

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Unit directions through pixels; valid = inside the image circle of `max_theta`."""
        # towards 180 degrees theta moves ever faster than the radius: no rounding in between
        rim = 2 * math.sin(0.5 * self.max_theta)
        offsets, valid = offsets_within(pixels.double(), self, rim=rim)
        half_sine = 0.25 * (offsets * offsets).sum(-1)  # squared
        half_cosine = (1 - half_sine).sqrt()
        rays = torch.cat([offsets * half_cosine[..., None], 1 - 2 * half_sine[..., None]], -1)
        return rays.to(pixels.dtype), valid


@dataclass(frozen=True)
class Stereographic(IdealFisheye):
    """r = 2 tan(theta / 2): circles stay circles."""

    model = "stereographic"

    @property
    def max_px_per_rad(self) -> float:
        """Upper bound of the image distance per angle between two rays of the domain."""
        return max(self.fx, self.fy) / math.cos(0.5 * self.max_theta) ** 2

    def project(
        self, points_camera: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of camera-frame points; seen = within `max_theta` of the axis."""
        return projected(points_camera, self, _double_half_tangent_over_h)

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Unit directions through pixels; valid = inside the image circle of `max_theta`."""
        offsets, valid = offsets_within(pixels, self, rim=2 * math.tan(0.5 * self.max_theta))
        squared = 0.25 * (offsets * offsets).sum(-1)[..., None]
        return torch.cat([offsets, 1 - squared], -1) / (1 + squared), valid


def _double_half_sine_over_h(q: Tensor, z: Tensor) -> Tensor:
    """2 sin(theta / 2) / h; in front without h, behind without n + z, which cancels there."""
    n = (q + z * z).sqrt()
    ahead = z >= 0
    front = (2 / (n * torch.where(ahead, n + z, torch.ones_like(n)))).sqrt()
    q_safe = torch.where(ahead | (q < ANTIPODE_Q), torch.ones_like(q), q)
    behind = (2 * torch.where(ahead, torch.ones_like(n), n - z) / (n * q_safe)).sqrt()
    return torch.where(ahead, front, behind)


def _double_half_tangent_over_h(q: Tensor, z: Tensor) -> Tensor:
    """2 tan(theta / 2) / h; in front without h, behind without n + z, which cancels there."""
    n = (q + z * z).sqrt()
    ahead = z >= 0
    front = 2 / torch.where(ahead, n + z, torch.ones_like(n))
    q_safe = torch.where(ahead | (q < ANTIPODE_Q), torch.ones_like(q), q)
    return torch.where(ahead, front, 2 * (n - z) / q_safe)
