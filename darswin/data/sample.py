"""A picture, its target and its lens, which move together."""

from typing import NamedTuple

import numpy as np

from darswin.data.labels.labels import Labels
from darswin.lens import Lens


class Sample(NamedTuple):
    """A picture with its target and its lens.

    The image is (H, W, C) uint8, and the lens is one lens with this image_size. The target is the
    label of each pixel, (H, W) uint8 with `IGNORE`; or its distance along the ray, (H, W) float32
    metres with 0 for unknown; or the things in the picture; or the id of its class; or None.
    """

    image: np.ndarray
    target: np.ndarray | Labels | int | None
    lens: Lens
