"""Render a posed avatar through any camera: colour, opacity, depth and parts of every pixel.

Only pixels that the projection of an occupied cell touches are marched; edges get several rays.
"""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.conventions import MASK_ALPHA, PIXEL_CENTRE, ConfigError, DataError
from ntop.field.avatar import Avatar
from ntop.field.canonical import (
    CanonicalGrid,
    Occupancy,
    PartLabels,
    canonical_body,
    dense_voxels,
    label_grid,
)
from ntop.field.culling import body_sight, pixel_window
from ntop.field.edges import CONTRAST_OFFSETS_PX, OUTLINE_OFFSETS_PX, edge_pixels, middle_ray
from ntop.field.kernels.packed import PackedDensity
from ntop.field.kernels.tables import EMPTY_RAW
from ntop.field.marching import EVERYWHERE, MarchRule, Rays, Scene, march_rays
from ntop.field.packing import packed_density, packed_scene
from ntop.field.straight import straight_colours
from ntop.field.warp import PoseWarp, occupied, pose_warp, with_octants
from ntop.geometry.cameras import Camera

CELL_M = 0.012  # of the warp grid; a coarser one bends wrongly at joints (0.02: -0.6 dB)


@dataclass(frozen=True)
class RenderSettings:
    """How exactly to march; every shortcut can be switched off, and costs at most its bound.

    Args:
        step_m: Largest length of a piece of a ray; faces of voxels cut it as well.
        piece_depth: Largest optical depth of a piece, by its denser end (infinity: any); the less
            light is left on the ray, the deeper it may be.
        stop_transmittance: Light left at which a ray ends (0: never); bounds the colour's error.
        colour_floor: Light up to which pieces of a ray share one colour (0: each has its own).
        intervals: Jump over space that no warp cell covers.
        cells: Jump over octants of cells in which the field is empty.
        extent: How much of an octant is asked whether it is empty; less than 1 may miss density.
        crop: March only pixels that may see the body.
        edge_rays: 4: so many rays more on outlines, half as many on contrasts; 1: one ray through
            every pixel's centre.
        phase: Offset of all pieces, in steps, for the phase-shift self-test.
    """

    step_m: float = 0.003
    piece_depth: float = 1.0
    stop_transmittance: float = 1e-3
    colour_floor: float = 1e-3
    intervals: bool = True
    cells: bool = True
    extent: float = 1.0
    crop: bool = True
    edge_rays: int = 4
    phase: float = 0.5

    def __post_init__(self) -> None:
        """Refuse steps that never reach the end of a ray, and lights that cannot be left.

        Raises:
            ConfigError: a number is out of its range.
        """
        if not 0 < self.step_m < math.inf:
            raise ConfigError(f"render step_m is {self.step_m} m, expected a positive length")
        if not self.piece_depth > 0:
            raise ConfigError(f"render piece_depth is {self.piece_depth}, expected more than 0")
        for name in ("stop_transmittance", "colour_floor", "phase"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"render {name} is {getattr(self, name)}, expected 0 <= it < 1")
        if not 0 <= self.extent <= 1:
            raise ConfigError(f"render extent is {self.extent}, expected 0 <= it <= 1")
        if self.edge_rays not in (1, 4):
            raise ConfigError(f"render edge_rays is {self.edge_rays}, expected 1 or 4")

    @property
    def rule(self) -> MarchRule:
        """What of this a march asks for."""
        return MarchRule(
            step_m=self.step_m,
            piece_depth=self.piece_depth,
            stop=self.stop_transmittance,
            colour_floor=self.colour_floor,
            skipping=self.intervals,
        )


# chosen and measured by `make bench`: benchmarks/quadrature.py, docs/benchmarks.md
PRESETS = {
    "draft": RenderSettings(
        step_m=0.008, piece_depth=4.0, stop_transmittance=1e-2, colour_floor=2e-2, edge_rays=1
    ),
    "default": RenderSettings(),
    "reference": RenderSettings(
        step_m=0.0005, piece_depth=0.25, stop_transmittance=1e-5, colour_floor=0.0
    ),
}


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


@dataclass(frozen=True)
class PosedAvatar:
    """All that the views of one pose share; `density` is `grid`'s, packed, where it is known."""

    grid: CanonicalGrid
    warp: PoseWarp
    light: Float[np.ndarray, "9 3"]
    labels: PartLabels
    density: PackedDensity | None = None

    @functools.cached_property
    def scene(self) -> Scene:
        """What rays march through, packed once for all views."""
        return packed_scene(
            self.grid, self.warp.tables, self.light, self.labels, density=self.density
        )


def pose_avatar(
    avatar: Avatar,
    model: BodyModel,
    pose: BodyPose,
    *,
    settings: RenderSettings | None = None,
    cell_m: float = CELL_M,
) -> PosedAvatar:
    """The per-pose work, once for all views: warp grid and occupancy of a single pose."""
    settings = settings or RenderSettings()
    body = canonical_body(model, avatar.betas)
    warp = pose_warp(body, model, pose, cell_m=cell_m, reach_m=avatar.reach_m)
    shared = _shared(avatar, model)
    if settings.cells:
        tables = occupied(warp.tables, shared.dense, extent=settings.extent)
    else:
        tables = with_octants(warp.tables, np.full_like(warp.tables.occupancy, 255))
    return PosedAvatar(
        grid=avatar.grid,
        warp=replace(warp, tables=tables),
        light=avatar.light.astype(np.float32),
        labels=shared.labels,
        density=shared.density,
    )


@dataclass(frozen=True)
class _Shared:
    """What is the same in every pose of an avatar; it holds what its key names."""

    avatar: Avatar
    model: BodyModel
    dense: Occupancy
    density: PackedDensity
    labels: PartLabels


_SHARED: dict[tuple[int, int], _Shared] = {}


def _shared(avatar: Avatar, model: BodyModel) -> _Shared:
    """Made for an avatar's first pose, and kept for the last avatar."""
    key = (id(avatar), id(model))
    if key not in _SHARED:
        _SHARED.clear()
        _SHARED[key] = _Shared(
            avatar,
            model,
            dense_voxels(avatar.grid, raw_threshold=EMPTY_RAW),
            packed_density(avatar.grid),
            label_grid(canonical_body(model, avatar.betas)),
        )
    return _SHARED[key]


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
