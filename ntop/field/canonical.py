"""Canonical space: the shaped body in a fixed pose with its legs apart, and voxel grids around it.

The T-pose leaves the thighs a few centimetres apart, so cells between them would belong to both;
spreading the legs separates them. Lengths are metres, axes the body frame's (y up, facing +z).
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from ntop.body.model import BodyModel, part_labels
from ntop.body.skinning import BodyPose, pose_body
from ntop.field.kernels.canonical import mark_dense, resample, signed_distances
from ntop.field.kernels.nearest import nearest_vertices
from ntop.field.kernels.occupancy import COARSE
from ntop.field.kernels.tables import VOID_RAW, GridTables

LEG_SPREAD_RAD = math.radians(20)
OCCUPANCY_SPACING_M = 0.004
LABEL_SPACING_M = 0.01
LABEL_REACH_M = 0.06
RAW_PER_M = 400.0  # initial density: raw rises by this per metre into the body
RAW_BOUNDS = (-6.0, 6.0)


@dataclass(frozen=True)
class CanonicalBody:
    """The body in the canonical pose, as the kernels read it."""

    vertices: Float[np.ndarray, "vertex 3"]
    normals: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    ring_offsets: Int[np.ndarray, " vertex_1"]
    ring_faces: Int[np.ndarray, " any"]
    canonical_from_rest: Float[np.ndarray, "vertex 3 4"]
    rest_from_canonical_bones: Float[np.ndarray, "24 4 4"]
    lbs_weights: Float[np.ndarray, "vertex 24"]
    parts: Int[np.ndarray, " vertex"]


@dataclass(frozen=True)
class CanonicalGrid:
    """Bricks of a regular grid (see `kernels.tables`): `positions[slot]` are brick coordinates."""

    values: Float[np.ndarray, "row 4"]
    bricks: Int[np.ndarray, "x y z"]
    positions: Int[np.ndarray, "slot 3"]
    origin: Float[np.ndarray, " 3"]
    voxel_m: float

    def tables(self) -> GridTables:
        """The arrays that the kernels read."""
        return GridTables(self.values, self.bricks, self.origin, 1 / self.voxel_m)


@dataclass(frozen=True)
class Occupancy:
    """Where the canonical grid may hold density: one byte per cell of a coarse grid."""

    cells: UInt8[np.ndarray, "x y z"]
    origin: Float[np.ndarray, " 3"]
    spacing_m: float

    @functools.cached_property
    def sums(self) -> Int[np.ndarray, "x1 y1 z1"]:
        """How many marked cells lie below each corner of a cell (a summed-area table)."""
        sums = np.zeros([n + 1 for n in self.cells.shape], np.int32)
        sums[1:, 1:, 1:] = self.cells
        for axis in range(3):
            np.cumsum(sums, axis=axis, out=sums)
        return sums

    @functools.cached_property
    def coarse_sums(self) -> Int[np.ndarray, "x2 y2 z2"]:
        """Those of `sums` between blocks of `COARSE` cells: small enough to stay in the cache."""
        ends = [np.minimum(np.arange(0, n + COARSE, COARSE), n) for n in self.cells.shape]
        return self.sums[np.ix_(*ends)]


@dataclass(frozen=True)
class PartLabels:
    """Part value (label + 1) of the nodes of a coarse canonical grid; 0 far from the body."""

    values: UInt8[np.ndarray, "x y z"]
    origin: Float[np.ndarray, " 3"]
    spacing_m: float


def canonical_pose(betas: torch.Tensor) -> BodyPose:
    """The canonical pose: T-pose with both legs spread sideways."""
    body_pose = torch.zeros(69, dtype=betas.dtype)
    body_pose[2], body_pose[5] = LEG_SPREAD_RAD, -LEG_SPREAD_RAD  # left hip, right hip about z
    zero = torch.zeros(3, dtype=betas.dtype)
    return BodyPose(betas=betas, global_orient=zero, body_pose=body_pose, transl=zero)


@functools.lru_cache(maxsize=8)
def canonical_body(model: BodyModel, betas: tuple[float, ...]) -> CanonicalBody:
    """The body in the canonical pose; kept for the last few people, as every pose needs it."""
    posed = pose_body(model, canonical_pose(torch.tensor(betas, dtype=torch.float64)))
    weights = model.lbs_weights.double().numpy()
    bones = posed.posed_from_rest.numpy()
    vertices = posed.vertices.numpy()
    faces = model.faces.numpy().astype(np.int32)
    offsets, ring = face_rings(faces, len(vertices))
    return CanonicalBody(
        vertices=vertices,
        normals=vertex_normals(vertices, faces),
        faces=faces,
        ring_offsets=offsets,
        ring_faces=ring,
        canonical_from_rest=np.tensordot(weights, bones[:, :3], axes=1),
        rest_from_canonical_bones=np.linalg.inv(bones),
        lbs_weights=weights,
        parts=part_labels(model).numpy().astype(np.int32),
    )


def face_rings(faces: Int[np.ndarray, "face 3"], num_vertices: int) -> tuple:
    """Faces around each vertex: offsets (vertices + 1) into a list of faces."""
    order = np.argsort(faces.ravel(), kind="stable")
    counts = np.bincount(faces.ravel(), minlength=num_vertices)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    return offsets, (order // 3).astype(np.int32)


def vertex_normals(
    vertices: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "vertex 3"]:
    """Unit normals, the area-weighted mean of the faces around each vertex."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for axis in range(3):
        for k in range(3):
            total[:, axis] += np.bincount(faces[:, k], normal[:, axis], len(vertices))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def distance_grid(
    body: CanonicalBody, *, spacing_m: float, reach_m: float
) -> tuple[Float[np.ndarray, "x y z"], Int[np.ndarray, "x y z"], Float[np.ndarray, " 3"]]:
    """Signed distance to the rest surface, nearest vertex (-1: none) and origin of a node grid.

    Distances are exact up to `reach_m`, and +-infinity beyond (inside and outside are not told
    apart there, both are far).
    """
    low = body.vertices.min(0) - reach_m - 2 * spacing_m
    high = body.vertices.max(0) + reach_m + 2 * spacing_m
    dims = 4 * np.ceil(((high - low) / spacing_m + 1) / 4).astype(np.int64)
    relative = body.vertices - low
    nearest = np.empty((2, dims.prod()), np.int32)
    squared = np.empty((2, dims.prod()), np.float64)
    nearest_vertices(
        relative,
        np.zeros((1, 3, 4)),
        dims,
        spacing_m,
        reach_m + spacing_m,
        1.0,
        1,
        nearest,
        squared,
    )
    nodes = np.flatnonzero(nearest[0] >= 0)
    found = np.empty(len(nodes))
    signed_distances(
        nodes, nearest[0], relative, body.faces, body.normals, body.ring_offsets, body.ring_faces,
        spacing_m, dims, found,
    )  # fmt: skip
    distances = np.full(dims.prod(), np.inf)
    distances[nodes] = found
    return distances.reshape(dims), nearest[0].reshape(dims), low


def label_grid(body: CanonicalBody) -> PartLabels:
    """The part of the nearest vertex, on a coarse grid."""
    _, nearest, origin = distance_grid(body, spacing_m=LABEL_SPACING_M, reach_m=LABEL_REACH_M)
    values = np.where(nearest >= 0, body.parts[nearest] + 1, 0).astype(np.uint8)
    return PartLabels(values, origin, LABEL_SPACING_M)


def initial_grid(
    body: CanonicalBody, *, voxel_m: float, outer_m: float, inner_m: float
) -> CanonicalGrid:
    """A shell around the rest surface whose density starts as the body's own.

    Starting from the body instead of from fog puts the silhouette within a few centimetres before
    the first step (as GART's on-mesh initialisation does).
    """
    distances, _, origin = distance_grid(body, spacing_m=voxel_m, reach_m=max(outer_m, inner_m))
    shell = (distances >= -inner_m) & (distances <= outer_m)
    bricks, positions = number_bricks(_any_in_bricks(shell))
    blocks = _as_bricks(distances)[tuple(positions[1:].T)]
    values = void_values(len(positions))
    raw = np.clip(-RAW_PER_M * blocks, *RAW_BOUNDS)
    values[64:, 0] = np.where(np.isfinite(blocks), raw, RAW_BOUNDS[0]).ravel()
    values[64:, 1:] = 0
    return CanonicalGrid(values, bricks, positions, origin, voxel_m)


def void_values(num_slots: int) -> Float[np.ndarray, "row 4"]:
    """Rows of a grid in which nothing is dense."""
    values = np.zeros((64 * num_slots, 4), np.float32)
    values[:, 0] = VOID_RAW
    return values


def number_bricks(occupied: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brick index and positions; slot 0 is the void's."""
    bricks = np.zeros(occupied.shape, np.int32)
    positions = np.ascontiguousarray(np.argwhere(occupied), np.int32)  # argwhere's is transposed
    bricks[tuple(positions.T)] = np.arange(1, len(positions) + 1)
    return bricks, np.concatenate([np.full((1, 3), -1, np.int32), positions])


def refined_grid(grid: CanonicalGrid, occupancy: Occupancy, *, voxel_m: float) -> CanonicalGrid:
    """The same field on a finer grid, with bricks only where density may be."""
    extent = grid.voxel_m * (4 * np.array(grid.bricks.shape) - 1)
    shape = np.ceil((extent / voxel_m + 1) / 4).astype(int)
    # a brick is kept where any occupancy cell overlaps its nodes
    inside = np.zeros(shape, bool)
    cells = np.argwhere(occupancy.cells)
    low = occupancy.origin + cells * occupancy.spacing_m - grid.origin
    first = np.clip(np.floor(low / (4 * voxel_m) - 1 / 4), 0, shape - 1).astype(int)
    last = np.floor((low + occupancy.spacing_m) / (4 * voxel_m)).clip(0, shape - 1).astype(int)
    for pick in np.ndindex(2, 2, 2):
        index = np.where(np.array(pick), last, first)
        inside[tuple(index.T)] = True
    bricks, positions = number_bricks(inside)
    values = void_values(len(positions))
    resample(grid.tables(), positions, grid.origin, voxel_m, values)
    return CanonicalGrid(values, bricks, positions, grid.origin, voxel_m)


def body_density(
    body: CanonicalGrid, grid: CanonicalGrid, *, sharpness: float
) -> Float[np.ndarray, " row"]:
    """Raw density of the body's own grid at the nodes of another one, `sharpness` times as steep.

    Where the body's shell has no brick, inside or out, nothing is known: the value is the one of
    the shell's border, far from both.
    """
    values = void_values(len(grid.positions))
    resample(body.tables(), grid.positions, grid.origin, grid.voxel_m, values)
    return np.ascontiguousarray(np.clip(sharpness * values[:, 0], *RAW_BOUNDS))


def occupied_cells(grid: CanonicalGrid, *, raw_threshold: float, margin_m: float) -> Occupancy:
    """Cells within `margin_m` of one in which the field's raw density may exceed a threshold."""
    spacing = OCCUPANCY_SPACING_M
    dilation = math.ceil(margin_m / spacing)
    pad = (dilation + 1) * spacing
    origin = grid.origin - pad
    extent = grid.voxel_m * (4 * np.array(grid.bricks.shape) - 1)
    shape = np.ceil((extent + 2 * pad) / spacing).astype(int)
    marked = np.zeros(shape, np.uint8)
    mark_dense(
        grid.values, grid.positions, grid.origin, grid.voxel_m, origin, 1 / spacing,
        raw_threshold, marked,
    )  # fmt: skip
    for axis in range(3):
        source = np.moveaxis(marked, axis, 0)
        grown = source.copy()
        for shift in range(1, dilation + 1):
            np.maximum(grown[shift:], source[:-shift], out=grown[shift:])
            np.maximum(grown[:-shift], source[shift:], out=grown[:-shift])
        marked = np.moveaxis(grown, 0, axis)
    return Occupancy(np.ascontiguousarray(marked), origin, spacing)


def dense_voxels(grid: CanonicalGrid, *, raw_threshold: float) -> Occupancy:
    """The voxels in which raw density may exceed a threshold: one of their nodes does."""
    blocks = np.zeros((*grid.bricks.shape, 4, 4, 4), bool)
    dense = ~(grid.values[:, 0] <= raw_threshold).reshape(-1, 4, 4, 4)  # NaN must stay visible
    blocks[tuple(grid.positions[1:].T)] = dense[1:]
    bx, by, bz = grid.bricks.shape
    cells = blocks.transpose(0, 3, 1, 4, 2, 5).reshape(4 * bx, 4 * by, 4 * bz)
    for axis in range(3):
        source = np.moveaxis(cells, axis, 0)
        source[:-1] |= source[1:]
    return Occupancy(cells.astype(np.uint8), grid.origin, grid.voxel_m)


def _as_bricks(nodes: Float[np.ndarray, "x y z"]) -> Float[np.ndarray, "bx by bz 4 4 4"]:
    bx, by, bz = (n // 4 for n in nodes.shape)
    return nodes.reshape(bx, 4, by, 4, bz, 4).transpose(0, 2, 4, 1, 3, 5)


def _any_in_bricks(nodes: np.ndarray) -> np.ndarray:
    return _as_bricks(nodes).any(axis=(3, 4, 5))
