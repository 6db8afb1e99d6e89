"""Lens models and cameras: pixel <-> ray in the camera frame, always with validity.

Notation: pixels (u, v), first centre at (0.5, 0.5); theta is the angle from the optical axis.
Every lens gives `project(points_camera) -> (pixels, seen)` and
`unproject(pixels) -> (directions_camera, valid)` with unit directions.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.geometry.rigid import RigidTransform

UNDISTORT_ITERATIONS = 10  # fixed point; mild lenses converge in 3-5


@dataclass(frozen=True)
class Pinhole:
    """Perspective lens with OpenCV's radial-tangential distortion (k1, k2, p1, p2, k3).

    `cx`, `cy` follow our pixel centres; OpenCV's are 0.5 smaller.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    model = "pinhole_radtan"

    def project(
        self, points_camera: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of camera-frame points; seen = in front of the camera, inside the image or not."""
        z = points_camera[..., 2]
        seen = z > 1e-9
        safe_z = torch.where(seen, z, torch.ones_like(z))
        distorted = self._distort(points_camera[..., :2] / safe_z[..., None])
        focal = distorted.new_tensor([self.fx, self.fy])
        return distorted * focal + distorted.new_tensor([self.cx, self.cy]), seen

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Unit directions through pixels; valid = the inverse distortion converged to 1e-3 px."""
        focal = pixels.new_tensor([self.fx, self.fy])
        target = (pixels - pixels.new_tensor([self.cx, self.cy])) / focal
        xy = target
        if any(self.distortion):
            for _ in range(UNDISTORT_ITERATIONS):
                # fixed point on the distortion's displacement: contraction for real lenses
                xy = target - (self._distort(xy) - xy)
        residual = ((self._distort(xy) - target) * focal).norm(dim=-1)
        directions = torch.cat([xy, torch.ones_like(xy[..., :1])], -1)
        return directions / directions.norm(dim=-1, keepdim=True), residual < 1e-3

    def _distort(self, xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        k1, k2, p1, p2, k3 = self.distortion
        if not any(self.distortion):
            return xy
        x, y = xy.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return torch.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            -1,
        )

    def opencv_matrix(self) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix for OpenCV calls: integer pixel centres."""
        return torch.tensor(
            [
                [self.fx, 0.0, self.cx - PIXEL_CENTRE],
                [0.0, self.fy, self.cy - PIXEL_CENTRE],
                [0.0, 0.0, 1.0],
            ],
            dtype=torch.float64,
        )

    def scaled(self, factor: float) -> "Pinhole":
        """The same lens for the image resized by `factor` (coordinates scale as `pixels * s`)."""
        return replace(
            self,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
            width=round(self.width * factor),
            height=round(self.height * factor),
        )


@dataclass(frozen=True)
class Equidistant:
    """Ideal fisheye: rho = focal * theta (NToP eq. 2), focal in pixels per radian.

    Defined for theta <= `max_theta` < pi; NToP's own ray formula f * tan(theta) is 0/0 on the axis
    and points backwards past 90 degrees (decision 0003), so rays are built from angles here.
    """

    focal: float
    cx: float
    cy: float
    width: int
    height: int
    max_theta: float = math.pi / 2

    model = "equidistant"

    def __post_init__(self) -> None:
        """Refuse a lens whose image circle is not a one-to-one map."""
        if not (self.focal > 0 and 0 < self.max_theta < math.pi):
            raise DataError(
                f"equidistant lens: focal {self.focal} px/rad, max_theta {self.max_theta} rad; "
                "expected focal > 0 and 0 < max_theta < pi"
            )

    def project(
        self, points_camera: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of camera-frame points; seen = within `max_theta` of the axis."""
        x, y, z = points_camera.unbind(-1)
        q = x * x + y * y
        small = (q < 1e-8 * z * z) & (z > 0)
        z_safe = torch.where(small, z, torch.ones_like(z))
        r_safe = torch.where(small | (q == 0), torch.ones_like(q), q).sqrt()
        # theta / hypot(x, y); series near the axis, where the quotient is 0/0
        gain = torch.where(
            small, (1 - q / (z_safe * z_safe) / 3) / z_safe, torch.atan2(r_safe, z) / r_safe
        )
        theta = torch.atan2(q.detach().sqrt(), z.detach())
        seen = (theta <= self.max_theta) & ((q > 0) | (z > 0))
        pixels = torch.stack([self.focal * x * gain + self.cx, self.focal * y * gain + self.cy], -1)
        return pixels, seen

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Unit directions through pixels; valid = inside the image circle of `max_theta`."""
        a = (pixels[..., 0] - self.cx) / self.focal
        b = (pixels[..., 1] - self.cy) / self.focal
        t2 = a * a + b * b
        small = t2 < 1e-6
        theta = torch.where(small, torch.ones_like(t2), t2).sqrt()
        sinc = torch.where(small, 1 - t2 / 6 * (1 - t2 / 20), torch.sin(theta) / theta)
        cosine = torch.where(small, 1 - t2 / 2 * (1 - t2 / 12), torch.cos(theta))
        return torch.stack([a * sinc, b * sinc, cosine], -1), t2 <= self.max_theta**2


Lens = Pinhole | Equidistant


@dataclass(frozen=True)
class Camera:
    """A lens placed in the world: `center_world` (metres) and the rotation camera_from_world."""

    lens: Lens
    center_world: Float[Tensor, " 3"]
    rotation: Float[Tensor, "3 3"]

    @property
    def camera_from_world(self) -> RigidTransform:
        """X_c = R X_w + t with t = -R c, derived from the stored centre."""
        return RigidTransform(self.rotation, -(self.rotation @ self.center_world))

    def project(
        self, points_world: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of world points and whether the lens sees them.

        Subtracts the centre first: R X + t cancels badly far from the origin.
        """
        return self.lens.project((points_world - self.center_world) @ self.rotation.T)

    def rays(
        self, pixels: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Unit world directions through pixels, and their validity; the origin is the centre."""
        directions, valid = self.lens.unproject(pixels)
        return directions @ self.rotation, valid


def pixel_grid(width: int, height: int, dtype: torch.dtype) -> Float[Tensor, "height width 2"]:
    """Centres of all pixels, [v, u] order, (u, v) values."""
    u = torch.arange(width, dtype=dtype) + PIXEL_CENTRE
    v = torch.arange(height, dtype=dtype) + PIXEL_CENTRE
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
