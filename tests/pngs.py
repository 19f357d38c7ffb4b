"""PNGs of every bit depth, written through zlib alone."""

import struct
import zlib

import numpy as np

GREY, COLOUR, PALETTE, GREY_ALPHA, COLOUR_ALPHA = 0, 2, 3, 4, 6
# The first pixel and the steps of the seven passes of an interlaced PNG, x and y.
PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2),
          (0, 1, 1, 2))  # fmt: skip


def png(stored, bits=8, kind=GREY, palette=None, interlaced=False):
    """A PNG with these stored numbers, (H, W) or (H, W, C)."""
    height, width = stored.shape[:2]
    passes = PASSES if interlaced else ((0, 0, 1, 1),)
    parts = [stored[y::down, x::across] for x, y, across, down in passes]
    rows = b"".join(b"\0" + _packed(row, bits) for part in parts if part.size for row in part)
    head = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, interlaced)
    chunks = [(b"IHDR", head)]
    if palette is not None:
        chunks.append((b"PLTE", np.asarray(palette, np.uint8).tobytes()))
    chunks += [(b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*each) for each in chunks)


def _packed(row, bits):
    digits = "".join(format(int(value), f"0{bits}b") for value in np.ravel(row))
    digits += "0" * (-len(digits) % 8)
    return int(digits, 2).to_bytes(len(digits) // 8, "big")


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
