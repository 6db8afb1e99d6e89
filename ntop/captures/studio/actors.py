"""Clothed actors: the embedded body in clothes that follow its skinning, and their colours.

Tight clothes are the body's own vertices moved outwards; the skirt of `loose` is a surface of its
own whose skinning weights are blended from the body around it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, coco17_points, pose_body, rest_body
from ntop.captures.studio import garments, textures
from ntop.captures.studio.raycast import vertex_normals
from ntop.captures.studio.textures import Cut, Landmarks
from ntop.conventions import NUM_BETAS, ConfigError

ACTORS = ("plain", "loose")
BODY_SURFACE, SKIRT_SURFACE = 0, 1

POINTS_PER_CHUNK = 1 << 17


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
    cut = garments.garment_cut(name, marks)
    faces = model.faces.numpy()
    weights = model.lbs_weights.numpy()
    texture_points, vertices = garments.clothe(
        body, faces, marks=marks, cut=cut, bulky=name == "plain"
    )
    surface = np.full(len(faces), BODY_SURFACE)
    if name == "loose":
        skirt, skirt_faces = garments.skirt_mesh(vertices, marks)
        weights = np.concatenate([weights, garments.blended_weights(skirt, vertices, weights)])
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
    """Albedo (sRGB) at places on the rest body; `surface` says on which surface each point lies."""
    colours = np.empty_like(rest_points)
    for start in range(0, len(rest_points), POINTS_PER_CHUNK):
        chunk = slice(start, start + POINTS_PER_CHUNK)
        part = _body_colours(actor, rest_points[chunk])
        on_skirt = surface[chunk] == SKIRT_SURFACE
        if on_skirt.any():
            top_y, hem_y = garments.skirt_span(actor.marks)
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
        ((0.12, 0.07, 0.04), (0.66, 0.45, 0.26))
        if plain
        else ((0.34, 0.11, 0.04), (0.93, 0.56, 0.27))
    )
    textures.layer(
        colours, points, weight=hair,
        pattern=lambda p: textures.hair(p, marks, dark=dark, light=light),
    )  # fmt: skip
    return colours


def _leggings(points: textures.Points) -> textures.Points:
    return textures.plain_colour(points, (0.16, 0.15, 0.19))
