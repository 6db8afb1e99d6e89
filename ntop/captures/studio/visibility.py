"""Which keypoints a camera sees, decided on the mesh itself rather than on images.

A ray from the camera towards the keypoint meets its first surface. The keypoint is visible if that
surface is its own limb's: not further in front than the clothed limb's radius, measured on the rest
body by rays towards the keypoint; or of the same or an adjacent part and within its reach.
"""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Int8
from numpy import ndarray

from ntop.annotation.keypoints import project_keypoints
from ntop.annotation.visibility import (
    COCO17_LIMBS,
    OCCLUDED,
    OUTSIDE,
    SKIN_POINTS,
    SMPL24_LIMBS,
    VISIBLE,
    Limbs,
    reach_m,
)
from ntop.body.skeletons import COCO17_NAMES, SMPL24_NAMES
from ntop.captures.studio.actors import Actor
from ntop.captures.studio.raycast import RayMesh
from ntop.captures.studio.views import Scene, hit_parts
from ntop.conventions import NUM_JOINTS
from ntop.geometry.cameras import Camera
from ntop.storage.schemas import RENDER_KEY, vector

# One row per true view, beside its render table.
VISIBILITY = pa.schema(
    [
        *RENDER_KEY,
        ("visibility_coco17", vector(17, pa.int8())),
        ("visibility_smpl24", vector(NUM_JOINTS, pa.int8())),
    ]
)
PROBES = 400  # rays towards a keypoint that measure its limb
PROBE_START_M = 0.3  # from it: outside the limb, short of the next one
SKIN_SLACK_M = 0.02  # a point on the skin is hidden once more than this lies before it


@dataclass(frozen=True)
class LimbRadii:
    """Radius of the clothed limb around each keypoint of both skeletons (metres)."""

    coco17_m: Float[ndarray, " 17"]
    smpl24_m: Float[ndarray, " 24"]


def measure_limbs(actor: Actor) -> LimbRadii:
    """Limb radii of an actor in rest pose."""
    mesh = RayMesh(actor.rest_vertices, actor.faces)
    return LimbRadii(
        coco17_m=_radii(mesh, actor.marks.coco17, COCO17_NAMES),
        smpl24_m=_radii(mesh, actor.marks.joints, SMPL24_NAMES),
    )


def true_visibility(
    scene: Scene, radii: LimbRadii, camera: Camera
) -> tuple[Int8[ndarray, " 17"], Int8[ndarray, " 24"]]:
    """Visibility (0 outside, 1 occluded, 2 visible) of COCO-17 and SMPL-24 in one view."""
    posed = scene.posed
    return (
        _visibility(scene, camera, posed.coco17_world, radii.coco17_m, COCO17_LIMBS),
        _visibility(scene, camera, posed.joints_world, radii.smpl24_m, SMPL24_LIMBS),
    )


def _visibility(
    scene: Scene,
    camera: Camera,
    points_world: Float[ndarray, "keypoint 3"],
    radius_m: Float[ndarray, " keypoint"],
    limbs: Limbs,
) -> Int8[ndarray, " keypoint"]:
    projected = project_keypoints(torch.from_numpy(points_world), camera)
    center = camera.center_world.numpy()
    towards = points_world - center
    distance = np.linalg.norm(towards, axis=-1)
    hits = scene.mesh.first_hits(center, towards / distance[:, None])
    visible = np.ones(len(points_world), bool)  # nothing on the ray hides nothing
    in_front = distance[hits.ray] - hits.distance_m
    own = limbs.own_parts[hits.ray, hit_parts(scene.actor, hits)]
    own &= limbs.reach_m[hits.ray] > limbs.radius_m[hits.ray]  # points on the skin have no reach
    radius = radius_m[hits.ray]
    visible[hits.ray] = (in_front <= radius) | (own & (in_front <= reach_m(radius)))
    return np.where(
        projected.in_view.numpy(), np.where(visible, VISIBLE, OCCLUDED), OUTSIDE
    ).astype(np.int8)


def _radii(
    mesh: RayMesh, points: Float[ndarray, "keypoint 3"], names: tuple[str, ...]
) -> Float[ndarray, " keypoint"]:
    index = np.arange(PROBES) + 0.5
    height = 1 - 2 * index / PROBES
    turn = index * np.pi * (3 - np.sqrt(5))  # golden angle: evenly spread directions
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], -1)
    radii = np.empty(len(points))
    for keypoint, (point, name) in enumerate(zip(points, names, strict=True)):
        # from outside in: from inside, a head's rays would end at the mouth's cavity
        hits = mesh.first_hits(point + PROBE_START_M * directions, -directions)
        distance = PROBE_START_M - hits.distance_m
        kind = name.removeprefix("left_").removeprefix("right_")
        # along a limb the rays run far: the median is that of its cross-section
        radii[keypoint] = (
            np.abs(distance).min() + SKIN_SLACK_M if kind in SKIN_POINTS else np.median(distance)
        )
    return radii
