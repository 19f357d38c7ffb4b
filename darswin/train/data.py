"""The data of runs: batches for training, in an order that can be resumed, and for tests."""

import math
import warnings
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from darswin.data.augment import RandAugment, RandomErasing
from darswin.data.cameras import Calibrations, is_json
from darswin.data.headers import check_files
from darswin.data.lens_distributions import parse_lenses, parse_sweep
from darswin.data.order import ResumableLoader, TrainingOrder
from darswin.data.pictures import Source, open_source
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD, Calibrated, Samples
from darswin.data.splits import Split
from darswin.data.turns import RandomTurns
from darswin.data.wide_angle import PAPER_FOV, WideAngle
from darswin.lens.files.reader import Coefficients
from darswin.train.runs import start_worker
from darswin.utils.parameters import check, check_statistics, naming
from darswin.utils.tasks import Fit
from darswin.utils.words import counted

SMALLEST = 32  # px, the size of images of smaller pictures

SamplesT = TypeVar("SamplesT", bound=Samples)


class RunData(LightningDataModule):
    """Base of the data of a run. Subclasses define `_open`, `test_names` and `dataset`.

    Args:
        path: the data set that `open_source` or `open_scenes` opens.
        lens: the lens of the camera that took the pictures, in place of the data set's own: a
            calibration file of any format that `darswin.lens.load` reads, a lens as JSON, or a
            lenses.json that assigns cameras to folders and pictures (see
            `darswin.data.Calibrations`).
        camera: the name or number of the camera, if the calibration has several.
        coefficients: the model of the coefficients, for calibrations of OpenCV or ROS that do not
            name it.
        size: px, H = W of the images; null means the size of model.weights, or else the median of
            the shorter sides of the pictures, but at least 32 px and at most 64 px for
            classification and 128 px for other tasks.
        fit: turns a picture into a square: stretch squashes it and keeps all of it, crop cuts its
            longer side. If the picture has a lens, the lens follows, and null means stretch;
            otherwise null means crop.
        channels: 1 for grey images, 3 for colour images; null means the channels of model.weights,
            or else 1 if all pictures are grey and 3 if not.
        mean: the mean of the pixels in [0, 1], per channel; null means the mean of model.weights,
            or else of ImageNet.
        std: the standard deviation of the pixels, in the same way.
        classes: a file with the names of the classes.
        splits: a file or folder that lists the pictures of each split.
        holdout: the share of the pictures for validation, and for testing, if the data set does
            not define these splits.
        limit: the largest number of pictures in each split.
        batch_size: images in a batch of one process.
        workers: processes that read and warp pictures, in the time that the steps of training
            leave; 0 uses the training process.
        flip: mirrors half of the training images, together with their lenses.
        rotate_deg: rotates training images about the optical axis, together with their lenses, by
            a random angle of at most this many degrees; 180 allows any angle. Pixels from outside
            the picture are black.
        lens_augmentation: shows training pictures as other lenses would have seen them: a level of
            the paper ("very low", "low", "medium", "high"), one ξ ("0.4"), a range of ξ
            ("0.2..0.35"), or "polynomial". null turns it off.
        randaugment: changes the colours of training images.
        seed: seeds the shuffles, the lenses and the augmentation, also those of the test sets.
        skip_broken: counts files that are not images, instead of stopping at the first one.
    """

    default_size: ClassVar[int] = 64  # of large pictures
    # For the model's card.
    fov: float
    card_fit: Fit
    colors: Sequence[Sequence[int]] = []
    pair_lenses = False  # True if the two images of a mixture share a lens
    _more_augmentation: dict[str, Any]  # the options of a subclass for the training split

    def __init__(
        self,
        path: str,
        *,
        lens: str | None = None,
        camera: str | None = None,
        coefficients: Coefficients | None = None,
        size: int | None = None,
        fit: Literal["crop", "stretch"] | None = None,
        channels: Literal[1, 3] | None = None,
        mean: list[float] | None = None,
        std: list[float] | None = None,
        classes: str | None = None,
        splits: str | None = None,
        holdout: float = 0.1,
        limit: int | None = None,
        batch_size: int = 128,
        workers: int = 2,
        flip: bool = False,
        rotate_deg: float = 0.0,
        lens_augmentation: str | None = None,
        randaugment: bool = True,
        seed: int = 0,
        skip_broken: bool = False,
    ):
        super().__init__()
        check("batch_size", batch_size, batch_size >= 1, "at least 1")
        check("workers", workers, workers >= 0, "at least 0")
        check_statistics(mean, std)
        self.path, self._lens = path, lens
        self._camera, self._coefficients = camera, coefficients
        self._size, self._channels, self._mean, self._std = size, channels, mean, std
        self._opening: dict[str, Any] = dict(classes=classes, splits=splits, holdout=holdout)
        self._fit = fit
        self._skip_broken = skip_broken
        self.limit, self.batch_size, self.workers = limit, batch_size, workers
        self.turns = RandomTurns(flip, rotate_deg) if flip or rotate_deg else None
        self.lens_augmentation = (
            None if lens_augmentation is None else parse_lenses(lens_augmentation)
        )
        self.colour_changes = RandAugment() if randaugment else None
        self.seed = seed
        self._sources: dict[Split, Any] = {}
        self.datasets: list[Samples] = []
        self.left_out: dict[Split, int] = {}  # broken pictures that `check` found in each split
        self._loader: ResumableLoader | None = None
        self._progress: dict[str, Any] = {}
        self._said_cut_off = False

    @property
    def fit(self) -> Fit:
        """How pictures become squares."""
        return self._fit or "stretch"

    def _open(self, split: Split, channels: int | None) -> Any:
        """The pictures of a split; with `channels` None they keep their own channels."""
        raise NotImplementedError

    def source(self, split: Split) -> Any:
        """The pictures of a split, opened once."""
        if split not in self._sources:
            # All splits have the channels of the training split.
            channels = self._channels if split == "train" else self.channels
            try:
                self._sources[split] = self._open(split, channels)
            except FileNotFoundError as error:
                if split == "train" or self._opening["holdout"]:
                    raise
                text = (
                    f"`holdout` 0 leaves no pictures for {split!r}, and {self.path} has none of "
                    "its own; set `limit_val_batches` 0 to train without validation"
                )
                raise naming(ValueError(text), "holdout", "limit_val_batches") from error
        return self._sources[split]

    @property
    def channels(self) -> int:
        """The channels of the images."""
        return self._channels or self.source("train").channels

    @cached_property
    def size(self) -> int:
        """The height and width of the images, px."""
        if self._size is not None:
            return self._size
        return max(SMALLEST, min(self.source("train").form().side, self.default_size))

    @property
    def mean(self) -> list[float]:
        """The mean that normalises the images, per channel."""
        return self._per_channel("mean", self._mean, IMAGENET_MEAN, 0.449)

    @property
    def std(self) -> list[float]:
        """The standard deviation that normalises the images, per channel."""
        return self._per_channel("std", self._std, IMAGENET_STD, 0.226)

    def _per_channel(
        self, name: str, given: list[float] | None, colour: Sequence[float], grey: float
    ) -> list[float]:
        values = list(given or (colour if self.channels == 3 else [grey]))
        if len(values) != self.channels:
            text = f"`{name}` must have {self.channels} values, got {values}"
            raise naming(ValueError(text), name)
        return values

    @property
    def _form(self) -> dict[str, Any]:
        return dict(
            size=self.size, fit=self.fit, mean=self.mean, std=self.std, seed=self.seed,
            skip_broken=self._skip_broken,
        )  # fmt: skip

    @property
    def classes(self) -> list[str]:
        """The names of the classes; empty for distances."""
        return self.source("train").classes

    @property
    def test_names(self) -> list[str]:
        """The names of the test sets, in order."""
        raise NotImplementedError

    def _limited(self, source: Any) -> Any:
        return source if self.limit is None else source.limited(self.limit)

    def _noted(self, dataset: SamplesT) -> SamplesT:
        """The data set, whose broken pictures `broken` will count. The first one that `fit`
        cuts something off brings a warning."""
        self.datasets.append(dataset)
        if not self._said_cut_off and not self._place["rank"] and (lost := dataset.cut_off()):
            self._said_cut_off = True
            said = UserWarning(f"`fit` crop cuts off {lost}; `fit` stretch keeps it")
            warnings.warn(naming(said, "fit"), stacklevel=2)
        return dataset

    def broken(self) -> int:
        """The number of pictures that could not be read so far."""
        return sum(len(dataset.broken) for dataset in self.datasets)

    @property
    def _place(self) -> dict[str, int]:
        if self.trainer is None:
            return dict(rank=0, world=1)
        return dict(rank=self.trainer.global_rank, world=self.trainer.world_size)

    @property
    def _options(self) -> dict[str, Any]:
        on_gpu = self.trainer is not None and self.trainer.strategy.root_device.type == "cuda"
        return dict(
            num_workers=self.workers,
            pin_memory=on_gpu,
            prefetch_factor=4 if self.workers else None,
            worker_init_fn=start_worker,
        )

    def _training(self) -> Samples:
        """The training split, augmented."""
        return self.dataset(
            "train", turns=self.turns, lens_augmentation=self.lens_augmentation,
            augment=self.colour_changes, **self._more_augmentation,
        )  # fmt: skip

    def check(self, splits: Sequence[Split]) -> None:
        """Raises one error for all files of these splits that a training could not use."""
        found = check_files({f"the pictures of {split!r}": self.dataset(split) for split in splits})
        self.left_out = dict(zip(splits, found.values(), strict=True))

    def train_dataloader(self) -> ResumableLoader:
        """The batches of the training split, in an order that can be resumed."""
        dataset = self._training()
        order = TrainingOrder(
            len(dataset), self.batch_size, pairs=self.pair_lenses, seed=self.seed,
            cameras=dataset.cameras if isinstance(dataset, Calibrated) else None, **self._place,
        )  # fmt: skip
        keep = self.workers > 0
        self._loader = ResumableLoader(dataset, order, persistent_workers=keep, **self._options)
        if self._progress:
            self._loader.load_state_dict(self._progress)
        return self._loader

    # Lightning restores the state of a loader only if the loader was made after the optimiser, but
    # the optimiser's schedule needs the loader's length.
    def state_dict(self) -> dict[str, Any]:
        """The place in the order of the training images."""
        return self._loader.state_dict() if self._loader else {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Makes the next training loader start at a saved place."""
        self._progress = state_dict

    def transfer_batch_to_device(
        self, batch: Sequence[Any], device: torch.device, dataloader_idx: int
    ) -> list[Any]:
        """Images, lenses and targets on the device; copies to a GPU do not block."""
        return [part.to(device, non_blocking=device.type == "cuda") for part in batch]

    def dataset(self, split: Split, name: str | None = None, **options: Any) -> Samples:
        """A split with options, those of augmentation; `name` is one of `test_names`."""
        raise NotImplementedError

    def _evaluation(self, split: Split, name: str | None = None) -> DataLoader:
        dataset = self.dataset(split, name)
        count, place = len(dataset), self._place
        part = range(place["rank"], count, place["world"])
        if not part:
            raise ValueError(
                f"the {split!r} split has {counted(count, 'picture')}, fewer than processes"
            )
        return DataLoader(dataset, self.batch_size, sampler=part, **self._options)

    def val_dataloader(self) -> DataLoader:
        """The batches of the validation split."""
        return self._evaluation("val")

    def test_dataloader(self) -> list[DataLoader]:
        """The batches of the test sets, one loader for each of `test_names`."""
        return [self._evaluation("test", name) for name in self.test_names]


class WideAngleData(RunData):
    """Pictures for classification, warped through random lenses or taken by calibrated cameras.

    Args:
        path: a folder of images, a folder of IDX files, or "digits": see
            `darswin.data.open_source`. If `lens` is given, pictures are not warped, and
            train_lenses, test_lenses, fov_deg, render and picture_size have no effect.
        train_lenses: the lenses of training and validation: a level of the paper ("very low",
            "low", "medium", "high"), one ξ ("0.4"), a range ("0.2..0.35"), or "polynomial".
        test_lenses: the lenses of the tests, in order: a list of such names, or a sweep "0:1:0.1".
        render: px, the size of the warped images before they are reduced to `size`.
        fov_deg: degrees, the field of view of a picture's width and of every lens.
        picture_size: px, the width to which larger pictures are reduced before the warp.
        erasing: the probability that a box of a training image is erased.
        pair_lenses: gives both images of a mixture the same lens, so that the mixture is an image
            through one lens. Otherwise a mixture has the lens of its first image, as in the
            authors' code. Calibrated pictures are paired by camera; those left over are not mixed.
        common: as `RunData`; the default size of large pictures is 64.
    """

    def __init__(
        self,
        path: str,
        *,
        train_lenses: str = "low",
        test_lenses: str | list[str] = "0:1:0.1",
        render: int = 224,
        fov_deg: float = math.degrees(PAPER_FOV),
        picture_size: int = 384,
        erasing: float = 0.25,
        pair_lenses: bool = True,
        **common: Any,
    ):
        super().__init__(path, **common)
        for name, value in (("camera", self._camera), ("coefficients", self._coefficients)):
            if value is not None and self._lens is None:
                text = f"`{name}` {value} needs a calibration: give `lens`"
                raise naming(ValueError(text), name, "lens")
        hint = f" ({fov_deg:g} radians are {math.degrees(fov_deg):.0f}°)" if fov_deg < 10 else ""
        check("fov_deg", f"{fov_deg:g}°{hint}", 10 <= fov_deg < 180, "from 10° to below 180°")
        self.train_lenses = parse_lenses(train_lenses)
        self._test_lenses = parse_sweep(test_lenses)
        self._warping: dict[str, Any] = dict(
            render=render, fov=math.radians(fov_deg), picture_size=picture_size
        )
        self.fov = 0.0 if self._lens else math.radians(fov_deg)
        self.card_fit = self.fit if self._lens else "whole"
        self.pair_lenses = pair_lenses
        self._more_augmentation = dict(erase=RandomErasing(erasing) if erasing else None)

    @property
    def fit(self) -> Fit:
        """How pictures become squares."""
        return self._fit or ("stretch" if self._lens else "crop")

    def _open(self, split: Split, channels: int | None) -> Source:
        return open_source(self.path, split, channels=channels, **self._opening)

    @property
    def test_names(self) -> list[str]:
        """The names of the test's lens distributions, or the name of the calibration."""
        if self._lens is None:
            return self._test_lenses
        return ["lens" if is_json(self._lens) else Path(self._lens).name]

    @cached_property
    def calibrations(self) -> Calibrations | None:
        """The lenses that took the pictures, if `lens` is given."""
        if not self._lens:
            return None
        return Calibrations(self._lens, self.path, self._camera, self._coefficients)

    def dataset(self, split: Split, name: str | None = None, **options: Any) -> Samples:
        """A split with the lenses of its cameras, or through the lens distribution `name`; None
        is the distribution of training."""
        source = self._limited(self.source(split))
        if self.calibrations is not None:
            return self._noted(Calibrated(source, self.calibrations, **self._form, **options))
        lenses = self.train_lenses if name is None else parse_lenses(name)
        return self._noted(WideAngle(source, lenses, **self._warping, **self._form, **options))
