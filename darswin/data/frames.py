"""Pictures that a calibrated camera took, brought to a model's size, and their lens with them."""

from typing import Literal, get_args

import cv2
import numpy as np

from darswin.lens import Lens

# "crop" cuts the longer side, "stretch" squashes it; "whole" keeps the picture's shape, and its
# shorter side gets the size.
Fit = Literal["crop", "stretch", "whole"]


def at_size(image: np.ndarray, lens: Lens, size: int, fit: Fit) -> tuple[np.ndarray, Lens]:
    """A picture (H, W, C) uint8 and its lens as a model of `size` px sees them.

    Args:
        lens: with the picture's image_size. fit: how the picture gets that size.

    Returns:
        (size, size, C) uint8, or as high and wide as "whole" makes it, and `lens_at_size`.

    Raises:
        ValueError: an unknown `fit`.
    """
    top, left, height, width = part_of(image.shape[:2], fit)
    new_height, new_width = _new_size(height, width, size, fit)
    part = image[top : top + height, left : left + width]
    return area_resized(part, (new_height, new_width)), lens_at_size(lens, size, fit)


def area_resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture (H, W, C) at another (H, W), each pixel the mean over its area.

    An axis that becomes shorter is resized before one that becomes longer. OpenCV takes areas only
    if no axis becomes longer; otherwise it shifts an axis that becomes much shorter by up to a
    third of a new pixel.
    """
    height, width = size
    less = min(image.shape[1], width), min(image.shape[0], height)
    for sides in dict.fromkeys((less, (width, height))):
        image = cv2.resize(image, sides, interpolation=cv2.INTER_AREA)
    return image.reshape(height, width, -1)


def lens_at_size(lens: Lens, size: int, fit: Fit) -> Lens:
    """The lens of a picture after `at_size`; exact, also where its pixels become oblong.

    Args:
        lens: one that has an image_size.
    """
    if lens.image_size is None:
        raise ValueError("a lens that follows its picture needs an image_size")
    part = part_of(tuple(round(side) for side in lens.image_size[0].tolist()), fit)
    if fit == "crop":
        lens = lens.cropped(*part)
    return lens.resized(_new_size(*part[2:], size, fit))


def part_of(size: tuple[int, ...], fit: Fit) -> tuple[int, int, int, int]:
    """What is taken of a picture: top, left, height, width."""
    if fit not in get_args(Fit):
        raise ValueError(f"fit must be one of {', '.join(get_args(Fit))}, got {fit!r}")
    height, width = size
    if fit != "crop":
        return 0, 0, height, width
    side = min(height, width)
    return (height - side) // 2, (width - side) // 2, side, side


def _new_size(height: int, width: int, size: int, fit: Fit) -> tuple[int, int]:
    if fit != "whole":
        return size, size
    scale = size / min(height, width)
    return round(height * scale), round(width * scale)
