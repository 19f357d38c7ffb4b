"""Frames of a fisheye camera: scanned digits, warped through a calibration of tests/lens/files."""

import os
from pathlib import Path

import cv2
import numpy as np
from sklearn.datasets import load_digits

from darswin.data import warp
from darswin.lens import Lens, Perspective, load

CALIBRATIONS = Path(__file__).parent / "lens" / "files"
WOODSCAPE = CALIBRATIONS / "woodscape.json"
FOV = 2.8  # rad, that a digit's width spans


def taken_with(lens: Lens, digit: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A digit (8, 8) of 0 to 16 as a lens in a picture of (H, W) shows it."""
    picture = cv2.resize((digit * (255 / 16)).astype(np.uint8), (96, 96))
    return warp(picture, Perspective.from_fov(FOV, 48), lens.in_picture(size), size)


def write_frames(
    folder: Path,
    calibration: str | os.PathLike = WOODSCAPE,
    count: int = 60,
    size: tuple[int, int] = (121, 160),
    classes: str = "0123456789",
) -> Path:
    """The first `count` digits of some classes as frames, in one folder a class."""
    digits, lens = load_digits(), load(calibration)
    chosen = [k for k, label in enumerate(digits.target) if str(label) in classes][:count]
    for k in chosen:
        file = folder / str(digits.target[k]) / f"{k}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), taken_with(lens, digits.images[k], size))
    return folder
