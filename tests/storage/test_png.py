"""The encoder against OpenCV's decoder, and its worst cases."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from ntop.storage.png import decode_png, encode_png


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
    content = encode_png(pixels)
    np.testing.assert_array_equal(decode(content), pixels)
    np.testing.assert_array_equal(decode_png(content), pixels)


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_channels_come_back_in_rgb_order(channels):
    pixels = np.random.default_rng(2).integers(0, 256, (20, 31, channels), dtype=np.uint8)
    content = encode_png(pixels)
    np.testing.assert_array_equal(decode(content), pixels)
    np.testing.assert_array_equal(decode_png(content), pixels)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_files_of_other_encoders_are_read(dtype, channels):
    # OpenCV picks a filter per row, which the quick way cannot read
    rng = np.random.default_rng(3)
    smooth = np.cumsum(rng.integers(0, 3, (40, 50, channels)), axis=1).astype(dtype)
    pixels = smooth[..., 0] if channels == 1 else smooth
    bgr = pixels if channels == 1 else smooth[..., [2, 1, 0, 3][:channels]]
    written, content = cv2.imencode(".png", bgr)
    assert written
    read = decode_png(content.tobytes())
    np.testing.assert_array_equal(read, pixels)
    assert read.dtype == dtype


def test_rows_without_a_filter_stand_beside_differences():
    # an encoder may leave rows as they are; those below the differences are not differences
    pixels = np.random.default_rng(4).integers(0, 256, (6, 5), dtype=np.uint8)
    lines = np.zeros((6, 6), np.uint8)
    lines[:, 1:] = pixels
    lines[2:4, 0] = 2
    lines[2:4, 1:] = pixels[2:4] - pixels[1:3]
    content = png_of(lines, width=5)
    np.testing.assert_array_equal(decode(content), pixels)
    np.testing.assert_array_equal(decode_png(content), pixels)


def test_a_damaged_file_is_refused_wherever_the_damage_is():
    pixels = np.random.default_rng(5).integers(0, 256, (12, 9, 4), dtype=np.uint8)
    content = encode_png(pixels)
    for at in range(len(content)):
        with pytest.raises(ValueError, match=r"it|its"):
            decode_png(content[:at])
        damaged = bytearray(content)
        damaged[at] ^= 1
        with pytest.raises(ValueError, match=r"it|its"):
            decode_png(bytes(damaged))


def test_a_stream_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="holds 12 bytes of pixels, expected 18"):
        decode_png(png_of(np.zeros((2, 6), np.uint8), width=5, height=3))
    with pytest.raises(ValueError, match="lacks IDAT"):
        decode_png(PNG_SIGNATURE + chunk(b"IHDR", bytes(13)) + chunk(b"IEND", b""))


PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def png_of(lines: np.ndarray, *, width: int, height: int | None = None) -> bytes:
    """A grey PNG of filtered lines, put together by hand."""
    header = struct.pack(">IIBBBBB", width, height or len(lines), 8, 0, 0, 0, 0)
    pieces = (b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes())), (b"IEND", b"")
    return PNG_SIGNATURE + b"".join(chunk(name, body) for name, body in pieces)


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


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
