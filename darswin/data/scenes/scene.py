"""Scenes: pictures with a label or a distance for each pixel, and the lenses that took them."""

import copy
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, Self

import numpy as np
import torch

from darswin.data.calibrations import PictureLenses
from darswin.data.scenes.targets import nothing_of, read_distance, read_labels
from darswin.lens import Lens
from darswin.utils.image import read_oriented

Target = Literal["labels", "distance"]


class Scene(NamedTuple):
    """A picture and what is known of each of its pixels.

    Attributes: image: (H, W, C) uint8; target: (H, W), uint8 ids with `IGNORE`, or float32 metres
    along the ray with 0 where it is not known; lens: one lens, with a center and this image_size.
    """

    image: np.ndarray
    target: np.ndarray
    lens: Lens


class Scenes:
    """A sequence of scenes, read from their files when they are asked for.

    Args:
        root: the folder that the files are relative to. files: (picture, target) pairs.
        lenses: which lens took which picture. target: what the second file of a pair holds.
        channels: 3 or 1, of the images.
        classes: names of the labels' ids. colors: (r, g, b) of each, or none.
        views: of each picture, what `cameras` calls the camera that took it; None takes them from
            `lenses`.
        trim: (rows, height): so many rows are cut at the top and at the bottom of a picture that is
            so high, and as large a part of others; their lenses follow.
        far: metres, from which on a distance is that of the sky, which is not known.

    Attributes:
        cameras: names of what took the pictures.
        unknown: (N,) int64, pixels of each target that say nothing: labels of `IGNORE`, distances
            that are not finite or not above 0; -1 until it was read, in any process.
    """

    def __init__(
        self,
        root: Path,
        files: Sequence[tuple[str, str]],
        lenses: PictureLenses,
        *,
        target: Target,
        channels: int = 3,
        classes: Sequence[str] = (),
        colors: Sequence[Sequence[int]] = (),
        views: Sequence[str] | None = None,
        trim: tuple[int, int] = (0, 1),
        far: float | None = None,
    ):
        self.root, self.lenses, self.target, self.channels = Path(root), lenses, target, channels
        self.classes, self.colors = list(classes), [list(color) for color in colors]
        self.trim, self.far = trim, far
        # As arrays, so that worker processes share them instead of copying every object.
        self._pictures = np.array([os.fsencode(picture) for picture, _ in files], np.bytes_)
        self._targets = np.array([os.fsencode(file) for _, file in files], np.bytes_)
        if views is None:
            self.cameras = [camera.name for camera in lenses.cameras]
            self._camera = lenses.cameras_of([self.file(k) for k in range(len(files))])
        else:
            self.cameras = list(dict.fromkeys(views))
            number = {name: k for k, name in enumerate(self.cameras)}
            self._camera = np.array([number[name] for name in views], np.int64)
        self.unknown = torch.full((len(files),), -1, dtype=torch.int64).share_memory_()

    def __len__(self) -> int:
        return len(self._pictures)

    def __getitem__(self, index: int) -> Scene:
        """The scene.

        Raises:
            BrokenImageError: a file that is missing or cannot be read. ValueError: a label that is
                no class's, a picture, target and lens of different sizes. Both name the file.
        """
        image, orientation = read_oriented(self.file(index), self.channels)
        if orientation != 1:
            raise ValueError(
                f"{self.file(index)} is stored turned, as its EXIF orientation {orientation} says, "
                "and its labels or distances may be of either picture: store it upright"
            )
        target = self._target(index)
        size = image.shape[0], image.shape[1]
        if target.shape != size:
            shapes = [f"{height}×{width}" for height, width in (target.shape, size)]
            raise ValueError(
                f"{self.target_file(index)} has {shapes[0]} px, and its picture "
                f"{self.file(index)} has {shapes[1]}"
            )
        lens = self.lenses.lens_of(self.file(index), size)
        rows = self._rows(size[0])
        kept = slice(rows, size[0] - rows)
        image, target = image[kept], target[kept]
        self.unknown[index] = int(np.count_nonzero(target == nothing_of(target)))
        return Scene(image, target, self._trimmed(lens, rows))

    def limited(self, count: int) -> Self:
        """At most so many of the scenes, chosen by a fixed shuffle."""
        if count < 1:
            raise ValueError(f"--data.limit must be at least 1, got {count}")
        chosen = np.sort(np.random.default_rng(0).permutation(len(self))[:count])
        part = copy.copy(self)
        part._pictures, part._targets = self._pictures[chosen], self._targets[chosen]
        part._camera = self._camera[chosen]
        part.unknown = self.unknown[torch.from_numpy(chosen)].share_memory_()
        return part

    def file(self, index: int) -> Path:
        """The picture's file."""
        return self.root / os.fsdecode(self._pictures[index])

    def target_file(self, index: int) -> Path:
        """The file of its labels or distances."""
        return self.root / os.fsdecode(self._targets[index])

    def camera_of(self, index: int) -> int:
        """What took a picture, as a number in `cameras`."""
        return int(self._camera[index])

    def lens_alone(self, index: int) -> Lens:
        """The lens of a picture that cannot be read: in one of the size that it was made for."""
        lens = self.lenses.lens_alone(self.file(index))
        height = 1 if lens.image_size is None else round(lens.image_size[0, 0].item())
        return self._trimmed(lens, self._rows(height))

    def _target(self, index: int) -> np.ndarray:
        if self.target == "labels":
            return read_labels(self.target_file(index), len(self.classes))
        return read_distance(self.target_file(index), self.far)

    def _rows(self, height: int) -> int:
        """How many rows are cut at the top of a picture."""
        rows, of = self.trim
        return -(-rows * height // of)

    def _trimmed(self, lens: Lens, rows: int) -> Lens:
        if not rows or lens.image_size is None:
            return lens
        height, width = (round(side) for side in lens.image_size[0].tolist())
        return lens.cropped(rows, 0, height - 2 * rows, width)
