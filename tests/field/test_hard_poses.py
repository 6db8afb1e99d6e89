"""Hard poses against the posed mesh itself: skin comes back, and pictures from above are whole."""

import functools
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch

from ntop.body.model import load_body_model
from ntop.body.skeletons import SMPL24_NAMES
from ntop.body.skinning import BodyPose, pose_body
from ntop.captures.studio.raycast import RayMesh
from ntop.conventions import PIXEL_CENTRE
from ntop.field.canonical import canonical_body
from ntop.field.posing import CELL_M, PosedAvatar, pose_avatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import Rendering, render_view
from ntop.field.warp import pose_warp
from ntop.geometry.cameras import Camera
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.metrics.images import mask_iou
from tests.field.hard_poses import HARD_POSES, hard_pose
from tests.field.ways_back import ways_back
from tests.numerics.avatars import analytic_avatar

SIZE_PX = 1000  # a standing person is some 200 px tall
VIEWS = ("centre", "s")
ONE_RAY = RenderSettings(edge_rays=1)  # as the mesh is looked at
VOXEL_M = 0.006
REACH_M = 0.05
HAND_LABELS = [SMPL24_NAMES.index(name) + 1 for name in ("left_hand", "right_hand")]


@dataclass(frozen=True)
class MeshView:
    """What the posed mesh's first surfaces are in one view; 0 where there is none."""

    depth_m: np.ndarray
    parts: np.ndarray

    @property
    def mask(self) -> np.ndarray:
        return self.depth_m > 0


def mesh_view(pose: BodyPose, camera: Camera) -> MeshView:
    """One ray through the centre of every pixel near the projected vertices."""
    body, vertices = embedded_body(), pose_body(load_body_model(), pose).vertices.numpy()
    size = (camera.lens.height, camera.lens.width)
    projected, seen = camera.project(torch.from_numpy(vertices))
    near = np.zeros(size, np.uint8)
    u, v = np.floor(projected[seen].numpy()).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < size[1]) & (v < size[0])
    near[v[inside], u[inside]] = 1
    v, u = np.nonzero(cv2.dilate(near, np.ones((15, 15), np.uint8)))  # wider than a triangle
    directions, valid = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
    hits = RayMesh(vertices, body.faces).first_hits(camera.center_world.numpy(), directions.numpy())
    hits = hits.only(valid.numpy()[hits.ray])
    depth, parts = np.zeros(size), np.zeros(size, int)
    nearest = body.faces[hits.face, hits.weights.argmax(1)]
    depth[v[hits.ray], u[hits.ray]] = hits.distance_m
    parts[v[hits.ray], u[hits.ray]] = body.parts[nearest] + 1
    return MeshView(depth, parts)


@functools.lru_cache(maxsize=1)
def embedded_body():
    return canonical_body(load_body_model(), (0.0,) * 10)


@functools.lru_cache(maxsize=1)
def posed(name: str) -> PosedAvatar:
    avatar = replace(analytic_avatar(VOXEL_M), reach_m=REACH_M)
    return pose_avatar(avatar, load_body_model(), hard_pose(name), settings=ONE_RAY)


def view_of(name: str, camera: Camera) -> Rendering:
    """The avatar in a pose."""
    return render_view(posed(name), camera, settings=ONE_RAY)


def cameras(name: str, **rig) -> dict[str, Camera]:
    """The views from above of a rig around the pose."""
    values = {"height_above_pelvis_m": 1.2, "ring_radius_m": 1.0, "max_theta_rad": math.pi / 2}
    values |= rig
    pelvis = pose_body(load_body_model(), hard_pose(name)).joints[0]
    focal_px = SIZE_PX / 2 / values["max_theta_rad"]
    return top_view_cameras(Rig(**values, width=SIZE_PX, height=SIZE_PX, focal_px=focal_px), pelvis)


def beside(mask: np.ndarray, other: np.ndarray) -> int:
    """Pixels of a mask that are more than a pixel away from another."""
    grown = cv2.dilate(other.astype(np.uint8), np.ones((3, 3), np.uint8))
    return int((mask & (grown == 0)).sum())


def compare(seen: Rendering, truth: MeshView) -> dict[str, float]:
    """Ghosts and holes in pixels, overlap, and shares of wrong depths and parts."""
    mask = seen.alpha >= 0.5
    both = mask & truth.mask
    return {
        "iou": mask_iou(mask, truth.mask),
        "ghosts": beside(mask, truth.mask),
        "holes": beside(~mask, ~truth.mask),
        "depth": float((np.abs(seen.depth_m - truth.depth_m)[both] > 0.02).mean()),
        "parts": float((seen.parts != truth.parts)[both].mean()),
    }


@pytest.mark.parametrize("name", HARD_POSES)
def test_pictures_from_above_are_whole(name):
    """No hole in the body, nothing beside it, the right surface and part in every pixel."""
    for view in VIEWS:
        camera = cameras(name)[view]
        found = compare(
            render_view(posed(name), camera, settings=ONE_RAY), mesh_view(hard_pose(name), camera)
        )
        assert found["ghosts"] <= 12, (view, found)  # copies of elbows and knees had hundreds
        assert found["holes"] <= 10, (view, found)
        assert found["iou"] > 0.98, (view, found)
        assert found["depth"] < 0.012, (view, found)
        assert found["parts"] < 0.04, (view, found)  # borders between parts


@pytest.mark.parametrize("name", HARD_POSES)
def test_skin_comes_back(name):
    """The warp grid keeps both sides of a fold, and of parts that lie against each other."""
    body, pose = embedded_body(), hard_pose(name)
    warp = pose_warp(body, load_body_model(), pose, cell_m=CELL_M, reach_m=REACH_M)
    vertices = pose_body(load_body_model(), pose).vertices.numpy()
    generator = np.random.default_rng(5)
    faces = body.faces[generator.choice(len(body.faces), 3000)]
    shares = generator.dirichlet((1, 1, 1), len(faces))
    points, truth = (np.einsum("nk,nkc->nc", shares, v[faces]) for v in (vertices, body.vertices))
    errors_m = np.nanmin(np.linalg.norm(ways_back(warp, points) - truth[:, None], axis=-1), axis=1)
    assert np.isfinite(errors_m).all()
    assert (errors_m > 0.01).mean() < 0.006  # 1.7 % of a squat when cells lost a side of folds
    assert (errors_m > 0.001).mean() < 0.025


def test_hands_above_the_camera_are_in_the_picture():
    """A lens of more than 90 degrees sees them; one of 90 cannot."""
    name = "raised hands"
    below = {"height_above_pelvis_m": 0.7, "ring_radius_m": 1.0}
    camera = cameras(name, **below, max_theta_rad=math.radians(115))["s"]
    truth, seen = mesh_view(hard_pose(name), camera), view_of(name, camera)
    hands = np.isin(truth.parts, HAND_LABELS)
    v, u = np.nonzero(hands)
    directions, _ = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
    assert (directions[:, 2] > 0).all()  # the world's z is up
    assert hands.sum() > 500
    assert (seen.alpha[hands] >= 0.5).mean() > 0.93  # fingers are as thin as voxels
    assert compare(seen, truth)["iou"] > 0.98
    narrow = cameras(name, **below)["s"]
    assert not np.isin(view_of(name, narrow).parts, HAND_LABELS).any()
