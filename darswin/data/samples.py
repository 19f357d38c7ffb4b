"""What the data sets of images with lenses share: a sample's random numbers and its form."""

from collections.abc import Callable, Sequence, Sized
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from darswin.data.turning import RandomTurns, Turn
from darswin.lens import Lens
from darswin.utils.image import BrokenImageError

# Per-channel statistics of ImageNet, in [0, 1].
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

Augmentation = Callable[[np.ndarray, np.random.Generator], np.ndarray]


class Draw(NamedTuple):
    """Which image, and which random numbers: all that a sample depends on.

    `epoch` and `picture` key its augmentation, `epoch` and `lens` its lens and its turn.
    """

    epoch: int
    picture: int
    lens: int


class Samples(Dataset):
    """Base of the data sets: `dataset[i]` is (image, lens, label). A data set defines `_seen`.

    A sample depends on the seed and its `Draw` alone, not on what was read before: `dataset[i]`
    means `dataset[Draw(0, i, i)]`.

    Args:
        source: the pictures, which a data set reads.
        size: px, H = W of the images.
        mean, std: per channel, in [0, 1]; the image comes out as (pixel/255 - mean) / std.
        turns: of the images with their lenses; None is none.
        augment: changes the (H, W, C) uint8 image, given it and a random generator.
        erase: changes the normalised (C, H, W) float32 image, likewise.
        seed: of everything random.
        skip_broken: makes a picture that cannot be read a black image with label -1 (or, where a
            label is one of each pixel, that of none), and counts it in `broken`, instead of
            raising.

    Making one sets OpenCV to one thread, in all of the process.

    Raises:
        BrokenImageError: from `dataset[i]`, naming a file that cannot be read.
    """

    def __init__(
        self,
        source: Sized,
        *,
        size: int = 64,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        turns: RandomTurns | None = None,
        augment: Augmentation | None = None,
        erase: Augmentation | None = None,
        seed: int = 0,
        skip_broken: bool = False,
    ):
        self.source, self.size = source, size
        self.mean = np.asarray(mean, np.float32)[:, None, None]
        self.std = np.asarray(std, np.float32)[:, None, None]
        self.turns, self.augment, self.erase, self.seed = turns, augment, erase, seed
        self.skip_broken = skip_broken
        # A DataLoader's workers are forks, and OpenCV's threads do not survive a fork: a worker
        # that waits for them hangs. Images this small gain nothing from them.
        cv2.setNumThreads(1)
        # Shared, so that what worker processes find is seen here.
        self._broken = torch.zeros(len(source), dtype=torch.bool).share_memory_()

    def __len__(self) -> int:
        return len(self.source)

    @property
    def broken(self) -> list[int]:
        """Indices of the pictures that could not be read so far."""
        return self._broken.nonzero().flatten().tolist()

    def __getitem__(self, draw: Draw | int) -> tuple[Tensor, Lens, int | Tensor]:
        if not isinstance(draw, Draw):
            draw = Draw(0, int(draw), int(draw))
        try:
            image, lens, label = self._seen(draw)
        except BrokenImageError:
            if not self.skip_broken:
                raise
            self._broken[draw.picture] = True
            black = torch.from_numpy(-self.mean / self.std)
            black = black.expand(-1, self.size, self.size).clone()
            return black, self._lens_alone(draw), self._unknown()
        rng = self._random(draw.epoch, draw.picture, 0)
        if self.augment:
            image = self.augment(image, rng)
        image = (image.transpose(2, 0, 1) * np.float32(1 / 255) - self.mean) / self.std
        if self.erase:
            image = self.erase(image, rng)
        return torch.from_numpy(np.ascontiguousarray(image)), lens, label

    def _random(self, epoch: int, key: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, epoch, key, purpose))

    def _turn(self, draw: Draw) -> Turn | None:
        return self.turns.draw(self._random(draw.epoch, draw.lens, 2)) if self.turns else None

    def _seen(self, draw: Draw) -> tuple[np.ndarray, Lens, int | Tensor]:
        """The image (size, size, C) uint8 of a draw before augmentation, its lens and its label."""
        raise NotImplementedError

    def _lens_alone(self, draw: Draw) -> Lens:
        """A lens for a picture that cannot be read."""
        raise NotImplementedError

    def _unknown(self) -> int | Tensor:
        """The label of a picture that cannot be read."""
        return -1
