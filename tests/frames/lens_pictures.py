"""Frames of a fisheye camera: scanned digits, warped through a calibration of tests/lens/files."""

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from sklearn.datasets import load_digits

from darswin.data import fitted
from darswin.lens import Lens, Perspective, load
from darswin.utils.tasks import Fit
from darswin.views import CameraView

CALIBRATIONS = Path(__file__).parents[1] / "lens" / "files"
WOODSCAPE = CALIBRATIONS / "woodscape.json"
FOV = 2.8  # rad, that a digit's width spans


def write_frames(
    folder: Path,
    calibration: str | os.PathLike = WOODSCAPE,
    count: int = 60,
    size: tuple[int, int] = (121, 160),
    classes: str = "0123456789",
) -> Path:
    """The first `count` digits of some classes as frames, in one folder a class."""
    digits, lens = load_digits(), load(calibration).in_picture(size)
    remap = CameraView(lens, size, supersampling=1).at(Perspective.from_fov(FOV, 48), (96, 96))
    chosen = [k for k, label in enumerate(digits.target) if str(label) in classes][:count]
    for k in chosen:
        file = folder / str(digits.target[k]) / f"{k}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        picture = (digits.images[k] * (255 / 16)).astype(np.uint8)
        cv2.imwrite(str(file), remap(cv2.resize(picture, (96, 96))))
    return folder


def at_size(image: np.ndarray, lens: Lens, size: int, fit: Fit) -> tuple[np.ndarray, Lens]:
    """A picture and its lens at a model's size."""
    remap = fitted(image.shape[:2], size, fit).at(lens, image.shape[:2])
    return remap(image), remap.camera


def warped(image: np.ndarray, own: Lens, lens: Lens, size: tuple[int, int]) -> np.ndarray:
    """A picture as another lens had seen it, by OpenCV and the formulas of the lenses."""
    y, x = np.mgrid[: size[0], : size[1]]
    rays = lens.to(torch.float64).unproject_points(
        torch.from_numpy(np.stack((x, y), -1)[None]), size
    )
    there = own.to(torch.float64).project_points(rays, image.shape[:2])[0].nan_to_num(-10.0)
    return cv2.remap(image, there.float().numpy(), None, cv2.INTER_LINEAR)


def blob(at: Sequence[float], size: tuple[int, int], width: float) -> np.ndarray:
    """A grey picture (H, W, 1) of a bright spot around (x, y)."""
    y, x = np.mgrid[: size[0], : size[1]]
    spot = np.exp(-((x - float(at[0])) ** 2 + (y - float(at[1])) ** 2) / (2 * width**2))
    return (250 * spot).astype(np.uint8)[..., None]


def centroid(image: np.ndarray) -> torch.Tensor:
    """(x, y) of the middle of what is bright."""
    weight = image[..., 0].astype(float)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    middle = np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()
    return torch.from_numpy(middle).float()
