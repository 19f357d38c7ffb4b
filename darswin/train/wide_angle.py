"""Pictures of one class each as wide-angle images: what classification trains on."""

import math
from functools import cached_property
from pathlib import Path
from typing import Any

from darswin.data.augment import RandomErasing
from darswin.data.cameras import Calibrations, is_json
from darswin.data.lens_distributions import parse_lenses, parse_sweep
from darswin.data.order import TrainingOrder
from darswin.data.pictures import Source, open_source
from darswin.data.samples import Calibrated, Samples
from darswin.data.splits import Split
from darswin.data.wide_angle import PAPER_FOV, WideAngle
from darswin.train.data import RunData


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
        common: as `RunData`; the default size is 64.
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
        self.train_lenses = parse_lenses(train_lenses)
        self._test_lenses = parse_sweep(test_lenses)
        self._warping: dict[str, Any] = dict(
            render=render, fov=math.radians(fov_deg), picture_size=picture_size
        )
        self.fov = 0.0 if self._lens else math.radians(fov_deg)
        self.frame_fit = self._form["framing"] if self._lens else "whole"
        self.erasing, self.pair_lenses = erasing, pair_lenses
        self._sources: dict[str, Source] = {}

    def source(self, split: Split) -> Source:
        """The pictures of a split."""
        if split not in self._sources:
            self._sources[split] = open_source(self.path, split, **self._opening)
        return self._sources[split]

    @property
    def classes(self) -> list[str]:
        """The names behind the labels."""
        return self.source("train").classes

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
        source = self.source(split)
        if self.limit is not None:
            source = source.limited(self.limit)
        dataset: Samples
        if self.calibrations is not None:
            dataset = Calibrated(source, self.calibrations, **self._form, **options)
        else:
            lenses = self.train_lenses if name is None else parse_lenses(name)
            dataset = WideAngle(source, lenses, **self._warping, **self._form, **options)
        self.datasets.append(dataset)
        return dataset

    def _training(self) -> tuple[Samples, TrainingOrder]:
        erase = RandomErasing(self.erasing) if self.erasing else None
        dataset = self.dataset("train", turns=self.turns, augment=self._colour_changes, erase=erase)
        order = TrainingOrder(
            len(dataset), self.batch_size, pairs=self.pair_lenses, seed=self.seed,
            cameras=dataset.cameras if isinstance(dataset, Calibrated) else None, **self._place,
        )  # fmt: skip
        return dataset, order
