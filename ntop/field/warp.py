"""Warp grids: from a posed body to tables that take a world point back to canonical space.

A world point belongs to the surface point closest to it and follows that point's blended bone
transform back. This is exact on the surface and continuous off it until another part of the body
is nearer; there a cell keeps two *sheets*, one per part, and the renderer takes the denser.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, pose_body
from ntop.conventions import DataError
from ntop.field.canonical import CanonicalBody, Occupancy, vertex_normals
from ntop.field.kernels.nearest import nearest_vertices
from ntop.field.kernels.occupancy import octant_occupancy
from ntop.field.kernels.posing import node_records, vertex_maps
from ntop.field.kernels.sheets import cell_sheets
from ntop.field.kernels.tables import WarpTables
from ntop.field.kernels.tiles import outer_cells

APART_M = 0.12  # canonical distance between a point's two places that are worth keeping both
AGREE_M = 0.03  # corners of one sheet lie this close to where their neighbour's map puts them
EXTRA_PER_CELL = 16
CELLS_AT_ONCE = 1 << 14  # 6 MB of extras: larger arrays would be new memory for every pose
MAX_NODES = 3e7  # a person with spread limbs has 4e6 at 12 mm; 16 bytes each
BLOCK = 4  # cells; distances to what is occupied are counted in blocks beyond the next ones
MAX_AWAY = 8  # blocks; how far a ray may jump over empty space at once
STRETCH = 1.2  # of canonical lengths against posed ones that occupancy allows for


@dataclass(frozen=True)
class PoseWarp:
    """One pose's warp tables; `origin_world` (metres) is the grid's first node."""

    tables: WarpTables
    origin_world: Float[np.ndarray, " 3"]
    cell_m: float

    @functools.cached_property
    def outer_centres_world(self) -> Float[np.ndarray, "cell 3"]:
        """Centres (m) of the occupied cells that have a neighbour which is not.

        A ray from outside meets one of them before it meets any other, and after.
        """
        tables = self.tables
        outer = np.empty(len(tables.cells), np.bool_)
        outer_cells(tables.cells, tables.occupancy, tables.dims[0], outer)
        index = np.stack(np.unravel_index(np.flatnonzero(outer), tables.dims[0]), 1)
        return (index + 0.5) * self.cell_m + self.origin_world


def pose_warp(
    body: CanonicalBody, model: BodyModel, pose: BodyPose, *, cell_m: float, reach_m: float
) -> PoseWarp:
    """Warp grid around a posed body, `reach_m` beyond its surface; occupancy is still empty.

    Raises:
        DataError: the pose or shape is not finite, or stretches the body beyond `MAX_NODES`.
    """
    pose = pose.double()
    posed = pose_body(model, pose)
    vertices_world = posed.vertices.numpy()
    radius = reach_m + 1.8 * cell_m  # a cell's farthest corner
    origin = vertices_world.min(0) - radius - 0.5 * cell_m
    nodes_along = np.ceil((vertices_world.max(0) + radius - origin) / cell_m) + 1
    if not nodes_along.prod() <= MAX_NODES:  # also refuses NaN
        raise DataError(
            f"a posed body {np.ptp(vertices_world, axis=0).round(2).tolist()} m large: expected "
            f"finite pose and shape parameters and at most {MAX_NODES:.0e} cells of {cell_m} m "
            "around it; check betas, pose and units (metres, radians)"
        )
    dims = nodes_along.astype(np.int64)
    vertices = vertices_world - origin
    maps = _vertex_maps(body, posed.posed_from_rest.numpy(), vertices, origin)
    normals = vertex_normals(vertices, body.faces)

    count = int(dims.prod())
    nearest = np.empty((2, count), np.int32)
    distance = np.empty((2, count), np.float32)
    nearest_vertices(
        vertices.astype(np.float32), maps.astype(np.float32), dims, cell_m, radius, APART_M,
        2, nearest, distance,
    )  # fmt: skip
    found = np.flatnonzero(nearest >= 0)
    ids = np.empty((len(found), 2), np.int32)
    ids[:, 1] = found >= count
    ids[:, 0] = found - count * ids[:, 1]
    records = np.empty((len(ids), 6), np.float32)
    outside = np.empty(len(ids), np.bool_)
    node_records(
        ids, vertices, body.vertices, body.faces, body.ring_offsets,
        body.ring_faces, maps, normals, body.normals, dims, cell_m, nearest, distance, records,
        outside,
    )  # fmt: skip
    record_of = np.full((2, count), -1, np.int32)
    record_of.ravel()[found] = np.arange(len(found), dtype=np.int32)

    cells = _cells_near(distance[0].reshape(dims), reach_m, cell_m)
    cell_ids = np.flatnonzero(cells >= 0)
    base = np.ravel_multi_index(np.unravel_index(cell_ids, cells.shape), dims)
    sheets, extras = np.empty((len(base), 2, 8), np.int32), []
    numbered = len(records)
    for start in range(0, len(base), CELLS_AT_ONCE):
        some = slice(start, start + CELLS_AT_ONCE)
        extra_count = np.empty(len(base[some]), np.int32)
        extra = np.empty((len(base[some]), EXTRA_PER_CELL, 6), np.float32)
        cell_sheets(
            base[some], dims, cell_m, nearest, distance, record_of, records, outside, maps,
            normals, body.vertices, body.normals, reach_m, AGREE_M, sheets[some], extra_count,
            extra,
        )  # fmt: skip
        extended = np.flatnonzero(extra_count)  # few cells; the others' sheets are records alone
        counts, own = extra_count[extended], sheets[some][extended]
        first = numbered + np.cumsum(counts, dtype=np.int32) - counts
        sheets[start + extended] = np.where(own <= -2, first[:, None, None] - 2 - own, own)
        extras.append(extra[extended][np.arange(EXTRA_PER_CELL) < counts[:, None]])
        numbered += len(extras[-1])
    tables = WarpTables(
        dims=(dims - 1)[None],
        cell_offset=np.zeros(1, np.int64),
        inverse_cell=1 / cell_m,
        cells=cells.ravel(),
        sheets=sheets,
        nodes=np.concatenate([records, *extras]),
        occupancy=np.zeros(len(base), np.uint8),
        away=np.zeros(cells.size, np.uint8),
    )
    return PoseWarp(tables, origin, cell_m)


def occupied(tables: WarpTables, occupancy: Occupancy, *, extent: float = 0.0) -> WarpTables:
    """The same warps, of one or several poses, that skip what the canonical occupancy rules out.

    `extent` 1 looks at the whole of every octant: with the occupancy of `dense_voxels`, nothing
    that is skipped has density. 0 looks at its centre, for an occupancy with a margin.
    """
    found = np.empty_like(tables.occupancy)
    octant_occupancy(
        tables, occupancy.sums, occupancy.coarse_sums, occupancy.origin, 1 / occupancy.spacing_m,
        extent, found,
    )  # fmt: skip
    return with_octants(tables, found)


def with_octants(tables: WarpTables, octants: UInt8[np.ndarray, " cell"]) -> WarpTables:
    """The same warps with these octants to look at."""
    poses = range(len(tables.dims))
    away = np.concatenate([_away(tables, octants, p) for p in poses])
    return tables._replace(occupancy=octants, away=away)


def octant_radius_m(cell_m: float) -> float:
    """How far a point of an octant, as the occupancy looks them up, may lie from its centre."""
    return STRETCH * cell_m * math.sqrt(3) / 4


def joined(tables: list[WarpTables]) -> WarpTables:
    """One table of all poses, for training; pose p is `tables[p]`."""
    cell_start = np.cumsum([0] + [len(t.sheets) for t in tables])
    node_start = np.cumsum([0] + [len(t.nodes) for t in tables])
    return WarpTables(
        dims=np.concatenate([t.dims for t in tables]),
        cell_offset=np.cumsum([0] + [len(t.cells) for t in tables])[:-1],
        inverse_cell=tables[0].inverse_cell,
        cells=np.concatenate(
            [
                np.where(t.cells >= 0, t.cells + s, -1)
                for t, s in zip(tables, cell_start[:-1], strict=True)
            ]
        ).astype(np.int32),
        sheets=np.concatenate(
            [
                np.where(t.sheets >= 0, t.sheets + s, -1)
                for t, s in zip(tables, node_start[:-1], strict=True)
            ]
        ).astype(np.int32),
        nodes=np.concatenate([t.nodes for t in tables]),
        occupancy=np.concatenate([t.occupancy for t in tables]),
        away=np.concatenate([t.away for t in tables]),
    )


def identity_warp(
    low_world: Float[np.ndarray, " 3"], high_world: Float[np.ndarray, " 3"], *, cell_m: float
) -> PoseWarp:
    """A warp that only shifts: canonical space is the world relative to the grid's first node."""
    dims = np.ceil((high_world - low_world) / cell_m).astype(np.int64)
    nodes = np.stack(np.meshgrid(*(np.arange(n + 1) for n in dims), indexing="ij"), -1)
    records = np.zeros((*nodes.shape[:3], 6), np.float32)
    records[..., :3] = nodes * cell_m
    records[..., 5] = 1  # any unit normal
    index = np.arange(nodes[..., 0].size, dtype=np.int32).reshape(nodes.shape[:3])
    sheets = np.full((int(dims.prod()), 2, 8), -1, np.int32)
    for corner in range(8):
        i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
        part = index[i : i + dims[0], j : j + dims[1], k : k + dims[2]]
        sheets[:, 0, corner] = part.ravel()
    tables = WarpTables(
        dims=dims[None],
        cell_offset=np.zeros(1, np.int64),
        inverse_cell=1 / cell_m,
        cells=np.arange(dims.prod(), dtype=np.int32),
        sheets=sheets,
        nodes=records.reshape(-1, 6),
        occupancy=np.zeros(dims.prod(), np.uint8),
        away=np.zeros(dims.prod(), np.uint8),
    )
    return PoseWarp(tables, low_world.astype(np.float64), cell_m)


def _vertex_maps(
    body: CanonicalBody,
    posed_from_rest: Float[np.ndarray, "24 4 4"],
    vertices: Float[np.ndarray, "vertex 3"],
    origin: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "vertex 3 4"]:
    """Maps posed (relative to `origin`) -> canonical."""
    bones = posed_from_rest.copy()
    bones[:, :3, 3] -= origin
    blended = (body.lbs_weights @ bones[:, :3].reshape(24, 12)).reshape(-1, 3, 4)
    maps = np.empty((len(vertices), 3, 4))
    vertex_maps(
        blended, body.canonical_from_rest, body.vertices, vertices, bones[:, :3], body.parts, maps
    )
    return maps


def _cells_near(squared: Float[np.ndarray, "x y z"], reach_m: float, cell_m: float) -> np.ndarray:
    """Cell numbers: cells with a corner within reach of the surface, -1 for the others."""
    limit = (reach_m + 0.9 * cell_m) ** 2  # a point of the cell is this close to some corner
    near = squared <= limit
    any_corner = np.zeros(tuple(n - 1 for n in near.shape), bool)
    for i, j, k in np.ndindex(2, 2, 2):
        any_corner |= near[
            i : i + any_corner.shape[0], j : j + any_corner.shape[1], k : k + any_corner.shape[2]
        ]
    return np.where(any_corner, np.cumsum(any_corner).reshape(any_corner.shape) - 1, -1).astype(
        np.int32
    )


def _away(tables: WarpTables, occupancy: np.ndarray, pose: int) -> np.ndarray:
    """How many cells away the nearest occupied cell is at least, per cell; see `WarpTables`.

    Near ones are counted cell by cell, the others by blocks of BLOCK.
    """
    dims = tables.dims[pose]
    cells = tables.cells[tables.cell_offset[pose] :][: dims.prod()].reshape(dims)
    full = np.zeros(BLOCK * (-(-dims // BLOCK)), bool)
    full[: dims[0], : dims[1], : dims[2]] = (cells >= 0) & (occupancy[cells] != 0)
    bx, by, bz = (n // BLOCK for n in full.shape)
    blocks = full.reshape(bx, BLOCK, by, BLOCK, bz, BLOCK).any(axis=(1, 3, 5))
    coarse = BLOCK * np.maximum(_steps_away(blocks, MAX_AWAY).astype(np.int64) - 1, 0) + 1
    near = _steps_away(full, BLOCK)
    for axis in range(3):
        coarse = coarse.repeat(BLOCK, axis)
    away = np.where(near < BLOCK, near, np.maximum(coarse, BLOCK)).astype(np.uint8)
    return away[: dims[0], : dims[1], : dims[2]].ravel()


def _steps_away(marked: np.ndarray, limit: int) -> UInt8[np.ndarray, "x y z"]:
    """Chessboard distance to what is marked, at most `limit`."""
    away = np.zeros(marked.shape, np.uint8)
    for _ in range(limit):
        away += ~marked
        marked = _grown(marked)
    return away


def _grown(marked: np.ndarray) -> np.ndarray:
    """Also the 26 neighbours."""
    for axis in range(3):
        source = np.moveaxis(marked, axis, 0)
        grown = source.copy()
        grown[1:] |= source[:-1]
        grown[:-1] |= source[1:]
        marked = np.moveaxis(grown, 0, axis)
    return marked
