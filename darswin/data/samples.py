"""Data sets of images with lenses: their base, and pictures of calibrated cameras."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from darswin.data.cameras import Calibrations
from darswin.data.lens_distributions import LensDistribution
from darswin.data.pictures import Source
from darswin.data.reframing import warp_picture
from darswin.data.scenes.scene import Scenes
from darswin.data.warping import (
    Crop,
    Framing,
    RandomTurns,
    Turn,
    at_size,
    cut_off,
    lens_at_size,
    picture_size,
    turned_picture,
)
from darswin.lens import Lens
from darswin.utils.image import BrokenImageError, Header, read_header

# Per-channel statistics of ImageNet, in [0, 1].
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

# The share of a random lens's largest angle that is used, because its curve may have no end there.
_USED = 0.95
_LOOKED_AT = 32  # pictures of which a framing may cut something off

Augmentation = Callable[[np.ndarray, np.random.Generator], np.ndarray]


class Draw(NamedTuple):
    """The number of a picture, and the keys of the sample's random numbers."""

    epoch: int
    picture: int  # with the epoch, the key of the augmentation
    lens: int  # with the epoch, the key of the lens and the turn


class Samples(Dataset):
    """Base of the data sets, see `Calibrated`; subclasses define `_seen` and `_lens_alone`."""

    def __init__(
        self,
        source: Source | Scenes,
        *,
        size: int = 64,
        framing: Framing = "stretch",
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        turns: RandomTurns | None = None,
        lens_augmentation: LensDistribution | None = None,
        augment: Augmentation | None = None,
        erase: Augmentation | None = None,
        seed: int = 0,
        skip_broken: bool = False,
    ):
        if framing not in ("crop", "stretch"):
            raise ValueError(f"framing must be 'crop' or 'stretch', got {framing!r}")
        self.source, self.size, self.framing = source, size, framing
        self.mean = np.asarray(mean, np.float32)[:, None, None]
        self.std = np.asarray(std, np.float32)[:, None, None]
        self.turns, self.lens_augmentation = turns, lens_augmentation
        self.augment, self.erase, self.seed = augment, erase, seed
        self.skip_broken = skip_broken
        # OpenCV's threads do not survive a fork, so the forked workers of a DataLoader would hang.
        # Small images gain nothing from threads anyway.
        cv2.setNumThreads(1)
        # Shared with the worker processes.
        self._broken = torch.zeros(len(source), dtype=torch.bool).share_memory_()

    def __len__(self) -> int:
        return len(self.source)

    @property
    def broken(self) -> list[int]:
        """The indices of the pictures that could not be read so far."""
        return self._broken.nonzero().flatten().tolist()

    def cut_off(self) -> str | None:
        """What the framing cuts off the pictures, in words; None if nothing is lost.

        It looks at 32 pictures or a few more, and describes the first that loses something.
        """
        if self.framing != "crop":
            return None
        for index in range(0, len(self), max(1, len(self) // _LOOKED_AT)):
            try:
                lost = cut_off(*self._taken(index), "crop")
            except (OSError, ValueError):  # who reads the picture says what is wrong
                continue
            if lost is not None:
                return lost
        return None

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

    def headers(self, index: int) -> Sequence[Header]:
        """The headers of a picture's files; none for pictures in memory."""
        file = self.source.file(index)
        return [] if file is None else [read_header(file)]

    def check(self, index: int, headers: Sequence[Header] | None) -> None:
        """Raises what `self[index]` would raise, as far as its headers tell; for None, the files
        are read. `skip_broken` has no effect."""
        if headers is None:
            self._seen(Draw(0, index, index))
        elif headers:
            self._check(index, headers)

    def _check(self, index: int, headers: Sequence[Header]) -> None:
        """Raises ValueError for files that do not fit each other or their lens."""

    def _random(self, epoch: int, key: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, epoch, key, purpose))

    def _turn(self, draw: Draw) -> Turn | None:
        return self.turns.draw(self._random(draw.epoch, draw.lens, 2)) if self.turns else None

    def _other_lens(
        self, draw: Draw, own: Lens, crop: Crop | None = None, purpose: int = 1
    ) -> Lens:
        """A random lens of `lens_augmentation` for a picture of the lens `own`, or for a part."""
        lenses = self.lens_augmentation
        assert lenses is not None
        size, share = self.size, 1.0 if crop is None else crop.share
        radius, theta_max = size / share / 2, own.theta_max.item()

        def of_fov(fov: float) -> Lens:
            return lenses.draw(self._random(draw.epoch, draw.lens, purpose), fov, radius)

        limit = _USED * of_fov(1.0).theta_limit.item()
        lens = of_fov(2 * min(theta_max, limit))
        middle, left = (size / share - 1) / 2, size / share - size
        across, down = (0.0, 0.0) if crop is None else (crop.across, crop.down)
        center = lens.theta_max.new_tensor([[middle - across * left, middle - down * left]])
        return lens.replace(center=center, image_size=center.new_tensor([[size, size]]))

    def _seen(self, draw: Draw) -> tuple[np.ndarray, Lens, int | Tensor]:
        """The image (size, size, C) uint8 before augmentation, its lens and its label."""
        raise NotImplementedError

    def _lens_alone(self, draw: Draw) -> Lens:
        """A lens for a picture that cannot be read."""
        raise NotImplementedError

    def _taken(self, index: int) -> tuple[tuple[int, int], Lens | None]:
        """(H, W) of a picture, and the lens that took it, if it is known."""
        raise NotImplementedError

    def _unknown(self) -> int | Tensor:
        """The label of a picture that cannot be read."""
        return -1


class Calibrated(Samples):
    """Pictures with the lenses that took them: `dataset[i]` is (image, lens, label).

    A picture is reduced to `size`, and its EXIF orientation is applied; its lens follows both. A
    sample depends only on the seed and its `Draw`. `dataset[i]` means `dataset[Draw(0, i, i)]`.
    Making a data set sets OpenCV to one thread in the whole process.

    Args:
        source: the pictures. calibrations: their lenses.
        size: px, H = W of the images.
        framing: turns a picture into a square: "stretch" squashes it and keeps all that the lens
            sees, "crop" cuts its longer side. The lens follows exactly.
        mean, std: per channel, in [0, 1]; the image is (pixel/255 - mean) / std.
        turns: random turns of the images with their lenses; None turns nothing.
        lens_augmentation: a distribution of lenses. Each picture is shown as a random lens would
            have seen it. The lens has the same θ_max, if it can, and its circle touches the sides
            of the image. `framing` then has no effect on calibrated pictures.
        augment: a function that changes the (H, W, C) uint8 image; its arguments are the image and
            a random generator.
        erase: the same for the normalised (C, H, W) float32 image.
        seed: seeds all random numbers.
        skip_broken: replaces a picture that cannot be read by a black image with label -1 (for
            dense targets, unknown pixels) and counts it in `broken`. Otherwise it is an error.

    Attributes:
        cameras: (N,), the number of each picture's camera.

    Raises:
        ValueError: a picture without a lens, or with another aspect ratio than its calibration.
        BrokenImageError: from `dataset[i]`, for a file that cannot be read.
    """

    source: Source

    def __init__(self, source: Source, calibrations: Calibrations, **options):
        super().__init__(source, **options)
        self.calibrations = calibrations
        self.cameras = calibrations.cameras_of([source.file(k) for k in range(len(source))])

    def _seen(self, draw: Draw) -> tuple[np.ndarray, Lens, int]:
        picture, lens, label = self._with_lens(draw.picture)
        turn = self._turn(draw)
        if self.lens_augmentation is not None:
            other = self._other_lens(draw, lens)
            return warp_picture(picture, lens, other, self.size, turn), other, label
        if turn is not None:
            picture, lens = turned_picture(picture, lens, turn)
        image, lens = at_size(picture, lens, self.size, self.framing)
        return image, lens, label

    def _with_lens(self, index: int) -> tuple[np.ndarray, Lens, int]:
        picture, label, orientation = self.source.oriented(index)
        size = picture.shape[0], picture.shape[1]
        return picture, self.calibrations.lens_of(self.source.file(index), size, orientation), label

    def _taken(self, index: int) -> tuple[tuple[int, int], Lens]:
        lens = self._with_lens(index)[1]
        return picture_size(lens), lens

    def _check(self, index: int, headers: Sequence[Header]) -> None:
        (picture,) = headers
        self.calibrations.check(self.source.file(index), picture.upright, picture.orientation)

    def _lens_alone(self, draw: Draw) -> Lens:
        lens = self.calibrations.lens_alone(self.source.file(draw.picture))
        if self.lens_augmentation is not None:
            return self._other_lens(draw, lens)
        return lens_at_size(lens, self.size, self.framing)
