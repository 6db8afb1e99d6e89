"""Views of the twin: every pixel whose ray meets the box around the posed joints, one ray each.

A ray has as many samples as in training, each in the middle of its piece (the paper's rendering
without jitter). Depth, parts, alpha and crop mean what they mean for the grid.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.conventions import MASK_ALPHA
from ntop.field.humannerf.avatar import HumanNerfAvatar
from ntop.field.humannerf.device import compute_device, parallel
from ntop.field.humannerf.field import ActorField, on_device
from ntop.field.humannerf.march import Interval, box_interval, median_depth, trace
from ntop.field.humannerf.skeleton import (
    CanonicalSkeleton,
    PosedSkeleton,
    canonical_skeleton,
    posed_skeleton,
)
from ntop.field.marching import Seen
from ntop.field.rendering import Rendering
from ntop.field.straight import straight_colours
from ntop.geometry.cameras import Camera, pixel_grid

RAYS_PER_PIECE = {"cpu": 1024, "cuda": 16384}  # of 128 samples, of which a fifth are evaluated
VISIBLE = 1 / 510  # opacity that rounds to one of 255 steps


@dataclass(frozen=True)
class PosedHumanNerf:
    """All that the views of one pose share."""

    field: ActorField
    skeleton: PosedSkeleton
    canonical: CanonicalSkeleton
    samples: int
    weight_floor: float
    device: torch.device


def pose_humannerf(avatar: HumanNerfAvatar, model: BodyModel, pose: BodyPose) -> PosedHumanNerf:
    """The per-pose work: bone transforms and the box."""
    device = compute_device()
    return PosedHumanNerf(
        field=avatar.field(device),
        skeleton=on_device(posed_skeleton(model, pose), device),
        canonical=canonical_skeleton(model, avatar.betas),
        samples=avatar.samples,
        weight_floor=avatar.weight_floor,
        device=device,
    )


def render_humannerf(posed: PosedHumanNerf, camera: Camera) -> Rendering:
    """One view through any lens; pixels outside the lens's valid circle stay empty."""
    width, height = camera.lens.width, camera.lens.height
    directions, valid = camera.rays(pixel_grid(width, height, torch.float64).view(-1, 2))
    origin = camera.center_world.double() - torch.from_numpy(posed.skeleton.origin_world)
    interval = box_interval(origin, directions, posed.skeleton.box)
    chosen = torch.nonzero(interval.hit & valid.view(-1))[:, 0]
    if not len(chosen):
        empty = np.zeros((height, width), np.float32)
        return Rendering(
            np.zeros((height, width, 3), np.float32), empty, empty.copy(),
            np.zeros((height, width), np.uint8), (0, 0, 0, 0), 0, 0,
        )  # fmt: skip
    near = Interval(*(values[chosen] for values in interval))
    pieces = torch.arange(len(chosen)).split(RAYS_PER_PIECE[posed.device.type])
    with ThreadPoolExecutor(max_workers=parallel(posed.device)) as pool:
        found = list(
            pool.map(
                lambda piece: _piece(
                    posed, origin, directions[chosen[piece]], Interval(*(v[piece] for v in near))
                ),
                pieces,
            )
        )

    def image(values: list[np.ndarray]) -> np.ndarray:
        flat = np.concatenate(values)
        whole = np.zeros((height * width, *flat.shape[1:]), flat.dtype)
        whole[chosen.numpy()] = flat
        return whole.reshape(height, width, *flat.shape[1:])

    alpha = image([piece.opacity for piece in found])
    alpha[alpha < VISIBLE] = 0
    rgb = straight_colours(image([piece.colours for piece in found]), alpha)
    depth, parts = image([p.depth_m for p in found]), image([p.parts for p in found])
    outside = np.rint(255 * alpha) < MASK_ALPHA
    depth[outside], parts[outside] = 0, 0
    columns, rows = chosen.numpy() % width, chosen.numpy() // width
    left, top = int(columns.min()), int(rows.min())
    window = (left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top)
    return Rendering(rgb, alpha, depth, parts, window, 0, sum(p.samples for p in found))


@torch.no_grad()  # here and not above: the mode belongs to a thread
def _piece(
    posed: PosedHumanNerf,
    origin: Float[Tensor, " 3"],
    directions: Float[Tensor, "ray 3"],
    interval: Interval,
) -> Seen:
    interval = Interval(
        interval.near.float().to(posed.device),
        interval.far.float().to(posed.device),
        interval.hit.to(posed.device),
    )
    found = trace(
        posed.field,
        posed.skeleton,
        origin=origin.float().to(posed.device),
        directions=directions.float().to(posed.device),
        interval=interval,
        offsets=torch.full((1, 1), 0.5, device=posed.device),
        num_samples=posed.samples,
        weight_floor=posed.weight_floor,
    )
    depth, index = median_depth(found.alphas, interval)
    known = torch.nonzero(index >= 0)[:, 0]
    parts = np.zeros(len(directions), np.uint8)
    # where the sample lies among the evaluated ones: its opacity is not zero, so it is
    flat = known * posed.samples + index[known]
    places = found.samples.canonical[torch.searchsorted(found.samples.kept, flat)]
    parts[known.cpu().numpy()] = posed.canonical.parts_at(places.cpu().numpy())
    return Seen(
        found.colours.cpu().numpy(),
        found.opacity.cpu().numpy(),
        torch.where(torch.isfinite(depth), depth, 0.0).cpu().numpy(),
        parts,
        0,
        len(found.samples.kept),
    )
