"""Build one pose's warp grid: nearest surface, canonical positions of nodes, sheets of cells.

Twin of the geometry: `tests/field/test_warp.py` compares with brute force and forward skinning.
"""

import math

import numba
import numpy as np

from ntop.field.kernels import device, kernel

MIN_SCALE = 0.8  # what lies off the surface is not stretched by more than the inverse of this
SAFE_STRETCH = 2 + MIN_SCALE**-2  # squared Frobenius norm of an inverse that cannot be beyond it
MAIN_SHARE = 0.02  # of the main bone: it decides directions that blending has collapsed
LEAST_RISE = 0.5  # of a point's distance from the skin: so far it stays above it at least
TINY_VOLUME = 1e-6
TINY_LENGTH = 1e-12
SLAB = 4  # nodes along x that one task owns


@device
def bounded_inverse(linear, main, inverse):
    """Inverse of a blended rotation, none of whose scales is taken below `MIN_SCALE`.

    Where the blend has collapsed, what is left is the mean of the bones' rotations (the polar one);
    `main`, the rotation of the vertex's main bone, decides where there is no mean.

    Args:
        linear, main: (3, 3). inverse: (3, 3) output.
    """
    left, scales, right = np.linalg.svd(linear + MAIN_SHARE * main)
    mirrored = np.linalg.det(left) * np.linalg.det(right) < 0
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                sign = -1.0 if mirrored and k == 2 else 1.0
                total += sign * right[k, i] * left[j, k] / max(scales[k], MIN_SCALE)
            inverse[i, j] = total


@kernel
def vertex_maps(blended, canonical_from_rest, canonical, posed, bones, main_bone, maps):
    """Per vertex the affine map posed -> canonical that sends the posed vertex to its own rest.

    It is the inverse of skinning, but bounded (`bounded_inverse`): where blending collapses (candy
    wrapper, the tip of a bent elbow), that would send what is off the surface far away, and one
    bone's would turn it into the body.

    Args:
        blended: (V, 3, 4) this pose's blend, rest -> posed. canonical_from_rest: (V, 3, 4) blend.
        canonical, posed: (V, 3) vertices, metres. bones: (24, 3, 4) rigid, rest -> posed.
        main_bone: (V,). maps: (V, 3, 4) output.
    """
    for v in numba.prange(canonical.shape[0]):
        a = blended[v]
        c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
        c01 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
        c02 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
        det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
        inverse = np.empty((3, 3), np.float64)
        stretch = np.inf
        if det > TINY_VOLUME:
            inverse[0, 0], inverse[1, 0], inverse[2, 0] = c00 / det, c01 / det, c02 / det
            inverse[0, 1] = (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]) / det
            inverse[1, 1] = (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]) / det
            inverse[2, 1] = (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1]) / det
            inverse[0, 2] = (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]) / det
            inverse[1, 2] = (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]) / det
            inverse[2, 2] = (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) / det
            stretch = (inverse * inverse).sum()
        if not stretch < SAFE_STRETCH:
            linear, main = a[:, :3].copy(), bones[main_bone[v], :, :3].copy()
            bounded_inverse(linear, main, inverse)
        for i in range(3):
            moved = 0.0
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += canonical_from_rest[v, i, k] * inverse[k, j]
                maps[v, i, j] = total
                moved += total * posed[v, j]
            maps[v, i, 3] = canonical[v, i] - moved


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
    ny, nz = dims[1], dims[2]
    limit = radius * radius
    inverse = 1 / cell
    for slab in numba.prange((dims[0] + SLAB - 1) // SLAB):
        first, last = slab * SLAB, min(dims[0], (slab + 1) * SLAB) - 1
        for n in range(first * ny * nz, (last + 1) * ny * nz):
            nearest[0, n] = nearest[1, n] = -1
            distance[0, n] = distance[1, n] = limit
        for candidate in range(candidates):
            for v in range(posed.shape[0]):
                x, y, z = posed[v, 0], posed[v, 1], posed[v, 2]
                i0 = max(first, int(math.ceil((x - radius) * inverse)))
                i1 = min(last, int(math.floor((x + radius) * inverse)))
                if i0 > i1:
                    continue
                j0 = max(0, int(math.ceil((y - radius) * inverse)))
                j1 = min(ny - 1, int(math.floor((y + radius) * inverse)))
                k0 = max(0, int(math.ceil((z - radius) * inverse)))
                k1 = min(nz - 1, int(math.floor((z + radius) * inverse)))
                for i in range(i0, i1 + 1):
                    dx = (i * cell - x) ** 2
                    for j in range(j0, j1 + 1):
                        dxy = dx + (j * cell - y) ** 2
                        if dxy >= limit:
                            continue
                        for k in range(k0, k1 + 1):
                            d = dxy + (k * cell - z) ** 2
                            n = (i * ny + j) * nz + k
                            if d < distance[candidate, n]:
                                if candidate == 1:
                                    gap = squared_gap(
                                        maps[v], maps[nearest[0, n]], i * cell, j * cell, k * cell
                                    )
                                    if gap < apart * apart:
                                        continue
                                distance[candidate, n] = d
                                nearest[candidate, n] = v


@device
def closest_weights(p, a, b, c):
    """Barycentric weights of the point of triangle abc closest to p, and the squared distance.

    Regions of the triangle as in Ericson, Real-Time Collision Detection, 5.1.5.
    """
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ac0, ac1, ac2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    ap0, ap1, ap2 = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    d1 = ab0 * ap0 + ab1 * ap1 + ab2 * ap2
    d2 = ac0 * ap0 + ac1 * ap1 + ac2 * ap2
    aa = ab0 * ab0 + ab1 * ab1 + ab2 * ab2
    cc = ac0 * ac0 + ac1 * ac1 + ac2 * ac2
    bc = ab0 * ac0 + ab1 * ac1 + ab2 * ac2
    d3, d4, d5, d6 = d1 - aa, d2 - bc, d1 - bc, d2 - cc
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if d1 <= 0 and d2 <= 0:
        v, w = 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        v, w = d1 / (d1 - d3), 0.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        v, w = 0.0, d2 / (d2 - d6)
    elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1 - w
    else:
        total = va + vb + vc
        v, w = vb / total, vc / total
    q0 = ap0 - v * ab0 - w * ac0
    q1 = ap1 - v * ab1 - w * ac1
    q2 = ap2 - v * ab2 - w * ac2
    return 1 - v - w, v, w, q0 * q0 + q1 * q1 + q2 * q2


@device
def closest_on_surface(p, v, vertices, faces, ring_offsets, ring_faces, weights):
    """Face around vertex v whose surface is closest to p; fills its weights (3).

    Returns the face and the squared distance; face -1 where no face has the vertex.
    """
    best, chosen = np.inf, -1
    for r in range(ring_offsets[v], ring_offsets[v + 1]):
        f = ring_faces[r]
        a, b, c, d = closest_weights(
            p, vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        )
        if d < best:
            best, chosen = d, f
            weights[0], weights[1], weights[2] = a, b, c
    return chosen, best


@device
def lift(place, height, foot, normal):
    """Move a place (3) along a unit normal until it is `height` above the plane through `foot`."""
    missing = height
    for i in range(3):
        missing -= (place[i] - foot[i]) * normal[i]
    if missing > 0:
        for i in range(3):
            place[i] += missing * normal[i]


@device
def way_back(
    p, v, posed, canonical, faces, ring_offsets, ring_faces, maps, normals, canonical_normals,
    record,
):  # fmt: skip
    """Canonical position and world normal of a point, from the surface around vertex v closest.

    The closest surface point q goes back exactly, as the mean of its triangle's corners; what lies
    off it, p - q, follows the mean of their maps. (The mean of the corners' affine maps of p would
    miss the surface between vertices, by a centimetre on a bent elbow's large triangles.) What is
    outside stays outside: beyond the tip of a bent knee, no mean of two bones' rotations suits all
    directions, and some would lead into the leg again.

    Args:
        p: (3,) metres, as `posed`. v: vertex nearest to p (or nearest of one part).
        posed, canonical, normals, canonical_normals: (V, 3). maps: (V, 3, 4) posed -> canonical.
        record: (6,) output.

    Returns:
        Squared distance of p to the surface, and how far it is above it (negative: inside).
    """
    weights = np.empty(3, np.float64)
    face, squared = closest_on_surface(p, v, posed, faces, ring_offsets, ring_faces, weights)
    last = np.inf
    while squared < last:  # the closest vertex need not be a corner of the closest face
        heaviest = 0
        for corner in range(1, 3):
            if weights[corner] > weights[heaviest]:
                heaviest = corner
        if faces[face, heaviest] == v:
            break
        v, last = faces[face, heaviest], squared
        face, squared = closest_on_surface(p, v, posed, faces, ring_offsets, ring_faces, weights)
    x, y, z = p[0], p[1], p[2]  # becomes p - q
    for corner in range(3):
        u = faces[face, corner]
        x -= weights[corner] * posed[u, 0]
        y -= weights[corner] * posed[u, 1]
        z -= weights[corner] * posed[u, 2]
    foot, upward = np.zeros(3, np.float64), np.zeros(3, np.float64)
    for i in range(3):
        offset, normal = 0.0, 0.0
        for corner in range(3):
            u = faces[face, corner]
            m = maps[u, i]
            foot[i] += weights[corner] * canonical[u, i]
            upward[i] += weights[corner] * canonical_normals[u, i]
            offset += weights[corner] * (m[0] * x + m[1] * y + m[2] * z)
            normal += weights[corner] * normals[u, i]
        record[i] = foot[i] + offset
        record[3 + i] = normal
    height = x * record[3] + y * record[4] + z * record[5]
    if height > 0:
        length = math.sqrt(upward[0] ** 2 + upward[1] ** 2 + upward[2] ** 2)
        for i in range(3):
            upward[i] /= max(length, TINY_LENGTH)
        lift(record, LEAST_RISE * math.sqrt(squared), foot, upward)
    return squared, height


@kernel
def node_records(
    node_ids, posed, canonical, faces, ring_offsets, ring_faces, maps, normals, canonical_normals,
    dims, cell, nearest, distance, records, outside,
):  # fmt: skip
    """Canonical position and normal of each listed node, from the surface closest to it.

    Args:
        node_ids: (any, 2) node number and candidate (0, 1). Others: see `way_back`.
        distance: (2, nodes) squared metres; sharpened from vertex to surface distance.
        records: (any, 6) output. outside: (any,) output, whether the node is outside that surface.
    """
    for n in numba.prange(node_ids.shape[0]):
        node, candidate = node_ids[n, 0], node_ids[n, 1]
        p = np.empty(3, np.float64)
        p[0] = (node // (dims[1] * dims[2])) * cell
        p[1] = (node // dims[2] % dims[1]) * cell
        p[2] = (node % dims[2]) * cell
        distance[candidate, node], height = way_back(
            p, nearest[candidate, node], posed, canonical, faces, ring_offsets, ring_faces, maps,
            normals, canonical_normals, records[n],
        )  # fmt: skip
        outside[n] = height > 0
