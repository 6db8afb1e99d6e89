"""Analytic fields behind the avatar's own interface: grids of given values, identity warps."""

from collections.abc import Callable

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator

from ntop.field.canonical import CanonicalGrid, PartLabels, number_bricks, void_values
from ntop.field.kernels.tables import DENSITY_SCALE, EMPTY_DENSITY
from ntop.field.posing import PosedAvatar
from ntop.field.quality import RenderSettings
from ntop.field.twin import Composite, composite
from ntop.field.warp import PoseWarp, identity_warp

Profile = Callable[[np.ndarray], np.ndarray]
EXACT = {"stop_transmittance": 0.0, "colour_floor": 0.0, "edge_rays": 1}  # no shortcut
DEFAULT_STEP_M = RenderSettings().step_m


def density_of(raw: np.ndarray) -> np.ndarray:
    """The field's law: density (1/m) of raw values."""
    return DENSITY_SCALE * np.maximum(np.logaddexp(0.0, raw) - EMPTY_DENSITY, 0)


def raw_of(density: np.ndarray) -> np.ndarray:
    """The law's inverse."""
    return np.log(np.expm1(density / DENSITY_SCALE + EMPTY_DENSITY))


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


def opened(warp: PoseWarp) -> PoseWarp:
    """The same warp with every octant occupied."""
    tables = warp.tables
    full = tables._replace(
        occupancy=np.full_like(tables.occupancy, 255), away=np.zeros_like(tables.away)
    )
    return PoseWarp(full, warp.origin_world, warp.cell_m)


def grid_of(
    raw: Profile, *, size_m: tuple[float, float, float], voxel_m: float, colour: Profile | None
) -> CanonicalGrid:
    """Nodes over [0, size_m] with raw densities and raw colours of their positions (metres)."""
    shape = [int(np.ceil((s / voxel_m + 1) / 4 - 1e-9)) for s in size_m]
    bricks, positions = number_bricks(np.ones(shape, bool))
    within = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = (4 * positions[1:, None] + within).reshape(-1, 3) * voxel_m
    values = void_values(len(positions))
    values[64:, 0] = raw(nodes)
    values[64:, 1:] = colour(nodes) if colour else 0.0
    return CanonicalGrid(values, bricks, positions, np.zeros(3), voxel_m)


def posed_field(
    raw: Profile,
    *,
    size_m: tuple[float, float, float],
    voxel_m: float,
    colour: Profile | None = None,
    low_world: tuple[float, float, float] = (0.0, 0.0, 0.0),
    cell_m: float | None = None,
) -> PosedAvatar:
    """A field in the box [low_world, low_world + size_m]; profiles take box coordinates.

    Rays are cut at the faces of half cells of the warp, 20 cells along the box's longest side
    unless `cell_m` is given, and at those of voxels.
    """
    low = np.array(low_world)
    cell_m = cell_m or max(size_m) / 20
    warp = opened(identity_warp(low, low + np.array(size_m), cell_m=cell_m))
    light = np.zeros((9, 3), np.float32)
    light[0] = 1
    labels = PartLabels(np.ones((1, 1, 1), np.uint8), np.zeros(3), 1.0)
    grid = grid_of(raw, size_m=size_m, voxel_m=voxel_m, colour=colour)
    return PosedAvatar(grid=grid, warp=warp, light=light, labels=labels)


def exact(step_m: float, **changes) -> RenderSettings:
    """Settings without shortcuts."""
    return RenderSettings(step_m=step_m, **(EXACT | changes))


def composed(tau: np.ndarray, colour: np.ndarray, dtype=torch.float64) -> Composite:
    """The specification's compositing of numpy arrays (rays, samples[, 3])."""
    return composite(torch.from_numpy(tau).to(dtype), torch.from_numpy(colour).to(dtype))


def brute_force(
    raw: Profile, colour: Profile, *, size_m: float, voxel_m: float, rays: tuple, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Opacity and colour of rays through a cube [0, size_m]^3 of `posed_field`, in float64.

    The field that is stored is integrated: linear between nodes, activated after that. The samples
    are the middles of equal parts of a ray's way through the cube, so the error is that of the
    midpoint rule with them. `rays`: origin (3,) and directions (ray, 3); the colour is the first.
    """
    axis = np.arange(0, size_m + 1e-9, voxel_m)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    values = np.stack([raw(nodes.reshape(-1, 3)), colour(nodes.reshape(-1, 3))[:, 0]], 1)
    stored = values.astype(np.float32).astype(np.float64).reshape(*nodes.shape[:3], 2)
    origin, directions = (part.numpy() for part in rays)
    faces = np.stack([-origin / directions, (size_m - origin) / directions])
    near, far = faces.min(0).max(1), faces.max(0).min(1)
    step = (far - near)[:, None] / samples
    t = near[:, None] + step * (np.arange(samples) + 0.5)
    places = origin + t[..., None] * directions[:, None]
    found = RegularGridInterpolator((axis,) * 3, stored)(places.clip(0, axis[-1]))
    shown = np.broadcast_to(sigmoid(found[..., 1:]), places.shape).copy()
    seen = composed(step * density_of(found[..., 0]), shown)
    return seen.opacity.numpy(), seen.rgb[:, 0].numpy()


def cone(target: np.ndarray, *, distance_m: float, spread_m: float, count: int, seed: int = 0):
    """A point before the target (along z) and unit directions to points scattered around it."""
    scatter = np.random.default_rng(seed).uniform(-spread_m, spread_m, (count, 2))
    centre = target - [0, 0, distance_m]
    aims = target + np.concatenate([scatter, np.zeros((count, 1))], 1)
    away = aims - centre
    directions = away / np.linalg.norm(away, axis=1, keepdims=True)
    return torch.from_numpy(centre), torch.from_numpy(directions)


def order(errors: list[float]) -> float:
    """Order of convergence from errors at steps that halve: the slope of the logarithms."""
    return float(-np.polyfit(np.arange(len(errors)), np.log2(errors), 1)[0])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
