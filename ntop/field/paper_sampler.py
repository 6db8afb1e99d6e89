"""The paper's sampler on our avatars, to be measured beside ours: how its stripes come about.

HumanNeRF, which the paper renders with, places 128 samples at equal distances between a ray's entry
into and exit from the box of the joints (0.3 m wider on each side), at the same fractions on every
ray, and closes the last interval at 1e10. Seen from above, where rays run along the body, the
distance of samples is 9 to 17 mm (decision 0004). Only the sampling differs from our renderer: the
field, its light, its occupancy and the cameras are the same.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ntop.conventions import PIXEL_CENTRE
from ntop.field.culling import body_pixels
from ntop.field.kernels import paper
from ntop.field.posing import PosedAvatar
from ntop.geometry.cameras import Camera

SAMPLES = 128
BOX_MARGIN_M = 0.3
TINY = 1e-30


@dataclass(frozen=True)
class PaperSampling:
    """What the paper's sampler sees, per ray or per pixel.

    `near_m` (first sample) and `step_m` give every ray's phase; rays that miss the box have step 0
    and see nothing. `rgb` is premultiplied per ray, and straight in an image.
    """

    rgb: Float[np.ndarray, "*shape 3"]
    alpha: Float[np.ndarray, "*shape"]
    near_m: Float[np.ndarray, "*shape"]
    step_m: Float[np.ndarray, "*shape"]


def box_interval(
    origin: Float[np.ndarray, " 3"],
    directions: Float[np.ndarray, "ray 3"],
    joints: Float[np.ndarray, "joint 3"],
) -> tuple[Float[np.ndarray, " ray"], Float[np.ndarray, " ray"]]:
    """Entry and exit (metres) of rays into the box of the joints; exit <= entry is a miss.

    A slab test, not HumanNeRF's search for exactly two plane hits, which loses rays.
    """
    safe = np.where(np.abs(directions) > TINY, directions, np.copysign(TINY, directions))
    first = (joints.min(0) - BOX_MARGIN_M - origin) / safe
    second = (joints.max(0) + BOX_MARGIN_M - origin) / safe
    near = np.minimum(first, second).max(1)
    return np.maximum(near, 0.0), np.maximum(first, second).min(1)


def paper_steps(
    origin: Float[np.ndarray, " 3"],
    directions: Float[np.ndarray, "ray 3"],
    joints: Float[np.ndarray, "joint 3"],
    *,
    samples: int = SAMPLES,
) -> tuple[Float[np.ndarray, " ray"], Float[np.ndarray, " ray"]]:
    """First sample and distance of samples (metres) of each ray; 0 apart where it misses."""
    near, far = box_interval(origin, directions, joints)
    return near, np.where(far > near, (far - near) / (samples - 1), 0.0)


def trace_paper_rays(
    posed: PosedAvatar,
    center_world: Float[Tensor, " 3"],
    directions_world: Float[Tensor, "ray 3"],
    *,
    joints_world: Float[np.ndarray, "joint 3"],
    samples: int = SAMPLES,
    shift: float | Float[np.ndarray, " ray"] = 0.0,
) -> PaperSampling:
    """Rays from one point with the paper's sampling.

    Args:
        posed: The avatar.
        center_world: Origin of all rays.
        directions_world: Unit length.
        joints_world: The joints around which the box lies.
        samples: Per ray.
        shift: Of all samples of a ray, in steps; the paper has none, random numbers are jitter.
    """
    origin = center_world.double().numpy()
    directions = np.ascontiguousarray(directions_world.numpy(), np.float64)
    near, step = paper_steps(origin, directions, joints_world, samples=samples)
    shifts = np.ascontiguousarray(np.broadcast_to(shift, len(directions)), np.float64)
    rgb, alpha = np.empty((len(directions), 3)), np.empty(len(directions))
    paper.paper_rays(
        posed.grid.tables(), posed.warp.tables, posed.light, origin - posed.warp.origin_world,
        directions, near, step, shifts, samples, rgb, alpha,
    )  # fmt: skip
    return PaperSampling(rgb, alpha, near, step)


def render_paper_view(
    posed: PosedAvatar,
    camera: Camera,
    *,
    joints_world: Float[np.ndarray, "joint 3"],
    pixels: Bool[np.ndarray, "height width"] | None = None,
    shift: float = 0.0,
) -> PaperSampling:
    """One view through any lens, one ray through the centre of every pixel that may see the body.

    `pixels`: only these, for measurements that need no others. Other arguments: see
    `trace_paper_rays`.
    """
    mask = body_pixels(posed.warp, camera) if pixels is None else pixels
    v, u = np.nonzero(mask)
    directions, valid = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
    v, u = v[valid.numpy()], u[valid.numpy()]
    rays = trace_paper_rays(
        posed, camera.center_world, directions[valid], joints_world=joints_world, shift=shift
    )
    view = PaperSampling(
        rgb=np.zeros((*mask.shape, 3)),
        alpha=np.zeros(mask.shape),
        near_m=np.zeros(mask.shape),
        step_m=np.zeros(mask.shape),
    )
    view.rgb[v, u] = np.clip(rays.rgb / np.maximum(rays.alpha, 1e-6)[:, None], 0, 1)
    view.alpha[v, u], view.near_m[v, u], view.step_m[v, u] = rays.alpha, rays.near_m, rays.step_m
    return view
