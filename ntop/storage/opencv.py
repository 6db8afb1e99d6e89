"""Camera files of OpenCV (YAML, XML or JSON), with the keys of its own calibration program."""

import math
from pathlib import Path

import cv2
import numpy as np

from ntop.conventions import DataError
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.opencv import fisheye_from_opencv, opencv_parameters, pinhole_from_opencv
from ntop.geometry.pinhole import Pinhole
from ntop.storage.atomic import write_bytes

MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "K")
DISTORTION_KEYS = ("distortion_coefficients", "distCoeffs", "D")


def read_opencv_lens(
    path: Path, *, max_theta: float = math.radians(170)
) -> Pinhole | KannalaBrandt:
    """The lens of a file with a camera matrix, distortion, image size and `fisheye_model` (0, 1).

    `max_theta` (radians) is the domain of a fisheye; a calibration does not say it.

    Raises:
        DataError: unreadable, a key is missing, or parameters that our lenses do not have.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such camera file")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise DataError(f"{path}: OpenCV cannot read it: {error}") from error
    try:
        matrix = _matrix(storage, MATRIX_KEYS, path)
        distortion = _matrix(storage, DISTORTION_KEYS, path).ravel().tolist()
        width, height, fisheye = (
            _whole(storage, key, path) for key in ("image_width", "image_height", "fisheye_model")
        )
    finally:
        storage.release()
    size = {"width": width, "height": height}
    try:
        if fisheye:
            return fisheye_from_opencv(matrix.tolist(), distortion, **size, max_theta=max_theta)
        return pinhole_from_opencv(matrix.tolist(), distortion, **size)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def write_opencv_lens(lens: Pinhole | KannalaBrandt, *, path: Path) -> None:
    """Write the file that `read_opencv_lens` and OpenCV's programs read; the suffix decides.

    Raises:
        DataError: another suffix than .yaml, .yml, .xml or .json.
    """
    if path.suffix not in (".yaml", ".yml", ".xml", ".json"):
        raise DataError(f"{path}: expected .yaml, .yml, .xml or .json, which OpenCV can read")
    matrix, distortion = opencv_parameters(lens)
    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY
    storage = cv2.FileStorage(path.suffix, flags)
    storage.write("image_width", lens.width)
    storage.write("image_height", lens.height)
    storage.write("fisheye_model", int(isinstance(lens, KannalaBrandt)))
    storage.write(MATRIX_KEYS[0], np.array(matrix))
    storage.write(DISTORTION_KEYS[0], np.array(distortion)[:, None])
    write_bytes(path, storage.releaseAndGetString().encode())


def _matrix(storage: cv2.FileStorage, keys: tuple[str, ...], path: Path) -> np.ndarray:
    for key in keys:
        node = storage.getNode(key)
        if not node.empty():
            values = node.mat()
            if values is not None and np.isfinite(values).all():
                return values.astype(np.float64)
            raise DataError(f"{path}: {key} is no matrix of finite numbers")
    raise DataError(f"{path}: has none of the matrices {', '.join(keys)}")


def _whole(storage: cv2.FileStorage, key: str, path: Path) -> int:
    node = storage.getNode(key)
    if node.empty() or not node.isInt():
        raise DataError(f"{path}: expected a whole number {key!r}; add it to the file")
    return int(node.real())
