"""Derivatives of lenses: pixel by point, ray by pixel, and the solid angle of a pixel."""

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.geometry.cameras import Lens


def pixel_by_point(
    lens: Lens, points_camera: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 2 3"]:
    """d(u, v) / d(x, y, z), pixels per metre; meaningful where the lens sees the point."""
    points = points_camera.detach().requires_grad_()
    pixels, _ = lens.project(points)
    return _rows(pixels, points)


def ray_by_pixel(lens: Lens, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3 2"]:
    """d(unit direction) / d(u, v), radians per pixel; meaningful where the pixel is valid."""
    at = pixels.detach().requires_grad_()
    directions, _ = lens.unproject(at)
    return _rows(directions, at)


def solid_angle(lens: Lens, pixels: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
    """Steradians per square pixel: sin(theta) / (f^2 theta) for an equidistant lens."""
    derivative = ray_by_pixel(lens, pixels)
    return torch.linalg.cross(derivative[..., 0], derivative[..., 1], dim=-1).norm(dim=-1)


def _rows(
    values: Float[Tensor, "*batch m"], variables: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch m n"]:
    # each value depends on its own variables only, so that one sum serves the whole batch
    rows = [
        torch.autograd.grad(values[..., i].sum(), variables, retain_graph=True)[0]
        for i in range(values.shape[-1])
    ]
    return torch.stack(rows, -2)
