"""The Kannala-Brandt lens: an odd polynomial of the angle, as OpenCV calibrates fisheyes."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.conventions import DataError
from ntop.geometry import radial_polynomial
from ntop.geometry.fisheye_rays import (
    WIDEST,
    offsets_within,
    projected,
    require_fisheye,
    sinc_and_cosine,
    theta_over_h,
)
from ntop.geometry.monotone import monotone_limit, steepest


@dataclass(frozen=True)
class KannalaBrandt:
    """r = theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9: OpenCV's fisheye model.

    `max_theta` lies within the range in which r grows; beyond its first fold a ray has no image,
    although the polynomial would give it one. OpenCV itself is right below 90 degrees only.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    max_theta: float = math.pi / 2
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    model = "kannala_brandt"

    def __post_init__(self) -> None:
        """Refuse a lens whose image circle is not a one-to-one map."""
        if len(self.distortion) != 4 or not all(math.isfinite(k) for k in self.distortion):
            raise DataError(
                f"{self.model} lens: distortion {self.distortion}; expected four finite k1..k4"
            )
        require_fisheye(
            self,
            below=min(WIDEST, monotone_limit(self.distortion)),
            why=f"its distortion {self.distortion} folds there, or the direction is straight back",
        )

    @property
    def max_px_per_rad(self) -> float:
        """Upper bound of the image distance per angle between two rays of the domain."""
        # r / sin(theta) = (r / theta) (theta / sin(theta)), and r / theta is a mean of slopes
        slope = steepest(self.distortion, self.max_theta)
        return max(self.fx, self.fy) * slope * self.max_theta / math.sin(self.max_theta)

    def project(
        self, points_camera: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of camera-frame points; seen = within `max_theta` of the axis."""
        return projected(points_camera, self, self._gain)

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Unit directions through pixels; valid = inside the image circle of `max_theta`."""
        rim = self.max_theta * float(
            radial_polynomial.ratio(
                torch.tensor(self.max_theta**2, dtype=torch.float64), self.distortion
            )
        )
        offsets, valid = offsets_within(pixels, self, rim=rim)
        squared = (offsets * offsets).sum(-1)
        small = squared < 1e-8  # theta^2 from its series: the root has no gradient at zero
        radius = torch.where(small, torch.ones_like(squared), squared).sqrt()
        theta = radial_polynomial.inverse(radius, self.distortion, limit=self.max_theta)
        k1, k2 = self.distortion[:2]
        series = 1 - squared * (k1 - squared * (3 * k1 * k1 - k2))  # theta / r
        theta2 = torch.where(small, squared * series * series, theta * theta)
        sinc, cosine = sinc_and_cosine(theta2)
        gain = sinc / radial_polynomial.ratio(theta2, self.distortion)
        return torch.cat([offsets * gain[..., None], cosine[..., None]], -1), valid

    def _gain(self, q: Tensor, z: Tensor) -> Tensor:
        ratio, theta2 = theta_over_h(q, z)
        return ratio * radial_polynomial.ratio(theta2, self.distortion)
