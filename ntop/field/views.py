"""What training sees: crops of photographs with mattes, their cameras and poses, and random rays.

Only the box around each person is kept, as 8-bit colour and matte, so that hundreds of full-size
photographs fit in memory.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from ntop.body.skinning import BodyPose
from ntop.field.kernels.batch import gather_rays
from ntop.geometry.cameras import Camera

LOOKUP_SPACING_PX = 8.0  # directions in between are interpolated: 1e-3 px for real lenses
MATTE_INSIDE, MATTE_OUTSIDE = 250, 5  # of 255; in between is the person's soft edge


@dataclass(frozen=True)
class TrainingViews:
    """Crops and where they come from. `boxes` are left, top, width, height in the camera's image.

    A crop is (height, width, 4): RGB and matte. `watched` views are never trained on: they say
    when to stop. `camera_names` (action, view) and `pose_names` (action, frame) are the capture's
    words for them; empty where views come from no capture.
    """

    cameras: tuple[Camera, ...]
    crops: tuple[UInt8[np.ndarray, "height width 4"], ...]
    boxes: Int[np.ndarray, "view 4"]
    camera_of_view: Int[np.ndarray, " view"]
    pose_of_view: Int[np.ndarray, " view"]
    poses: BodyPose
    watched: Bool[np.ndarray, " view"]
    camera_names: tuple[tuple[str, str], ...] = ()
    pose_names: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True)
class RayBatch:
    """Rays with what the photograph shows, sorted by view."""

    poses: Int[np.ndarray, " ray"]
    cameras: Int[np.ndarray, " ray"]
    origins: Float[np.ndarray, "ray 3"]
    directions: Float[np.ndarray, "ray 3"]
    offsets: Float[np.ndarray, " ray"]
    backgrounds: Float[np.ndarray, "ray 3"]
    targets: Float[np.ndarray, "ray 3"]
    mattes: Float[np.ndarray, " ray"]
    colour_weights: Float[np.ndarray, " ray"]
    matte_weights: Float[np.ndarray, " ray"]


class RaySource:
    """Draws rays from views; owns the flat pixel arrays that the kernel reads."""

    def __init__(
        self,
        views: TrainingViews,
        chosen: Int[np.ndarray, " any"],
        pose_origins: Float[np.ndarray, "pose 3"],
        *,
        band_px: int,
        shares: tuple[float, float],
        band_weights: tuple[float, float],
    ) -> None:
        """Index the pixels of the chosen views by zone.

        Args:
            views: All views.
            chosen: Which to draw from.
            pose_origins: World origin of each pose's warp grid.
            band_px: Half width of the band along the person's edge.
            shares: Share of rays inside the person, and in the band; the rest lies anywhere.
            band_weights: Colour and matte weights in the band.
        """
        crops = [views.crops[v] for v in chosen]
        self._boxes = views.boxes[chosen].astype(np.int64)
        self._pose = views.pose_of_view[chosen].astype(np.int64)
        self._camera = views.camera_of_view[chosen].astype(np.int64)
        counts = [crop.shape[0] * crop.shape[1] for crop in crops]
        self._pixel_offset = np.cumsum([0, *counts])[:-1]
        self._pixels = np.concatenate([crop.reshape(-1, 4) for crop in crops])
        zones = [_zones(crop[..., 3], band_px) for crop in crops]
        self._inside_offset, self._inside = _indexed([zone == 1 for zone in zones])
        self._band_offset, self._band = _indexed([zone == 2 for zone in zones])
        self._pose_origins = pose_origins
        self._shares, self._band_weights = np.array(shares), np.array(band_weights)
        lookups = [_direction_lookup(camera) for camera in views.cameras]
        self._lookup_size = np.array([lookup.shape[:2] for lookup in lookups])
        sizes = self._lookup_size.prod(1)
        self._lookup_offset = np.cumsum([0, *sizes])[:-1]
        self._lookup = np.concatenate([lookup.reshape(-1, 3) for lookup in lookups])
        self._centres = np.stack([camera.center_world.double().numpy() for camera in views.cameras])

    def draw(self, count: int, *, num_views: int, generator: np.random.Generator) -> RayBatch:
        """`count` rays from `num_views` random views (with repetition)."""
        views = np.sort(generator.integers(0, len(self._pose), num_views))
        views = np.repeat(views, -(-count // num_views))[:count]
        draws = generator.random((count, 2), np.float32)
        poses, cameras = np.empty(count, np.int64), np.empty(count, np.int64)
        origins, directions = np.empty((count, 3)), np.empty((count, 3))
        targets, mattes = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        colour_weights, matte_weights = np.empty(count, np.float32), np.empty(count, np.float32)
        gather_rays(
            draws, views, self._pose, self._camera, self._boxes, self._pixel_offset,
            self._pixels, self._inside_offset, self._inside, self._band_offset, self._band,
            self._shares, self._lookup_offset, self._lookup_size, self._lookup, LOOKUP_SPACING_PX,
            self._centres, self._pose_origins, poses, cameras, origins, directions, targets,
            mattes, colour_weights, matte_weights, self._band_weights, np.empty(count, np.int8),
        )  # fmt: skip
        return RayBatch(
            poses=poses,
            cameras=cameras,
            origins=origins,
            directions=directions,
            offsets=spread(count, generator),
            backgrounds=generator.random((count, 3), np.float32),
            targets=targets,
            mattes=mattes,
            colour_weights=colour_weights,
            matte_weights=matte_weights,
        )


def spread(count: int, generator: np.random.Generator) -> Float[np.ndarray, " ray"]:
    """One offset per ray in [0, 1): the golden-ratio sequence from a random start.

    Neighbouring rays get well-spread phases; a draw per sample would cost half an order of
    convergence (NUMERICS table 4).
    """
    golden = 0.6180339887498949
    return (generator.random() + golden * np.arange(count)) % 1.0


def _zones(matte: UInt8[np.ndarray, "height width"], band_px: int) -> UInt8[np.ndarray, "h w"]:
    """1 well inside the person, 2 within `band_px` of the edge, 0 outside."""
    around = np.ones((2 * band_px + 1, 2 * band_px + 1), np.uint8)
    highest, lowest = cv2.dilate(matte, around), cv2.erode(matte, around)
    inside = lowest >= MATTE_INSIDE
    band = (highest > MATTE_OUTSIDE) & ~inside
    return np.where(inside, 1, np.where(band, 2, 0)).astype(np.uint8)


def _indexed(masks: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    found = [np.flatnonzero(mask).astype(np.int32) for mask in masks]
    offsets = np.cumsum([0, *(len(index) for index in found)])
    return offsets, np.concatenate(found)


def _direction_lookup(camera: Camera) -> Float[np.ndarray, "row column 3"]:
    """Unit world directions on a coarse grid of image positions, one step beyond the image."""
    columns = int(np.ceil(camera.lens.width / LOOKUP_SPACING_PX)) + 2
    rows = int(np.ceil(camera.lens.height / LOOKUP_SPACING_PX)) + 2
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    pixels = torch.from_numpy(np.stack([u, v], -1) * LOOKUP_SPACING_PX)
    directions, _ = camera.rays(pixels)
    return directions.numpy()
