"""Data sets of images with lenses: their base, and pictures of calibrated cameras."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from darswin.data.cameras import Calibrations
from darswin.data.framing import Crop, cut_off, taken_part
from darswin.data.lens_distributions import LensDistribution
from darswin.data.pictures import Source
from darswin.data.sample import Sample
from darswin.data.scenes.scene import Scenes
from darswin.data.turns import RandomTurns
from darswin.lens import Lens
from darswin.utils.image import BrokenImageError, Header, read_header
from darswin.utils.parameters import check
from darswin.utils.tasks import Fit
from darswin.views import CameraView, CropView
from darswin.views.camera import picture_size
from darswin.views.turn import STILL, Turn

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
    """Base of the data sets, see `Calibrated`; subclasses define `_read` and `_lens_alone`."""

    _other = 1  # the purpose of the random numbers of `_other_lens`
    _each_pixel = False  # of `CropView`

    def __init__(
        self,
        source: Source | Scenes,
        *,
        size: int = 64,
        fit: Fit = "stretch",
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        turns: RandomTurns | None = None,
        lens_augmentation: LensDistribution | None = None,
        augment: Augmentation | None = None,
        erase: Augmentation | None = None,
        seed: int = 0,
        skip_broken: bool = False,
    ):
        check("fit", repr(fit), fit in ("crop", "stretch"), "'crop' or 'stretch'")
        self.source, self.size, self.fit = source, size, fit
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
        """What `fit` cuts off the pictures, in words; None if nothing is lost.

        It looks at 32 pictures or a few more, and describes the first that loses something.
        """
        if self.fit != "crop":
            return None
        for index in range(0, len(self), max(1, len(self) // _LOOKED_AT)):
            try:
                lost = cut_off(*self._taken(index), "crop")
            except (OSError, ValueError):  # who reads the picture says what is wrong
                continue
            if lost is not None:
                return lost
        return None

    def __getitem__(self, draw: Draw | int) -> tuple[Tensor, Lens, int | Tensor | None]:
        if not isinstance(draw, Draw):
            draw = Draw(0, int(draw), int(draw))
        try:
            image, target, lens = self.shown(draw)
        except BrokenImageError:
            if not self.skip_broken:
                raise
            self._broken[draw.picture] = True
            black = torch.from_numpy(-self.mean / self.std)
            black = black.expand(-1, self.size, self.size).clone()
            alone = self._lens_alone(draw)
            lens = self._view(alone, draw).camera(alone, picture_size(alone))
            return black, lens, self._unknown()
        rng = self._random(draw.epoch, draw.picture, 0)
        if self.augment:
            image = self.augment(image, rng)
        image = np.ascontiguousarray(image.transpose(2, 0, 1)) * np.float32(1 / 255)
        image = (image - self.mean) / self.std
        if self.erase:
            image = self.erase(image, rng)
        label: Any = as_tensor(target) if isinstance(target, np.ndarray) else target
        return torch.from_numpy(np.ascontiguousarray(image)), lens, label

    def __getitems__(self, draws: Sequence[Draw | int]) -> list:
        """The samples of a batch. Those with the same lens are made one after the other, because
        they share its map too."""
        order = sorted(range(len(draws)), key=lambda k: getattr(draws[k], "lens", k))
        made = {k: self[draws[k]] for k in order}
        return [made[k] for k in range(len(draws))]

    def headers(self, index: int) -> Sequence[Header]:
        """The headers of a picture's files; none for pictures in memory."""
        file = self.source.file(index)
        return [] if file is None else [read_header(file)]

    def check(self, index: int, headers: Sequence[Header] | None) -> None:
        """Raises what `self[index]` would raise, as far as its headers tell; for None, the files
        are read. `skip_broken` has no effect."""
        if headers is None:
            self.shown(Draw(0, index, index))
        elif headers:
            self._check(index, headers)

    def _check(self, index: int, headers: Sequence[Header]) -> None:
        """Raises ValueError for files that do not fit each other or their lens."""

    def _random(self, epoch: int, key: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, epoch, key, purpose))

    def shown(self, draw: Draw) -> Sample:
        """The sample at the size, before its colours are changed, with an image (H, W, C) uint8."""
        sample = self._read(draw)
        return sample.through(self._view(sample.lens, draw))

    def _view(self, own: Lens, draw: Draw) -> CameraView | CropView:
        """What a sample shows of a picture of the lens `own`."""
        turn, crop = self._turn(draw), self._crop(draw)
        if self.lens_augmentation is not None:
            return CameraView(self._other_lens(draw, own, crop), turn=turn)
        part = taken_part(picture_size(own), self.fit, crop)
        return CropView(part, (self.size, self.size), turn, each_pixel=self._each_pixel)

    def _turn(self, draw: Draw) -> Turn:
        return self.turns.draw(self._random(draw.epoch, draw.lens, 2)) if self.turns else STILL

    def _crop(self, draw: Draw) -> Crop | None:
        """A random part of the pictures."""
        return None

    def _other_lens(self, draw: Draw, own: Lens, crop: Crop | None = None) -> Lens:
        """A random lens of `lens_augmentation` for a picture of the lens `own`, or for a part."""
        lenses = self.lens_augmentation
        assert lenses is not None
        limit = _USED * self._drawn(lenses, draw, self._other, 1.0, crop).theta_limit.item()
        fov = 2 * min(own.theta_max.item(), limit)
        return self._drawn(lenses, draw, self._other, fov, crop)

    def _drawn(
        self, lenses: LensDistribution, draw: Draw, purpose: int, fov: float, crop: Crop | None
    ) -> Lens:
        """A random lens whose circle touches the sides of the image, or of a larger image of which
        `crop` is the part that is shown."""
        share, across, down = crop or (1.0, 0.0, 0.0)
        whole = self.size / share
        lens = lenses.draw(self._random(draw.epoch, draw.lens, purpose), fov, whole / 2)
        middle, left = (whole - 1) / 2, whole - self.size
        center = lens.theta_max.new_tensor([[middle - across * left, middle - down * left]])
        return lens.replace(center=center, image_size=center.new_tensor([[self.size] * 2]))

    def _read(self, draw: Draw) -> Sample:
        """The sample as it was taken."""
        raise NotImplementedError

    def _lens_alone(self, draw: Draw) -> Lens:
        """A lens for a picture that cannot be read."""
        raise NotImplementedError

    def _taken(self, index: int) -> tuple[tuple[int, int], Lens | None]:
        """(H, W) of a picture, and the lens that took it, if it is known."""
        lens = self._read(Draw(0, index, index)).lens
        return picture_size(lens), lens

    def _unknown(self) -> int | Tensor:
        """The label of a picture that cannot be read."""
        return -1


def as_tensor(target: np.ndarray) -> Tensor:
    """A target of pixels as a tensor: ids of labels as int64."""
    tensor = torch.from_numpy(target)
    return tensor if tensor.is_floating_point() else tensor.long()


class Calibrated(Samples):
    """Pictures with the lenses that took them: `dataset[i]` is (image, lens, label).

    A picture is reduced to `size`, and its EXIF orientation is applied; its lens follows both. A
    sample depends only on the seed and its `Draw`. `dataset[i]` means `dataset[Draw(0, i, i)]`.
    Making a data set sets OpenCV to one thread in the whole process.

    Args:
        source: the pictures. calibrations: their lenses.
        size: px, H = W of the images.
        fit: turns a picture into a square: "stretch" squashes it and keeps all that the lens
            sees, "crop" cuts its longer side. The lens follows exactly.
        mean, std: per channel, in [0, 1]; the image is (pixel/255 - mean) / std.
        turns: random turns of the images with their lenses; None turns nothing.
        lens_augmentation: a distribution of lenses. Each picture is shown as a random lens would
            have seen it. The lens has the same θ_max, if it can, and its circle touches the sides
            of the image. `fit` then has no effect on calibrated pictures.
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
        OSError: from `dataset[i]`, for a file that cannot be read.
    """

    source: Source
    _each_pixel = True

    def __init__(self, source: Source, calibrations: Calibrations, **options):
        super().__init__(source, **options)
        self.calibrations = calibrations
        self.cameras = calibrations.cameras_of([source.file(k) for k in range(len(source))])

    def _read(self, draw: Draw) -> Sample:
        picture, label, orientation = self.source.oriented(draw.picture)
        file, size = self.source.file(draw.picture), (picture.shape[0], picture.shape[1])
        return Sample(picture, label, self.calibrations.lens_of(file, size, orientation))

    def _check(self, index: int, headers: Sequence[Header]) -> None:
        (picture,) = headers
        self.calibrations.check(self.source.file(index), picture.upright, picture.orientation)

    def _lens_alone(self, draw: Draw) -> Lens:
        return self.calibrations.lens_alone(self.source.file(draw.picture))
