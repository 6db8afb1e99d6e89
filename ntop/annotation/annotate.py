"""All labels of one rendered view, from its row and its images."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from ntop.annotation.boxes import silhouette
from ntop.annotation.keypoints import project_keypoints
from ntop.annotation.visibility import COCO17_LIMBS, SMPL24_LIMBS, keypoint_visibility
from ntop.geometry.cameras import Camera

BODY_NAMES = ("betas", "global_orient_rad", "body_pose_rad", "transl_m")


@dataclass(frozen=True)
class ViewImages:
    """What the labels of a view are measured on."""

    mask: Bool[ndarray, "height width"]
    depth_m: Float[ndarray, "height width"]
    parts: UInt8[ndarray, "height width"]


def annotate_view(row: dict[str, Any], images: ViewImages, *, camera: Camera) -> dict[str, Any]:
    """The row of schema KEYPOINTS for one row of schema RENDER.

    `persons` is empty where the mask is: nobody is in view.
    """
    outline = silhouette(images.mask)
    persons = []
    if outline.bbox_xywh_px is not None:
        joints_world = _points(row["joints3d_world_m"])
        smpl24 = project_keypoints(joints_world, camera)
        coco17 = project_keypoints(_points(row["coco17_world_m"]), camera)
        depth = {"depth_m": images.depth_m, "parts": images.parts}
        persons.append(
            {
                "person_id": row["actor"],
                "bbox_xywh_px": list(outline.bbox_xywh_px),
                "area_px": outline.area_px,
                "keypoints2d_coco17_px": coco17.pixels.flatten().tolist(),
                "visibility_coco17": keypoint_visibility(coco17, COCO17_LIMBS, **depth).tolist(),
                "keypoints2d_smpl24_px": smpl24.pixels.flatten().tolist(),
                "visibility_smpl24": keypoint_visibility(smpl24, SMPL24_LIMBS, **depth).tolist(),
                "joints3d_world_m": row["joints3d_world_m"],
                "joints3d_camera_m": smpl24.points_camera.flatten().tolist(),
                **{name: row[name] for name in BODY_NAMES},
            }
        )
    return {"sample_id": row["sample_id"], "persons": persons, "rle": outline.rle}


def _points(values: list[float]) -> Float[torch.Tensor, "keypoint 3"]:
    return torch.tensor(np.asarray(values).reshape(-1, 3), dtype=torch.float64)
