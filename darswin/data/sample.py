"""A picture, its target and its lens, which move together."""

from typing import NamedTuple

import numpy as np

from darswin.lens import Lens


class Sample(NamedTuple):
    """A picture with its target and its lens.

    Attributes:
        image: (H, W, C) uint8.
        target: (H, W), a label of each pixel, uint8 with `IGNORE`, or its distance, float32 metres
            along the ray with 0 for unknown; the id of the picture's class; or None.
        lens: one lens, with this image_size.
    """

    image: np.ndarray
    target: np.ndarray | int | None
    lens: Lens
