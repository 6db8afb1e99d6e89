"""The virtual top-view rig: nine downward fisheye cameras, one in the centre and eight around.

Slots are placed by camera *centre*: azimuth n * 45 degrees counter-clockwise from above, `e` = +x.
The paper puts (x_p, y_p, h) into the translation T of X_c = R X_w + T, which no proper rotation
turns into that centre; read literally it mirrors E and W (decision 0005).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.conventions import VIEWS
from ntop.geometry.cameras import Camera
from ntop.geometry.fisheyes import Fisheye, fisheye_lens
from ntop.geometry.ideal_fisheyes import Equidistant

# image right = +x, image up = +y, looking down
ROTATION_LOOKING_DOWN = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))


@dataclass(frozen=True)
class Rig:
    """Where the nine cameras stand relative to the pelvis, and their lens."""

    height_above_pelvis_m: float
    ring_radius_m: float
    width: int
    height: int
    focal_px: float
    max_theta_rad: float = math.pi / 2
    model: str = Equidistant.model
    focal_y_px: float | None = None
    center_px: tuple[float, float] | None = None
    distortion: tuple[float, ...] = ()

    def lens(self) -> Fisheye:
        """The lens all nine cameras share; pixels are square and centred unless told otherwise.

        Raises:
            DataError: no such model, or parameters that it cannot have.
        """
        center = self.center_px or (self.width / 2, self.height / 2)
        return fisheye_lens(
            self.model,
            fx=self.focal_px,
            fy=self.focal_px if self.focal_y_px is None else self.focal_y_px,
            cx=center[0],
            cy=center[1],
            width=self.width,
            height=self.height,
            max_theta=self.max_theta_rad,
            distortion=self.distortion,
        )


def top_view_cameras(
    rig: Rig, pelvis_world: Float[Tensor, " 3"], *, paper_compat: bool = False
) -> dict[str, Camera]:
    """The nine cameras of a set, by view name, above the given pelvis (float64).

    `paper_compat` reproduces the paper's mirrored labels: what it calls `e` stands at -x.
    """
    pelvis = pelvis_world.to(torch.float64)
    rotation = torch.tensor(ROTATION_LOOKING_DOWN, dtype=torch.float64)
    cameras = {}
    for index, view in enumerate(VIEWS):
        offset = torch.zeros(3, dtype=torch.float64)
        if view != "centre":
            azimuth = (index - 1) * math.pi / 4
            x, y = rig.ring_radius_m * math.cos(azimuth), rig.ring_radius_m * math.sin(azimuth)
            offset[0], offset[1] = (-x if paper_compat else x), y
        offset[2] = rig.height_above_pelvis_m
        cameras[view] = Camera(rig.lens(), pelvis + offset, rotation)
    return cameras
