"""The data of a run."""

import math
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from darswin.data.augment import RandAugment, RandomErasing
from darswin.data.calibrated import Calibrated
from darswin.data.calibrations import Calibrations, is_json
from darswin.data.datasets import open_source
from darswin.data.frames import Fit
from darswin.data.lenses import parse_lenses, parse_sweep
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD, Samples
from darswin.data.sampling import EveryNth, ResumableLoader, TrainingOrder
from darswin.data.sources import Part, Source
from darswin.data.splits import Split
from darswin.data.turning import RandomTurns
from darswin.data.wide_angle import PAPER_FOV, WideAngle
from darswin.train.stopping import ignore_signals


class WideAngleData(LightningDataModule):
    """Pictures as wide-angle images, or wide-angle pictures with the lenses that took them.

    Args:
        path: a folder of images, a folder of IDX files, or "digits": see
            `darswin.data.open_source`.
        lens: the lens of a camera that took the pictures: a calibration file of any format that
            `darswin.lens.load` reads, a lens as JSON, or a lenses.json that says which camera took
            which folder or picture (see `darswin.data.Calibrations`). The pictures are then not
            warped, and what is said of lenses, fov_deg, render and picture_size has no effect.
        camera: which, of a calibration of several cameras.
        train_lenses: what training and validation go through: a level of the paper ("very low",
            "low", "medium", "high"), one ξ ("0.4"), a range ("0.2..0.35"), or "polynomial".
        test_lenses: what testing goes through, one after the other: such names, or a sweep
            "0:1:0.1".
        size: px, H = W of the images; null is that of model.weights, or 64.
        render: px, what they are reduced from.
        fov_deg: degrees, the field of view that a picture's width spans, and that of every lens.
        fit: how a picture becomes a square: crop cuts it, stretch squashes it; its lens, if it has
            one, follows.
        picture_size: px, the width that larger pictures are first reduced to.
        channels: of the images, grey or colour; null is that of model.weights, or 3.
        mean: of the pixels in [0, 1], per channel; null is that of model.weights, or
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
        erasing: how often a box of an image is erased in training.
        pair_lenses: gives both images of a mixture the same lens, so that the mixture is an image
            through one lens. Without it, the mixed-in image is taken for one through the other's
            lens, as in the authors' code; or, without mixing, every image has a lens of its own.
            Calibrated pictures are paired by their cameras, and those left over stay unmixed.
        seed: of the shuffles, lenses and augmentation, those of the test sets among them.
        skip_broken: counts files that are no images, instead of stopping at the first.
    """

    def __init__(
        self,
        path: str,
        *,
        lens: str | None = None,
        camera: str | None = None,
        train_lenses: str = "low",
        test_lenses: str | list[str] = "0:1:0.1",
        size: int | None = None,
        render: int = 224,
        fov_deg: float = math.degrees(PAPER_FOV),
        fit: Literal["crop", "stretch"] = "crop",
        picture_size: int = 384,
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
        erasing: float = 0.25,
        pair_lenses: bool = True,
        seed: int = 0,
        skip_broken: bool = False,
    ):
        super().__init__()
        size, channels = 64 if size is None else size, channels or 3
        if batch_size < 1 or workers < 0:
            raise ValueError(
                "--data.batch_size must be at least 1 and --data.workers at least 0, "
                f"got {batch_size} and {workers}"
            )
        if camera is not None and lens is None:
            raise ValueError(f"--data.camera {camera} is one of a calibration: give --data.lens")
        self._lens, self._camera = lens, camera
        self.train_lenses = parse_lenses(train_lenses)
        self.test_names = parse_sweep(test_lenses)
        if lens is not None:
            self.test_names = ["lens" if is_json(lens) else Path(lens).name]
        self._path, self._holdout = path, holdout
        self._open = partial(
            open_source, path, channels=channels, classes=classes, splits=splits, holdout=holdout
        )
        self.size, self.channels = size, channels
        # What a model's card says of its pictures.
        self.fov = 0.0 if lens else math.radians(fov_deg)
        self.frame_fit: Fit = fit if lens else "whole"
        self.mean = list(mean or (IMAGENET_MEAN if channels == 3 else [0.449]))
        self.std = list(std or (IMAGENET_STD if channels == 3 else [0.226]))
        if not len(self.mean) == len(self.std) == channels:
            raise ValueError(f"mean and std must have {channels} values, got {mean} and {std}")
        self._form: dict[str, Any] = dict(
            size=size, fit=fit, mean=self.mean, std=self.std, seed=seed, skip_broken=skip_broken
        )
        self._warped = partial(
            WideAngle, render=render, fov=math.radians(fov_deg), picture_size=picture_size
        )
        self.limit, self.batch_size, self.workers = limit, batch_size, workers
        self.turns = RandomTurns(flip, rotate_deg) if flip or rotate_deg else None
        self.randaugment, self.erasing = randaugment, erasing
        self.pair_lenses, self.seed = pair_lenses, seed
        self._sources: dict[str, Source] = {}
        self.datasets: list[Samples] = []
        self._loader: ResumableLoader | None = None
        self._progress: dict[str, Any] = {}

    def source(self, split: Split) -> Source:
        """The pictures of a split."""
        if split not in self._sources:
            self._sources[split] = self._open(split)
        return self._sources[split]

    @property
    def classes(self) -> list[str]:
        """The names behind the labels."""
        return self.source("train").classes

    @cached_property
    def calibrations(self) -> Calibrations | None:
        """The lenses that the pictures were taken with, if `lens` says them."""
        return Calibrations(self._lens, self._path, self._camera) if self._lens else None

    def dataset(self, split: Split, lenses: str | None = None, **options) -> Samples:
        """A split as it is, with its cameras' lenses; or through a distribution of lenses, where
        None means that of training."""
        source = self.source(split)
        if self.limit is not None and self.limit < len(source):
            source = Part(source, self.limit)
        dataset: Samples
        if self.calibrations is not None:
            dataset = Calibrated(source, self.calibrations, **self._form, **options)
        else:
            distribution = self.train_lenses if lenses is None else parse_lenses(lenses)
            dataset = self._warped(source, distribution, **self._form, **options)
        self.datasets.append(dataset)
        return dataset

    def broken(self) -> int:
        """How many pictures could not be read so far."""
        return sum(len(dataset.broken) for dataset in self.datasets)

    @property
    def _place(self) -> dict[str, int]:
        if self.trainer is None:
            return dict(rank=0, world=1)
        return dict(rank=self.trainer.global_rank, world=self.trainer.world_size)

    @property
    def _options(self) -> dict[str, Any]:
        return dict(
            num_workers=self.workers,
            prefetch_factor=4 if self.workers else None,
            worker_init_fn=ignore_signals,
        )

    def train_dataloader(self) -> ResumableLoader:
        dataset = self.dataset(
            "train",
            turns=self.turns,
            augment=RandAugment() if self.randaugment else None,
            erase=RandomErasing(self.erasing) if self.erasing else None,
        )
        order = TrainingOrder(
            len(dataset), self.batch_size, pairs=self.pair_lenses, seed=self.seed,
            cameras=dataset.cameras if isinstance(dataset, Calibrated) else None, **self._place,
        )  # fmt: skip
        self._loader = ResumableLoader(
            dataset, order, persistent_workers=self.workers > 0, **self._options
        )
        if self._progress:
            self._loader.load_state_dict(self._progress)
        return self._loader

    # Lightning restores a loader's own state only if it was made after the optimiser, and the
    # optimiser's schedule needs its length.
    def state_dict(self) -> dict[str, Any]:
        return self._loader.state_dict() if self._loader else {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._progress = state_dict

    def _evaluation(self, split: Split, lenses: str | None = None) -> DataLoader:
        try:
            dataset = self.dataset(split, lenses)
        except FileNotFoundError as error:
            if self._holdout:
                raise
            raise ValueError(
                f"--data.holdout 0 leaves no pictures for {split!r}, and {self._path} has none of "
                "its own; --trainer.limit_val_batches 0 trains without validation"
            ) from error
        part = EveryNth(len(dataset), **self._place)
        if not part.indices:
            raise ValueError(
                f"the {split!r} split has too few pictures for as many processes: {len(dataset)}"
            )
        return DataLoader(dataset, self.batch_size, sampler=part, **self._options)

    def val_dataloader(self) -> DataLoader:
        return self._evaluation("val")

    def test_dataloader(self) -> list[DataLoader]:
        return [self._evaluation("test", name) for name in self.test_names]
