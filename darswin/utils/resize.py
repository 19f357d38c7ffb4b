"""Pictures at another size."""

import cv2
import numpy as np


def area_resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture (H, W, C) at another size (H, W); each pixel is the mean over its area."""
    height, width = size
    if image.ndim > 2 and image.shape[2] > 4:  # more than OpenCV takes
        fours = (image[..., k : k + 4] for k in range(0, image.shape[2], 4))
        return np.concatenate([area_resized(part, size) for part in fours], -1)
    # An axis that becomes shorter is resized before one that becomes longer. OpenCV averages areas
    # only if no axis becomes longer. Otherwise it shifts an axis that becomes much shorter by up to
    # a third of a new pixel.
    less = min(image.shape[1], width), min(image.shape[0], height)
    for sides in dict.fromkeys((less, (width, height))):
        image = cv2.resize(image, sides, interpolation=cv2.INTER_AREA)
    return image.reshape(height, width, -1)
