"""The data of a run."""

import math
from functools import partial
from typing import Any, Literal

from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from darswin.data.augment import RandAugment, RandomErasing
from darswin.data.datasets import open_source
from darswin.data.lenses import parse_lenses, parse_sweep
from darswin.data.sampling import EveryNth, ResumableLoader, TrainingOrder
from darswin.data.sources import Part, Source
from darswin.data.splits import Split
from darswin.data.wide_angle import IMAGENET_MEAN, IMAGENET_STD, PAPER_FOV, WideAngle
from darswin.train.stopping import ignore_signals


class WideAngleData(LightningDataModule):
    """Pictures as wide-angle images.

    Args:
        path: a folder of images, a folder of IDX files, or "digits": see
            `darswin.data.open_source`.
        train_lenses: what training and validation go through: a level of the paper ("very low",
            "low", "medium", "high"), one ξ ("0.4"), a range ("0.2..0.35"), or "polynomial".
        test_lenses: what testing goes through, one after the other: such names, or a sweep
            "0:1:0.1".
        size: px, H = W of the images.
        render: px, what they are reduced from.
        fov_deg: degrees, the field of view that a picture's width spans, and that of every lens.
        fit: how a picture becomes a square, cut or squashed.
        picture_size: px, the width that larger pictures are first reduced to.
        channels: of the images, grey or colour.
        mean: of the pixels in [0, 1], per channel; null means ImageNet's.
        std: of the pixels, likewise.
        classes: a file with the names of the classes.
        splits: a file or folder that says which picture is in which split.
        holdout: the share for validation, and for testing, where nothing says so.
        limit: at most so many pictures of each split.
        batch_size: of one process.
        workers: processes that read and warp; 0 does it in the training process.
        randaugment: changes colours in training.
        erasing: how often a box of an image is erased in training.
        pair_lenses: gives both images of a mixture the same lens, so that the mixture is an image
            through one lens. Without it, the mixed-in image is taken for one through the other's
            lens, as in the authors' code; or, without mixing, every image has a lens of its own.
        seed: of the shuffles, lenses and augmentation, those of the test sets among them.
        skip_broken: counts files that are no images, instead of stopping at the first.
    """

    def __init__(
        self,
        path: str,
        *,
        train_lenses: str = "low",
        test_lenses: str | list[str] = "0:1:0.1",
        size: int = 64,
        render: int = 224,
        fov_deg: float = math.degrees(PAPER_FOV),
        fit: Literal["crop", "stretch"] = "crop",
        picture_size: int = 384,
        channels: Literal[1, 3] = 3,
        mean: list[float] | None = None,
        std: list[float] | None = None,
        classes: str | None = None,
        splits: str | None = None,
        holdout: float = 0.1,
        limit: int | None = None,
        batch_size: int = 128,
        workers: int = 1,
        randaugment: bool = True,
        erasing: float = 0.25,
        pair_lenses: bool = True,
        seed: int = 0,
        skip_broken: bool = False,
    ):
        super().__init__()
        if batch_size < 1 or workers < 0:
            raise ValueError(
                "--data.batch_size must be at least 1 and --data.workers at least 0, "
                f"got {batch_size} and {workers}"
            )
        self.train_lenses = parse_lenses(train_lenses)
        self.test_names = parse_sweep(test_lenses)
        self._path, self._holdout = path, holdout
        self._open = partial(
            open_source, path, channels=channels, classes=classes, splits=splits, holdout=holdout
        )
        self.size, self.fov, self.channels = size, math.radians(fov_deg), channels
        self.mean = list(mean or (IMAGENET_MEAN if channels == 3 else [0.449]))
        self.std = list(std or (IMAGENET_STD if channels == 3 else [0.226]))
        if not len(self.mean) == len(self.std) == channels:
            raise ValueError(f"mean and std must have {channels} values, got {mean} and {std}")
        self._view = partial(
            WideAngle, size=size, render=render, fov=self.fov, fit=fit, picture_size=picture_size,
            mean=self.mean, std=self.std, seed=seed, skip_broken=skip_broken,
        )  # fmt: skip
        self.limit, self.batch_size, self.workers = limit, batch_size, workers
        self.randaugment, self.erasing = randaugment, erasing
        self.pair_lenses, self.seed = pair_lenses, seed
        self._sources: dict[str, Source] = {}
        self.datasets: list[WideAngle] = []
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

    def dataset(self, split: Split, lenses: str | None = None, **options) -> WideAngle:
        """A split through a distribution of lenses; None means that of training."""
        source = self.source(split)
        if self.limit is not None and self.limit < len(source):
            source = Part(source, self.limit)
        distribution = self.train_lenses if lenses is None else parse_lenses(lenses)
        dataset = self._view(source, distribution, **options)
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
            augment=RandAugment() if self.randaugment else None,
            erase=RandomErasing(self.erasing) if self.erasing else None,
        )
        order = TrainingOrder(
            len(dataset), self.batch_size, pairs=self.pair_lenses, seed=self.seed, **self._place
        )
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
