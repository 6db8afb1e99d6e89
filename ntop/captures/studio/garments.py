"""Clothes as geometry: how far they stand off the rest body, and the skirt's own surface.

Tight clothes, shoes and hair are the body's vertices moved outwards. The skirt is a mesh of its own
whose skinning weights are blended from the body around it. All in the body frame, metres.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse
from scipy.spatial import ConvexHull
from scipy.spatial.distance import cdist

from ntop.captures.studio import textures
from ntop.captures.studio.patterns import inside, ripple
from ntop.captures.studio.raycast import vertex_normals
from ntop.captures.studio.textures import Cut, Landmarks

SKIRT_COLUMNS, SKIRT_ROWS = 96, 40
SKIRT_BLEND_M = 0.07  # how far over the body a skirt vertex gathers its skinning weights
LOWER_BODY_JOINTS = 12  # SMPL's first twelve: pelvis, spine, legs, feet


def garment_cut(name: str, marks: Landmarks) -> Cut:
    """Where the garments of an actor end: short sleeves for `plain`, long ones for `loose`."""
    shoulder, elbow, wrist = (
        abs(marks.joint(f"left_{joint}")[0]) for joint in ("shoulder", "elbow", "wrist")
    )
    ankle_y = marks.joint("left_ankle")[1]
    return Cut(
        sleeve_x=shoulder + 0.72 * (elbow - shoulder) if name == "plain" else wrist - 0.03,
        hem_y=marks.joint("pelvis")[1] - (0.06 if name == "plain" else -0.06),
        trouser_end_y=ankle_y + 0.005,
        shoe_top_y=ankle_y + 0.012,
    )


def clothe(
    body: Float[ndarray, "vertex 3"],
    faces: Int[ndarray, "face 3"],
    *,
    marks: Landmarks,
    cut: Cut,
    bulky: bool,
) -> tuple[Float[ndarray, "vertex 3"], Float[ndarray, "vertex 3"]]:
    """The surface under the clothes, evened out, and the surface of clothes, shoes and hair."""
    shirt = textures.shirt_weight(body, marks, cut)
    trousers = textures.trouser_weight(body, marks, cut)
    shoes = textures.shoe_weight(body, cut)
    hair = textures.hair_weight(body, marks, 0.02) * (body[:, 1] > marks.joint("neck")[1])
    covered = np.maximum(np.maximum(shirt, trousers), np.maximum(shoes, hair))
    # cloth bridges what lies under it: even out the body before moving outwards
    smoother = _mean_of_neighbours(faces, len(body))
    smooth = body
    for _ in range(12):
        smooth = smooth + 0.6 * covered[:, None] * (smoother @ smooth - smooth)
    normals = vertex_normals(smooth, faces)
    folds = ripple(body * (1.0, 0.55, 1.0), wavelength_m=0.085, seed=3)
    tight = 0.011 if bulky else 0.007
    # trouser legs stand off further towards their ends
    flare = inside(marks.joint("left_hip")[1] - 0.1 - body[:, 1], 0.5) * bulky
    distance = shirt * (tight + 0.0035 * folds)
    distance = np.maximum(distance, trousers * (tight - 0.002 + 0.016 * flare + 0.003 * folds))
    crown = inside(body[:, 1] - marks.keypoint("left_ear")[1] - 0.06, 0.12)
    tufts = 0.003 * ripple(body, wavelength_m=0.04, seed=4)
    distance = np.maximum(distance, hair * (0.012 + 0.012 * crown + tufts))
    for side in (1, -1):
        foot = np.flatnonzero((shoes > 0) & (side * body[:, 0] > 0))
        to_hull = _distance_to_hull(smooth[foot], normals[foot], body[foot])
        distance[foot] = np.maximum(distance[foot], shoes[foot] * (to_hull + 0.007))
    return smooth, smooth + distance[:, None] * normals


def _distance_to_hull(
    points: Float[ndarray, "point 3"],
    directions: Float[ndarray, "point 3"],
    hull_points: Float[ndarray, "corner 3"],
) -> Float[ndarray, " point"]:
    """How far points inside a convex hull can go along their directions until they reach it."""
    planes = ConvexHull(hull_points).equations
    room = -(points @ planes[:, :3].T + planes[:, 3])
    speed = directions @ planes[:, :3].T
    ahead = np.where(speed > 1e-6, room / np.maximum(speed, 1e-6), np.inf)
    return np.clip(ahead.min(1), 0, 0.05)


def _mean_of_neighbours(faces: Int[ndarray, "face 3"], count: int) -> sparse.csr_matrix:
    """The matrix that replaces every vertex by the mean of its neighbours."""
    start = np.concatenate([faces[:, k] for k in range(3)])
    end = np.concatenate([faces[:, (k + 1) % 3] for k in range(3)])
    ones = np.ones(2 * len(start))
    links = sparse.csr_matrix(
        (ones, (np.concatenate([start, end]), np.concatenate([end, start]))), shape=(count, count)
    )
    links.data[:] = 1
    degree = np.asarray(links.sum(1)).ravel()
    return sparse.diags(1 / np.maximum(degree, 1)) @ links


def skirt_span(marks: Landmarks) -> tuple[float, float]:
    """Height of the skirt's upper edge and of its hem (body frame)."""
    top = float(marks.joint("spine1")[1]) + 0.05
    return top, float(marks.joint("left_knee")[1]) - 0.14


def skirt_mesh(
    clothed: Float[ndarray, "vertex 3"], marks: Landmarks
) -> tuple[Float[ndarray, "vertex 3"], Int[ndarray, "face 3"]]:
    """A flared tube with folds from the waist to below the knees, clear of the body in rest."""
    top, hem = skirt_span(marks)
    centre_z = float(marks.joint("pelvis")[2])
    angles = np.arange(SKIRT_COLUMNS) * (2 * np.pi / SKIRT_COLUMNS)
    direction = np.stack([np.sin(angles), np.cos(angles)], -1)  # x, z; angle from the front
    trunk = clothed[np.abs(clothed[:, 0]) < 0.26]  # not the arms
    rings, radius = [], np.zeros(SKIRT_COLUMNS)
    for t in np.linspace(0, 1, SKIRT_ROWS):
        y = top + t * (hem - top)
        slab = trunk[np.abs(trunk[:, 1] - y) < 0.02][:, [0, 2]] - (0.0, centre_z)
        # the convex outline of the slab, seen from the axis, and never narrower than above
        support = (slab @ direction.T).max(0)
        radius = np.maximum(support + 0.008 + 0.03 * t, radius * (1 + 0.09 / SKIRT_ROWS * 4))
        # even the ring out, so that it hangs like cloth
        radius = np.maximum(radius, 0.5 * (np.roll(radius, 3) + np.roll(radius, -3)))
        folds = 0.016 * t * np.sin(14 * angles)
        ring = direction * (radius + folds)[:, None]
        rings.append(np.stack([ring[:, 0], np.full(SKIRT_COLUMNS, y), ring[:, 1] + centre_z], -1))
    vertices = np.concatenate(rings)
    row, column = np.meshgrid(np.arange(SKIRT_ROWS - 1), np.arange(SKIRT_COLUMNS), indexing="ij")
    a = (row * SKIRT_COLUMNS + column).ravel()
    b = (row * SKIRT_COLUMNS + (column + 1) % SKIRT_COLUMNS).ravel()
    c, d = a + SKIRT_COLUMNS, b + SKIRT_COLUMNS
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    return vertices, faces


def blended_weights(
    points: Float[ndarray, "point 3"],
    body: Float[ndarray, "vertex 3"],
    weights: Float[ndarray, "vertex 24"],
) -> Float[ndarray, "point 24"]:
    """Skinning weights gathered from the body around each point, the nearest counting most."""
    # arms and hands hang beside a skirt but do not move it
    movers = np.flatnonzero(weights[:, :LOWER_BODY_JOINTS].sum(-1) > 0.999)
    blended = np.empty((len(points), weights.shape[1]), weights.dtype)
    for start in range(0, len(points), SKIRT_COLUMNS):  # ring by ring bounds the memory
        ring = slice(start, start + SKIRT_COLUMNS)
        distance = cdist(points[ring], body[movers])
        distance -= distance.min(-1, keepdims=True)
        kernel = np.exp(-0.5 * (distance / SKIRT_BLEND_M) ** 2)
        kernel /= kernel.sum(-1, keepdims=True)
        blended[ring] = kernel @ weights[movers]
    return blended
