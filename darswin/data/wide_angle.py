"""A data set of wide-angle images, made from ordinary pictures as it is read."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from darswin.data.lenses import LensDistribution
from darswin.data.sources import Source
from darswin.data.warp import remap
from darswin.lens import Lens, Perspective
from darswin.lens.reprojection import OUTSIDE, radial_reprojection
from darswin.utils.image import BrokenImageError

# Per-channel statistics of ImageNet, in [0, 1].
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# The paper's pictures, 384 px wide, have a focal length of 9 px.
PAPER_FOV = 2 * math.atan(192 / 9)


@lru_cache(maxsize=256)
def _camera(fov: float, side: int) -> Perspective:
    """What a square picture was taken with."""
    return Perspective.from_fov(fov, side / 2)


@lru_cache(maxsize=4)
def _rays(side: int) -> tuple[Tensor, np.ndarray, np.ndarray]:
    """The different radii (1, K) of a square's pixels, which one each pixel has, and its offset."""
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    square, place = np.unique(x * x + y * y, return_inverse=True)
    radii = torch.from_numpy(np.sqrt(square)).to(torch.float32).clamp(min=1e-6)
    return radii[None], place.reshape(side, side), np.stack((x, y), -1).astype(np.float32)


class Draw(NamedTuple):
    """Which image, and which random numbers: all that a sample depends on.

    `epoch` and `picture` key its augmentation, `epoch` and `lens` its lens.
    """

    epoch: int
    picture: int
    lens: int


class WideAngle(Dataset):
    """Pictures seen through random lenses: `dataset[i]` is (image, lens, label).

    Each picture is taken for a perspective view whose width spans `fov`. It is warped through a
    lens whose circle, of the same field of view, touches the image's sides, at `render` pixels, and
    reduced to `size` by averaging areas. Beyond the field of view it is black.

    A sample depends on the seed and its `Draw` alone, not on what was read before: `dataset[i]`
    means `dataset[Draw(0, i, i)]`, always the same image through the same lens.

    Args:
        source: the pictures. lenses: the distribution of lenses.
        size: px, H = W of the images. render: px, what they are reduced from; at least `size`.
        fov: rad, the full field of view, below π.
        fit: how a picture becomes a square: "crop" cuts its longer side, "stretch" squashes it, as
            the authors' code does.
        picture_size: px, the width that larger pictures are reduced to before they are warped.
        mean, std: per channel, in [0, 1]; the image comes out as (pixel/255 - mean) / std.
        augment: changes the warped (H, W, C) uint8 image, given it and a random generator.
        erase: changes the normalised (C, H, W) float32 image, likewise.
        seed: of everything random.
        skip_broken: makes a picture that cannot be read a black image with label -1, and counts it
            in `broken`, instead of raising.

    Making one sets OpenCV to one thread, in all of the process.

    Raises:
        ValueError: sizes or angles out of range.
        BrokenImageError: from `dataset[i]`, naming a file that cannot be read.

    Source: DarSwin, ICCV 2023, sec. 5.1.
    """

    def __init__(
        self,
        source: Source,
        lenses: LensDistribution,
        *,
        size: int = 64,
        render: int = 224,
        fov: float = PAPER_FOV,
        fit: Literal["crop", "stretch"] = "crop",
        picture_size: int = 384,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        augment: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None,
        erase: Callable[[np.ndarray, np.random.Generator], np.ndarray] | None = None,
        seed: int = 0,
        skip_broken: bool = False,
    ):
        if not 0 < size <= render:
            raise ValueError(f"sizes must be 0 < size ≤ render, got {size} and {render}")
        if not 0 < fov < math.pi:
            raise ValueError(f"fov must be in (0, π), got {fov}")
        if fit not in ("crop", "stretch"):
            raise ValueError(f"fit must be 'crop' or 'stretch', got {fit!r}")
        self.source, self.lenses = source, lenses
        self.size, self.render, self.picture_size = size, render, picture_size
        self.fov, self.fit = fov, fit
        self.mean = np.asarray(mean, np.float32)[:, None, None]
        self.std = np.asarray(std, np.float32)[:, None, None]
        self.augment, self.erase, self.seed = augment, erase, seed
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

    def __getitem__(self, draw: Draw | int) -> tuple[Tensor, Lens, int]:
        if not isinstance(draw, Draw):
            draw = Draw(0, int(draw), int(draw))
        lens = self.lenses.draw(self._random(draw.epoch, draw.lens, 1), self.fov, self.size / 2)
        try:
            picture, label = self.source[draw.picture]
        except BrokenImageError:
            if not self.skip_broken:
                raise
            self._broken[draw.picture] = True
            black = torch.from_numpy(-self.mean / self.std)
            return black.expand(-1, self.size, self.size).clone(), lens, -1
        rng = self._random(draw.epoch, draw.picture, 0)
        image = self.through(lens, picture)
        if self.augment:
            image = self.augment(image, rng)
        image = (image.transpose(2, 0, 1) * np.float32(1 / 255) - self.mean) / self.std
        if self.erase:
            image = self.erase(image, rng)
        return torch.from_numpy(np.ascontiguousarray(image)), lens, label

    def _random(self, epoch: int, key: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, epoch, key, purpose))

    def through(self, lens: Lens, picture: np.ndarray) -> np.ndarray:
        """The picture (H, W, C) uint8 through a lens of this data set → (size, size, C) uint8."""
        picture = self._square(picture)
        image = remap(picture, self._map(lens, picture.shape[0]))
        if self.render != self.size:
            image = cv2.resize(image, (self.size, self.size), interpolation=cv2.INTER_AREA)
        return image.reshape(self.size, self.size, -1)

    def _map(self, lens: Lens, side: int) -> np.ndarray:
        """(render, render, 2): where in a picture of `side` px each pixel of the lens's image lies.

        An image has an eighth as many radii as pixels, and only radii need the lens's curve.
        """
        radii, place, offset = _rays(self.render)
        large = lens.resized(self.render / self.size)
        ratio = radial_reprojection(_camera(self.fov, side), large, radii)[0].numpy()[place]
        places = offset * ratio[..., None] + np.float32((side - 1) / 2)
        return np.fmax(places, np.float32(OUTSIDE), out=places)  # NaN becomes OUTSIDE

    def _square(self, picture: np.ndarray) -> np.ndarray:
        height, width = picture.shape[:2]
        if self.fit == "crop":
            side = min(height, width)
            top, left = (height - side) // 2, (width - side) // 2
            picture = picture[top : top + side, left : left + side]
        side = min(max(picture.shape[:2]), self.picture_size)
        if picture.shape[:2] == (side, side):
            return np.ascontiguousarray(picture)
        return cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
