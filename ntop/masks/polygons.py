"""Masks kept as polygons: the hand-checked reference of the recording.

A file holds, per frame, closed rings of (u, v) in continuous pixels of the frame; a pixel belongs
to the mask if its centre lies inside an odd number of rings, so a ring within a ring is a hole.
"""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.storage.atomic import write_bytes

Ring = Float[np.ndarray, "point 2"]


def read_polygon_masks(path: Path) -> dict[int, Bool[np.ndarray, "height width"]]:
    """The masks of a polygon file, by frame.

    Raises:
        DataError: the file is missing, is no JSON, or a ring has fewer than three points.
    """
    try:
        content = json.loads(path.read_text())
        width, height = int(content["width"]), int(content["height"])
        frames = {int(frame): rings for frame, rings in content["frames"].items()}
        masks = {}
        for frame, rings in sorted(frames.items()):
            arrays = [np.array(ring, dtype=np.float64).reshape(-1, 2) for ring in rings]
            if any(len(ring) < 3 for ring in arrays):
                raise DataError(f"{path} frame {frame}: a ring has fewer than three points")
            masks[frame] = rasterise(arrays, height=height, width=width)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"cannot read polygon masks {path}: {type(error).__name__} {error}; expected "
            '{"width", "height", "frames": {frame: [[[u, v], ...], ...]}}'
        ) from error
    return masks


def write_polygon_masks(
    frames: dict[int, list[Ring]], *, height: int, width: int, note: str, path: Path
) -> None:
    """Write rings per frame, coordinates rounded to a tenth of a pixel."""
    content = {
        "note": note,
        "width": width,
        "height": height,
        "frames": {
            str(frame): [np.round(ring, 1).tolist() for ring in rings]
            for frame, rings in sorted(frames.items())
        },
    }
    lines = json.dumps(content).replace(', "', ',\n"').replace("]], [[", "]],\n[[")
    write_bytes(path, (lines + "\n").encode())


def rasterise(rings: list[Ring], *, height: int, width: int) -> Bool[np.ndarray, "height width"]:
    """The pixels whose centres lie inside an odd number of rings."""
    toggles = np.zeros((height, width + 1), np.int64)
    for ring in rings:
        for (u0, v0), (u1, v1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            # rows whose centre lies in [min v, max v): each end point counts once
            low, high = sorted((v0, v1))
            rows = np.arange(
                max(0, int(np.ceil(low - PIXEL_CENTRE))),
                min(height, int(np.ceil(high - PIXEL_CENTRE))),
            )
            if not len(rows):
                continue
            crossing = u0 + (rows + PIXEL_CENTRE - v0) * (u1 - u0) / (v1 - v0)
            columns = np.clip(np.ceil(crossing - PIXEL_CENTRE), 0, width).astype(int)
            toggles[rows, columns] += 1
    return np.cumsum(toggles, axis=1)[:, :width] % 2 == 1
