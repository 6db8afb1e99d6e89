"""Mask, tight box, area and run-length code of a person in one view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from numpy import ndarray
from pycocotools import mask as coco_mask


@dataclass(frozen=True)
class Silhouette:
    """What a mask says: `bbox_xywh_px` spans its pixels' outer edges, None where it is empty.

    In our continuous pixels the first pixel spans [0, 1], so that the box is also COCO's.
    `rle` is COCO's compressed run-length code (column-major, ASCII).
    """

    bbox_xywh_px: tuple[float, float, float, float] | None
    area_px: int
    rle: str


def silhouette(mask: Bool[ndarray, "height width"]) -> Silhouette:
    """Box, area and run-length code of a mask."""
    rows, columns = mask.any(1).nonzero()[0], mask.any(0).nonzero()[0]
    code = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))
    box = None
    if len(rows):
        left, top = float(columns[0]), float(rows[0])
        box = (left, top, float(columns[-1]) + 1 - left, float(rows[-1]) + 1 - top)
    return Silhouette(box, int(np.count_nonzero(mask)), code["counts"].decode("ascii"))
