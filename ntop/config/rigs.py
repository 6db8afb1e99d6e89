"""The rig of a configuration: its place and its lens. Imports torch: not for the Snakefile."""

import math
from dataclasses import replace

import torch

from ntop.config.sections import ImageConfig, RigConfig
from ntop.geometry.rigs import Rig


def configured_rig(place: RigConfig, image: ImageConfig) -> Rig:
    """Nine cameras at a place, with the configured lens."""
    unit = Rig(
        height_above_pelvis_m=place.height_above_pelvis_m,
        ring_radius_m=place.ring_radius_m,
        width=image.width_px,
        height=image.height_px,
        focal_px=1.0,
        max_theta_rad=math.radians(image.max_theta_deg),
        model=image.lens,
        focal_y_px=image.focal_y_px,
        center_px=image.center_px,
        distortion=image.distortion,
    )
    side = min(image.width_px, image.height_px)
    return replace(unit, focal_px=image.focal_px or 0.5 * side / _radius_at_90_degrees(unit))


def _radius_at_90_degrees(rig: Rig) -> float:
    """Focal lengths from the principal point to the image of a ray across the axis."""
    lens = rig.lens()
    pixel, _ = lens.project(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    return (float(pixel[0]) - lens.cx) / lens.fx
