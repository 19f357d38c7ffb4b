"""The data of runs: batches in the order of a training, and of every test set."""

import math
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from darswin.data.augment import RandAugment, RandomErasing
from darswin.data.cameras import Calibrations, is_json
from darswin.data.lens_distributions import parse_lenses, parse_sweep
from darswin.data.order import ResumableLoader, TrainingOrder
from darswin.data.pictures import Source, open_source
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD, Calibrated, Samples
from darswin.data.splits import Split
from darswin.data.warping import Framing, RandomTurns
from darswin.data.wide_angle import PAPER_FOV, WideAngle
from darswin.lens.files.opencv import Coefficients
from darswin.train.runs import ignore_signals

__all__ = ["RunData", "WideAngleData"]

SMALLEST = 32  # px, the size of images of smaller pictures

SamplesT = TypeVar("SamplesT", bound=Samples)


class RunData(LightningDataModule):
    """Base of the data of a run. Such data define `_open`, `test_names`, `dataset`, `_training`.

    Args:
        path: what `open_source` or `open_scenes` opens.
        lens: the lens of a camera that took the pictures: a calibration file of any format that
            `darswin.lens.load` reads, a lens as JSON, or a lenses.json that says which camera took
            which folder or picture (see `darswin.data.Calibrations`).
        camera: which, of a calibration of several cameras.
        coefficients: what they are, in a calibration of OpenCV or ROS that does not say it.
        size: px, H = W of the images; null means the size of model.weights, or else the median of
            the shorter sides of the pictures, at least 32 px and at most the default size.
        fit: how a picture becomes a square: crop cuts it, stretch squashes it; its lens, if it has
            one, follows.
        channels: 1 for grey images, 3 for colour images; null means the channels of model.weights,
            or else 1 if all pictures are grey and 3 if not.
        mean: of the pixels in [0, 1], per channel; null means the mean of model.weights, or else
            ImageNet's.
        std: of the pixels, likewise.
        classes: a file with the names of the classes.
        splits: a file or folder that says which picture is in which split.
        holdout: the share for validation, and for testing, where nothing says so.
        limit: at most so many pictures of each split.
        batch_size: of one process.
        workers: processes that read and warp; 0 does it in the training process.
        flip: mirrors half of the images in training, and their lenses with them.
        rotate_deg: turns images about the optical axis in training, and their lenses with them, by
            an angle uniform in ± so many degrees; 180 is any. What turns in from beyond a picture
            is black.
        randaugment: changes colours in training.
        seed: of the shuffles, lenses and augmentation, those of the test sets among them.
        skip_broken: counts files that are no images, instead of stopping at the first.
    """

    default_size: ClassVar[int] = 64  # of large pictures
    # What a model's card says of its pictures.
    fov: float
    frame_fit: Framing
    colors: Sequence[Sequence[int]] = []
    pair_lenses = False  # whether images that are mixed in training have one lens

    def __init__(
        self,
        path: str,
        *,
        lens: str | None = None,
        camera: str | None = None,
        coefficients: Coefficients | None = None,
        size: int | None = None,
        fit: Literal["crop", "stretch"] = "crop",
        channels: Literal[1, 3] | None = None,
        mean: list[float] | None = None,
        std: list[float] | None = None,
        classes: str | None = None,
        splits: str | None = None,
        holdout: float = 0.1,
        limit: int | None = None,
        batch_size: int = 128,
        workers: int = 1,
        flip: bool = False,
        rotate_deg: float = 0.0,
        randaugment: bool = True,
        seed: int = 0,
        skip_broken: bool = False,
    ):
        super().__init__()
        if batch_size < 1 or workers < 0:
            raise ValueError(
                "`batch_size` must be at least 1 and `workers` at least 0, got "
                f"{batch_size} and {workers}"
            )
        self.path, self._lens = path, lens
        self._camera, self._coefficients = camera, coefficients
        self._size, self._channels, self._mean, self._std = size, channels, mean, std
        self._opening: dict[str, Any] = dict(classes=classes, splits=splits, holdout=holdout)
        self._framing: Framing = fit
        self._skip_broken = skip_broken
        self.limit, self.batch_size, self.workers = limit, batch_size, workers
        self.turns = RandomTurns(flip, rotate_deg) if flip or rotate_deg else None
        self.colour_changes = RandAugment() if randaugment else None
        self.seed = seed
        self._sources: dict[Split, Any] = {}
        self.datasets: list[Samples] = []
        self._loader: ResumableLoader | None = None
        self._progress: dict[str, Any] = {}

    def _open(self, split: Split, channels: int | None) -> Any:
        """The pictures of a split; None stands for the channels of the pictures."""
        raise NotImplementedError

    def source(self, split: Split) -> Any:
        """The pictures of a split, opened once."""
        if split not in self._sources:
            # All splits have the channels of the training split.
            channels = self._channels if split == "train" else self.channels
            self._sources[split] = self._open(split, channels)
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
            raise ValueError(f"`{name}` must have {self.channels} values, got {values}")
        return values

    @property
    def _form(self) -> dict[str, Any]:
        return dict(
            size=self.size, framing=self._framing, mean=self.mean, std=self.std, seed=self.seed,
            skip_broken=self._skip_broken,
        )  # fmt: skip

    @property
    def classes(self) -> list[str]:
        """The names behind the labels; none for distances."""
        return self.source("train").classes

    @property
    def test_names(self) -> list[str]:
        """The names of the sets that a test measures, one after the other."""
        raise NotImplementedError

    def _limited(self, source: Any) -> Any:
        return source if self.limit is None else source.limited(self.limit)

    def _noted(self, dataset: SamplesT) -> SamplesT:
        """A data set whose broken pictures are counted."""
        self.datasets.append(dataset)
        return dataset

    def broken(self) -> int:
        """Number of pictures that could not be read so far."""
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
            worker_init_fn=ignore_signals,
        )

    def _training(self) -> Samples:
        """The training split, augmented."""
        raise NotImplementedError

    def train_dataloader(self) -> ResumableLoader:
        """Batches of the training split, in an order that can be resumed."""
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

    # Lightning restores a loader's own state only if it was made after the optimiser, and the
    # optimiser's schedule needs its length.
    def state_dict(self) -> dict[str, Any]:
        """The place in the order of the training."""
        return self._loader.state_dict() if self._loader else {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Goes on from there: the next training loader starts at that place."""
        self._progress = state_dict

    def transfer_batch_to_device(
        self, batch: Sequence[Any], device: torch.device, dataloader_idx: int
    ) -> list[Any]:
        """Images, lenses and targets on the device; a GPU is not waited for."""
        return [part.to(device, non_blocking=device.type == "cuda") for part in batch]

    def dataset(self, split: Split, name: str | None = None) -> Samples:
        """A split as it is evaluated; `name` is one of `test_names`."""
        raise NotImplementedError

    def _evaluation(self, split: Split, name: str | None = None) -> DataLoader:
        try:
            dataset = self.dataset(split, name)
        except FileNotFoundError as error:
            if self._opening["holdout"]:
                raise
            raise ValueError(
                f"`holdout` 0 leaves no pictures for {split!r}, and {self.path} has none of its "
                "own; `limit_val_batches` 0 trains without validation"
            ) from error
        count, place = len(dataset), self._place
        part = range(place["rank"], count, place["world"])
        if not part:
            raise ValueError(
                f"the {split!r} split has too few pictures for as many processes: {count}"
            )
        return DataLoader(dataset, self.batch_size, sampler=part, **self._options)

    def val_dataloader(self) -> DataLoader:
        """Batches of the validation split, as in training but for what is augmented."""
        return self._evaluation("val")

    def test_dataloader(self) -> list[DataLoader]:
        """Batches of what a test measures, one loader for each of `test_names`."""
        return [self._evaluation("test", name) for name in self.test_names]


class WideAngleData(RunData):
    """Pictures as wide-angle images, or wide-angle pictures with the lenses that took them.

    Args:
        path: a folder of images, a folder of IDX files, or "digits": see
            `darswin.data.open_source`. Pictures that `lens` took are not warped, and what is said
            of train_lenses, test_lenses, fov_deg, render and picture_size has no effect on them.
        train_lenses: what training and validation go through: a level of the paper ("very low",
            "low", "medium", "high"), one ξ ("0.4"), a range ("0.2..0.35"), or "polynomial".
        test_lenses: what testing goes through, one after the other: such names, or a sweep
            "0:1:0.1".
        render: px, what images are reduced from.
        fov_deg: degrees, the field of view that a picture's width spans, and that of every lens.
        picture_size: px, the width that larger pictures are first reduced to.
        erasing: how often a box of an image is erased in training.
        pair_lenses: gives both images of a mixture the same lens, so that the mixture is an image
            through one lens. Without it, the mixed-in image is taken for one through the other's
            lens, as in the authors' code; or, without mixing, every image has a lens of its own.
            Calibrated pictures are paired by their cameras, and those left over stay unmixed.
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
                raise ValueError(f"`{name}` {value} is one of a calibration: give `lens`")
        self.train_lenses = parse_lenses(train_lenses)
        self._test_lenses = parse_sweep(test_lenses)
        self._warping: dict[str, Any] = dict(
            render=render, fov=math.radians(fov_deg), picture_size=picture_size
        )
        self.fov = 0.0 if self._lens else math.radians(fov_deg)
        self.frame_fit = self._framing if self._lens else "whole"
        self.erasing, self.pair_lenses = erasing, pair_lenses

    def _open(self, split: Split, channels: int | None) -> Source:
        return open_source(self.path, split, channels=channels, **self._opening)

    @property
    def test_names(self) -> list[str]:
        """The distributions of lenses of a test, or the calibration."""
        if self._lens is None:
            return self._test_lenses
        return ["lens" if is_json(self._lens) else Path(self._lens).name]

    @cached_property
    def calibrations(self) -> Calibrations | None:
        """The lenses that the pictures were taken with, if `lens` says them."""
        if not self._lens:
            return None
        return Calibrations(self._lens, self.path, self._camera, self._coefficients)

    def dataset(self, split: Split, name: str | None = None, **options: Any) -> Samples:
        """A split as it is, with its cameras' lenses; or through a distribution of lenses, where
        None means that of training."""
        source = self._limited(self.source(split))
        if self.calibrations is not None:
            return self._noted(Calibrated(source, self.calibrations, **self._form, **options))
        lenses = self.train_lenses if name is None else parse_lenses(name)
        return self._noted(WideAngle(source, lenses, **self._warping, **self._form, **options))

    def _training(self) -> Samples:
        erase = RandomErasing(self.erasing) if self.erasing else None
        return self.dataset("train", turns=self.turns, augment=self.colour_changes, erase=erase)
