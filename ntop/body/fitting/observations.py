"""What the cameras saw, in the form the solver needs: rays and their pixel scale, no lenses.

A pixel becomes a ray once; afterwards the miss of a body point is its distance from the ray over
its distance from the camera, times the lens's pixels per radian. So every lens costs the same and
distortion is undone only once.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ntop.geometry.triangulation import Triangulation, triangulate_robust


@dataclass(frozen=True)
class LandmarkRays:
    """Detected landmarks of all frames; cameras may differ from frame to frame.

    Attributes:
        centers_world: optical centres, metres.
        directions_world: unit rays.
        weights: detector confidence in [0, 1]; zero where there is no observation.
        scale_px: pixels per radian on the axis.
    """

    centers_world: Float[Tensor, "frame camera 3"]
    directions_world: Float[Tensor, "frame camera landmark 3"]
    weights: Float[Tensor, "frame camera landmark"]
    scale_px: Float[Tensor, "frame camera"]


@dataclass(frozen=True)
class ContourRays:
    """Points of silhouettes' borders, each to be met by one vertex of the body.

    Attributes:
        frame: which frame each belongs to.
        vertex: which fit point it should meet.
        center_world, direction_world: its ray.
        normal_world: unit, across the ray, out of the silhouette: sliding along the border is free.
        weights: >= 0.
    """

    frame: Int[Tensor, " point"]
    vertex: Int[Tensor, " point"]
    center_world: Float[Tensor, "point 3"]
    direction_world: Float[Tensor, "point 3"]
    normal_world: Float[Tensor, "point 3"]
    weights: Float[Tensor, " point"]


def triangulated_landmarks(rays: LandmarkRays, *, tolerance_px: float) -> Triangulation:
    """One 3D point per frame and landmark, wrong cameras dropped; (frame, landmark) leading."""
    tolerance_rad = tolerance_px / float(rays.scale_px.mean())
    results = [
        triangulate_robust(
            rays.centers_world[frame],
            rays.directions_world[frame].transpose(0, 1),
            rays.weights[frame].transpose(0, 1),
            tolerance_rad=tolerance_rad,
        )
        for frame in range(rays.centers_world.shape[0])
    ]
    return Triangulation(
        *(
            torch.stack([getattr(result, name) for result in results])
            for name in ("points_world", "valid", "used", "angle_rad", "condition")
        )
    )


def landmark_misses_px(
    rays: LandmarkRays, points_world: Float[Tensor, "frame landmark 3"]
) -> Float[Tensor, "frame camera landmark"]:
    """How far each landmark misses its ray, in pixels."""
    offset = points_world[:, None] - rays.centers_world[:, :, None]
    along = (offset * rays.directions_world).sum(-1, keepdim=True)
    sideways = (offset - along * rays.directions_world).square().sum(-1)
    # + 1e-12: the root's slope at zero; 1e-6 m is far below any observation
    distance = (sideways + 1e-12).sqrt() / along.squeeze(-1).clamp(min=0.1)
    return distance * rays.scale_px[..., None]


def contour_misses_m(
    rays: ContourRays, points_world: Float[Tensor, "frame point 3"]
) -> Float[Tensor, " contour"]:
    """Signed miss of each contour point across the border, in metres; positive is outside."""
    offset = points_world[rays.frame, rays.vertex] - rays.center_world
    return (offset * rays.normal_world).sum(-1)
