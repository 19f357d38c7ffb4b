"""Augmentation: RandAugment without its geometric operations, random erasing, mixup and CutMix.

Augmentation may change the colours of an image but not its geometry: otherwise its lens would be
wrong.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageEnhance, ImageOps
from torch import Tensor

from darswin.lens import Lens
from darswin.ops.checks import readable

LARGEST = 10  # the largest magnitude
# An operation takes a picture, a magnitude and a random generator.
Operation = Callable[[Image.Image, float, np.random.Generator], Image.Image]


def _enhance(kind: type) -> Operation:
    def enhance(image: Image.Image, magnitude: float, rng: np.random.Generator) -> Image.Image:
        change = 0.9 * magnitude / LARGEST
        return kind(image).enhance(max(0.1, 1 + (change if rng.random() < 0.5 else -change)))

    return enhance


def _solarize_add(image: Image.Image, add: int) -> Image.Image:
    """Brightens dark pixels."""
    table = [min(255, value + add) if value < 128 else value for value in range(256)]
    return image.point(table * len(image.getbands()))


# A larger magnitude makes a stronger change ("increasing").
OPERATIONS: dict[str, Operation] = {
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


class RandAugment:
    """Applies a few random changes of colour, each with a random strength.

    It draws `count` operations from `OPERATIONS` with replacement. Each is applied with probability
    `p` at a magnitude from N(magnitude, deviation), clipped to [0, 10]. This is timm's
    `rand-m9-mstd0.5-inc1` without Rotate, Shear and Translate.

    Source: Cubuk et al., RandAugment, 2020; the recipe of DarSwin, ICCV 2023, sec. 5.2.
    """

    def __init__(
        self, count: int = 2, magnitude: float = 9.0, deviation: float = 0.5, p: float = 0.5
    ):
        self.count, self.magnitude, self.deviation, self.p = count, magnitude, deviation, p

    def __call__(self, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The changed picture (H, W, 3 or 1) uint8."""
        picture = Image.fromarray(image[..., 0] if image.shape[2] == 1 else image)
        operations = list(OPERATIONS.values())
        for chosen in rng.integers(len(operations), size=self.count):
            if rng.random() < self.p:
                magnitude = float(np.clip(rng.normal(self.magnitude, self.deviation), 0, LARGEST))
                picture = operations[chosen](picture, magnitude, rng)
        return np.asarray(picture).reshape(image.shape)


class RandomErasing:
    """With probability p, replaces a random box of a normalised image by noise N(0, 1).

    The share of the area is uniform in `AREA`, and the aspect ratio is log-uniform in `ASPECT`. If
    ten boxes do not fit, the image stays as it is.

    Source: Zhong et al., Random Erasing, 2020, in timm's "pixel" mode.
    """

    AREA, ASPECT = (0.02, 1 / 3), (0.3, 1 / 0.3)

    def __init__(self, p: float = 0.25):
        self.p = p

    def __call__(self, image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The image (C, H, W) float32, changed in place."""
        if rng.random() >= self.p:
            return image
        channels, height, width = image.shape
        for _ in range(10):
            area = rng.uniform(*self.AREA) * height * width
            aspect = math.exp(rng.uniform(math.log(self.ASPECT[0]), math.log(self.ASPECT[1])))
            h, w = round(math.sqrt(area * aspect)), round(math.sqrt(area / aspect))
            if h < height and w < width:
                top, left = rng.integers(height - h + 1), rng.integers(width - w + 1)
                noise = rng.standard_normal((channels, h, w), dtype=np.float32)
                image[:, top : top + h, left : left + w] = noise
                break
        return image


@dataclass(frozen=True)
class Mixing:
    """Mixup and CutMix of a batch of images and their labels.

    Each image is mixed with its partner, the image at its place in the reversed batch. λ is drawn
    once for a batch, from Beta(α, α). Mixup adds λ of the image and 1 - λ of its partner. CutMix
    puts a box of the partner into the image and sets λ to the remaining area.

    Args:
        mixup, cutmix: α of each method; 0 turns it off. With both, each gets half of the batches.
        p: the share of batches that are mixed.

    Source: Zhang et al., mixup, 2018; Yun et al., CutMix, 2019; timm's "batch" mode.
    """

    mixup: float = 0.8
    cutmix: float = 1.0
    p: float = 1.0

    def __post_init__(self) -> None:
        if self.mixup < 0 or self.cutmix < 0 or not 0 <= self.p <= 1:
            raise ValueError(f"mixing needs mixup ≥ 0, cutmix ≥ 0 and p in [0, 1], got {self}")

    def __call__(
        self,
        images: Tensor,
        targets: Tensor,
        rng: np.random.Generator,
        may_mix: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Mixed images (B, C, H, W) and class probabilities (B, K).

        Images for which `may_mix`, (B,) bool, is False stay as they are; None mixes all.
        """
        if not (self.mixup or self.cutmix) or rng.random() >= self.p:
            return images, targets
        partners = images.flip(0)
        cut = rng.random() < 0.5 if self.mixup and self.cutmix else self.cutmix > 0
        if cut:
            share = rng.beta(self.cutmix, self.cutmix)
            top, bottom, left, right = _box(images.shape[2], images.shape[3], share, rng)
            mixed = images.clone()
            mixed[..., top:bottom, left:right] = partners[..., top:bottom, left:right]
            area = (bottom - top) * (right - left)
            share = 1 - area / (images.shape[2] * images.shape[3])
        else:
            share = rng.beta(self.mixup, self.mixup)
            mixed = torch.lerp(partners, images, share)
        mixed_targets = torch.lerp(targets.flip(0), targets, share)
        if may_mix is None or (readable(may_mix) and bool(may_mix.all())):
            return mixed, mixed_targets
        return (
            torch.where(may_mix[:, None, None, None], mixed, images),
            torch.where(may_mix[:, None], mixed_targets, targets),
        )


def partners_share(lens: Lens) -> Tensor:
    """True for each image of a batch whose partner has the same lens, (B,) bool."""
    tensors = (getattr(lens, name) for name in lens.names)
    same = [(t == t.flip(0)).reshape(len(t), -1).all(1) for t in tensors if t is not None]
    return torch.stack(same).all(0)


def _box(
    height: int, width: int, share: float, rng: np.random.Generator
) -> tuple[int, int, int, int]:
    """The top, bottom, left and right of a box of 1 - share of the area, cut at the border."""
    side = math.sqrt(1 - share)
    h, w = int(height * side), int(width * side)
    y, x = int(rng.integers(height)), int(rng.integers(width))
    top, bottom = max(y - h // 2, 0), min(y + h // 2, height)
    return top, bottom, max(x - w // 2, 0), min(x + w // 2, width)
