"""Read one actor's recordings: frames, cameras and keypoints that fit together."""

from pathlib import Path

import numpy as np
import torch

from ntop.body.fitting.recordings import Recording
from ntop.conventions import DataError
from ntop.geometry.cameras import Camera
from ntop.storage import schemas
from ntop.storage.cameras import read_cameras
from ntop.storage.tables import Row, read_table


def read_recordings(*, frames: Path, cameras: Path, keypoints2d: Path) -> list[Recording]:
    """All actions of one actor, sorted by name.

    Raises:
        DataError: a camera is missing, keypoints do not match the frames, are of several
            skeletons, or are not finite although their confidence is positive.
    """
    frame_rows = read_table(frames, schema=schemas.FRAME)
    if not frame_rows:
        raise DataError(f"{frames}: no frames; run the capture stage again")
    known_cameras = read_cameras(cameras)
    points = _keypoints_by_view(keypoints2d, frame_rows)
    actions = sorted({row["action"] for row in frame_rows})
    return [
        _recording(
            [row for row in frame_rows if row["action"] == action],
            cameras=known_cameras,
            points=points,
            path=keypoints2d,
        )
        for action in actions
    ]


def _recording(
    rows: list[Row],
    *,
    cameras: dict[tuple[str, str], Camera],
    points: dict[tuple[str, int, str], Row],
    path: Path,
) -> Recording:
    action = rows[0]["action"]
    views = tuple(sorted({row["view"] for row in rows}))
    frames = tuple(sorted({row["frame"] for row in rows}))
    where = f"{rows[0]['source']}/{rows[0]['actor']} {action}"
    missing = [view for view in views if (action, view) not in cameras]
    if missing:
        raise DataError(
            f"{where}: no camera for views {missing}; run the capture stage again or drop the views"
        )
    usable = {(row["frame"], row["view"]) for row in rows if not row["reason"]}
    sample = next((points[key] for key in sorted(points) if key[0] == action), None)
    if sample is None:
        raise DataError(f"{path}: no keypoints for {where}; run the mask stage again")
    count = len(sample["confidence"])
    pixels = np.zeros((len(frames), len(views), count, 2))
    confidence = np.zeros((len(frames), len(views), count))
    for i, frame in enumerate(frames):
        for j, view in enumerate(views):
            row = points.get((action, frame, view))
            if row is None or (frame, view) not in usable:
                continue
            _check_keypoints(row, skeleton=sample["skeleton"], count=count, path=path)
            certain = np.asarray(row["confidence"])
            values = np.asarray(row["keypoints_px"]).reshape(-1, 2)
            pixels[i, j] = np.where(certain[:, None] > 0, values, 0.0)
            confidence[i, j] = certain
    return Recording(
        source=rows[0]["source"],
        actor=rows[0]["actor"],
        action=action,
        frames=frames,
        views=views,
        cameras=tuple(cameras[(action, view)] for view in views),
        skeleton=sample["skeleton"],
        pixels=torch.from_numpy(pixels),
        confidence=torch.from_numpy(confidence),
    )


def _keypoints_by_view(path: Path, frame_rows: list[Row]) -> dict[tuple[str, int, str], Row]:
    known = {(row["action"], row["frame"], row["view"]) for row in frame_rows}
    points = {}
    for row in read_table(path, schema=schemas.KEYPOINTS2D):
        key = (row["action"], row["frame"], row["view"])
        if key not in known:
            raise DataError(
                f"{path}: keypoints of {row['source']}/{row['actor']} {key}, which is no captured "
                "frame; run the mask stage again"
            )
        points[key] = row
    return points


def _check_keypoints(row: Row, *, skeleton: str, count: int, path: Path) -> None:
    where = f"{path}: {row['source']}/{row['actor']} {row['action']} {row['view']} frame"
    where = f"{where} {row['frame']}"
    if row["skeleton"] != skeleton or len(row["confidence"]) != count:
        raise DataError(
            f"{where}: {len(row['confidence'])} keypoints of {row['skeleton']!r}, others have "
            f"{count} of {skeleton!r}; detect all frames with one method"
        )
    certain = np.asarray(row["confidence"], dtype=float)
    values = np.asarray(row["keypoints_px"], dtype=float)
    if len(values) != 2 * count or not np.isfinite(certain).all() or (certain < 0).any():
        raise DataError(
            f"{where}: {len(values)} coordinates for {count} keypoints, or a confidence that is "
            "negative or not finite; expected 2 per keypoint and confidences in [0, 1]"
        )
    bad = int((~np.isfinite(values.reshape(-1, 2)).all(1) & (certain > 0)).sum())
    if bad:
        raise DataError(
            f"{where}: {bad} keypoints are not finite although their confidence is positive; "
            "a point that was not found has confidence 0"
        )
