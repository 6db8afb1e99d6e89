"""One action of one actor as arrays: 2D keypoints and cameras, frames x views."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ntop.body.fitting.observations import LandmarkRays
from ntop.body.landmarks import Landmarks
from ntop.geometry.cameras import Camera
from ntop.geometry.refinement import pixels_per_radian
from ntop.geometry.triangulation import camera_centers, camera_rays


@dataclass(frozen=True)
class Recording:
    """Keypoints of one action; where a view or point is missing, confidence is 0.

    Attributes:
        frames: frame numbers, ascending; views: names, ascending, as in `cameras`.
        skeleton: order of the keypoints (ntop.body.skeletons).
        pixels: our pixel convention, float64.
    """

    source: str
    actor: str
    action: str
    frames: tuple[int, ...]
    views: tuple[str, ...]
    cameras: tuple[Camera, ...]
    skeleton: str
    pixels: Float[Tensor, "frame view keypoint 2"]
    confidence: Float[Tensor, "frame view keypoint"]

    def with_extrinsics(self, placed: dict[str, Camera]) -> "Recording":
        """The same recording, seen by its own lenses at other places."""
        cameras = tuple(
            replace(camera, center_world=placed[view].center_world, rotation=placed[view].rotation)
            for view, camera in zip(self.views, self.cameras, strict=True)
        )
        return replace(self, cameras=cameras)

    def without_views(self, dropped: tuple[str, ...]) -> "Recording":
        """The same recording without some cameras."""
        kept = [i for i, view in enumerate(self.views) if view not in dropped]
        return replace(
            self,
            views=tuple(self.views[i] for i in kept),
            cameras=tuple(self.cameras[i] for i in kept),
            pixels=self.pixels[:, kept],
            confidence=self.confidence[:, kept],
        )


def landmark_rays(
    recordings: list[Recording], landmarks: Landmarks, *, min_confidence: float
) -> LandmarkRays:
    """Keypoints of all recordings, one after the other, as weighted rays.

    Points below `min_confidence`, or that the body does not define, have weight zero. All
    recordings have the same number of views.
    """
    centers, directions, weights, scales = [], [], [], []
    for recording in recordings:
        cameras = list(recording.cameras)
        rays, covered = camera_rays(cameras, recording.pixels.transpose(1, 2))
        certain = recording.confidence >= min_confidence
        usable = certain & covered.transpose(1, 2) & landmarks.defined
        count = len(recording.frames)
        centers.append(camera_centers(cameras).expand(count, -1, 3))
        directions.append(rays.transpose(1, 2))
        weights.append(recording.confidence * usable)
        scale = [pixels_per_radian(camera.lens) for camera in cameras]
        scales.append(torch.tensor(scale, dtype=torch.float64).expand(count, -1))
    return LandmarkRays(
        torch.cat(centers), torch.cat(directions), torch.cat(weights), torch.cat(scales)
    )
