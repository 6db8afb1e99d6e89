"""A capture rig's extrinsics refined under the held-out protocol.

Held-out cameras must not touch what is trained: the other cameras are refined without them, and
each held-out camera is then placed against the points that the others see.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.geometry.cameras import Camera
from ntop.geometry.refinement import Observations, refine_extrinsics, resect
from ntop.geometry.triangulation import (
    camera_centers,
    camera_rays,
    reprojection_errors_px,
    triangulate,
    triangulate_robust,
)


@dataclass(frozen=True)
class RefinementSettings:
    """Prior in pixels per radian and metre; where the loss turns linear; what is an outlier."""

    prior_weight: float = 30.0
    loss_scale_px: float = 4.0
    outlier_px: float = 25.0


def refine_rig(
    cameras: list[Camera],
    observations: Observations,
    *,
    held_out: list[int],
    for_training: Bool[Tensor, " point"],
    for_held_out: Bool[Tensor, " point"],
    settings: RefinementSettings,
) -> list[Camera]:
    """All cameras refined; those in `held_out` from points that the others place.

    `for_training` and `for_held_out` say which points the two kinds of cameras may use.
    """
    training = [i for i in range(len(cameras)) if i not in held_out]
    refined = dict(
        zip(
            training,
            refine_extrinsics(
                [cameras[i] for i in training],
                _selected(observations, cameras=training, points=for_training),
                prior_weight=settings.prior_weight,
                loss_scale_px=settings.loss_scale_px,
            ),
            strict=True,
        )
    )
    if held_out:
        seen = _selected(observations, cameras=training, points=for_held_out)
        rotation = torch.stack([refined[i].rotation for i in training])
        scale = float(seen.scale_px.mean())
        placed = triangulate_robust(
            camera_centers([refined[i] for i in training]),
            (seen.bearings_camera[..., None, :] @ rotation).squeeze(-2),
            seen.weights,
            tolerance_rad=settings.outlier_px / scale,
        )
        for index in held_out:
            own = _selected(observations, cameras=[index], points=for_held_out)
            refined[index] = resect(
                cameras[index],
                Observations(
                    own.bearings_camera, own.scale_px, own.weights * placed.valid[:, None]
                ),
                placed.points_world,
                prior_weight=settings.prior_weight,
                loss_scale_px=settings.loss_scale_px,
            )
    return [refined[i] for i in range(len(cameras))]


def agreement_px(
    cameras: list[Camera],
    pixels: Float[Tensor, "point camera 2"],
    observed: Bool[Tensor, "point camera"],
) -> Float[Tensor, " error"]:
    """Reprojection errors of plain triangulated points that every camera observes, in pixels."""
    complete = observed.all(-1)
    directions, covered = camera_rays(cameras, pixels[complete])
    found = triangulate(camera_centers(cameras), directions, covered.double())
    errors = reprojection_errors_px(cameras, found.points_world, pixels[complete])
    return errors[found.valid].flatten()


def _selected(
    observations: Observations, *, cameras: list[int], points: Bool[Tensor, " point"]
) -> Observations:
    return Observations(
        observations.bearings_camera[points][:, cameras],
        observations.scale_px[points][:, cameras],
        observations.weights[points][:, cameras],
    )
