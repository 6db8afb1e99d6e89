"""The side cameras of the studio, and the errors that a real recording would carry."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from ntop.body.skinning import BodyPose
from ntop.config.sources import StudioSource
from ntop.geometry.cameras import Camera, Pinhole
from ntop.geometry.rotations import matrix_from_axis_angle

HEIGHTS_M = (1.0, 2.2, 1.4, 1.8)  # of the cameras, in turn around the ring
TARGET_WORLD_M = (0.0, 0.0, 1.0)
FOCAL_PER_SIZE = 1.08  # the image spans 2.5 m at the person's distance
LIMB_M = 0.4  # a joint error of one millimetre turns a bone of this length by 2.5 mrad


def side_cameras(settings: StudioSource) -> dict[str, Camera]:
    """The ring of perspective cameras, `cam01` at +x and on counter-clockwise from above."""
    size = settings.image_size_px
    focal = FOCAL_PER_SIZE * size
    lens = Pinhole(fx=focal, fy=focal, cx=size / 2, cy=size / 2, width=size, height=size)
    cameras = {}
    for index in range(settings.num_cameras):
        azimuth = 2 * math.pi * index / settings.num_cameras
        center = torch.tensor(
            [
                settings.camera_radius_m * math.cos(azimuth),
                settings.camera_radius_m * math.sin(azimuth),
                HEIGHTS_M[index % len(HEIGHTS_M)],
            ],
            dtype=torch.float64,
        )
        cameras[f"cam{index + 1:02d}"] = Camera(lens, center, looking_at(center))
    return cameras


def looking_at(center: Float[torch.Tensor, " 3"]) -> Float[torch.Tensor, "3 3"]:
    """Rotation camera_from_world of an upright camera that looks at the person's middle."""
    forward = torch.tensor(TARGET_WORLD_M, dtype=torch.float64) - center
    forward = forward / forward.norm()
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    return torch.stack([right, torch.linalg.cross(forward, right), forward])


def misplaced(
    cameras: dict[str, Camera], *, error_px: float, generator: np.random.Generator
) -> dict[str, Camera]:
    """Cameras as a calibration with errors of about that many pixels would give them."""
    result = {}
    for view, camera in cameras.items():
        angle = error_px / camera.lens.fx
        turn = torch.from_numpy(generator.normal(size=3) * angle)
        shift = torch.from_numpy(generator.normal(size=3) * angle)  # a metre away: as many pixels
        rotation = matrix_from_axis_angle(turn) @ camera.rotation
        result[view] = replace(camera, rotation=rotation, center_world=camera.center_world + shift)
    return result


def disturbed(pose: BodyPose, *, error_mm: float, generator: np.random.Generator) -> BodyPose:
    """Poses (frame first) with joint errors of about that many millimetres."""
    error_m = error_mm / 1000
    angles = {
        name: getattr(pose, name)
        + torch.from_numpy(
            generator.normal(size=tuple(getattr(pose, name).shape)) * error_m / LIMB_M
        ).to(pose.transl)
        for name in ("global_orient", "body_pose")
    }
    shift = torch.from_numpy(generator.normal(size=tuple(pose.transl.shape)) * error_m)
    return replace(pose, transl=pose.transl + shift.to(pose.transl), **angles)


def grown(matte: Float[ndarray, "height width"], growth_px: int) -> ndarray:
    """A matte widened (> 0) or narrowed (< 0) by whole pixels, in steps of a cross."""
    for _ in range(abs(growth_px)):
        padded = np.pad(matte, 1, mode="edge")
        around = np.stack(
            [
                matte,
                padded[:-2, 1:-1],
                padded[2:, 1:-1],
                padded[1:-1, :-2],
                padded[1:-1, 2:],
            ]
        )
        matte = around.max(0) if growth_px > 0 else around.min(0)
    return matte
