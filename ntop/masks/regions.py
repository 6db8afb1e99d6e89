"""The rotated square of an image that a pose network looks at, and the warps to it and back.

All coordinates are continuous pixels, first centre at 0.5; OpenCV's integer centres appear only
in the matrices handed to `cv2.warpAffine`.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from ntop.conventions import PIXEL_CENTRE

# MediaPipe: the person's circle (mid-hip, full-body point) gives a square of twice its radius,
# enlarged by a quarter.
SIDE_PER_RADIUS = 2.5


@dataclass(frozen=True)
class Region:
    """A square of the image: its centre and side in pixels, and its rotation.

    At `angle_rad` 0 the crop is upright; a positive angle turns the crop's axes clockwise as seen
    on the screen (from u towards v).
    """

    centre_u_px: float
    centre_v_px: float
    side_px: float
    angle_rad: float

    def image_from_crop(self, crop_size: int) -> Float[np.ndarray, "2 3"]:
        """Affine map from continuous crop pixels to continuous image pixels."""
        scale = self.side_px / crop_size
        cosine, sine = scale * math.cos(self.angle_rad), scale * math.sin(self.angle_rad)
        half = crop_size / 2
        return np.array(
            [
                [cosine, -sine, self.centre_u_px - half * (cosine - sine)],
                [sine, cosine, self.centre_v_px - half * (sine + cosine)],
            ]
        )


def region_of_person(
    hip_px: Float[np.ndarray, " 2"], full_body_px: Float[np.ndarray, " 2"]
) -> Region:
    """The square around a person: mid-hip in the centre, the full-body point straight up."""
    du, dv = (float(x) for x in full_body_px - hip_px)
    return Region(
        float(hip_px[0]),
        float(hip_px[1]),
        SIDE_PER_RADIUS * math.hypot(du, dv),
        math.atan2(dv, du) + math.pi / 2,  # up on the screen is -v
    )


def transform_points(
    matrix: Float[np.ndarray, "2 3"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Points through an affine map."""
    return points @ matrix[:, :2].T + matrix[:, 2]


def opencv_affine(matrix: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
    """The same map between integer-centre coordinates, for OpenCV."""
    shifted = matrix.copy()
    shifted[:, 2] += PIXEL_CENTRE * (matrix[:, 0] + matrix[:, 1]) - PIXEL_CENTRE
    return shifted


def crop_region(
    image: UInt8[np.ndarray, "height width 3"], region: Region, *, size: int
) -> UInt8[np.ndarray, "size size 3"]:
    """The region resampled to `size` pixels a side; black outside the image, as MediaPipe does.

    A region larger than the crop is first shrunk by area averaging, so that nothing aliases.
    """
    factor = max(1, int(region.side_px / (2 * size)))
    if factor > 1:
        height, width = (n // factor for n in image.shape[:2])
        image = cv2.resize(
            image[: height * factor, : width * factor],
            (width, height),
            interpolation=cv2.INTER_AREA,
        )
    matrix = region.image_from_crop(size) / factor
    return cv2.warpAffine(
        image,
        opencv_affine(matrix),
        (size, size),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
    )


def warp_back(
    values: Float32[np.ndarray, "size size"], region: Region, *, shape: tuple[int, int]
) -> Float32[np.ndarray, "height width"]:
    """A crop's values resampled (cubic) in the frame's pixels; 0 outside the region.

    `shape` is the frame's (height, width).
    """
    return cv2.warpAffine(
        np.ascontiguousarray(values),
        opencv_affine(region.image_from_crop(len(values))),
        (shape[1], shape[0]),
        flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_CONSTANT,
    )


def box_around(
    mask: Bool[np.ndarray, "height width"], *, margin_px: int
) -> tuple[slice, slice] | None:
    """The mask's bounding box with a margin, clipped to the image; None for an empty mask."""
    rows, columns = mask.any(1).nonzero()[0], mask.any(0).nonzero()[0]
    if not len(rows):
        return None
    return (
        slice(max(0, int(rows[0]) - margin_px), int(rows[-1]) + 1 + margin_px),
        slice(max(0, int(columns[0]) - margin_px), int(columns[-1]) + 1 + margin_px),
    )
