"""Lenses of transformed images: crop, resize, mirror, quarter turn; and a camera's roll.

Each function answers: which lens belongs to the picture after this operation? Pixel positions are
continuous and the image spans [0, W] x [0, H], so that no half pixel appears anywhere.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.geometry.cameras import Camera, Lens
from ntop.geometry.guards import require_lens
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.pinhole import Pinhole


def cropped(lens: Lens, *, left: int, top: int, width: int, height: int) -> Lens:
    """The lens of a window of whole pixels: (u, v) -> (u - left, v - top)."""
    return replace(lens, cx=lens.cx - left, cy=lens.cy - top, width=width, height=height)


def resized(lens: Lens, *, width: int, height: int) -> Lens:
    """The lens of the image resized to a new size: (u, v) -> (u width / W, v height / H).

    Raises:
        DataError: the new image has no pixels.
    """
    require_lens(
        lens.model, focal=(lens.fx, lens.fy), center=(lens.cx, lens.cy), size=(width, height)
    )
    across, down = width / lens.width, height / lens.height
    return _with_intrinsics(
        lens,
        focal=(lens.fx * across, lens.fy * down),
        center=(lens.cx * across, lens.cy * down),
        size=(width, height),
    )


def mirrored(lens: Lens) -> Lens:
    """The lens of the image flipped left to right, for a scene mirrored in the camera's x.

    (u, v) -> (W - u, v) and (x, y, z) -> (-x, y, z). No turned camera sees a mirrored world.
    """
    flipped = replace(lens, cx=lens.width - lens.cx)
    if isinstance(flipped, Pinhole):
        k1, k2, p1, p2, k3 = flipped.distortion
        return replace(flipped, distortion=(k1, k2, p1, -p2, k3))
    return flipped


def turned(camera: Camera) -> Camera:
    """The camera of the image turned clockwise by a quarter: (u, v) -> (H - v, u)."""
    lens = camera.lens
    upright = _with_intrinsics(
        lens,
        focal=(lens.fy, lens.fx),
        center=(lens.height - lens.cy, lens.cx),
        size=(lens.height, lens.width),
    )
    if isinstance(upright, Pinhole):
        k1, k2, p1, p2, k3 = upright.distortion
        upright = replace(upright, distortion=(k1, k2, p2, -p1, k3))
    return replace(rolled(camera, angle_rad=math.pi / 2), lens=upright)


def rolled(camera: Camera, *, angle_rad: float) -> Camera:
    """The camera rolled about its axis so that its image turns clockwise by `angle_rad`.

    Round lenses (fx = fy, no tangential part) turn their pixels about the principal point.
    """
    return replace(camera, rotation=_about_axis(angle_rad, camera.rotation) @ camera.rotation)


def _about_axis(angle_rad: float, like: Tensor) -> Float[Tensor, "3 3"]:
    quarters = angle_rad / (math.pi / 2)
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    if quarters == round(quarters):  # whole quarters exactly
        cosine, sine = float(round(cosine)), float(round(sine))
    return torch.tensor(
        [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]],
        dtype=like.dtype,
        device=like.device,
    )


def _with_intrinsics(
    lens: Lens, *, focal: tuple[float, float], center: tuple[float, float], size: tuple[int, int]
) -> Lens:
    place = {"cx": center[0], "cy": center[1], "width": size[0], "height": size[1]}
    if isinstance(lens, Pinhole | KannalaBrandt):
        return replace(lens, fx=focal[0], fy=focal[1], **place)
    return replace(lens, focal=focal[0], aspect=focal[1] / focal[0], **place)
