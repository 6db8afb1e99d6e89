"""A posed body drawn over a picture: flat-shaded triangles, farthest first (painter's order).

For looking at, not for measuring: occlusion within a triangle's length is approximate.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from ntop.geometry.cameras import Camera

FRACTION_BITS = 4
SKIN_COLOUR = np.array([196.0, 206.0, 222.0])
AMBIENT = 0.35


def shaded_body(
    vertices_world: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], camera: Camera
) -> UInt8[np.ndarray, "height width 4"]:
    """The body as the camera sees it: RGBA, lit from the camera, transparent elsewhere."""
    vertices = vertices_world.to(torch.float64)
    pixels, seen = camera.project(vertices)
    corners = vertices[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    to_camera = camera.center_world - corners.mean(1)
    distance = to_camera.norm(dim=-1)
    facing = (normals * to_camera).sum(-1) / distance
    drawn = (facing > 0) & seen[faces].all(-1)
    order = torch.nonzero(drawn)[:, 0][distance[drawn].argsort(descending=True, stable=True)]
    canvas = np.zeros((camera.lens.height, camera.lens.width, 4), np.uint8)
    # OpenCV's pixel centres are integers
    fixed = np.rint((pixels.numpy() - 0.5) * 2**FRACTION_BITS).astype(np.int64)
    limit = 1 << 24  # far outside; keeps OpenCV's 32-bit coordinates safe
    fixed = np.clip(fixed, -limit, limit).astype(np.int32)
    light = (AMBIENT + (1 - AMBIENT) * facing.clamp(0, 1)).numpy()
    for face in order.tolist():
        colour = (*np.rint(SKIN_COLOUR * light[face]).tolist(), 255)
        cv2.fillConvexPoly(canvas, fixed[faces[face].numpy()], colour, cv2.LINE_8, FRACTION_BITS)
    return canvas
