"""One or two consistent sheets of correspondences for each cell of a warp grid."""

import math

import numba
import numpy as np

from ntop.field.kernels import device, kernel
from ntop.field.kernels.posing import LEAST_RISE, lift


@device
def apply_map(m, x, y, z, out):
    """Out = affine map (3, 4) of a point."""
    for i in range(3):
        out[i] = m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3]


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
    for number in numba.prange(cell_ids.shape[0]):
        base = cell_ids[number]
        bx, by = base // (dims[1] * dims[2]), base // dims[2] % dims[1]
        bz = base % dims[2]
        predicted = np.empty(3, np.float64)
        used = 0
        first_vertex = -1
        for sheet in range(2):
            start, start_candidate, start_corner = np.inf, -1, -1
            for corner in range(8):
                i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
                node = base + (i * dims[1] + j) * dims[2] + k
                for candidate in range(2):
                    record = record_of[candidate, node]
                    if record < 0 or distance[candidate, node] >= start:
                        continue
                    if sheet == 1:
                        if distance[candidate, node] > reach * reach:
                            continue
                        apply_map(
                            maps[first_vertex], (bx + i) * cell, (by + j) * cell, (bz + k) * cell,
                            predicted,
                        )  # fmt: skip
                        gap = 0.0
                        for a in range(3):
                            gap += (records[record, a] - predicted[a]) ** 2
                        if gap < agree * agree:
                            continue
                    start, start_candidate, start_corner = (
                        distance[candidate, node],
                        candidate,
                        corner,
                    )
            if start_corner < 0:
                sheets[number, sheet, 0] = -1
                continue
            i, j, k = start_corner >> 2, (start_corner >> 1) & 1, start_corner & 1
            vertex = nearest[start_candidate, base + (i * dims[1] + j) * dims[2] + k]
            if sheet == 0:
                first_vertex = vertex
            for corner in range(8):
                i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
                node = base + (i * dims[1] + j) * dims[2] + k
                apply_map(
                    maps[vertex], (bx + i) * cell, (by + j) * cell, (bz + k) * cell, predicted
                )
                best, chosen = agree * agree, -1
                for candidate in range(2):
                    record = record_of[candidate, node]
                    if record >= 0:
                        gap = 0.0
                        for a in range(3):
                            gap += (records[record, a] - predicted[a]) ** 2
                        if gap < best:
                            best, chosen = gap, record
                if chosen >= 0:
                    sheets[number, sheet, corner] = chosen
                else:
                    if record_of[0, node] >= 0 and outside[record_of[0, node]]:
                        height = LEAST_RISE * math.sqrt(distance[0, node])
                        lift(predicted, height, canonical[vertex], canonical_normals[vertex])
                    sheets[number, sheet, corner] = -2 - used
                    for a in range(3):
                        extra[number, used, a] = predicted[a]
                        extra[number, used, 3 + a] = normals[vertex, a]
                    used += 1
        extra_count[number] = used
