"""What a network says of every pixel, at the size of the picture that it was asked of."""

import cv2
import numpy as np

from darswin.data.frames import Fit, lens_at_size, part_of
from darswin.data.scenes.targets import IGNORE
from darswin.lens import Lens
from darswin.lens.pixels import pixel_angles


class FullSize:
    """Undoes `at_size` for what a network says of each pixel of pictures through one lens.

    Between the network's pixels it is bilinear, of those pixels alone that a ray reaches. Pixels of
    the picture that the network did not see, since "crop" cut them off, and those beyond θ_max have
    no label and no distance.

    Attributes:
        seen: (H, W), the pixels that have an answer.
        reached: (h, w), of the pixels that the network sees, those that a ray reaches.

    Args:
        lens: of the pictures, with their image_size. size, fit: as `at_size` had them.

    Raises:
        ValueError: a lens without an image_size, or several; an unknown `fit`.
    """

    def __init__(self, lens: Lens, size: int, fit: Fit):
        if lens.image_size is None or len(lens) != 1:
            raise ValueError("FullSize takes one lens, with the image_size of its pictures")
        lens = lens.detach().to("cpu")
        height, width = _size(lens)
        self._part = top, left, rows, columns = part_of((height, width), fit)
        self.reached = _reached(lens_at_size(lens, size, fit))
        self._weight = self._enlarged(self.reached)
        self.seen = np.zeros((height, width), bool)
        part = np.s_[top : top + rows, left : left + columns]
        self.seen[part] = _reached(lens)[part] & (self._weight > 0)

    def labels(self, logits: np.ndarray) -> np.ndarray:
        """The classes with the largest logits.

        Args:
            logits: (K, h, w) of the pictures as the network sees them, of at most 255 classes.

        Returns:
            (H, W) uint8: ids, `IGNORE` where there is no answer.
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
        """Distances, whose logarithm is what is bilinear.

        Args:
            distance: (h, w), m, above 0 where a ray reaches.

        Returns:
            (H, W) float32, m: 0 where there is no answer.
        """
        logarithm = np.log(np.where(self.reached, distance, 1))
        weight = np.where(self._weight > 0, self._weight, 1)
        return self._in_picture(np.exp(self._weighted(logarithm) / weight), 0.0)

    def _weighted(self, values: np.ndarray) -> np.ndarray:
        """Values (h, w) at the pixels that `at_size` took, times how much of them a ray reaches."""
        return self._enlarged(np.where(self.reached, values, 0))

    def _enlarged(self, values: np.ndarray) -> np.ndarray:
        _, _, height, width = self._part
        return cv2.resize(
            values.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR
        )

    def _in_picture(self, values: np.ndarray, missing: float) -> np.ndarray:
        top, left, height, width = self._part
        whole = np.full(self.seen.shape, missing, values.dtype)
        whole[top : top + height, left : left + width] = values
        whole[~self.seen] = missing
        return whole


def _reached(lens: Lens) -> np.ndarray:
    """The pixels of a lens's pictures that a ray reaches, (H, W)."""
    return ~pixel_angles(lens, _size(lens))[0].isnan().numpy()


def _size(lens: Lens) -> tuple[int, int]:
    height, width = lens.image_size[0].tolist()
    return round(height), round(width)
