"""Render a posed avatar through any camera: colour, opacity, depth and parts of every pixel.

Only pixels that the projection of an occupied cell touches are marched; edges get several rays.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from ntop.conventions import MASK_ALPHA, PIXEL_CENTRE, DataError
from ntop.field.culling import body_sight, pixel_window
from ntop.field.edges import CONTRAST_OFFSETS_PX, OUTLINE_OFFSETS_PX, edge_pixels, middle_ray
from ntop.field.marching import EVERYWHERE, Rays, march_rays
from ntop.field.posing import PosedAvatar
from ntop.field.quality import RenderSettings
from ntop.field.straight import straight_colours
from ntop.geometry.cameras import Camera


@dataclass(frozen=True)
class Rendering:
    """One view. `rgb` is straight (not premultiplied), with a margin (`straight_colours`).

    `depth_m` is the ray length at which half of the light is gone, `parts` holds label + 1; both
    are 0 outside the mask (alpha below one half). `window` (left, top, width, height) holds every
    pixel with alpha > 0; all is zero outside. `voxels` were looked up, `samples` densities computed
    in them.
    """

    rgb: Float[np.ndarray, "height width 3"]
    alpha: Float[np.ndarray, "height width"]
    depth_m: Float[np.ndarray, "height width"]
    parts: UInt8[np.ndarray, "height width"]
    window: tuple[int, int, int, int]
    voxels: int
    samples: int

    @property
    def evaluations(self) -> int:
        """What it cost: voxels looked up and densities computed."""
        return self.voxels + self.samples


@dataclass(frozen=True)
class RayRendering:
    """Rays one by one; `rgb` is premultiplied."""

    rgb: Float[np.ndarray, "ray 3"]
    alpha: Float[np.ndarray, " ray"]
    depth_m: Float[np.ndarray, " ray"]
    parts: UInt8[np.ndarray, " ray"]
    voxels: int
    samples: int

    @property
    def evaluations(self) -> int:
        """What it cost: voxels looked up and densities computed."""
        return self.voxels + self.samples


def trace_rays(
    posed: PosedAvatar,
    center_world: Float[Tensor, " 3"],
    directions_world: Float[Tensor, "ray 3"],
    *,
    settings: RenderSettings,
    spans_m: Float[np.ndarray, "any 2"] = EVERYWHERE,
) -> RayRendering:
    """Rays from one point, in any directions; their length says nothing.

    `spans_m` are lengths (one pair, or one per ray) outside of which nothing is.

    Raises:
        DataError: a direction or the centre is no number, or the avatar's values are none.
    """
    count = len(directions_world)
    origin = center_world.double().numpy() - posed.warp.origin_world
    directions = unit_directions(origin, directions_world.double().numpy())
    offsets = np.full(count, settings.phase)
    rays = Rays(np.zeros(1, np.int64), origin[None], directions, offsets, spans_m)
    seen = march_rays(posed.scene, rays, settings.rule)
    if not (np.isfinite(seen.colours).all() and np.isfinite(seen.opacity).all()):
        raise DataError(
            "rendered pixels are not finite: the avatar holds NaN or infinity; train it again"
        )
    return RayRendering(*seen)


def unit_directions(
    origin: Float[np.ndarray, " 3"], directions: Float[np.ndarray, "ray 3"]
) -> Float[np.ndarray, "ray 3"]:
    """Directions of length one, contiguous: the march measures optical depth in metres.

    Raises:
        DataError: one has no direction (zero, NaN or infinite), or the origin is not finite.
    """
    length = np.sqrt((directions**2).sum(1, keepdims=True))
    usable = np.isfinite(length) & (length > 0)
    if not (usable.all() and np.isfinite(origin).all()):
        raise DataError(
            f"{int((~usable).sum())} of {len(directions)} rays have no direction (zero, NaN or "
            f"infinite), from {origin.tolist()}: check the camera's lens and pose"
        )
    return np.ascontiguousarray(directions / length)


def render_view(
    posed: PosedAvatar, camera: Camera, *, settings: RenderSettings | None = None
) -> Rendering:
    """One view through any lens; pixels outside the lens's valid circle stay empty."""
    settings = settings or RenderSettings()
    width, height = camera.lens.width, camera.lens.height
    rgb = np.zeros((height, width, 3), np.float32)
    alpha = np.zeros((height, width), np.float32)
    depth = np.zeros((height, width), np.float32)
    parts = np.zeros((height, width), np.uint8)
    sight = body_sight(posed.warp, camera) if settings.crop else None
    mask = sight.mask if sight else np.ones((height, width), bool)
    window = pixel_window(mask)
    left, top, columns, rows = window
    if columns == 0:
        return Rendering(rgb, alpha, depth, parts, window, 0, 0)
    inner = (slice(top, top + rows), slice(left, left + columns))
    v, u = np.nonzero(mask[inner])
    centres = np.stack([u + left, v + top], 1) + PIXEL_CENTRE
    spans_m = EVERYWHERE
    if sight and settings.intervals:
        spans_m = sight.of_pixels(v + top, u + left)
    first = _trace_pixels(posed, camera, centres, settings=settings, spans_m=spans_m)
    box = _Box(rows, columns, v, u)
    if settings.edge_rays > 1:
        outline, contrast = edge_pixels(box.image(first.rgb), box.image(first.alpha))
        for edges, offsets in ((outline, OUTLINE_OFFSETS_PX), (contrast, CONTRAST_OFFSETS_PX)):
            chosen = np.flatnonzero(edges[v, u])
            some = spans_m[chosen] if len(spans_m) > 1 else spans_m
            first = _supersampled(
                posed, camera, centres[chosen], first=first, chosen=chosen,
                offsets_px=np.array(offsets), settings=settings, spans_m=some,
            )  # fmt: skip
    opacity = box.image(first.alpha)
    bodyless = np.rint(255 * opacity) < MASK_ALPHA
    alpha[inner] = opacity
    rgb[inner] = straight_colours(box.image(first.rgb), opacity)
    depth[inner] = np.where(bodyless, 0, box.image(first.depth_m))
    parts[inner] = np.where(bodyless, 0, box.image(first.parts))
    return Rendering(rgb, alpha, depth, parts, window, first.voxels, first.samples)


@dataclass(frozen=True)
class _Box:
    """A window of an image, and the places of rays in it."""

    rows: int
    columns: int
    v: Int[np.ndarray, " ray"]
    u: Int[np.ndarray, " ray"]

    def image(self, values: np.ndarray) -> np.ndarray:
        """Values (ray, ...) at their places, 0 elsewhere."""
        image = np.zeros((self.rows, self.columns, *values.shape[1:]), values.dtype)
        image[self.v, self.u] = values
        return image


def _supersampled(
    posed: PosedAvatar,
    camera: Camera,
    centres: Float[np.ndarray, "pixel 2"],
    *,
    first: RayRendering,
    chosen: Int[np.ndarray, " pixel"],
    offsets_px: Float[np.ndarray, "ray 2"],
    settings: RenderSettings,
    spans_m: Float[np.ndarray, "any 2"],
) -> RayRendering:
    """The same rays; those of some pixels stand for more rays of theirs as well."""
    rays = len(offsets_px)
    pixels = (centres[:, None] + offsets_px).reshape(-1, 2)
    if len(spans_m) > 1:
        spans_m = np.repeat(spans_m, rays, 0)
    more = _trace_pixels(posed, camera, pixels, settings=settings, spans_m=spans_m)
    layers = ("rgb", "alpha", "depth_m", "parts")
    everything = {}
    for name in layers:
        own, others = getattr(first, name), getattr(more, name)
        both = others.reshape(len(chosen), rays, *others.shape[1:])
        everything[name] = np.concatenate([own[chosen][:, None], both], 1)
    middle = middle_ray(everything["alpha"], everything["depth_m"])
    found = {name: getattr(first, name).copy() for name in layers}
    for name in ("rgb", "alpha"):
        found[name][chosen] = everything[name].mean(1)
    for name in ("depth_m", "parts"):
        found[name][chosen] = everything[name][np.arange(len(chosen)), middle]
    cost = (first.voxels + more.voxels, first.samples + more.samples)
    return RayRendering(*found.values(), *cost)


def _trace_pixels(
    posed: PosedAvatar,
    camera: Camera,
    pixels: Float[np.ndarray, "ray 2"],
    *,
    settings: RenderSettings,
    spans_m: Float[np.ndarray, "any 2"],
) -> RayRendering:
    directions, valid = camera.rays(torch.from_numpy(pixels))
    kept = valid.numpy()
    found = trace_rays(
        posed, camera.center_world, directions[valid], settings=settings,
        spans_m=spans_m[kept] if len(spans_m) > 1 else spans_m,
    )  # fmt: skip
    if kept.all():
        return found
    spread = []
    for values in (found.rgb, found.alpha, found.depth_m, found.parts):
        everywhere = np.zeros((len(pixels), *values.shape[1:]), values.dtype)
        everywhere[kept] = values
        spread.append(everywhere)
    return RayRendering(*spread, found.voxels, found.samples)
