"""The perspective lens with radial-tangential distortion, on the range where it is one-to-one.

Notation: (x, y) = (X/Z, Y/Z) undistorted, its length the tangent of theta; D(x, y) distorted.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.conventions import DataError
from ntop.geometry import radial_polynomial
from ntop.geometry.guards import guarded_offsets, guarded_points, require_lens
from ntop.geometry.monotone import monotone_limit

MAX_TANGENT = 1e3  # of theta: 89.94 degrees; nothing is imaged at 90
MAX_ITERATIONS = 12  # of Newton's method for the tangential part; 3-4 are enough
CONVERGED_PX = 1e-9


@dataclass(frozen=True)
class Pinhole:
    """Perspective lens with OpenCV's radial-tangential distortion (k1, k2, p1, p2, k3).

    `cx`, `cy` follow our pixel centres; OpenCV's are 0.5 smaller. Points outside `max_tangent` are
    not seen: there the polynomial may fold them back into the image.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    model = "pinhole_radtan"

    def __post_init__(self) -> None:
        """Refuse intrinsics that cannot be those of an image."""
        require_lens(
            self.model,
            focal=(self.fx, self.fy),
            center=(self.cx, self.cy),
            size=(self.width, self.height),
        )
        if len(self.distortion) != 5 or not all(math.isfinite(k) for k in self.distortion):
            raise DataError(
                f"{self.model} lens: distortion {self.distortion}; expected five finite numbers "
                "k1, k2, p1, p2, k3"
            )

    @cached_property
    def max_tangent(self) -> float:
        """Radius of the undistorted disc on which the distortion is one-to-one.

        On a convex set a map is one-to-one if its derivative's symmetric part is positive; with
        radial terms alone that is where the polynomial grows.
        """
        k1, k2, p1, p2, k3 = self.distortion
        limit = min(MAX_TANGENT, monotone_limit((k1, k2, k3)))
        if p1 == p2 == 0:
            return limit
        radii = np.geomspace(1e-3 * min(limit, 1.0), limit, 512)[:, None]
        azimuths = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        xy = torch.from_numpy(
            np.stack([radii * np.cos(azimuths), radii * np.sin(azimuths)], -1)
        ).double()
        jacobian = self._distortion_jacobian(xy)
        smallest = torch.linalg.eigvalsh(0.5 * (jacobian + jacobian.mT))[..., 0]
        folded = (smallest <= 0).any(-1)
        return float(radii[int(folded.int().argmax()) - 1, 0]) if bool(folded.any()) else limit

    @cached_property
    def max_theta(self) -> float:
        """Angle of the widest ray that lands inside the image (radians)."""
        return math.atan(self._widest_tangent)

    @cached_property
    def max_px_per_rad(self) -> float:
        """Upper bound of the image distance per angle between two rays within `max_theta`."""
        radii = torch.linspace(0, self._widest_tangent, 256, dtype=torch.float64)[:, None]
        azimuths = torch.linspace(0, 2 * math.pi, 64, dtype=torch.float64)
        xy = torch.stack([radii * azimuths.cos(), radii * azimuths.sin()], -1)
        stretch = torch.linalg.matrix_norm(self._distortion_jacobian(xy), ord=2)
        largest = float((stretch * (1 + radii**2)).max())
        return 1.02 * max(self.fx, self.fy) * largest  # between the samples

    @cached_property
    def _widest_tangent(self) -> float:
        """Largest undistorted radius inside the image: it lies on the border."""
        share = torch.linspace(0, 1, 65, dtype=torch.float64)
        zero, one = torch.zeros_like(share), torch.ones_like(share)
        sides = [(share, zero), (share, one), (zero, share), (one, share)]
        border = torch.cat([torch.stack(side, -1) for side in sides])
        directions, valid = self.unproject(border * torch.tensor([self.width, self.height]))
        if not bool(valid.all()):
            return self.max_tangent
        tangents = directions[:, :2].norm(dim=-1) / directions[:, 2]
        return min(1.02 * float(tangents.max()), self.max_tangent)

    def project(
        self, points_camera: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of camera-frame points; seen = ahead and within `max_tangent`.

        Inside the image or not: the pixel says so. Unseen points get the principal point.
        """
        scaled, usable = guarded_points(points_camera)
        exact = scaled.detach().double()
        z = exact[..., 2]
        h = torch.hypot(exact[..., 0], exact[..., 1])
        seen = usable & (z > 0) & (h <= self.max_tangent * z)
        safe_z = torch.where(seen, scaled[..., 2], torch.ones_like(scaled[..., 2]))
        xy = torch.where(seen[..., None], scaled[..., :2], torch.zeros_like(scaled[..., :2]))
        distorted = self._distort(xy / safe_z[..., None])
        focal = distorted.new_tensor([self.fx, self.fy])
        return distorted * focal + distorted.new_tensor([self.cx, self.cy]), seen

    def unproject(
        self, pixels: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Unit directions through pixels; valid = images of a ray within `max_tangent`."""
        target, valid = guarded_offsets(
            pixels,
            focal=(self.fx, self.fy),
            center=(self.cx, self.cy),
            rim=1e6 * self.max_tangent,  # the test against the domain is on the undistorted side
        )
        if any(self.distortion):
            solution, inside = self._undistorted(target.detach().double())
            # the implicit function theorem: dx = J^-1 dt at the solution, whatever found it
            moved = self._step(solution.to(pixels.dtype), target - target.detach())
            xy = solution.to(pixels.dtype) + moved
        else:
            exact = target.detach().double()
            inside = (exact * exact).sum(-1) <= self.max_tangent**2
            xy = torch.where(inside[..., None], target, torch.zeros_like(target))
        scale = (1 + (xy * xy).sum(-1, keepdim=True)).rsqrt()
        return torch.cat([xy * scale, scale], -1), valid & inside

    def _undistorted(
        self, target: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """The (x, y) with D(x, y) = target, and where there is one in the domain; float64."""
        k1, k2, p1, p2, k3 = self.distortion
        limit = self.max_tangent
        radius = target.norm(dim=-1, keepdim=True)
        tangent, _ = radial_polynomial.solve(radius, (k1, k2, k3), limit=limit)
        xy = target * torch.where(radius > 0, tangent / radius.clamp(min=1e-300), radius)
        focal = target.new_tensor([self.fx, self.fy])
        for _ in range(MAX_ITERATIONS if p1 or p2 else 0):
            miss = target - self._distort(xy)
            if not bool((miss.abs() > 1e-16).any()):
                break
            xy = xy + self._step(xy, miss)
            # back into the disc on which the derivative can be inverted
            xy = xy * (limit / xy.norm(dim=-1, keepdim=True).clamp(min=limit))
        residual_px = ((self._distort(xy) - target) * focal).norm(dim=-1)
        return xy, residual_px <= CONVERGED_PX + 1e-12 * (target * focal).norm(dim=-1)

    def _distort(self, xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        if not any(self.distortion):
            return xy
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy.unbind(-1)
        r2 = x * x + y * y
        radial = radial_polynomial.ratio(r2, (k1, k2, k3))
        return torch.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            -1,
        )

    def _step(
        self, xy: Float[Tensor, "*batch 2"], miss: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch 2"]:
        """By how much (x, y) moves where D(x, y) moves by `miss`: J^-1 of a symmetric 2 x 2 J."""
        jacobian = self._distortion_jacobian(xy)
        along, across, down = jacobian[..., 0, 0], jacobian[..., 0, 1], jacobian[..., 1, 1]
        determinant = along * down - across * across
        x = (down * miss[..., 0] - across * miss[..., 1]) / determinant
        y = (along * miss[..., 1] - across * miss[..., 0]) / determinant
        return torch.stack([x, y], -1)

    def _distortion_jacobian(self, xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2 2"]:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy.unbind(-1)
        r2 = x * x + y * y
        radial = radial_polynomial.ratio(r2, (k1, k2, k3))
        bend = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d(radial)/d(r2) * 2
        across = bend * x * y + 2 * p1 * x + 2 * p2 * y
        return torch.stack(
            [
                torch.stack([radial + bend * x * x + 2 * p1 * y + 6 * p2 * x, across], -1),
                torch.stack([across, radial + bend * y * y + 6 * p1 * y + 2 * p2 * x], -1),
            ],
            -2,
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
