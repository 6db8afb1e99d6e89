"""What all lenses do before their arithmetic: refuse bad parameters, set bad numbers aside.

A point or pixel that is not finite never reaches a formula: a harmless one takes its place and the
result is marked as invalid, so that neither value nor gradient can become NaN.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.conventions import DataError

FARTHEST = 1e100  # focal lengths off the principal point; squares stay finite


def require_lens(
    name: str, *, focal: tuple[float, float], center: tuple[float, float], size: tuple[int, int]
) -> None:
    """Refuse intrinsics that cannot be those of an image.

    Raises:
        DataError: a focal length or size that is not positive, or a number that is not finite.
    """
    numbers = (*focal, *center, *size)
    if not (all(math.isfinite(n) for n in numbers) and min(*focal, *size) > 0):
        raise DataError(
            f"{name} lens: focal {focal} px, principal point {center} px, image {size[0]}x{size[1]}"
            " px; expected finite numbers, focal > 0 and an image of at least one pixel"
        )


def require_domain(name: str, max_theta: float, *, below: float, why: str) -> None:
    """Refuse a largest angle beyond which the lens is not a one-to-one map.

    Raises:
        DataError: `max_theta` is not in (0, below].
    """
    if not 0 < max_theta <= below:
        raise DataError(
            f"{name} lens: max_theta {max_theta} rad; expected 0 < max_theta <= {below:.9g}: {why}"
        )


def guarded_points(
    points: Float[Tensor, "*batch 3"],
) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
    """Points scaled to order one, and which were usable (finite, not the camera's centre itself).

    A projection only asks for directions; a power of two scales without rounding, so that squares
    neither overflow nor vanish.
    """
    size = points.detach().abs().amax(-1, keepdim=True)
    usable = torch.isfinite(size) & (size > 0)
    on_axis = torch.zeros_like(points)
    on_axis[..., 2] = 1
    mantissa, _ = torch.frexp(torch.where(usable, size, torch.ones_like(size)))
    power = torch.where(usable, size, torch.ones_like(size)) / (2 * mantissa)
    return torch.where(usable, points, on_axis) / power, usable[..., 0]


def guarded_offsets(
    pixels: Float[Tensor, "*batch 2"],
    *,
    focal: tuple[float, float],
    center: tuple[float, float],
    rim: float,
) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
    """Offsets from the principal point in focal lengths, and which lie within radius `rim`.

    The others are moved onto the rim, or to the centre where they are no numbers. The comparison
    is float64's whatever the pixels are: a pixel's validity does not depend on the precision.
    """
    exact = pixels.detach().double()
    exact = (exact - exact.new_tensor(center)) / exact.new_tensor(focal)
    usable = (exact.abs() < FARTHEST).all(-1)
    exact = torch.where(usable[..., None], exact, torch.zeros_like(exact))
    squared = (exact * exact).sum(-1)
    valid = usable & (squared <= rim * rim)
    shrink = torch.where(valid, torch.ones_like(squared), rim / squared.sqrt().clamp(min=rim))
    inside = torch.where(valid[..., None], pixels, pixels.new_tensor(center))
    offsets = (inside - inside.new_tensor(center)) / inside.new_tensor(focal)
    moved = (exact * shrink[..., None]).to(pixels.dtype)
    return torch.where(valid[..., None], offsets, moved), valid
