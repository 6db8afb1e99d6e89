"""Build one pose's warp grid: the way back of vertices, and of nodes from the nearest surface.

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
def closest_weights(p, vertices, i, j, k):
    """Barycentric weights of the point of a triangle closest to p, and the squared distance.

    Regions of the triangle as in Ericson, Real-Time Collision Detection, 5.1.5.

    Args:
        p: Three coordinates. vertices: (V, 3). i, j, k: the triangle's.
    """
    a0, a1, a2 = vertices[i, 0], vertices[i, 1], vertices[i, 2]
    ab0, ab1, ab2 = vertices[j, 0] - a0, vertices[j, 1] - a1, vertices[j, 2] - a2
    ac0, ac1, ac2 = vertices[k, 0] - a0, vertices[k, 1] - a1, vertices[k, 2] - a2
    ap0, ap1, ap2 = p[0] - a0, p[1] - a1, p[2] - a2
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
def closest_on_surface(p, v, vertices, faces, ring_offsets, ring_faces):
    """Face around vertex v whose surface is closest to p, three coordinates.

    Returns the face (-1 where no face has the vertex), the squared distance and the three weights.
    """
    best, chosen = np.inf, -1
    a = b = c = 0.0
    for r in range(ring_offsets[v], ring_offsets[v + 1]):
        f = ring_faces[r]
        wa, wb, wc, d = closest_weights(p, vertices, faces[f, 0], faces[f, 1], faces[f, 2])
        if d < best:
            best, chosen, a, b, c = d, f, wa, wb, wc
    return chosen, best, a, b, c


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
def mean_of(weights, corners, values, axis):
    """Weighted mean of three vertices' values (V, any)."""
    return (
        weights[0] * values[corners[0], axis]
        + weights[1] * values[corners[1], axis]
        + weights[2] * values[corners[2], axis]
    )


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
        p: three coordinates, metres, as `posed`. v: vertex nearest to p (or nearest of one part).
        posed, canonical, normals, canonical_normals: (V, 3). maps: (V, 3, 4) posed -> canonical.
        record: (6,) output.

    Returns:
        Squared distance of p to the surface, and how far it is above it (negative: inside).
    """
    face, squared, a, b, c = closest_on_surface(p, v, posed, faces, ring_offsets, ring_faces)
    last = np.inf
    while squared < last:  # the closest vertex need not be a corner of the closest face
        heaviest = faces[face, 0]
        if b > a:
            heaviest = faces[face, 1]
        if c > max(a, b):
            heaviest = faces[face, 2]
        if heaviest == v:
            break
        v, last = heaviest, squared
        face, squared, a, b, c = closest_on_surface(p, v, posed, faces, ring_offsets, ring_faces)
    corners, weights = (faces[face, 0], faces[face, 1], faces[face, 2]), (a, b, c)
    x = p[0] - mean_of(weights, corners, posed, 0)
    y = p[1] - mean_of(weights, corners, posed, 1)
    z = p[2] - mean_of(weights, corners, posed, 2)
    for i in range(3):
        offset = 0.0
        for corner in range(3):
            u = corners[corner]
            offset += weights[corner] * (maps[u, i, 0] * x + maps[u, i, 1] * y + maps[u, i, 2] * z)
        record[i] = mean_of(weights, corners, canonical, i) + offset
        record[3 + i] = mean_of(weights, corners, normals, i)
    height = x * record[3] + y * record[4] + z * record[5]
    if height > 0:
        foot = (
            mean_of(weights, corners, canonical, 0),
            mean_of(weights, corners, canonical, 1),
            mean_of(weights, corners, canonical, 2),
        )
        up_x = mean_of(weights, corners, canonical_normals, 0)
        up_y = mean_of(weights, corners, canonical_normals, 1)
        up_z = mean_of(weights, corners, canonical_normals, 2)
        length = max(math.sqrt(up_x * up_x + up_y * up_y + up_z * up_z), TINY_LENGTH)
        upward = (up_x / length, up_y / length, up_z / length)
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
        p = (
            (node // (dims[1] * dims[2])) * cell,
            (node // dims[2] % dims[1]) * cell,
            (node % dims[2]) * cell,
        )
        distance[candidate, node], height = way_back(
            p, nearest[candidate, node], posed, canonical, faces, ring_offsets, ring_faces, maps,
            normals, canonical_normals, records[n],
        )  # fmt: skip
        outside[n] = height > 0
