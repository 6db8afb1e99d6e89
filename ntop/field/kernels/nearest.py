"""The posed vertices nearest to the nodes of a grid: found block by block of nodes.

Twin of the geometry: `tests/field/test_warp.py` compares with brute force.
"""

import numba
import numpy as np

from ntop.field.kernels import device, kernel

BLOCK = 4  # nodes along an edge of a block
CLUSTER = 16  # vertices, consecutive ones: a mesh lists neighbours near each other
SLACK = 1e-4  # of bounds (relative, or metres), for what rounding may do


@device
def squared_gap(one, other, x, y, z):
    """Squared distance of the places to which two affine maps (3, 4) send a point."""
    gap = 0.0
    for a in range(3):
        gap += (
            (one[a, 0] - other[a, 0]) * x
            + (one[a, 1] - other[a, 1]) * y
            + (one[a, 2] - other[a, 2]) * z
            + (one[a, 3] - other[a, 3])
        ) ** 2
    return gap


@device
def grow(low, high, m, x, y, z):
    """Widen bounds (3, 4) of affine maps by one more; its place of (x, y, z) is in column 3."""
    for a in range(3):
        place = m[a, 0] * x + m[a, 1] * y + m[a, 2] * z + m[a, 3]
        low[a, 3], high[a, 3] = min(low[a, 3], place), max(high[a, 3], place)
        for b in range(3):
            low[a, b], high[a, b] = min(low[a, b], m[a, b]), max(high[a, b], m[a, b])


@device
def centre(low, high):
    """Bounds (any, any) become their middle and how far they go to both sides of it."""
    for a in range(low.shape[0]):
        for b in range(low.shape[1]):
            low[a, b], high[a, b] = 0.5 * (low[a, b] + high[a, b]), 0.5 * (high[a, b] - low[a, b])


@device
def cluster_bounds(posed, maps, boxes, middles, spreads):
    """Where clusters of consecutive vertices are, and what their maps have in common.

    Args:
        posed, maps: See `nearest_vertices`.
        boxes: (clusters, 2, 3) output: middles and half sizes, metres.
        middles, spreads: (clusters, 3, 4) output: linear parts, and in column 3 the places of the
            box's middle, as middle and spread to both sides. Left empty where `maps` is.
    """
    for n in range(boxes.shape[0]):
        box = boxes[n]
        vertices = range(n * CLUSTER, min((n + 1) * CLUSTER, posed.shape[0]))
        box[0], box[1] = np.inf, -np.inf
        for v in vertices:
            for a in range(3):
                box[0, a], box[1, a] = min(box[0, a], posed[v, a]), max(box[1, a], posed[v, a])
        centre(box[:1], box[1:])
        if middles.shape[0] == 0:
            continue
        middles[n], spreads[n] = np.inf, -np.inf
        for v in vertices:
            grow(middles[n], spreads[n], maps[v], box[0, 0], box[0, 1], box[0, 2])
        centre(middles[n], spreads[n])


@device
def may_differ(middle, spread, x, y, z, own, own_spread, half, apart):
    """May a map of a cluster and one of a block send a point of the block `apart` from another?

    Args:
        middle, spread: (3, 4) of the cluster's maps. x, y, z: block's centre from the cluster's.
        own, own_spread: (3, 4) of the block's maps, places being its centre's. half: of its size.
    """
    bound = 0.0
    for a in range(3):
        place = middle[a, 0] * x + middle[a, 1] * y + middle[a, 2] * z + middle[a, 3]
        gap = abs(place - own[a, 3]) + spread[a, 3] + own_spread[a, 3]
        gap += spread[a, 0] * abs(x) + spread[a, 1] * abs(y) + spread[a, 2] * abs(z)
        for b in range(3):
            gap += (abs(middle[a, b] - own[a, b]) + spread[a, b] + own_spread[a, b]) * half
        bound += gap * gap
    return not bound < (apart - SLACK) ** 2


@device
def squared_clearance(dx, dy, dz, half_x, half_y, half_z):
    """Squared distance from a point to a box, given the way to its centre and its half sizes."""
    x, y, z = max(abs(dx) - half_x, 0.0), max(abs(dy) - half_y, 0.0), max(abs(dz) - half_z, 0.0)
    return x * x + y * y + z * z


@device
def near_clusters(boxes, box, radius, given, chosen):
    """Those of the given clusters whose boxes come within a distance of another box.

    Args:
        boxes: (clusters, 2, 3) and box: (2, 3) middles and half sizes; infinite ones say nothing.
        given, chosen: (1 + clusters,) how many, then which; `chosen` is output.
    """
    count = 0
    for n in range(1, given[0] + 1):
        other = boxes[given[n]]
        squared = squared_clearance(
            box[0, 0] - other[0, 0], box[0, 1] - other[0, 1], box[0, 2] - other[0, 2],
            box[1, 0] + other[1, 0], box[1, 1] + other[1, 1], box[1, 2] + other[1, 2],
        )  # fmt: skip
        if squared <= radius * radius:
            count += 1
            chosen[count] = given[n]
    chosen[0] = count


@device
def rival_vertices(posed, clusters, x, y, z, half, radius, found):
    """Vertices that may be the nearest one of a node of a block, in ascending order.

    No vertex that is farther from all of the block than the one nearest to its centre can be.

    Args:
        clusters: (1 + any,) how many are near, then which. x, y, z: the block's centre.
        found: (any,) output. Returns how many.
    """
    best, u = np.inf, -1
    for n in range(1, clusters[0] + 1):
        for v in range(clusters[n] * CLUSTER, min((clusters[n] + 1) * CLUSTER, posed.shape[0])):
            d = (posed[v, 0] - x) ** 2 + (posed[v, 1] - y) ** 2 + (posed[v, 2] - z) ** 2
            if d < best:
                best, u = d, v
    count = 0
    if u < 0 or best > (radius + 2 * half) ** 2:  # half a block's diagonal is 1.73 halves
        return count
    ux, uy, uz = posed[u, 0], posed[u, 1], posed[u, 2]
    for n in range(1, clusters[0] + 1):
        for v in range(clusters[n] * CLUSTER, min((clusters[n] + 1) * CLUSTER, posed.shape[0])):
            d = (posed[v, 0] - x) ** 2 + (posed[v, 1] - y) ** 2 + (posed[v, 2] - z) ** 2
            step = abs(posed[v, 0] - ux) + abs(posed[v, 1] - uy) + abs(posed[v, 2] - uz)
            if not d * (1 - SLACK) > best + 2 * half * step:
                found[count] = v
                count += 1
    return count


@kernel
def nearest_vertices(posed, maps, dims, cell, radius, apart, candidates, nearest, distance):
    """For each node the nearest posed vertex, and the nearest that leads elsewhere.

    Args:
        posed: (V, 3) metres relative to node (0, 0, 0).
        maps: (V, 3, 4) posed -> canonical, read for the second candidate only.
        dims: (3,) nodes. cell: node spacing (m). radius: search radius (m).
        apart: distance (m) of the two canonical places of a node from which a vertex leads
            elsewhere. Both sides of a wrist lead to the same place, an arm and a trunk do not.
        candidates: 1 or 2; with 1 the second is left empty.
        nearest: (2, nodes) int32 output, -1 where none. distance: (2, nodes) squared metres.
    """
    nx, ny, nz = dims[0], dims[1], dims[2]
    limit, half = radius * radius, 0.5 * (BLOCK - 1) * cell
    reach = (radius + SLACK) ** 2
    count = (posed.shape[0] + CLUSTER - 1) // CLUSTER
    kept = count if candidates == 2 else 0
    boxes = np.empty((count, 2, 3))
    middles, spreads = np.empty((kept, 3, 4)), np.empty((kept, 3, 4))
    cluster_bounds(posed, maps, boxes, middles, spreads)
    for slab in numba.prange((nx + BLOCK - 1) // BLOCK):
        every, in_slab = np.empty(count + 1, np.int64), np.empty(count + 1, np.int64)
        in_row, in_block = np.empty(count + 1, np.int64), np.empty(count + 1, np.int64)
        rivals = np.empty(posed.shape[0], np.int64)
        xs, ys, zs = np.empty(BLOCK**3), np.empty(BLOCK**3), np.empty(BLOCK**3)
        squared = np.empty(BLOCK**3, distance.dtype)
        who, box = np.empty(BLOCK**3, np.int32), np.empty((2, 3))
        own, own_spread, none = np.empty((3, 4)), np.empty((3, 4)), np.zeros((3, 4))
        every[0] = count
        for n in range(count):
            every[n + 1] = n
        i0 = slab * BLOCK
        i1 = min(nx, i0 + BLOCK)
        x = (i0 + 0.5 * (BLOCK - 1)) * cell
        for n in range(i0 * ny * nz, i1 * ny * nz):
            nearest[0, n] = nearest[1, n] = -1
            distance[0, n] = distance[1, n] = limit
        box[0], box[1], box[0, 0], box[1, 0] = 0.0, np.inf, x, half
        near_clusters(boxes, box, radius + SLACK, every, in_slab)
        for j0 in range(0, ny, BLOCK):
            j1 = min(ny, j0 + BLOCK)
            y = (j0 + 0.5 * (BLOCK - 1)) * cell
            box[0, 1], box[1, 1], box[1, 2] = y, half, np.inf
            near_clusters(boxes, box, radius + SLACK, in_slab, in_row)
            for k0 in range(0, nz, BLOCK):
                k1 = min(nz, k0 + BLOCK)
                z = (k0 + 0.5 * (BLOCK - 1)) * cell
                box[0, 2], box[1, 2] = z, half
                near_clusters(boxes, box, radius + SLACK, in_row, in_block)
                rival_count = rival_vertices(posed, in_block, x, y, z, half, radius, rivals)
                if rival_count == 0:
                    continue
                for n in range(BLOCK**3):
                    xs[n] = (i0 + n // (BLOCK * BLOCK)) * cell
                    ys[n] = (j0 + n // BLOCK % BLOCK) * cell
                    zs[n] = (k0 + n % BLOCK) * cell
                    squared[n] = limit
                    who[n] = -1
                for r in range(rival_count):
                    v = np.int32(rivals[r])
                    vx, vy, vz = posed[v, 0], posed[v, 1], posed[v, 2]
                    for n in range(BLOCK**3):
                        d = (xs[n] - vx) ** 2 + (ys[n] - vy) ** 2 + (zs[n] - vz) ** 2
                        closer = d < squared[n]
                        squared[n] = d if closer else squared[n]
                        who[n] = v if closer else who[n]
                own[:], own_spread[:] = np.inf, -np.inf
                last = -1
                for i in range(i0, i1):
                    for j in range(j0, j1):
                        for k in range(k0, k1):
                            n = ((i - i0) * BLOCK + j - j0) * BLOCK + k - k0
                            node = (i * ny + j) * nz + k
                            nearest[0, node], distance[0, node] = who[n], squared[n]
                            if who[n] >= 0 and who[n] != last and candidates == 2:
                                last = who[n]
                                grow(own, own_spread, maps[last], x, y, z)
                if last < 0:
                    continue
                centre(own, own_spread)
                for c in in_block[1 : in_block[0] + 1]:
                    dx, dy, dz = x - boxes[c, 0, 0], y - boxes[c, 0, 1], z - boxes[c, 0, 2]
                    if not may_differ(
                        middles[c], spreads[c], dx, dy, dz, own, own_spread, half, apart
                    ):
                        continue
                    for v in range(c * CLUSTER, min((c + 1) * CLUSTER, posed.shape[0])):
                        vx, vy, vz = posed[v, 0], posed[v, 1], posed[v, 2]
                        if squared_clearance(vx - x, vy - y, vz - z, half, half, half) > reach:
                            continue
                        if not may_differ(maps[v], none, x, y, z, own, own_spread, half, apart):
                            continue
                        for i in range(i0, i1):
                            for j in range(j0, j1):
                                dxy = (i * cell - vx) ** 2 + (j * cell - vy) ** 2
                                if dxy >= limit:
                                    continue
                                for k in range(k0, k1):
                                    d = dxy + (k * cell - vz) ** 2
                                    node = (i * ny + j) * nz + k
                                    u = nearest[0, node]
                                    if d < distance[1, node] and u >= 0:
                                        gap = squared_gap(
                                            maps[v], maps[u], i * cell, j * cell, k * cell
                                        )
                                        if not gap < apart * apart:
                                            distance[1, node] = d
                                            nearest[1, node] = v
