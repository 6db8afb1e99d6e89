"""Projection of 3D keypoints into a view, in float64, unclipped."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from ntop.geometry.cameras import Camera


@dataclass(frozen=True)
class ProjectedKeypoints:
    """Keypoints of one person in one view.

    `pixels` are unclipped and may lie outside the image; `in_view` says inside the image and
    within the lens's image circle. `distances_m` are ray lengths from the camera's centre.
    """

    pixels: Float[Tensor, "keypoint 2"]
    in_view: Bool[Tensor, " keypoint"]
    points_camera: Float[Tensor, "keypoint 3"]
    distances_m: Float[Tensor, " keypoint"]


def project_keypoints(
    points_world: Float[Tensor, "keypoint 3"], camera: Camera
) -> ProjectedKeypoints:
    """Where world points appear in a camera; the arithmetic is that of the points' dtype."""
    points_camera = (points_world - camera.center_world) @ camera.rotation.T
    pixels, seen = camera.lens.project(points_camera)
    size = pixels.new_tensor([camera.lens.width, camera.lens.height])
    inside = ((pixels >= 0) & (pixels < size)).all(-1)
    return ProjectedKeypoints(
        pixels=pixels,
        in_view=seen & inside,
        points_camera=points_camera,
        distances_m=points_camera.norm(dim=-1),
    )
