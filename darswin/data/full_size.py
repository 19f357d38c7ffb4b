"""What a network says of every pixel, at the size of the picture that it was asked of."""

import cv2
import numpy as np

from darswin.data.frames import Fit, part_of
from darswin.data.scenes.targets import IGNORE
from darswin.lens import Lens
from darswin.lens.pixels import pixel_angles


class FullSize:
    """Undoes `at_size` for what a network says of each pixel of pictures through one lens.

    Pixels that the network did not see, since "crop" cut them off, and those beyond θ_max have no
    label and no distance.

    Attributes:
        seen: (H, W), the pixels that have an answer.

    Args:
        lens: of the pictures, with their image_size. fit: as `at_size` had it.

    Raises:
        ValueError: a lens without an image_size, or several; an unknown `fit`.
    """

    def __init__(self, lens: Lens, fit: Fit):
        if lens.image_size is None or len(lens) != 1:
            raise ValueError("pictures through one lens with an image_size are meant")
        height, width = (round(side) for side in lens.image_size[0].tolist())
        self._part = top, left, rows, columns = part_of((height, width), fit)
        inside = ~pixel_angles(lens.detach(), (height, width))[0].isnan().cpu().numpy()
        self.seen = np.zeros_like(inside)
        part = np.s_[top : top + rows, left : left + columns]
        self.seen[part] = inside[part]

    def labels(self, logits: np.ndarray) -> np.ndarray:
        """The classes with the largest logits, which are bilinear between the network's pixels.

        Args:
            logits: (K, h, w), of at most 255 classes.

        Returns:
            (H, W) uint8: ids, `IGNORE` where there is no answer.
        """
        best = self._enlarged(logits[0])
        labels = np.zeros(best.shape, np.uint8)
        for k, map_of_class in enumerate(logits[1:], 1):
            here = self._enlarged(map_of_class)
            larger = here > best
            np.copyto(best, here, where=larger)
            labels[larger] = k
        return self._in_picture(labels, IGNORE)

    def distance(self, distance: np.ndarray) -> np.ndarray:
        """Distances in between the network's pixels, whose logarithm is bilinear.

        Args:
            distance: (h, w), m, above 0.

        Returns:
            (H, W) float32, m: 0 where there is no answer.
        """
        return self._in_picture(np.exp(self._enlarged(np.log(distance))), 0.0)

    def _enlarged(self, values: np.ndarray) -> np.ndarray:
        """Values (h, w) at the pixels that `at_size` took."""
        _, _, height, width = self._part
        values = np.ascontiguousarray(values, np.float32)
        return cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)

    def _in_picture(self, values: np.ndarray, missing: float) -> np.ndarray:
        top, left, height, width = self._part
        whole = np.full(self.seen.shape, missing, values.dtype)
        whole[top : top + height, left : left + width] = values
        whole[~self.seen] = missing
        return whole
