"""Rays through posed avatars, on the GPU where this job has one and else on CPU cores."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from ntop.field.canonical import PartLabels
from ntop.field.devices import kernel_device
from ntop.field.kernels.march import RAYS_PER_CHUNK, render_rays
from ntop.field.kernels.packed import PackedDensity, PackedSheets
from ntop.field.kernels.tables import HUGE, GridTables, WarpTables


class Scene(NamedTuple):
    """What is marched through: one avatar in one or several poses (`packing.packed_scene`)."""

    grid: GridTables
    warp: WarpTables
    density: PackedDensity
    sheets: PackedSheets
    light: Float[np.ndarray, "9 3"]
    labels: PartLabels


EVERYWHERE = np.array([[0.0, HUGE]])


class Rays(NamedTuple):
    """Unit directions; `poses`, `origins` and `spans` may hold one for all.

    Origins are relative to the warp grid's; spans are lengths (m) outside of which nothing is.
    """

    poses: Int[np.ndarray, " any"]
    origins: Float[np.ndarray, "any 3"]
    directions: Float[np.ndarray, "ray 3"]
    offsets: Float[np.ndarray, " ray"]
    spans: Float[np.ndarray, "any 2"] = EVERYWHERE


class MarchRule(NamedTuple):
    """How a march goes, as of `render_rays`; the step is in metres."""

    step_m: float
    piece_depth: float
    stop: float
    colour_floor: float
    skipping: bool


class Seen(NamedTuple):
    """Rays one by one: premultiplied colour, opacity, depth (m), part; the cost of all.

    `voxels` were looked up, and `samples` densities computed in them.
    """

    colours: Float[np.ndarray, "ray 3"]
    opacity: Float[np.ndarray, " ray"]
    depth_m: Float[np.ndarray, " ray"]
    parts: UInt8[np.ndarray, " ray"]
    voxels: int
    samples: int


def march_rays(scene: Scene, rays: Rays, rule: MarchRule) -> Seen:
    """Colour, opacity, median depth and part of each ray; see `render_rays`."""
    if kernel_device().gpu:
        from ntop.field.gpu import march_on_gpu  # numba.cuda only where it is used

        return march_on_gpu(scene, rays, rule)
    return march_on_cpu(scene, rays, rule)


def march_on_cpu(scene: Scene, rays: Rays, rule: MarchRule) -> Seen:
    """The same on all threads of the CPU; what is seen is as precise as the grid's values."""
    count, precision = len(rays.directions), scene.grid.values.dtype
    colours, opacity = np.empty((count, 3), precision), np.empty(count, precision)
    depth, parts = np.empty(count, precision), np.empty(count, np.uint8)
    evaluations = np.zeros((-(-count // RAYS_PER_CHUNK), 2), np.int64)
    render_rays(
        scene.grid, scene.warp, scene.density, scene.sheets, scene.light, scene.labels.values,
        scene.labels.origin, 1 / scene.labels.spacing_m, *rays, *rule, colours, opacity,
        depth, parts, evaluations,
    )  # fmt: skip
    return Seen(colours, opacity, depth, parts, *(int(sum_) for sum_ in evaluations.sum(0)))
