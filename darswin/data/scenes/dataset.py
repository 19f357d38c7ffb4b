"""A data set of scenes: images with their lenses, and a label or a distance for each pixel."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from darswin.data.framing import Crop
from darswin.data.sample import Sample
from darswin.data.samples import Draw, Samples, as_tensor
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import nothing
from darswin.lens import Lens
from darswin.utils.image import Header
from darswin.utils.parameters import check


class SceneSamples(Samples):
    """Scenes at a given size: `dataset[i]` is (image, lens, target), which move together.

    The target is (size, size): labels, int64 with `IGNORE`, or distances along the ray, float32
    metres with 0 for unknown. Pixels beyond θ_max, or from outside the picture, are unknown.

    Args:
        scenes: the pictures, their targets and lenses.
        crop: the least share of a picture's side, in (0, 1], for random parts of the pictures. The
            lens follows, and its principal point moves off the middle. None uses whole pictures.
        options: size, fit, mean, std, turns, lens_augmentation, augment, erase, seed and
            skip_broken, as for `Calibrated`.

    Raises:
        ValueError: a share out of range; from `dataset[i]`, as for `Scenes`.
        OSError: from `dataset[i]`, for a file that cannot be read.
    """

    def __init__(self, scenes: Scenes, *, crop: float | None = None, **options: Any):
        if crop is not None:
            check("crop", crop, 0 < crop <= 1, "a share in (0, 1]")
        super().__init__(scenes, **options)
        self.scenes, self.crop = scenes, crop

    @property
    def cameras(self) -> np.ndarray:
        """The number of each picture's camera in `scenes.cameras`, (N,)."""
        return np.array([self.scenes.camera_of(k) for k in range(len(self))], np.int64)

    def headers(self, index: int) -> list[Header]:
        return self.scenes.headers(index)

    def _check(self, index: int, headers: Sequence[Header]) -> None:
        self.scenes.check(index, *headers)

    def _read(self, draw: Draw) -> Sample:
        return self.scenes[draw.picture]

    def _crop(self, draw: Draw) -> Crop | None:
        if self.crop is None:
            return None
        rng = self._random(draw.epoch, draw.lens, 3)
        return Crop(rng.uniform(self.crop, 1), rng.random(), rng.random())

    def _lens_alone(self, draw: Draw) -> Lens:
        return self.scenes.lens_alone(draw.picture)

    def _unknown(self) -> Tensor:
        return as_tensor(nothing(self.scenes.target, (self.size, self.size)))
