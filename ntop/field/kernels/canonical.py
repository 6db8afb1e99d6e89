"""Loops over the canonical grid: distance to the rest surface, resampling, where density may be."""

import numba
import numpy as np

from ntop.field.kernels import kernel
from ntop.field.kernels.posing import closest_on_surface, mean_of
from ntop.field.kernels.tables import grid_corners, interpolate


@kernel
def signed_distances(
    nodes, nearest, vertices, faces, normals, ring_offsets, ring_faces, spacing, dims, distances
):
    """Signed distance (m, positive outside) of listed grid nodes to the surface near a vertex.

    The sign is that of the interpolated vertex normal, which has no ties at edges.

    Args:
        nodes: (any,) node numbers. nearest: (nodes,) vertex of every node of the grid.
        vertices: (V, 3) relative to node (0, 0, 0). distances: (any,) output.
    """
    for n in numba.prange(nodes.shape[0]):
        node = nodes[n]
        p = (
            (node // (dims[1] * dims[2])) * spacing,
            (node // dims[2] % dims[1]) * spacing,
            (node % dims[2]) * spacing,
        )
        face, squared, a, b, c = closest_on_surface(
            p, nearest[node], vertices, faces, ring_offsets, ring_faces
        )
        corners, weights = (faces[face, 0], faces[face, 1], faces[face, 2]), (a, b, c)
        side = 0.0
        for i in range(3):
            point = mean_of(weights, corners, vertices, i)
            side += mean_of(weights, corners, normals, i) * (p[i] - point)
        distances[n] = np.sqrt(squared) if side >= 0 else -np.sqrt(squared)


@kernel
def resample(grid, positions, origin, voxel, values):
    """Values of a new grid's bricks from another grid, trilinearly in raw values.

    Args:
        grid: GridTables to read. positions: (bricks, 3) of the new grid; slot 0, the void, is
            skipped. origin (3), voxel: of the new grid (metres). values: (rows, 4) output, filled
            with the void's values beforehand.
    """
    for slot in numba.prange(positions.shape[0]):
        if slot == 0:
            continue
        rows = np.empty(8, np.int64)
        weights = np.empty(8, values.dtype)
        for local in range(64):
            x = origin[0] + voxel * (4 * positions[slot, 0] + (local >> 4))
            y = origin[1] + voxel * (4 * positions[slot, 1] + ((local >> 2) & 3))
            z = origin[2] + voxel * (4 * positions[slot, 2] + (local & 3))
            if grid_corners(grid, x, y, z, rows, weights):
                for channel in range(4):
                    values[slot * 64 + local, channel] = interpolate(grid, channel, rows, weights)


@kernel
def mark_dense(values, positions, origin, voxel, low, inverse_spacing, threshold, marked):
    """Mark the occupancy cells within `voxel` of a node whose raw density exceeds a threshold.

    A node's trilinear influence reaches one voxel, so nothing above the threshold is missed. Only
    ever writes 1, so bricks may run in any order.

    Args:
        low: (3,) the occupancy grid's origin (metres).
        marked: (x, y, z) uint8 output.
    """
    for slot in numba.prange(1, positions.shape[0]):
        first = np.empty(3, np.int64)
        last = np.empty(3, np.int64)
        for local in range(64):
            if values[slot * 64 + local, 0] > threshold:
                for a in range(3):
                    step = (local >> 4) if a == 0 else ((local >> 2) & 3 if a == 1 else local & 3)
                    centre = origin[a] + voxel * (4 * positions[slot, a] + step) - low[a]
                    first[a] = max(0, int(np.floor((centre - voxel) * inverse_spacing)))
                    last[a] = min(
                        marked.shape[a] - 1, int(np.floor((centre + voxel) * inverse_spacing))
                    )
                for i in range(first[0], last[0] + 1):
                    for j in range(first[1], last[1] + 1):
                        for k in range(first[2], last[2] + 1):
                            marked[i, j, k] = 1
