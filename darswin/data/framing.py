"""The sizes of pictures: at a model's size, and back."""

import math
from typing import NamedTuple, get_args

import cv2
import numpy as np
import torch

from darswin.lens import Lens
from darswin.lens.pixels import pixel_angles
from darswin.utils.parameters import check
from darswin.utils.tasks import IGNORE, Fit
from darswin.utils.words import in_px
from darswin.views import CropView, Remap
from darswin.views.base import Pair
from darswin.views.camera import picture_size
from darswin.views.crop import Part


def fitted(picture: Pair, size: int, fit: Fit) -> CropView:
    """The view that gives pictures of (H, W) a model's `size`, px.

    Args:
        fit: "crop" cuts the longer side, "stretch" squashes it, and "whole" keeps the aspect ratio
            and gives the shorter side the size.

    Raises:
        ValueError: an unknown `fit`.
    """
    part = taken_part(picture, fit)
    return CropView(part, size_of_part(part, size, fit))


class Crop(NamedTuple):
    """A part of a picture: the share of its sides, and its place, as shares of the space that is
    left across and down."""

    share: float
    across: float
    down: float


def taken_part(size: tuple[int, ...], fit: Fit, crop: Crop | None = None) -> Part:
    """The part of a picture (H, W) that is kept."""
    check("fit", repr(fit), fit in get_args(Fit), f"one of {', '.join(get_args(Fit))}")
    height, width = (min(size),) * 2 if fit == "crop" else size
    if crop is None:
        return (size[0] - height) // 2, (size[1] - width) // 2, height, width
    height, width = (max(1, round(crop.share * side)) for side in (height, width))
    top, left = round(crop.down * (size[0] - height)), round(crop.across * (size[1] - width))
    return top, left, height, width


def size_of_part(part: Part, size: int, fit: Fit) -> tuple[int, int]:
    """(H, W) of a part at a model's size."""
    height, width = part[2:]
    if fit != "whole":
        return size, size
    scale = size / min(height, width)
    return round(height * scale), round(width * scale)


def cut_off(size: tuple[int, int], lens: Lens | None, fit: Fit) -> str | None:
    """What a fit cuts off pictures of (H, W), in words; None if nothing is lost.

    Args:
        lens: the lens of the pictures, with this image_size. The text then names the angles that
            are lost, and pixels that no ray reaches do not count. None means that it is unknown.
    """
    top, left, height, width = taken_part(size, fit)
    if (height, width) == size:
        return None
    theta = np.zeros(size) if lens is None else _angles(lens)
    cut = np.ones(size, bool)
    cut[top : top + height, left : left + width] = False
    lost = theta[cut & np.isfinite(theta)]
    if not lost.size:
        return None
    ends = (("left", left, "right", size[1] - width - left),
            ("top", top, "bottom", size[0] - height - top))  # fmt: skip
    parts = [
        f"{a} px at the {one} and {b} px at the {other}" for one, a, other, b in ends if a or b
    ]
    share = 100 * lost.size / np.isfinite(theta).sum()
    text = f"{' and '.join(parts)} of pictures of {in_px(size)}"
    if lens is None:
        return f"{text} ({share:.2g} % of their pixels)"
    first, last = (f"{math.degrees(angle):.0f}°" for angle in (lost.min(), lost.max()))
    return f"{text} ({share:.2g} % of what their lens sees, from {first} to {last} off its axis)"


# -- and back ----------------------------------------------------------------------------------


class FullSize:
    """Brings a network's answers for each pixel back to the size of the pictures of one lens.

    It undoes `fitted`, with bilinear interpolation between those pixels of the network that a ray
    reaches. Pixels that "crop" cut off, pixels beyond θ_max, and those that the model's view does
    not show, have no label and no distance.

    Attributes:
        seen: (H, W), True for pixels that have an answer.
        reached: (h, w), True for pixels of the network that have an answer.

    Args:
        remap: `fitted(…).at(lens, (H, W))`, of one lens.
        shown: (1, h, w), the pixels that the model's view shows, as the model prepares it. None
            means that it shows all that the lens sees.
    """

    def __init__(self, remap: Remap, shown: torch.Tensor | None = None):
        assert isinstance(remap.view, CropView) and remap.camera is not None
        top, left, self._height, self._width = remap.view.part
        self._part = np.s_[top : top + self._height, left : left + self._width]
        self.reached = ~np.isnan(_angles(remap.camera))
        near = self._enlarged(self.reached)
        if shown is not None:
            self.reached &= shown.cpu().numpy().reshape(self.reached.shape)
        self._weight = self._enlarged(self.reached)
        reached = ~np.isnan(pixel_angles(remap.some_lens, remap.size)[0].numpy())
        self.seen = np.zeros_like(reached)
        # Pixels that the lens sees, and of which the view shows more than a half.
        self.seen[self._part] = reached[self._part] & (self._weight > 0.5 * near)

    def labels(self, logits: np.ndarray) -> np.ndarray:
        """The classes with the largest logits.

        Args:
            logits: (K, h, w), the output of the network, for at most 255 classes.

        Returns:
            (H, W) uint8: ids, or `IGNORE` without an answer.
        """
        best = self._weighted(logits[0])
        labels = np.zeros(best.shape, np.uint8)
        for k, map_of_class in enumerate(logits[1:], 1):
            here = self._weighted(map_of_class)
            larger = here > best
            np.copyto(best, here, where=larger)
            labels[larger] = k
        return self._in_picture(labels, IGNORE)

    def distance(self, distance: np.ndarray) -> np.ndarray:
        """Distances; their logarithms are interpolated.

        Args:
            distance: (h, w), m, above 0 for pixels that a ray reaches and the view shows.

        Returns:
            (H, W) float32, m; 0 without an answer.
        """
        metres = np.exp(self.values(np.log(np.where(self.reached, distance, 1))))
        return np.where(self.seen, metres, np.float32(0))

    def values(self, values: np.ndarray) -> np.ndarray:
        """Any values (h, w), interpolated linearly: (H, W) float32, 0 without an answer."""
        weight = np.where(self._weight > 0, self._weight, 1)
        return self._in_picture(self._weighted(values) / weight, 0)

    def _weighted(self, values: np.ndarray) -> np.ndarray:
        """Values (h, w) at the pixels that `fitted` kept, times the share that a ray reaches."""
        return self._enlarged(np.where(self.reached, values, 0))

    def _enlarged(self, values: np.ndarray) -> np.ndarray:
        size = self._width, self._height
        return cv2.resize(values.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)

    def _in_picture(self, values: np.ndarray, missing: float) -> np.ndarray:
        whole = np.full(self.seen.shape, missing, values.dtype)
        whole[self._part] = values
        whole[~self.seen] = missing
        return whole


def _angles(lens: Lens) -> np.ndarray:
    """θ of the pixels of one lens, (H, W), rad; NaN where no ray lands."""
    return pixel_angles(lens.detach().to("cpu"), picture_size(lens))[0].numpy()
