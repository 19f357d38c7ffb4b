"""Small videos for tests."""

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
