"""A data set of scenes: images with their lenses, and a label or a distance for each pixel."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from darswin.data.reframing import resize_scene, turn_scene, warp_scene
from darswin.data.samples import Draw, Samples
from darswin.data.scenes.scene import Scene, Scenes
from darswin.data.scenes.targets import IGNORE
from darswin.data.warping import Crop, picture_size, taken_part
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
        options: size, framing, mean, std, turns, lens_augmentation, augment, erase, seed and
            skip_broken, as for `Calibrated`.

    Raises:
        ValueError: a share out of range; from `dataset[i]`, as for `Scenes`.
        BrokenImageError: from `dataset[i]`, for a file that cannot be read.
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

    def _seen(self, draw: Draw) -> tuple[np.ndarray, Lens, Tensor]:
        image, target, lens = self._reframed(self.scenes[draw.picture], draw)
        kind = torch.int64 if self.scenes.target == "labels" else torch.float32
        return image, lens, torch.from_numpy(np.ascontiguousarray(target)).to(kind)

    def _reframed(self, scene: Scene, draw: Draw) -> Scene:
        turn, crop = self._turn(draw), self._crop(draw)
        if self.lens_augmentation is not None:
            lens = self._other_lens(draw, scene.lens, crop)
            return warp_scene(scene, lens, self.size, turn)
        height, width = scene.target.shape
        taken = taken_part((height, width), self.framing, crop)
        if turn is not None and turn.angle:
            return turn_scene(scene, turn, taken, self.size)
        return resize_scene(scene, taken, self.size, turn is not None and turn.mirrored)

    def _crop(self, draw: Draw) -> Crop | None:
        if self.crop is None:
            return None
        rng = self._random(draw.epoch, draw.lens, 3)
        return Crop(rng.uniform(self.crop, 1), rng.random(), rng.random())

    def _taken(self, index: int) -> tuple[tuple[int, int], Lens]:
        lens = self.scenes[index].lens
        return picture_size(lens), lens

    def _lens_alone(self, draw: Draw) -> Lens:
        own = self.scenes.lens_alone(draw.picture)
        if self.lens_augmentation is not None:
            return self._other_lens(draw, own, self._crop(draw))
        taken = taken_part(picture_size(own), self.framing)
        return own.cropped(*taken).resized((self.size, self.size))

    def _unknown(self) -> Tensor:
        shape = self.size, self.size
        if self.scenes.target == "labels":
            return torch.full(shape, IGNORE, dtype=torch.int64)
        return torch.zeros(shape)
