"""Pack an avatar, and its poses, for the renderer; see `ntop.field.kernels.packed`."""

import numpy as np
from jaxtyping import Float, Int

from ntop.field.canonical import CanonicalGrid, PartLabels, dense_voxels
from ntop.field.kernels.packed import (
    NODES,
    PackedDensity,
    PackedSheets,
    mark_straight,
    pack_bricks,
    pack_sheets,
)
from ntop.field.kernels.tables import EMPTY_RAW, VOID_RAW, GridTables, WarpTables
from ntop.field.marching import Scene


def packed_scene(
    grid: CanonicalGrid,
    warp: WarpTables,
    light: Float[np.ndarray, "9 3"],
    labels: PartLabels,
    *,
    density: PackedDensity | None = None,
    poses: Int[np.ndarray, " any"] | None = None,
) -> Scene:
    """All that a march reads.

    Args:
        grid: The field.
        warp: Of one or several poses.
        light: See `kernels.tables.shade`.
        labels: Parts of canonical space.
        density: The packed field, where it is known from an earlier pose.
        poses: Of `warp`, that rays will ask for; else all. 12 MB each.
    """
    tables = grid.tables()
    sheets = packed_sheets(tables, warp, poses)
    # a straight cell is walked as a whole, from the face where a ray enters it
    whole = np.where(sheets.straight & (warp.occupancy != 0), 255, warp.occupancy)
    return Scene(
        tables,
        warp._replace(occupancy=whole.astype(np.uint8)),
        density or packed_density(grid),
        sheets,
        light,
        labels,
    )


def packed_density(grid: CanonicalGrid) -> PackedDensity:
    """Raw density by bricks, as precise as the grid; empty ones, to rendering, are the void's."""
    dense = dense_voxels(grid, raw_threshold=EMPTY_RAW).cells
    bx, by, bz = grid.bricks.shape
    full = dense.reshape(bx, 4, by, 4, bz, 4).any(axis=(1, 3, 5))
    bricks = np.ascontiguousarray(np.argwhere(full))
    slots = np.zeros(full.shape, np.int32)
    slots[full] = np.arange(1, len(bricks) + 1)
    raw = np.empty((len(bricks) + 1, NODES**3), grid.values.dtype)
    raw[0] = VOID_RAW
    voxels = np.zeros((len(raw), 64), np.bool_)
    pack_bricks(grid.tables(), bricks, raw[1:], voxels[1:])
    return PackedDensity(slots, raw, voxels)


def packed_sheets(
    grid: GridTables, warp: WarpTables, poses: Int[np.ndarray, " any"] | None = None
) -> PackedSheets:
    """Corners of all cells that are occupied, of all poses or of some."""
    wanted = warp.occupancy != 0
    if poses is not None:
        chosen = np.zeros(len(wanted), bool)
        for pose in np.unique(poses):
            cells = warp.cells[warp.cell_offset[pose] :][: warp.dims[pose].prod()]
            chosen[cells[cells >= 0]] = True
        wanted = wanted & chosen
    exists = (warp.sheets[:, :, 0] >= 0) & wanted[:, None]
    sheets = np.ascontiguousarray(np.argwhere(exists))
    rows = np.full(exists.shape, -1, np.int32)
    rows[exists] = np.arange(len(sheets))
    corners = np.empty((len(sheets), 48), grid.values.dtype)
    pack_sheets(grid, warp, sheets, corners)
    straight = np.empty(len(rows), np.bool_)
    mark_straight(rows, corners, straight)
    return PackedSheets(rows, corners, straight)
