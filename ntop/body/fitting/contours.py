"""Silhouettes as observations: points of mattes' borders, each matched to a vertex of the rim.

The rim of a posed body in a view is where its surface turns away from the camera and nothing of
the body lies beyond. Matching and fitting alternate (Besl & McKay 1992), in both directions: a
border point without body pulls it out, a rim vertex outside the matte pulls it in.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from ntop.body.fitting.observations import ContourRays
from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, pose_body
from ntop.conventions import MASK_ALPHA, NUM_JOINTS
from ntop.geometry.cameras import Camera
from ntop.geometry.refinement import pixels_per_radian

# Of the diagonal of the matte's box, which a person fills alike in every camera
SPACING_SHARE, SMOOTHING_SHARE = 1 / 75, 1 / 350
MIN_SPACING_PX, MIN_SMOOTHING_PX = 2, 0.7
MIN_CURVE_POINTS = 8
FRAME_EDGE_PX = 4  # a border there is the picture's, not the person's
RIM_COSINE = 0.15  # wider, vertices short of the rim fatten the body by 3 mm
# At the body, in metres: the same on a large and on a small picture
NORMAL_WEIGHT_M = 0.12  # opposite normals lie as far apart as points twice that away
BEYOND_M = 0.024
SPLAT_CELL_M = 0.008


@dataclass(frozen=True)
class Border:
    """Border points of one matte in pixels and their unit normals, pointing out."""

    points_px: Float[ndarray, "point 2"]
    normals: Float[ndarray, "point 2"]


@dataclass(frozen=True)
class View:
    """One camera's matte border at one frame (an index into the poses)."""

    frame: int
    camera: Camera
    border: Border


def matte_border(matte: Float[ndarray, "height width"]) -> Border:
    """Points along the matte's half level, some 75 to 200 around a person, holes included."""
    rows, columns = (np.nonzero((matte >= 0.5).any(axis))[0] for axis in (1, 0))
    if not len(rows):
        return Border(np.zeros((0, 2)), np.zeros((0, 2)))
    diagonal_px = math.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1)
    spacing = max(MIN_SPACING_PX, round(SPACING_SHARE * diagonal_px))
    smooth = cv2.GaussianBlur(matte, (0, 0), max(MIN_SMOOTHING_PX, SMOOTHING_SHARE * diagonal_px))
    person = (smooth >= MASK_ALPHA / 255).astype(np.uint8)
    curves, _ = cv2.findContours(person, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    long = [curve for curve in curves if len(curve) >= MIN_CURVE_POINTS * spacing]
    picked = [curve[::spacing, 0] for curve in long]
    cells = np.concatenate(picked) if picked else np.zeros((0, 2), np.int32)
    height, width = matte.shape
    edge = FRAME_EDGE_PX
    inner = ((cells >= edge) & (cells < np.array([width, height]) - edge)).all(1)
    cells = cells[inner]
    across = np.stack(
        [
            cv2.Sobel(smooth, cv2.CV_32F, 1, 0)[cells[:, 1], cells[:, 0]],
            cv2.Sobel(smooth, cv2.CV_32F, 0, 1)[cells[:, 1], cells[:, 0]],
        ],
        -1,
    ).astype(float)
    length = np.linalg.norm(across, axis=1)
    steep = length > 1e-3
    return Border(cells[steep] + 0.5, -across[steep] / length[steep, None])


def match_contours(
    model: BodyModel,
    pose: BodyPose,
    views: list[View],
    *,
    candidates: Int[Tensor, " candidate"],
    reach_m: float,
) -> ContourRays:
    """Which candidate vertex should meet which border point; fit points count joints first."""
    parts: list[tuple[Tensor, ...]] = []
    by_frame: dict[int, list[View]] = {}
    for view in views:
        by_frame.setdefault(view.frame, []).append(view)
    for frame in sorted(by_frame):
        single = BodyPose(
            pose.betas[frame], pose.global_orient[frame], pose.body_pose[frame], pose.transl[frame]
        )
        vertices = pose_body(model, single).vertices
        normals = _vertex_normals(vertices, model.faces)
        for view in by_frame[frame]:
            vertex, point = _match(view, vertices, normals, candidates=candidates, reach_m=reach_m)
            parts.append(_as_rays(view, vertex, point))
    joined = [torch.cat(column) for column in zip(*parts, strict=True)]
    return ContourRays(*joined)


def candidate_vertices(model: BodyModel, *, cell_m: float) -> Int[Tensor, " candidate"]:
    """One vertex per cell of a grid over the rest body, without fingers: enough for outlines."""
    labels = model.lbs_weights.argmax(-1)
    body = torch.nonzero(labels < NUM_JOINTS - 2).squeeze(-1).numpy()
    cells = np.floor(model.v_template.numpy()[body] / cell_m).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return torch.from_numpy(np.sort(body[first]))


def _match(
    view: View,
    vertices: Float[Tensor, "vertex 3"],
    normals: Float[Tensor, "vertex 3"],
    *,
    candidates: Int[Tensor, " candidate"],
    reach_m: float,
) -> tuple[ndarray, ndarray]:
    """Pairs (index into candidates, index into border points)."""
    camera, border = view.camera, view.border
    chosen, outward = vertices[candidates], normals[candidates]
    toward = torch.nn.functional.normalize(camera.center_world - chosen, dim=-1)
    grazing = ((outward * toward).sum(-1).abs() < RIM_COSINE).numpy()
    pixels = camera.project(vertices)[0].numpy()
    distance_m = float((vertices.mean(0) - camera.center_world).norm())
    px_per_m = pixels_per_radian(camera.lens) / distance_m
    here = pixels[candidates.numpy()]
    there = camera.project(chosen + 0.02 * outward)[0].numpy()
    direction = there - here
    direction /= np.linalg.norm(direction, axis=1, keepdims=True).clip(1e-9)
    rim = np.nonzero(
        grazing
        & _beyond_body(pixels, here + BEYOND_M * px_per_m * direction, camera, px_per_m=px_per_m)
    )[0]
    if not len(rim) or not len(border.points_px):
        empty = np.zeros(0, np.int64)
        return empty, empty
    weight_px, reach_px = NORMAL_WEIGHT_M * px_per_m, reach_m * px_per_m
    rim_features = np.hstack([here[rim], weight_px * direction[rim]])
    features = np.hstack([border.points_px, weight_px * border.normals])
    distance, nearest = cKDTree(rim_features).query(features)
    ours = distance < reach_px
    back, nearest_point = cKDTree(features).query(rim_features)
    theirs = back < reach_px
    vertex = np.concatenate([rim[nearest[ours]], rim[theirs]])
    point = np.concatenate([np.nonzero(ours)[0], nearest_point[theirs]])
    return vertex, point


def _beyond_body(
    pixels: Float[ndarray, "vertex 2"],
    points: Float[ndarray, "point 2"],
    camera: Camera,
    *,
    px_per_m: float,
) -> ndarray:
    """Which points lie outside the body's image, drawn coarsely from its vertices."""
    cells_per_px = min(1.0, 1 / (SPLAT_CELL_M * px_per_m))
    width = round(camera.lens.width * cells_per_px)
    height = round(camera.lens.height * cells_per_px)
    image = np.zeros((height, width), np.uint8)

    def inside(cells: ndarray) -> ndarray:
        return (cells >= 0).all(1) & (cells[:, 0] < width) & (cells[:, 1] < height)

    cells = np.floor(pixels * cells_per_px).astype(np.int64)
    cells = cells[inside(cells)]
    image[cells[:, 1], cells[:, 0]] = 1
    image = cv2.morphologyEx(image, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    wanted = np.floor(points * cells_per_px).astype(np.int64)
    visible = inside(wanted)
    wanted = np.where(visible[:, None], wanted, 0)
    return visible & (image[wanted[:, 1], wanted[:, 0]] == 0)


def _as_rays(view: View, vertex: ndarray, point: ndarray) -> tuple[Tensor, ...]:
    """The fields of `ContourRays` for one view's pairs."""
    camera = view.camera
    pixels = torch.from_numpy(view.border.points_px[point])
    normals = torch.from_numpy(view.border.normals[point])
    direction, valid = camera.rays(pixels)
    beside, _ = camera.rays(pixels + normals)
    normal = beside - (beside * direction).sum(-1, keepdim=True) * direction
    count = len(point)
    return (
        torch.full((count,), view.frame),
        torch.from_numpy(vertex) + NUM_JOINTS,
        camera.center_world.expand(count, 3),
        direction,
        torch.nn.functional.normalize(normal, dim=-1),
        valid.double(),
    )


def _vertex_normals(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]
) -> Float[Tensor, "vertex 3"]:
    """Unit normals, the mean of the faces around weighted by their area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(vertices)
    for corner in range(3):
        total.index_add_(0, faces[:, corner], normal)
    return torch.nn.functional.normalize(total, dim=-1)
