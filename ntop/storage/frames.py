"""Recorded pictures: stills and video frames as arrays, each video decoded once, in order.

A row of schema FRAME names a still (`image_index` -1) or the 0-based frame `image_index` of a
video; its path is relative to the table's folder.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from ntop.conventions import DataError
from ntop.storage.remedies import remedy
from ntop.storage.tables import Row

Picture = UInt8[np.ndarray, "height width 3"]

STILL = -1


def iterate_frames(table_path: Path, rows: Iterable[Row]) -> Iterator[tuple[Row, Picture]]:
    """Each row with its picture (RGB, [v, u] order), sorted by file, then by frame.

    Every video is opened once and decoded forwards, never sought in: seeking is inexact for many
    encodings.

    Raises:
        DataError: a file is missing or not decodable up to the wanted frame, or a picture is not
            as large as its row says.
    """
    folder = table_path.parent
    ordered = sorted(rows, key=lambda row: (row["image_path"], row["image_index"]))
    for image_path, group in groupby(ordered, key=lambda row: row["image_path"]):
        yield from _read_file(folder / image_path, list(group))


def read_frame(table_path: Path, row: Row) -> Picture:
    """The picture of a single row; for many frames of one video use `iterate_frames`."""
    ((_, picture),) = iterate_frames(table_path, [row])
    return picture


def video_size_px(path: Path) -> tuple[int, int]:
    """Width and height of a video's pictures."""
    with _open_video(path) as video:
        return int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT))


def count_frames(path: Path) -> int:
    """How many frames of a video can be decoded, by decoding them.

    Raises:
        DataError: the video cannot be opened, or ends before its container says it does.
    """
    with _open_video(path) as video:
        declared = round(video.get(cv2.CAP_PROP_FRAME_COUNT))
        decoded = 0
        while video.grab():
            decoded += 1
    if decoded < declared:
        raise DataError(
            f"{path}: truncated or damaged: {decoded} frames can be decoded, its container says "
            f"{declared}; copy or fetch the file again"
        )
    return decoded


def _read_file(path: Path, rows: list[Row]) -> Iterator[tuple[Row, Picture]]:
    if rows[0]["image_index"] == STILL:
        for row in rows:
            yield row, _checked(_read_still(path), row, path)
        return
    with _open_video(path) as video:
        position, picture = STILL, None
        for row in rows:
            wanted = row["image_index"]
            while position < wanted:
                if not video.grab():
                    raise DataError(
                        f"{path}: cannot read frame {wanted}: decoding ends after frame "
                        f"{position}; the file is truncated or damaged, copy or fetch it again"
                    )
                position, picture = position + 1, None
            if picture is None:
                picture = _retrieve(video, path=path, index=position)
            yield row, _checked(picture, row, path)


def _retrieve(video: cv2.VideoCapture, *, path: Path, index: int) -> Picture:
    intact, bgr = video.retrieve()
    if not intact:
        raise DataError(f"{path}: frame {index} is damaged; copy or fetch the file again")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _read_still(path: Path) -> Picture:
    # orientation tags are ignored: calibration describes the picture as stored
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    bgr = cv2.imread(str(path), flags) if path.is_file() else None
    if bgr is None:
        problem = "cannot be decoded" if path.is_file() else "does not exist"
        raise DataError(f"picture {path} {problem}; {remedy(path)}")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _checked(picture: Picture, row: Row, path: Path) -> Picture:
    height, width = picture.shape[:2]
    if (width, height) != (row["width"], row["height"]):
        raise DataError(
            f"{path} frame {row['image_index']}: picture is {width}x{height} px, its table says "
            f"{row['width']}x{row['height']} px; {remedy(path)}"
        )
    return picture


@contextmanager
def _open_video(path: Path) -> Iterator[cv2.VideoCapture]:
    if not path.is_file():
        raise DataError(f"video {path} does not exist; fetch or copy it, then run again")
    video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise DataError(
                f"video {path} cannot be opened: it is truncated, empty or in a format that this "
                "OpenCV does not decode; copy or fetch it again"
            )
        yield video
    finally:
        video.release()
