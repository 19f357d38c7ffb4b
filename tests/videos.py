"""Small videos for tests."""

import struct
from pathlib import Path

import cv2
import numpy as np


def write_video(
    path: Path, count: int, *, size: tuple[int, int] = (64, 96), rate: float = 10.0,
    codec: str = "mp4v",
) -> list[np.ndarray]:  # fmt: skip
    """Writes frames (H, W, 3), smooth and each unlike the others; returns them, RGB."""
    height, width = size
    y, x = np.mgrid[:height, :width]
    frames = []
    for k in range(count):
        red = 128 + 100 * np.sin(x / 15 + k / 3)
        green = 128 + 100 * np.cos(y / 12 + k / 5)
        frames.append(
            np.stack((red, green, np.full_like(red, 200 * k / count)), -1).astype(np.uint8)
        )
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    return frames


def turn_video(path: Path, degrees: int) -> None:
    """Makes the track header of an MP4 say that its frames are to be turned, clockwise."""
    content = bytearray(path.read_bytes())
    sine, cosine = {0: (0, 1), 90: (1, 0), 180: (0, -1), 270: (-1, 0)}[degrees]
    matrix = content.index(b"tkhd") + 4 + 40  # ISO/IEC 14496-12, 8.3.2: version 0
    assert struct.unpack_from(">9i", content, matrix)[0] == 1 << 16
    rows = [cosine << 16, sine << 16, 0, -sine << 16, cosine << 16, 0, 0, 0, 1 << 30]
    struct.pack_into(">9i", content, matrix, *rows)
    path.write_bytes(content)
