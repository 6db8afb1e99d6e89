"""One or two consistent sheets of correspondences for each cell of a warp grid."""

import math

import numba
import numpy as np

from ntop.field.kernels import device, kernel
from ntop.field.kernels.posing import LEAST_RISE, lift

CHUNK = 512  # cells that share their scratch memory: allocating it costs as much as a plain cell


@device
def apply_map(m, x, y, z, out):
    """Out = affine map (3, 4) of a point."""
    for i in range(3):
        out[i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]


@device
def squared_gaps(maps, v, first, cell, records, chosen, gaps):
    """Squared distance of each record of a cell from where a vertex's map puts its corner.

    Args:
        maps: (V, 3, 4). v: the vertex. first: (3,) node numbers of the cell's corner 0. cell: node
            spacing (m).
        chosen: (8, 2) record of each corner and candidate, or -1. gaps: (8, 2) output.
    """
    x, y, z = first[0] * cell, first[1] * cell, first[2] * cell
    for corner in range(8):
        for candidate in range(2):
            gaps[corner, candidate] = 0.0
    for axis in range(3):
        mx, my, mz = maps[v, axis, 0], maps[v, axis, 1], maps[v, axis, 2]
        along_x, along_y, along_z = mx * cell, my * cell, mz * cell
        start = mx * x + my * y + mz * z + maps[v, axis, 3]
        for corner in range(8):
            place = start
            if corner & 4:
                place += along_x
            if corner & 2:
                place += along_y
            if corner & 1:
                place += along_z
            for candidate in range(2):
                record = chosen[corner, candidate]
                if record >= 0:
                    gaps[corner, candidate] += (records[record, axis] - place) ** 2


@kernel
def cell_sheets(
    cell_ids, dims, cell, nearest, distance, record_of, records, outside, maps, normals,
    canonical, canonical_normals, reach, agree, sheets, extra_count, extra,
):  # fmt: skip
    """One or two consistent sheets per cell, each with a canonical position at all 8 corners.

    A sheet starts at the corner that is closest to a surface; the map of that corner's vertex,
    applied to the other corners, predicts where they must lie. A corner whose own record disagrees
    (it is nearer to another part) gets the prediction instead, so that interpolation never mixes
    two parts. The second sheet starts at the closest record that disagrees with the first: what the
    first does not hold would be lost, even where the two are the sides of one fold.

    A prediction goes on straight where the skin does not: beyond the tip of a bent elbow it would
    enter the arm again. A corner outside the body is therefore outside on every sheet (`lift`).

    Args:
        cell_ids: (cells,) number of each cell's first node. record_of: (2, nodes) record or -1.
        outside: (records,) whether a record's node is outside its surface.
        canonical, canonical_normals: (V, 3) vertices and their unit normals.
        reach: surface distance (m) up to which a second sheet is kept.
        agree: canonical distance (m) up to which records are of one sheet.
        sheets: (cells, 2, 8): record number, or -2 - e for extra e of this cell (-1: no sheet).
        extra_count: (cells,). extra: (cells, 16, 6) output.
    """
    cells, near = cell_ids.shape[0], agree * agree
    for chunk in numba.prange((cells + CHUNK - 1) // CHUNK):
        predicted, first = np.empty(3, np.float64), np.empty(3, np.int64)
        nodes, chosen = np.empty(8, np.int64), np.empty((8, 2), np.int32)
        gaps, squared = np.empty((8, 2), np.float64), np.empty((8, 2), distance.dtype)
        for number in range(chunk * CHUNK, min(cells, (chunk + 1) * CHUNK)):
            base = cell_ids[number]
            first[0], first[1] = base // (dims[1] * dims[2]), base // dims[2] % dims[1]
            first[2] = base % dims[2]
            start, vertex = np.inf, -1
            for corner in range(8):
                i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
                node = base + (i * dims[1] + j) * dims[2] + k
                nodes[corner] = node
                for candidate in range(2):
                    chosen[corner, candidate] = record_of[candidate, node]
                    squared[corner, candidate] = distance[candidate, node]
                    if chosen[corner, candidate] >= 0 and squared[corner, candidate] < start:
                        start, vertex = squared[corner, candidate], nearest[candidate, node]
            used = 0
            for sheet in range(2):
                if sheet == 1:
                    start, vertex = np.inf, -1
                    for corner in range(8):
                        for candidate in range(2):
                            if (
                                chosen[corner, candidate] >= 0
                                and not gaps[corner, candidate] < near
                                and squared[corner, candidate] < start
                                and squared[corner, candidate] <= reach * reach
                            ):
                                start = squared[corner, candidate]
                                vertex = nearest[candidate, nodes[corner]]
                if vertex < 0:
                    sheets[number, sheet] = -1
                    continue
                squared_gaps(maps, vertex, first, cell, records, chosen, gaps)
                for corner in range(8):
                    best, record = near, -1
                    for candidate in range(2):
                        if chosen[corner, candidate] >= 0 and gaps[corner, candidate] < best:
                            best, record = gaps[corner, candidate], chosen[corner, candidate]
                    if record >= 0:
                        sheets[number, sheet, corner] = record
                        continue
                    apply_map(
                        maps[vertex],
                        (first[0] + (corner >> 2)) * cell,
                        (first[1] + ((corner >> 1) & 1)) * cell,
                        (first[2] + (corner & 1)) * cell,
                        predicted,
                    )
                    own = chosen[corner, 0]
                    if own >= 0 and outside[own]:
                        height = LEAST_RISE * math.sqrt(squared[corner, 0])
                        lift(predicted, height, canonical[vertex], canonical_normals[vertex])
                    sheets[number, sheet, corner] = -2 - used
                    for axis in range(3):
                        extra[number, used, axis] = predicted[axis]
                        extra[number, used, 3 + axis] = normals[vertex, axis]
                    used += 1
            extra_count[number] = used
