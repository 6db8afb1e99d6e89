"""Outlines of posed bodies in the image, and how well they cover mattes."""

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose, pose_body
from ntop.conventions import MASK_ALPHA
from ntop.geometry.cameras import Camera

SUBPIXEL_BITS = 4
DRAWING_SIZE_PX = 960  # larger images are drawn smaller: good to a pixel there, and faster


def draw_silhouette(
    pixels: Float[ndarray, "vertex 2"], faces: Int[ndarray, "face 3"], *, width: int, height: int
) -> Bool[ndarray, "height width"]:
    """Pixels that the projected triangles cover (those that face the camera suffice)."""
    corners = pixels[faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    facing = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0  # v points down
    # cv2 counts from pixel centres, with a fixed-point fraction
    fixed = np.rint((corners[facing] - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)
    image = np.zeros((height, width), np.uint8)
    for triangle in fixed:
        cv2.fillConvexPoly(image, triangle, 1, shift=SUBPIXEL_BITS)
    return image > 0


def silhouette_iou(
    model: BodyModel,
    pose: BodyPose,
    camera: Camera,
    *,
    matte: Float[ndarray, "height width"],
) -> float:
    """Intersection over union of one posed body's outline and a matte (>= one half)."""
    vertices = pose_body(model, pose).vertices.double()
    scale = min(1.0, DRAWING_SIZE_PX / max(matte.shape))
    height, width = round(matte.shape[0] * scale), round(matte.shape[1] * scale)
    pixels = camera.project(vertices)[0].numpy() * scale
    outline = draw_silhouette(pixels, model.faces.numpy(), width=width, height=height)
    small = cv2.resize(matte, (width, height), interpolation=cv2.INTER_AREA)
    person = small >= MASK_ALPHA / 255
    union = (outline | person).sum()
    return float((outline & person).sum() / union) if union else 0.0


def share_inside(
    points_px: Float[Tensor, "point 2"], matte: Float[ndarray, "height width"], *, margin_px: int
) -> float:
    """Share of points that lie in the matte, grown by a margin."""
    person = (matte >= MASK_ALPHA / 255).astype(np.uint8)
    size = 2 * margin_px + 1
    grown = cv2.dilate(person, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    cells = torch.floor(points_px).long().numpy()
    height, width = matte.shape
    within = (cells >= 0).all(1) & (cells[:, 0] < width) & (cells[:, 1] < height)
    hits = grown[cells[within, 1], cells[within, 0]] > 0
    return float(hits.sum() / len(cells))
