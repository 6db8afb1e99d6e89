"""Image files: straight-alpha RGBA, depth, part labels and mattes as deterministic PNG.

Values are rounded to nearest: truncation costs 6 dB of the 58.9 dB that 8 bits allow and darkens
every image by half a level. Colours are stored straight (not multiplied by alpha), because at
alpha 0.02 un-premultiplying eight bits is off by 26 levels.

All readers take the address of a tar's member (`ntop.storage.archives`) as well as a file.
"""

import hashlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from ntop.conventions import DEPTH_STEP_M, DataError
from ntop.storage.archives import read_content
from ntop.storage.atomic import write_bytes
from ntop.storage.png import decode_png, encode_png
from ntop.storage.remedies import remedy

DILATION_PX = 3  # straight colour reaches this far beyond alpha > 0: scaling mixes in no black
DEPTH_LIMIT_M = 65535 * DEPTH_STEP_M


def encode_rgba(
    rgb: Float[ndarray, "height width 3"], alpha: Float[ndarray, "height width"]
) -> bytes:
    """PNG bytes of straight sRGB colour and alpha, both in [0, 1], rounded to nearest.

    Colour is carried `DILATION_PX` beyond alpha > 0, so that scaling or recompositing the file
    shows no dark fringe; further out it is zero.
    """
    if rgb.shape[:2] != alpha.shape or rgb.shape[2:] != (3,):
        raise DataError(f"RGBA image: colour {rgb.shape} and alpha {alpha.shape} do not match")
    pixels = np.zeros((*alpha.shape, 4), np.uint8)
    if not alpha.size:
        return encode_png(pixels)  # which says what is wrong
    box = _box(alpha, margin=DILATION_PX)  # only there is anything to convert: 4 % of a usual view
    quantised = eight_bit(alpha[box])
    pixels[box][..., :3] = _dilated(eight_bit(rgb[box]), quantised > 0)
    pixels[box][..., 3] = quantised
    return encode_png(pixels)


def encode_depth(depth_m: Float[ndarray, "height width"]) -> bytes:
    """PNG bytes of ray lengths in metres, 16 bit, `DEPTH_STEP_M` per step; 0 means nothing there.

    Raises:
        DataError: a length beyond 6.5535 m, negative or not finite: it would wrap silently.
    """
    lowest, highest = float(depth_m.min(initial=0)), float(depth_m.max(initial=0))
    if not (lowest >= 0 and highest <= DEPTH_LIMIT_M):
        raise DataError(
            f"depth image: values {lowest} .. {highest} m, expected 0 .. {DEPTH_LIMIT_M:.4f} m; "
            "lower the rig or crop the scene"
        )
    steps = np.zeros(depth_m.shape, np.uint16)
    box = _box(depth_m, margin=0)
    steps[box] = np.rint(depth_m[box].astype(np.float64) / DEPTH_STEP_M)
    return encode_png(steps)


def encode_parts(parts: UInt8[ndarray, "height width"]) -> bytes:
    """PNG bytes of part labels: skinning bone + 1, 0 where there is nothing."""
    return encode_png(parts)


def encode_matte(matte: Float[ndarray, "height width"]) -> bytes:
    """PNG bytes of a soft mask in [0, 1], rounded to 8 bit."""
    return encode_png(eight_bit(matte))


def write_rgba(
    rgb: Float[ndarray, "height width 3"], alpha: Float[ndarray, "height width"], *, path: Path
) -> str:
    """Write an RGBA image (see `encode_rgba`); returns the SHA-256 of the file."""
    content = encode_rgba(rgb, alpha)
    write_bytes(path, content)
    return hashlib.sha256(content).hexdigest()


def write_depth(depth_m: Float[ndarray, "height width"], *, path: Path) -> None:
    """Write ray lengths in metres (see `encode_depth`)."""
    write_bytes(path, encode_depth(depth_m))


def write_parts(parts: UInt8[ndarray, "height width"], *, path: Path) -> None:
    """Write part labels, bone + 1 (see `encode_parts`)."""
    write_bytes(path, encode_parts(parts))


def write_matte(matte: Float[ndarray, "height width"], *, path: Path) -> None:
    """Write a soft mask in [0, 1] (see `encode_matte`)."""
    write_bytes(path, encode_matte(matte))


def read_rgba(path: Path) -> UInt8[ndarray, "height width 4"]:
    """Straight-alpha RGBA, 8 bit; the mask is channel 3 >= `MASK_ALPHA`."""
    return _read(path, channels=4, dtype=np.uint8)


def read_depth(path: Path) -> Float[ndarray, "height width"]:
    """Ray lengths in metres (float32), 0 where there is nothing."""
    steps = _read(path, channels=1, dtype=np.uint16)
    return steps.astype(np.float32) * np.float32(DEPTH_STEP_M)


def read_parts(path: Path) -> UInt8[ndarray, "height width"]:
    """Part labels: bone + 1, 0 where there is nothing."""
    return _read(path, channels=1, dtype=np.uint8)


def read_matte(path: Path) -> Float[ndarray, "height width"]:
    """A soft mask in [0, 1], float32."""
    return _read(path, channels=1, dtype=np.uint8).astype(np.float32) / np.float32(255)


def eight_bit(values: Float[ndarray, "*shape"]) -> UInt8[ndarray, "*shape"]:
    """Values in [0, 1] as 0..255, rounded to nearest (half to even) and clipped.

    Raises:
        DataError: a value is NaN or infinite: it would become an arbitrary grey.
    """
    if not np.isfinite(values).all():
        count = int((~np.isfinite(values)).sum())
        raise DataError(
            f"image of {values.shape}: {count} values are not finite, expected 0 .. 1; the stage "
            "that computed them is at fault"
        )
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def _box(values: Float[ndarray, "height width"], *, margin: int) -> tuple[slice, slice]:
    """The window that holds all values other than zero, and `margin` pixels more."""
    slices = []
    for axis, size in ((1, values.shape[0]), (0, values.shape[1])):
        filled = np.flatnonzero(values.any(axis))
        first, last = (filled[0], filled[-1] + 1) if len(filled) else (0, 0)
        slices.append(slice(max(first - margin, 0), min(last + margin, size)))
    return slices[0], slices[1]


def _dilated(
    rgb: UInt8[ndarray, "height width 3"], inside: np.ndarray
) -> UInt8[ndarray, "height width 3"]:
    """Colour inside; beyond, within DILATION_PX, the mean of the colours inside near by."""
    size = (2 * DILATION_PX + 1, 2 * DILATION_PX + 1)
    weight = inside.astype(np.float32)
    total = cv2.boxFilter(weight, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    colour = cv2.boxFilter(
        rgb.astype(np.float32) * weight[..., None],
        -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT,
    )  # fmt: skip
    near = np.rint(colour / np.maximum(total, 1)[..., None]).astype(np.uint8)
    return np.where(inside[..., None], rgb, near)


def _read(path: Path, *, channels: int, dtype: type) -> np.ndarray:
    try:
        pixels = decode_png(read_content(path))
    except OSError as error:
        raise DataError(
            f"cannot read image {path}: {error.strerror or error}; {remedy(path)}"
        ) from error
    except ValueError as error:
        raise DataError(f"{path} is not a whole PNG: {error}; {remedy(path)}") from error
    got = 1 if pixels.ndim == 2 else pixels.shape[2]
    if got != channels or pixels.dtype != dtype:
        raise DataError(
            f"{path}: {got} channels of {pixels.dtype}, expected {channels} of "
            f"{np.dtype(dtype)}; it is another kind of image"
        )
    return pixels
