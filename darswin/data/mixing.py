"""Mixup and CutMix: batches whose images are mixtures of two, and so are their labels."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.ops.checks import readable


@dataclass(frozen=True)
class Mixing:
    """Mixes each image of a batch with its partner, that of the reversed batch, by mixup or CutMix.

    One λ for a whole batch: from Beta(α, α) of mixup's or CutMix's α. Mixup takes λ of the image
    and 1 - λ of its partner, CutMix puts a box of the partner into it and corrects λ to the box's
    area.

    Args:
        mixup, cutmix: α of each; 0 turns it off. With both, each has half of the batches.
        p: the share of batches that are mixed.

    Source: Zhang et al., mixup, 2018; Yun et al., CutMix, 2019; timm's "batch" mode.
    """

    mixup: float = 0.8
    cutmix: float = 1.0
    p: float = 1.0

    def __post_init__(self) -> None:
        if self.mixup < 0 or self.cutmix < 0 or not 0 <= self.p <= 1:
            raise ValueError(f"mixing needs mixup, cutmix ≥ 0 and p in [0, 1], got {self}")

    def __call__(
        self,
        images: Tensor,
        targets: Tensor,
        rng: np.random.Generator,
        may_mix: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Images (B, C, H, W) and class probabilities (B, K) → mixed, of the same shapes.

        Where `may_mix`, (B,) bool, is False, an image stays as it is; None is True for all.
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
    """(B,) bool: whether an image of a batch and its partner have the same lens."""
    tensors = (getattr(lens, name) for name in lens._names())
    same = [(t == t.flip(0)).reshape(len(t), -1).all(1) for t in tensors if t is not None]
    return torch.stack(same).all(0)


def _box(
    height: int, width: int, share: float, rng: np.random.Generator
) -> tuple[int, int, int, int]:
    """Top, bottom, left, right of a box of 1 - share of the area, cut off at the image's border."""
    side = math.sqrt(1 - share)
    h, w = int(height * side), int(width * side)
    y, x = int(rng.integers(height)), int(rng.integers(width))
    top, bottom = max(y - h // 2, 0), min(y + h // 2, height)
    return top, bottom, max(x - w // 2, 0), min(x + w // 2, width)
