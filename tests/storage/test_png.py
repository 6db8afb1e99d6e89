"""The encoder against OpenCV's decoder, and its worst cases."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from ntop.storage.png import encode_png


def decode(content: bytes) -> np.ndarray:
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 3:
        pixels = pixels[..., [2, 1, 0, *range(3, pixels.shape[2])]]
    return pixels


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("rows", [(0, 37), (5, 6), (0, 1), (36, 37), (9, 30), (0, 0)])
def test_decodes_to_the_same_pixels_wherever_the_filled_rows_lie(dtype, rows):
    rng = np.random.default_rng(1)
    pixels = np.zeros((37, 53), dtype)
    pixels[rows[0] : rows[1]] = rng.integers(0, np.iinfo(dtype).max + 1, (rows[1] - rows[0], 53))
    np.testing.assert_array_equal(decode(encode_png(pixels)), pixels)


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_channels_come_back_in_rgb_order(channels):
    pixels = np.random.default_rng(2).integers(0, 256, (20, 31, channels), dtype=np.uint8)
    np.testing.assert_array_equal(decode(encode_png(pixels)), pixels)


def test_an_empty_large_image_takes_few_bytes():
    content = encode_png(np.zeros((1000, 1000, 4), np.uint8))
    assert len(content) < 6000
    assert not decode(content).any()


def test_checksums_satisfy_a_strict_decoder():
    # OpenCV skips the Adler-32 of the stream; zlib does not
    pixels = np.zeros((300, 200), np.uint8)
    pixels[100:140, 20:60] = np.arange(1600, dtype=np.uint16).reshape(40, 40).astype(np.uint8)
    content = encode_png(pixels)
    start = content.index(b"IDAT")
    (length,) = struct.unpack(">I", content[start - 4 : start])
    lines = zlib.decompress(content[start + 4 : start + 4 + length])
    assert len(lines) == 300 * 201
    (stored,) = struct.unpack(">I", content[start + 4 + length : start + 8 + length])
    assert stored == zlib.crc32(content[start : start + 4 + length])
