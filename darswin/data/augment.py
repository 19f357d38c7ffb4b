"""Augmentation of single images: RandAugment without its geometric operations, and random erasing.

An image seen through a known lens may change its colours but not its geometry, or the lens would be
wrong.
"""

import math
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageEnhance, ImageOps

LARGEST = 10  # the magnitude that the strongest form of an operation has


def _enhance(kind: type) -> Callable[[Image.Image, float, np.random.Generator], Image.Image]:
    def enhance(image: Image.Image, magnitude: float, rng: np.random.Generator) -> Image.Image:
        change = 0.9 * magnitude / LARGEST
        return kind(image).enhance(max(0.1, 1 + (change if rng.random() < 0.5 else -change)))

    return enhance


# The stronger the magnitude, the stronger the change ("increasing").
OPERATIONS: dict[str, Callable[[Image.Image, float, np.random.Generator], Image.Image]] = {
    "auto_contrast": lambda image, magnitude, rng: ImageOps.autocontrast(image),
    "equalize": lambda image, magnitude, rng: ImageOps.equalize(image),
    "invert": lambda image, magnitude, rng: ImageOps.invert(image),
    "posterize": lambda image, magnitude, rng: ImageOps.posterize(
        image, max(1, 4 - int(4 * magnitude / LARGEST))
    ),
    "solarize": lambda image, magnitude, rng: ImageOps.solarize(
        image, 256 - int(256 * magnitude / LARGEST)
    ),
    "solarize_add": lambda image, magnitude, rng: _solarize_add(
        image, min(128, int(110 * magnitude / LARGEST))
    ),
    "color": _enhance(ImageEnhance.Color),
    "contrast": _enhance(ImageEnhance.Contrast),
    "brightness": _enhance(ImageEnhance.Brightness),
    "sharpness": _enhance(ImageEnhance.Sharpness),
}


def _solarize_add(image: Image.Image, add: int, threshold: int = 128) -> Image.Image:
    """Brightens what is dark."""
    table = [min(255, value + add) if value < threshold else value for value in range(256)]
    return image.point(table * len(image.getbands()))


class RandAugment:
    """Applies a few random changes of colour, each with a random strength.

    Each of `count` operations is drawn from `OPERATIONS` with replacement, applied with probability
    `p`, at a magnitude of N(magnitude, deviation) clipped to [0, 10]: `rand-m9-mstd0.5-inc1` of
    timm without Rotate, Shear and Translate.

    Source: Cubuk et al., RandAugment, 2020; the recipe of DarSwin, ICCV 2023, sec. 5.2.
    """

    def __init__(
        self, count: int = 2, magnitude: float = 9.0, deviation: float = 0.5, p: float = 0.5
    ):
        self.count, self.magnitude, self.deviation, self.p = count, magnitude, deviation, p

    def __call__(self, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(H, W, 3 or 1) uint8 → the same shape."""
        picture = Image.fromarray(image[..., 0] if image.shape[2] == 1 else image)
        operations = list(OPERATIONS.values())
        for chosen in rng.integers(len(operations), size=self.count):
            if rng.random() < self.p:
                magnitude = float(np.clip(rng.normal(self.magnitude, self.deviation), 0, LARGEST))
                picture = operations[chosen](picture, magnitude, rng)
        return np.asarray(picture).reshape(image.shape)


class RandomErasing:
    """With probability p, replaces a random box of a normalised image by noise N(0, 1).

    The box has a share of the area uniform in `area` and an aspect ratio log-uniform in `aspect`;
    after ten that do not fit, the image stays as it is.

    Source: Zhong et al., Random Erasing, 2020, in timm's "pixel" mode.
    """

    def __init__(
        self,
        p: float = 0.25,
        area: tuple[float, float] = (0.02, 1 / 3),
        aspect: tuple[float, float] = (0.3, 1 / 0.3),
    ):
        self.p, self.area, self.aspect = p, area, aspect

    def __call__(self, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(C, H, W) float32, changed in place and returned."""
        if rng.random() >= self.p:
            return image
        channels, height, width = image.shape
        for _ in range(10):
            area = rng.uniform(*self.area) * height * width
            aspect = math.exp(rng.uniform(math.log(self.aspect[0]), math.log(self.aspect[1])))
            h, w = round(math.sqrt(area * aspect)), round(math.sqrt(area / aspect))
            if h < height and w < width:
                top, left = rng.integers(height - h + 1), rng.integers(width - w + 1)
                noise = rng.standard_normal((channels, h, w), dtype=np.float32)
                image[:, top : top + h, left : left + w] = noise
                break
        return image
