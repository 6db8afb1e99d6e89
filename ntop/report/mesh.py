"""A posed body drawn over a picture: flat triangles, farthest first (painter's order).

For looking at and for the painted baseline: occlusion within a triangle's length is approximate.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from ntop.body.model import BodyModel, part_labels
from ntop.body.skinning import BodyPose, pose_body
from ntop.geometry.cameras import Camera
from ntop.metrics.images import Cutout
from ntop.report.capture import FrameKey, Recording

FRACTION_BITS = 4
SKIN_COLOUR = np.array([196.0, 206.0, 222.0])
AMBIENT = 0.35
NUM_PARTS = 24
SAMPLES = 3  # per pixel side, for soft edges like those of the pictures it is compared with
MAX_PICTURES = 24  # mean colours settle quickly


@dataclass(frozen=True)
class Drawing:
    """Triangles in drawing order, in pixels, with the cosine between surface and view."""

    corners_px: Float[np.ndarray, "triangle 3 2"]
    faces: Int[np.ndarray, " triangle"]
    facing: Float[np.ndarray, " triangle"]


@dataclass(frozen=True)
class PaintedBody:
    """The baseline: a body painted in one mean colour per part."""

    model: BodyModel
    colours: Float[np.ndarray, "part 3"]  # sRGB in [0, 1]

    def cutout(self, pose: BodyPose, camera: Camera) -> Cutout:
        """The painted body in a pose, as the camera sees it."""
        drawing = _drawing(self.model, pose, camera)
        colours = self.colours[_face_parts(self.model)[drawing.faces]] * 255
        height, width = camera.lens.height, camera.lens.width
        rgba = np.zeros((height, width, 4))
        low = np.floor(drawing.corners_px.min((0, 1), initial=np.inf)).clip(0, (width, height))
        high = np.ceil(drawing.corners_px.max((0, 1), initial=-np.inf)).clip(0, (width, height))
        if (high > low).all():
            (left, top), (columns, rows) = low.astype(int), (high - low).astype(int)
            fine = _filled(
                (drawing.corners_px - low) * SAMPLES,
                colours,
                size=(rows * SAMPLES, columns * SAMPLES),
            ).astype(np.float32)
            # the mean of each pixel's samples; colour is zero where alpha is: premultiplied
            mean = cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA) / 255
            mean[..., :3] /= np.maximum(mean[..., 3:], 1e-9)
            rgba[top : top + rows, left : left + columns] = mean
        return Cutout(rgba[..., :3], rgba[..., 3])


def painted_body(recording: Recording, model: BodyModel, *, views: set[str]) -> PaintedBody:
    """Mean colour of every part over the actor's pictures in these views.

    A part that no picture shows gets the mean of all others.
    """
    keys = sorted(
        key for key in recording.mattes if key[2] in views and key[:2] in recording.bodies
    )
    spread = keys[:: max(1, len(keys) // MAX_PICTURES)]
    sums, counts = np.zeros((NUM_PARTS, 3)), np.zeros(NUM_PARTS)
    for key, image in recording.pictures(spread).items():
        labels = _label_image(recording, model, key)
        labels[recording.matte(key) < 0.5] = 0
        for part in range(NUM_PARTS):
            pixels = image[labels == part + 1]
            sums[part] += pixels.sum(0) / 255
            counts[part] += len(pixels)
    overall = sums.sum(0) / max(counts.sum(), 1)
    shown = counts[:, None] > 0
    return PaintedBody(model, np.where(shown, sums / np.maximum(counts, 1)[:, None], overall))


def shaded_body(
    model: BodyModel, pose: BodyPose, camera: Camera
) -> UInt8[np.ndarray, "height width 4"]:
    """The body as the camera sees it: RGBA, lit from the camera, transparent elsewhere."""
    drawing = _drawing(model, pose, camera)
    light = AMBIENT + (1 - AMBIENT) * drawing.facing
    return _filled(
        drawing.corners_px,
        SKIN_COLOUR * light[:, None],
        size=(camera.lens.height, camera.lens.width),
    )


def _label_image(recording: Recording, model: BodyModel, key: FrameKey) -> np.ndarray:
    """Part label + 1 of the body in one picture, 0 beside it."""
    action, frame, view = key
    camera = recording.cameras[action, view]
    drawing = _drawing(model, recording.pose((action, frame)), camera)
    labels = np.repeat(_face_parts(model)[drawing.faces, None] + 1.0, 3, axis=1)
    size = (camera.lens.height, camera.lens.width)
    return _filled(drawing.corners_px, labels, size=size)[..., 0]


def _drawing(model: BodyModel, pose: BodyPose, camera: Camera) -> Drawing:
    vertices: Float[Tensor, "vertex 3"] = pose_body(model, pose).vertices.to(torch.float64)
    pixels, seen = camera.project(vertices)
    corners = vertices[model.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    to_camera = camera.center_world - corners.mean(1)
    distance = to_camera.norm(dim=-1)
    facing = (normals * to_camera).sum(-1) / distance
    drawn = torch.nonzero((facing > 0) & seen[model.faces].all(-1))[:, 0]
    order = drawn[distance[drawn].argsort(descending=True, stable=True)]
    return Drawing(
        corners_px=pixels[model.faces[order]].numpy(),
        faces=order.numpy(),
        facing=facing[order].clamp(0, 1).numpy(),
    )


def _face_parts(model: BodyModel) -> Int[np.ndarray, " face"]:
    """The part of each face: that of its first corner."""
    return part_labels(model)[model.faces[:, 0]].numpy()


def _filled(
    corners_px: Float[np.ndarray, "triangle 3 2"],
    colours: Float[np.ndarray, "triangle 3"],
    *,
    size: tuple[int, int],
) -> UInt8[np.ndarray, "height width 4"]:
    """Triangles filled one after the other; alpha 255 where any lies."""
    canvas = np.zeros((*size, 4), np.uint8)
    # OpenCV's pixel centres are integers; far-away corners would leave its 32-bit coordinates
    fixed = np.rint((corners_px - 0.5) * 2**FRACTION_BITS).clip(-(1 << 24), 1 << 24)
    flat = np.rint(colours).tolist()
    for triangle, colour in zip(fixed.astype(np.int32), flat, strict=True):
        cv2.fillConvexPoly(canvas, triangle, (*colour, 255), cv2.LINE_8, FRACTION_BITS)
    return canvas
