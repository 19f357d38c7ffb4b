"""Where pictures come from: folders of images, IDX files, the bundled digits.

A source is a sequence: `source[i]` is (image (H, W, C) uint8, label), and it has `classes`, the
names behind the labels. `open_source` finds out which kind a path is and which part of it a split
means.
"""

import gzip
import math
import os
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from darswin.data.folders import SPLITS, Split, class_of, hold_out, pictures_of, read_classes
from darswin.utils.image import read_image, with_channels


class Source(Protocol):
    """What every source offers."""

    classes: list[str]

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        """The image (H, W, C) uint8 and its label; BrokenImageError names a file that is none."""


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
        path = self.root / os.fsdecode(self.paths[index])
        return read_image(path, self.channels), int(self.labels[index])


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


def open_source(
    path: str | Path,
    split: Split,
    *,
    channels: int = 3,
    classes: str | Path | None = None,
    splits: str | Path | None = None,
    holdout: float = 0.1,
) -> Source:
    """The part of a data set that a split means.

    What `path` may be:

    - "digits": scikit-learn's 1797 scanned digits of 8×8 pixels;
    - a folder of IDX files, the MNIST family: `train-images-idx3-ubyte[.gz]` and its three
      companions. "test" is its test set, "val" the last `holdout` of its training set;
    - a folder of images, one folder a class; or `train/`, `val/` (also `valid/`, `validation/`)
      and `test/` folders of that kind. Links to folders are followed, hidden ones left out.

    Without a test set, "val" serves as one. What has neither, or no "val", gets `holdout` of each
    class of "train" for each, chosen by a hash of their names; at least one is left to train on.
    Pictures that are in no split are said as `darswin.data.folders.LeftOut` warnings.

    Args:
        channels: 3 or 1, of the images that come out.
        classes: a list of class names, as a text file with one a line or a JSON list: which
            folders to take and in which order. For IDX files and digits, the labels' names.
        splits: a JSON file `{"train": ["class/a.jpg", …], "val": …, "test": …}` with paths relative
            to `path`, or a folder of `train.txt`, `val.txt`, `test.txt` with one path a line. The
            first folder of a path is its class. A split without a list is held out.
        holdout: a share, in [0, 0.5).

    Raises:
        FileNotFoundError: no such folder, or nothing in it. ValueError: folders whose meaning is
            not clear, and lists that do not fit them; it names them.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {SPLITS}, got {split!r}")
    if not 0 <= holdout < 0.5:
        raise ValueError(f"holdout must be in [0, 0.5), got {holdout}")
    names = None if classes is None else read_classes(classes)
    root = Path(path)
    digits = str(path) == "digits"
    idx = not digits and _idx_file(root, "train-images-idx3-ubyte") is not None
    if splits is not None and (digits or idx):
        raise ValueError(f"--data.splits is for folders of images, and {path} is none")
    if digits:
        source = _digits(split, channels, names, holdout)
    elif not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    elif idx:
        source = _idx(root, split, channels, names, holdout)
    else:
        pictures, names = pictures_of(split, root, names=names, lists=splits, holdout=holdout)
        label = {name: k for k, name in enumerate(names)}
        files = [(path, label[class_of(path)]) for path in pictures.paths]
        return ImageFiles(pictures.folder, files, names, channels)
    if not len(source):
        raise FileNotFoundError(
            f"no images for the {split!r} split of {path}: --data.holdout {holdout:g} leaves none"
        )
    return source


# -- IDX files and digits ---------------------------------------------------------------------


def _idx_file(root: Path, name: str) -> Path | None:
    return next((p for p in (root / name, root / f"{name}.gz") if p.exists()), None)


def read_idx(path: Path) -> np.ndarray:
    """A file of unsigned bytes in the IDX format, gzipped or not; ValueError where it is none."""
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            head = file.read(4)
            if len(head) != 4 or head[:3] != b"\0\0\x08" or not 1 <= head[3] <= 4:
                raise ValueError(f"{path} is no IDX file of unsigned bytes")
            sizes = np.frombuffer(file.read(4 * head[3]), ">u4")
            data = np.frombuffer(file.read(), np.uint8)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path} is no whole gzip file: {error}") from error
    if len(sizes) != head[3] or data.size != math.prod(sizes.tolist()):
        raise ValueError(f"{path} says it holds {sizes.tolist()} bytes, but holds {data.size}")
    return data.reshape(sizes)


def _idx(
    root: Path, split: Split, channels: int, names: list[str] | None, holdout: float
) -> Source:
    labels = _idx_array(root, "train-labels-idx1-ubyte")
    names = names or [str(k) for k in range(int(labels.max(initial=0)) + 1)]
    if split == "test":
        images = _idx_array(root, "t10k-images-idx3-ubyte")
        labels = _idx_array(root, "t10k-labels-idx1-ubyte")
    else:
        images = _idx_array(root, "train-images-idx3-ubyte")
        kept = len(images) - math.ceil(holdout * len(images))
        part = slice(kept) if split == "train" else slice(kept, None)
        images, labels = images[part], labels[part]
    if (last := int(labels.max(initial=0))) >= len(names):
        raise ValueError(
            f"{root} has labels up to {last} for the {split!r} split, but its classes are {names}"
        )
    return Arrays(images, labels, names, channels)


def _idx_array(root: Path, name: str) -> np.ndarray:
    file = _idx_file(root, name)
    if file is None:
        raise FileNotFoundError(f"no {name} or .gz in {root}")
    return read_idx(file)


def _digits(split: Split, channels: int, names: list[str] | None, holdout: float) -> Source:
    from sklearn.datasets import load_digits

    digits = load_digits()
    labels = digits.target.tolist()
    parts = hold_out(labels, [str(k) for k in range(len(labels))], holdout, ("test", "val"))
    part = parts[split]
    images = np.round(digits.images[part] * (255 / 16)).astype(np.uint8)
    return Arrays(images, digits.target[part], names or [str(k) for k in range(10)], channels)
