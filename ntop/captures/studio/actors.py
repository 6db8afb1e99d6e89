"""Clothed actors: the embedded body in clothes that follow its skinning, and their colours.

Tight clothes are the body's own vertices moved outwards; the skirt of `loose` is a surface of its
own whose skinning weights are blended from the body around it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse
from scipy.spatial import ConvexHull

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, coco17_points, pose_body, rest_body
from ntop.captures.studio import textures
from ntop.captures.studio.patterns import inside, ripple
from ntop.captures.studio.raycast import vertex_normals
from ntop.captures.studio.textures import Cut, Landmarks
from ntop.conventions import NUM_BETAS, ConfigError

ACTORS = ("plain", "loose")
BODY_SURFACE, SKIRT_SURFACE = 0, 1

SKIRT_COLUMNS, SKIRT_ROWS = 96, 40
SKIRT_BLEND_M = 0.07  # how far over the body a skirt vertex gathers its skinning weights
FACES_PER_TEXTURE_CHUNK = 1 << 17


@dataclass(frozen=True)
class Actor:
    """A clothed body in rest pose (body frame, metres).

    `texture_points` are the places where the solid textures are read: the rest body's surface
    under the clothes, so that a garment's edge lies where its cut says.
    """

    name: str
    model: BodyModel
    betas: Float[ndarray, " beta"]
    marks: Landmarks
    cut: Cut
    rest_vertices: Float[ndarray, "vertex 3"]
    texture_points: Float[ndarray, "vertex 3"]
    lbs_weights: Float[ndarray, "vertex 24"]
    faces: Int[ndarray, "face 3"]
    surface: Int[ndarray, " face"]

    @property
    def parts(self) -> Int[ndarray, " vertex"]:
        """The bone that moves each vertex most."""
        return self.lbs_weights.argmax(-1)


@dataclass(frozen=True)
class PosedActor:
    """An actor in one pose, in the world (metres)."""

    vertices_world: Float[ndarray, "vertex 3"]
    normals_world: Float[ndarray, "vertex 3"]
    joints_world: Float[ndarray, "24 3"]
    coco17_world: Float[ndarray, "17 3"]


def dress_actor(name: str, model: BodyModel) -> Actor:
    """The actor of that name.

    Raises:
        ConfigError: there is no such actor.
    """
    betas = np.zeros(NUM_BETAS)
    match name:
        case "plain":
            betas[:3] = 0.5, -0.3, 0.4
        case "loose":
            betas[:3] = -0.8, 0.4, -0.5
        case _:
            raise ConfigError(f"studio: no actor {name!r}, have {ACTORS}; check the actors table")
    rest = rest_body(model, torch.from_numpy(betas))
    body = rest.vertices.numpy()
    marks = Landmarks(rest.joints.numpy(), coco17_points(model, rest.vertices).numpy())
    cut = _cut(name, marks)
    faces = model.faces.numpy()
    weights = model.lbs_weights.numpy()
    texture_points, vertices = _clothe(body, faces, marks=marks, cut=cut, bulky=name == "plain")
    surface = np.full(len(faces), BODY_SURFACE)
    if name == "loose":
        skirt, skirt_faces = _skirt_mesh(vertices, marks)
        weights = np.concatenate([weights, _blended_weights(skirt, vertices, weights)])
        faces = np.concatenate([faces, skirt_faces + len(vertices)])
        vertices = np.concatenate([vertices, skirt])
        texture_points = np.concatenate([texture_points, skirt])
        surface = np.concatenate([surface, np.full(len(skirt_faces), SKIRT_SURFACE)])
    return Actor(
        name=name,
        model=model,
        betas=betas,
        marks=marks,
        cut=cut,
        rest_vertices=vertices,
        texture_points=texture_points.astype(np.float32),
        lbs_weights=weights,
        faces=faces,
        surface=surface,
    )


def pose_actor(actor: Actor, pose: BodyPose) -> PosedActor:
    """The actor in one pose (no leading dimensions); clothes follow linear blend skinning."""
    posed = pose_body(actor.model, pose)
    bones = posed.posed_from_rest.numpy()
    blended = (actor.lbs_weights @ bones[:, :3, :].reshape(len(bones), 12)).reshape(-1, 3, 4)
    vertices = np.einsum("vij,vj->vi", blended[..., :3], actor.rest_vertices) + blended[..., 3]
    return PosedActor(
        vertices_world=vertices,
        normals_world=vertex_normals(vertices, actor.faces),
        joints_world=posed.joints.numpy(),
        coco17_world=coco17_points(actor.model, posed.vertices).numpy(),
    )


def albedo(
    actor: Actor, rest_points: Float[ndarray, "point 3"], surface: Int[ndarray, " point"]
) -> Float[ndarray, "point 3"]:
    """sRGB albedo at places on the rest body; `surface` says on which surface each point lies."""
    colours = np.empty_like(rest_points)
    for start in range(0, len(rest_points), FACES_PER_TEXTURE_CHUNK):
        chunk = slice(start, start + FACES_PER_TEXTURE_CHUNK)
        part = _body_colours(actor, rest_points[chunk])
        on_skirt = surface[chunk] == SKIRT_SURFACE
        if on_skirt.any():
            top_y, hem_y = _skirt_span(actor.marks)
            part[on_skirt] = textures.skirt(
                rest_points[chunk][on_skirt],
                centre_z=float(actor.marks.joint("pelvis")[2]),
                top_y=top_y,
                hem_y=hem_y,
            )
        colours[chunk] = part
    return np.clip(colours, 0, 1)


def _body_colours(actor: Actor, points: textures.Points) -> textures.Points:
    marks, cut = actor.marks, actor.cut
    plain = actor.name == "plain"
    head = points[:, 1] > marks.joint("neck")[1] - 0.02
    shirt = textures.shirt_weight(points, marks, cut)
    trousers = textures.trouser_weight(points, marks, cut)
    shoes = textures.shoe_weight(points, cut)
    colours = np.empty_like(points)
    bare = np.maximum(np.maximum(shirt, trousers), shoes) < 1
    tone = (0.82, 0.60, 0.47) if plain else (0.91, 0.72, 0.60)
    colours[bare] = textures.skin(points[bare], marks, tone)
    colours[~bare] = 0  # covered by a garment below
    textures.layer(
        colours, points, weight=trousers,
        pattern=(lambda p: textures.denim(p, marks)) if plain else _leggings,
    )  # fmt: skip
    textures.layer(
        colours, points, weight=shoes,
        pattern=lambda p: textures.trainers(
            p, marks, (0.75, 0.16, 0.10) if plain else (0.20, 0.12, 0.10)
        ),
    )  # fmt: skip
    textures.layer(
        colours, points, weight=shirt,
        pattern=lambda p: textures.flannel(p, marks) if plain else textures.blouse(p, marks),
    )  # fmt: skip
    hair = np.zeros(len(points), points.dtype)
    hair[head] = textures.hair_weight(points[head], marks)
    dark, light = (
        ((0.12, 0.07, 0.04), (0.66, 0.45, 0.26)) if plain else ((0.34, 0.11, 0.04), (0.93, 0.56, 0.27))
    )
    textures.layer(
        colours, points, weight=hair,
        pattern=lambda p: textures.hair(p, marks, dark=dark, light=light),
    )  # fmt: skip
    return colours


def _leggings(points: textures.Points) -> textures.Points:
    return textures.plain_colour(points, (0.16, 0.15, 0.19))


def _cut(name: str, marks: Landmarks) -> Cut:
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


def _clothe(
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


def _skirt_span(marks: Landmarks) -> tuple[float, float]:
    """Height of the skirt's upper edge and of its hem (body frame)."""
    top = float(marks.joint("spine1")[1]) + 0.05
    return top, float(marks.joint("left_knee")[1]) - 0.14


def _skirt_mesh(
    clothed: Float[ndarray, "vertex 3"], marks: Landmarks
) -> tuple[Float[ndarray, "vertex 3"], Int[ndarray, "face 3"]]:
    """A flared tube with folds from the waist to below the knees, clear of the body in rest."""
    top, hem = _skirt_span(marks)
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
    row, column = np.meshgrid(
        np.arange(SKIRT_ROWS - 1), np.arange(SKIRT_COLUMNS), indexing="ij"
    )
    a = (row * SKIRT_COLUMNS + column).ravel()
    b = (row * SKIRT_COLUMNS + (column + 1) % SKIRT_COLUMNS).ravel()
    c, d = a + SKIRT_COLUMNS, b + SKIRT_COLUMNS
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    return vertices, faces


def _blended_weights(
    points: Float[ndarray, "point 3"],
    body: Float[ndarray, "vertex 3"],
    weights: Float[ndarray, "vertex 24"],
) -> Float[ndarray, "point 24"]:
    """Skinning weights gathered from the body around each point, the nearest counting most."""
    # arms and hands hang beside a skirt but do not move it
    movers = np.flatnonzero(weights[:, :12].sum(-1) > 0.999)
    squared = ((points[:, None, :] - body[None, movers, :]) ** 2).sum(-1)
    distance = np.sqrt(squared) - np.sqrt(squared.min(-1, keepdims=True))
    kernel = np.exp(-0.5 * (distance / SKIRT_BLEND_M) ** 2)
    kernel /= kernel.sum(-1, keepdims=True)
    return (kernel @ weights[movers]).astype(weights.dtype)
