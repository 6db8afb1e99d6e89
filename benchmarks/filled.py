"""Fields that nobody trained: the studio actor's true surface and textures, written into a grid.

Under even light such a grid has the error of its cells, of the warp and of the renderer only.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.spatial import cKDTree
from scipy.special import logit, spence

from ntop.body.model import BodyModel
from ntop.captures.studio.actors import Actor, albedo
from ntop.field.avatar import Avatar
from ntop.field.canonical import (
    CanonicalGrid,
    canonical_body,
    distance_grid,
    number_bricks,
    void_values,
)
from ntop.field.kernels.tables import DENSITY_SCALE

RAW_LIMIT = 8.0  # raw density a voxel inside the surface, as trained avatars have it
SHELL_VOXELS = 4
REACH_M = 0.05  # of the warp, as in training
SURFACE_POINTS = 3_000_000  # half a millimetre apart
COLOUR_RANGE = (0.004, 0.996)  # what a raw value of 5.5 can say


def clothed_model(actor: Actor) -> BodyModel:
    """The body model whose vertices are the actor's clothed surface; its joints stay the actor's.

    Only for tight clothes, whose vertices are the body's own.
    """
    vertices = torch.from_numpy(np.asarray(actor.rest_vertices, dtype=np.float64))
    joints = torch.from_numpy(np.asarray(actor.marks.joints, dtype=np.float64))
    model = actor.model
    return BodyModel(
        v_template=vertices,
        shapedirs=torch.zeros_like(model.shapedirs, dtype=torch.float64),
        posedirs=None,
        joint_regressor=joints @ torch.linalg.pinv(vertices),  # of all that give the joints
        lbs_weights=model.lbs_weights.double(),
        parents=model.parents,
        faces=model.faces,
        coco17_regressor=model.coco17_regressor.double(),
    )


def filled_avatar(actor: Actor, betas: tuple[float, ...], *, voxel_m: float) -> Avatar:
    """The true surface with its true textures in cells of this size, under even light of 1."""
    body = canonical_body(clothed_model(actor), betas)
    shell_m = SHELL_VOXELS * voxel_m
    distances, _, origin = distance_grid(body, spacing_m=voxel_m, reach_m=shell_m)
    blocks = np.array(distances.shape) // 4
    split = distances.reshape(blocks[0], 4, blocks[1], 4, blocks[2], 4).transpose(0, 2, 4, 1, 3, 5)
    bricks, positions = number_bricks((np.abs(split) <= shell_m).any(axis=(3, 4, 5)))
    inner = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = (4 * positions[1:, None] + inner).reshape(-1, 3)
    distance = split[tuple(positions[1:].T)].ravel()
    values = void_values(len(positions))
    steepness = RAW_LIMIT / voxel_m
    outside_m = _seen_outside_m(steepness)
    raw = np.clip(-steepness * (distance + outside_m), -RAW_LIMIT, RAW_LIMIT)
    values[64:, 0] = raw
    near = np.abs(distance) <= shell_m
    surface = _textured_surface(actor, body.vertices)
    values[64:, 1:][near] = surface.raw_colours(origin + voxel_m * nodes[near])
    light = np.zeros((9, 3), np.float32)
    light[0] = 1
    grid = CanonicalGrid(values, bricks, positions, origin, voxel_m)
    return Avatar(grid, light, betas, REACH_M, 0)


@dataclass(frozen=True)
class _Surface:
    """Points of the canonical surface and their colours (sRGB)."""

    tree: cKDTree
    colours: Float[np.ndarray, "point 3"]

    def raw_colours(self, places: Float[np.ndarray, "place 3"]) -> np.ndarray:
        """What a grid holds at these places for the colour of the closest surface point."""
        _, nearest = self.tree.query(places, workers=-1)
        return logit(np.clip(self.colours[nearest], *COLOUR_RANGE))


def _textured_surface(actor: Actor, canonical: Float[np.ndarray, "vertex 3"]) -> _Surface:
    """Evenly random points of the surface, with the colours of their places on the rest body."""
    corners = canonical[actor.faces]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    generator = np.random.default_rng(0)
    faces = generator.choice(len(areas), SURFACE_POINTS, p=areas / areas.sum())
    u, v = np.sort(generator.random((2, SURFACE_POINTS)), axis=0)
    weights = np.stack([u, v - u, 1 - v], 1)
    places = np.einsum("pk,pkc->pc", weights, corners[faces])
    texture = np.einsum("pk,pkc->pc", weights, actor.texture_points[actor.faces[faces]])
    colours = albedo(actor, texture.astype(np.float32), actor.surface[faces])
    return _Surface(cKDTree(places), colours)


def _seen_outside_m(steepness: float) -> float:
    """How far outside raw density 0 half of the light is gone; raw rises by `steepness` per m.

    The optical depth down to raw u is -Li2(-exp(u)) * DENSITY_SCALE / steepness.
    """

    def excess(raw: float) -> float:
        return -spence(1 + np.exp(raw)) * DENSITY_SCALE / steepness - np.log(2)

    return -brentq(excess, -RAW_LIMIT, RAW_LIMIT) / steepness
