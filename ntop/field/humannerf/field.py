"""From a posed point to colour and density: skeletal warp, non-rigid offset, canonical field."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ntop.field.humannerf.networks import CanonicalField, NonRigidMotion
from ntop.field.humannerf.skeleton import Box, PosedSkeleton


@dataclass(frozen=True)
class ActorField:
    """What a ray meets. `volume` holds the bones' weights at the nodes of the canonical `box`.

    `windows` open the bands of the non-rigid motion; None: the bones alone move the actor.
    """

    volume: Float[Tensor, "24 x y z"]
    box: Box
    canonical: CanonicalField
    non_rigid: NonRigidMotion
    windows: Float[Tensor, " band"] | None


class Warped(NamedTuple):
    """Canonical positions of points, and how much of each belongs to the actor (0..1)."""

    canonical: Float[Tensor, "point 3"]
    share: Float[Tensor, " point"]


class Samples(NamedTuple):
    """What the points that are `kept` (indices) hold: colour, density per metre, opacity's bound.

    `canonical` are their positions before the non-rigid offset.
    """

    kept: Int[Tensor, " kept"]
    canonical: Float[Tensor, "kept 3"]
    colours: Float[Tensor, "kept 3"]
    densities: Float[Tensor, " kept"]
    shares: Float[Tensor, " kept"]


def on_device(skeleton: PosedSkeleton, device: torch.device) -> PosedSkeleton:
    """The same pose with its tensors where the networks are."""
    return replace(skeleton, maps=skeleton.maps.to(device), pose=skeleton.pose.to(device))


def bone_weights(
    field: ActorField, skeleton: PosedSkeleton, points: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, "24 point 3"], Float[Tensor, "24 point"]]:
    """Where each bone takes posed points, and its weight there (trilinear, 0 beyond the box)."""
    rotations, shifts = skeleton.maps[:, :, :3], skeleton.maps[:, None, :, 3]
    places = points @ rotations.transpose(1, 2) + shifts
    low = places.new_tensor(field.box.low)
    size = places.new_tensor(field.box.high - field.box.low)
    # grid_sample wants the last axis first, in [-1, 1]
    grid = (2 * (places - low) / size - 1).flip(-1)
    weights = torch.nn.functional.grid_sample(
        field.volume[:, None], grid[:, None, None], align_corners=True
    )
    return places, weights[:, 0, 0, 0]


def warped(field: ActorField, skeleton: PosedSkeleton, points: Float[Tensor, "point 3"]) -> Warped:
    """Posed points in canonical space by the bones alone (HumanNeRF's eq. 3 and 4).

    Each bone takes the point to canonical space by its own transform and looks its weight up there;
    the places are averaged by these weights. Points that no bone claims stay at zero.
    """
    places, weights = bone_weights(field, skeleton, points)
    total = weights.sum(0)
    safe = torch.where(total > 0, total, 1.0)
    mean = (places * weights[..., None]).sum(0) / safe[:, None]
    return Warped(mean, total.clamp(max=1))


def sampled(
    field: ActorField,
    skeleton: PosedSkeleton,
    points: Float[Tensor, "point 3"],
    *,
    weight_floor: float,
) -> Samples:
    """Evaluate the points of which at least `weight_floor` belongs to the actor."""
    with torch.no_grad():
        _, weights = bone_weights(field, skeleton, points)
        kept = torch.nonzero(weights.sum(0) >= weight_floor)[:, 0]
    canonical, shares = warped(field, skeleton, points[kept])
    moved = canonical
    if field.windows is not None:
        moved = canonical + field.non_rigid(canonical, skeleton.pose, field.windows)
    colours, densities = field.canonical(moved)
    return Samples(kept, canonical, colours, densities, shares)
