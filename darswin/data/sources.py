"""Sources of pictures.

A source is a sequence: `source[i]` is (image (H, W, C) uint8, label), and it has `classes`, the
names behind the labels.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from darswin.utils.image import read_image, read_oriented, with_channels


class Source(Protocol):
    """What every source offers."""

    classes: list[str]

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        """The image (H, W, C) uint8 and its label; BrokenImageError names a file that is none."""
        ...

    def oriented(self, index: int) -> tuple[np.ndarray, int, int]:
        """The image, its label, and the EXIF orientation that it was turned upright from."""
        ...

    def file(self, index: int) -> Path | None:
        """The image's own file, if it has one."""
        ...


class ImageFiles:
    """Picture files with a label each.

    Args:
        root: the folder that the paths are relative to. files: (path, label) pairs.
        classes: names of the labels. channels: 3 or 1, what the files are read as.
    """

    def __init__(
        self,
        root: Path,
        files: Sequence[tuple[str, int]],
        classes: Sequence[str],
        channels: int = 3,
    ):
        self.root, self.classes, self.channels = Path(root), list(classes), channels
        # As arrays, so that worker processes share them instead of copying a million objects.
        self.paths = np.array([os.fsencode(path) for path, _ in files], dtype=np.bytes_)
        self.labels = np.array([label for _, label in files], dtype=np.int64)

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        return read_image(self.file(index), self.channels), int(self.labels[index])

    def oriented(self, index: int) -> tuple[np.ndarray, int, int]:
        image, orientation = read_oriented(self.file(index), self.channels)
        return image, int(self.labels[index]), orientation

    def file(self, index: int) -> Path:
        return self.root / os.fsdecode(self.paths[index])


class Arrays:
    """Images in memory: (N, H, W) or (N, H, W, C) uint8, and their labels (N,)."""

    def __init__(
        self, images: np.ndarray, labels: np.ndarray, classes: Sequence[str], channels: int = 3
    ):
        if len(images) != len(labels):
            raise ValueError(f"there are {len(images)} images and {len(labels)} labels")
        self.images = images if images.ndim == 4 else images[..., None]
        self.labels, self.classes, self.channels = labels, list(classes), channels

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        return with_channels(self.images[index], self.channels), int(self.labels[index])

    def oriented(self, index: int) -> tuple[np.ndarray, int, int]:
        return *self[index], 1

    def file(self, index: int) -> None:
        return None


class Part:
    """At most `count` of a source's pictures, chosen by a fixed shuffle."""

    def __init__(self, source: Source, count: int):
        if count < 1:
            raise ValueError(f"--data.limit must be at least 1, got {count}")
        self.source, self.classes = source, source.classes
        self.chosen = np.sort(np.random.default_rng(0).permutation(len(source))[:count])

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        return self.source[self.chosen[index]]

    def oriented(self, index: int) -> tuple[np.ndarray, int, int]:
        return self.source.oriented(self.chosen[index])

    def file(self, index: int) -> Path | None:
        return self.source.file(self.chosen[index])
