"""Rays through the posed body's box: where they enter and leave, and what is seen along them."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.field.humannerf.field import ActorField, Samples, sampled
from ntop.field.humannerf.skeleton import Box, PosedSkeleton


class Interval(NamedTuple):
    """Where rays are inside a box, in metres from their origin."""

    near: Float[Tensor, " ray"]
    far: Float[Tensor, " ray"]
    hit: Bool[Tensor, " ray"]


class Traced(NamedTuple):
    """Rays, premultiplied. `alphas` are the samples' own opacities, `samples` what was found."""

    colours: Float[Tensor, "ray 3"]
    opacity: Float[Tensor, " ray"]
    alphas: Float[Tensor, "ray sample"]
    samples: Samples


def box_interval(
    origin: Float[Tensor, " 3"], directions: Float[Tensor, "ray 3"], box: Box
) -> Interval:
    """Slab test; a ray that begins inside the box begins there, one behind it misses.

    Directions parallel to a face are told by their zero component, not by an epsilon.
    """
    low, high = directions.new_tensor(box.low), directions.new_tensor(box.high)
    parallel = directions == 0
    safe = torch.where(parallel, 1.0, directions)
    first, second = (low - origin) / safe, (high - origin) / safe
    inside = ((origin >= low) & (origin <= high)).expand_as(directions)
    endless = torch.full_like(directions, torch.inf)
    enter = torch.where(parallel, torch.where(inside, -endless, endless), first.minimum(second))
    leave = torch.where(parallel, torch.where(inside, endless, -endless), first.maximum(second))
    near = enter.amax(-1).clamp(min=0)
    far = leave.amin(-1)
    return Interval(near, far, far > near)


def trace(
    field: ActorField,
    skeleton: PosedSkeleton,
    *,
    origin: Float[Tensor, " 3"],
    directions: Float[Tensor, "ray 3"],
    interval: Interval,
    offsets: Float[Tensor, "#ray #sample"],
    num_samples: int,
    weight_floor: float,
) -> Traced:
    """March rays that hit the box; everything relative to the pose's origin.

    The interval is cut into `num_samples` equal pieces with one sample each, `offsets` (0..1)
    of a piece from its start. The last piece ends where the box ends.
    """
    pieces = torch.arange(num_samples, device=directions.device, dtype=directions.dtype)
    step = (interval.far - interval.near)[:, None] / num_samples
    depths = interval.near[:, None] + step * (pieces + offsets)
    points = origin + depths[..., None] * directions[:, None, :]
    shape = depths.shape
    found = sampled(field, skeleton, points.reshape(-1, 3), weight_floor=weight_floor)
    lengths = step.expand(shape).reshape(-1)[found.kept]
    kept_alphas = -torch.expm1(-found.densities * lengths) * found.shares
    empty = points.new_zeros(shape.numel())
    alphas = empty.index_copy(0, found.kept, kept_alphas).view(shape)
    clear = torch.cumprod(1 - alphas, 1)
    before = torch.cat([torch.ones_like(clear[:, :1]), clear[:, :-1]], 1)
    weights = (before * alphas).reshape(-1)[found.kept, None]
    ray = found.kept // num_samples
    colours = points.new_zeros(len(directions), 3).index_add(0, ray, weights * found.colours)
    return Traced(colours, 1 - clear[:, -1], alphas, found)


def median_depth(
    alphas: Float[Tensor, "ray sample"], interval: Interval
) -> tuple[Float[Tensor, " ray"], Float[Tensor, " ray"]]:
    """Ray length at which half of the light is gone, and the sample it falls into.

    Within a piece light falls exponentially. Both are infinite and -1 where more than half passes.
    """
    clear = torch.cumprod(1 - alphas, 1)
    gone = clear <= 0.5
    index = gone.to(torch.uint8).argmax(1)
    rows = torch.arange(len(alphas), device=alphas.device)
    before = torch.where(index > 0, clear[rows, (index - 1).clamp(min=0)], 1.0)
    rest = torch.log1p(-alphas[rows, index].clamp(max=1 - 1e-7))
    share = torch.where(rest < 0, torch.log(0.5 / before) / torch.where(rest < 0, rest, -1.0), 0.5)
    step = (interval.far - interval.near) / alphas.shape[1]
    depth = interval.near + step * (index + share.clamp(0, 1))
    known = gone.any(1)
    return torch.where(known, depth, torch.inf), torch.where(known, index, -1)
