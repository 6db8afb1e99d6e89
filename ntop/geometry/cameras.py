"""Cameras: a lens placed in the world. Pixel <-> ray, always with validity.

Notation: pixels (u, v), first centre at (0.5, 0.5); theta is the angle from the optical axis.
Every lens gives `project(points_camera) -> (pixels, seen)` and `unproject(pixels) ->
(directions_camera, valid)` with unit directions, `max_theta`, beyond which it sees nothing, and
`max_px_per_rad`, a bound of how far apart the images of two rays can be. Points and pixels that
are no numbers give finite results marked as invalid. Lenses: `pinhole`, `ideal_fisheyes`,
`kannala_brandt`.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.geometry.ideal_fisheyes import Equidistant, Equisolid, Stereographic
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.pinhole import Pinhole
from ntop.geometry.rigid import RigidTransform

MAX_ROTATION_DEFECT = 1e-3  # of R R^T: calibrations are written with few digits

Lens = Pinhole | Equidistant | Equisolid | Stereographic | KannalaBrandt


@dataclass(frozen=True)
class Camera:
    """A lens placed in the world: `center_world` (metres) and the rotation camera_from_world."""

    lens: Lens
    center_world: Float[Tensor, " 3"]
    rotation: Float[Tensor, "3 3"]

    def __post_init__(self) -> None:
        """Refuse a place that is none."""
        if not bool(self.center_world.isfinite().all() & self.rotation.isfinite().all()):
            raise DataError(
                f"camera at {self.center_world.tolist()} m, camera_from_world "
                f"{self.rotation.tolist()}; expected finite numbers"
            )
        exact = self.rotation.detach().double()
        identity = torch.eye(3, dtype=torch.float64, device=exact.device)
        defect = float((exact @ exact.T - identity).abs().max())
        if defect > MAX_ROTATION_DEFECT or float(torch.linalg.det(exact)) < 0:
            raise DataError(
                f"camera_from_world {exact.tolist()} is no rotation: R R^T - 1 is {defect:.1e}, "
                "expected orthogonal axes of length one that are not mirrored"
            )

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
