"""Pictures with a label each: folders of images, IDX files and scikit-learn's digits."""

import gzip
import math
import os
import statistics
import warnings
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from darswin.data.folders import class_of, open_folder
from darswin.data.splits import SPLITS, Limited, Split, check_split, hold_out, read_classes
from darswin.utils.image import (
    BrokenImageError,
    Header,
    read_header,
    read_image,
    read_oriented,
    with_channels,
)
from darswin.utils.parameters import naming

_LOOKED_AT = 32  # pictures whose headers tell the form of all


class Form(NamedTuple):
    """The form of a data set's pictures.

    Attributes: channels: 1 if all are grey, else 3; side: px, the median of their shorter sides.
    """

    channels: int
    side: int


def form_of(file: Callable[[int], Path | None], count: int) -> Form:
    """The form of `count` picture files, from the headers of some of them."""
    headers: list[Header] = []
    errors: list[BrokenImageError] = []
    for index in range(0, count, -(-count // _LOOKED_AT)):
        path = file(index)
        assert path is not None
        try:
            with warnings.catch_warnings(action="ignore"):
                headers.append(read_header(path))
        except BrokenImageError as error:
            errors.append(error)
    if not headers:
        raise errors[0]
    sides = [min(header.size) for header in headers]
    return Form(max(header.channels for header in headers), statistics.median_low(sides))


class Source(Limited):
    """A sequence of pictures: `source[i]` is (image (H, W, C) uint8, label)."""

    def __init__(self, labels: np.ndarray, classes: Sequence[str], channels: int = 3):
        self.labels, self.classes, self.channels = labels, list(classes), channels

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        raise NotImplementedError

    def oriented(self, index: int) -> tuple[np.ndarray, int, int]:
        """The upright image, its label, and the EXIF orientation of the stored image."""
        return *self[index], 1

    def file(self, index: int) -> Path | None:
        """The file of the image, if it has one."""
        return None

    def form(self) -> Form:
        """The form of the pictures as they are stored."""
        return form_of(self.file, len(self))


class ImageFiles(Source):
    """Picture files in `root`, given as (path, label) pairs."""

    PER_PICTURE = ("labels", "paths")

    def __init__(self, root: Path, files: Sequence[tuple[str, int]], classes: Sequence[str]):
        super().__init__(np.array([label for _, label in files], np.int64), classes)
        self.root = Path(root)
        # Worker processes share an array, but would copy a million strings.
        self.paths = np.array([os.fsencode(path) for path, _ in files], dtype=np.bytes_)

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        return read_image(self.file(index), self.channels), int(self.labels[index])

    def oriented(self, index: int) -> tuple[np.ndarray, int, int]:
        image, orientation = read_oriented(self.file(index), self.channels)
        return image, int(self.labels[index]), orientation

    def file(self, index: int) -> Path:
        return self.root / os.fsdecode(self.paths[index])


class Arrays(Source):
    """Images in memory: (N, H, W) or (N, H, W, C) uint8, and their labels (N,)."""

    PER_PICTURE = ("labels", "images")

    def __init__(
        self, images: np.ndarray, labels: np.ndarray, classes: Sequence[str], channels: int = 3
    ):
        if len(images) != len(labels):
            raise ValueError(f"there are {len(images)} images and {len(labels)} labels")
        super().__init__(labels, classes, channels)
        self.images = images if images.ndim == 4 else images[..., None]

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        return with_channels(self.images[index], self.channels), int(self.labels[index])

    def form(self) -> Form:
        height, width, channels = self.images.shape[1:]
        return Form(channels, min(height, width))


def open_source(
    path: str | Path,
    split: Split,
    *,
    channels: int | None = 3,
    classes: str | Path | None = None,
    splits: str | Path | None = None,
    holdout: float = 0.1,
) -> Source:
    """The pictures of one split of a data set: `source[i]` is (image (H, W, C) uint8, label).

    What `path` may be:

    - "digits": scikit-learn's 1797 scanned digits of 8×8 pixels;
    - a folder of IDX files, as MNIST has them: `train-images-idx3-ubyte[.gz]` and its three
      companions. "val" is the last `holdout` of the training set;
    - a folder with a folder of images for each class; or the folders `train/`, `val/` (also
      `valid/`, `validation/`) and `test/`, each with folders of classes. Links to folders are
      followed; hidden folders are ignored.

    Without a test set, "val" serves as one. Other missing splits get `holdout` of each class of
    "train", chosen by a hash of the names; at least one picture of a class is left to train on.
    `LeftOut` warnings name pictures that are in no split.

    Args:
        channels: the channels of the images, 3 or 1. None means 1 if all pictures are grey,
            otherwise 3; only the headers of some pictures are checked.
        classes: a text file with a class name per line, or a JSON list. It selects and orders the
            folders of classes. For IDX files and digits, it names the labels.
        splits: a JSON file `{"train": ["class/a.jpg", …], "val": …, "test": …}` with paths relative
            to `path`, or a folder of `train.txt`, `val.txt`, `test.txt` with one path per line. The
            first folder of a path is its class. A split without a list is held out.
        holdout: a share, in [0, 0.5).

    Raises:
        FileNotFoundError: a missing or empty folder, or a listed picture that is missing.
        ValueError: ambiguous folders, lists that do not fit the folders, or a picture that is
            listed to train with and also for another split; it names them.
    """
    check_split(split, SPLITS, holdout)
    names = None if classes is None else read_classes(classes)
    root = Path(path)
    in_memory = str(path) == "digits" or _idx_file(root, "train-images-idx3-ubyte") is not None
    if in_memory and splits is not None:
        text = f"`splits` is for folders of images, but {path} is none"
        raise naming(ValueError(text), "splits")
    if not in_memory and not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    source: Source
    if str(path) == "digits":
        source = _digits(split, names, holdout)
    elif in_memory:
        source = _idx(root, split, names, holdout)
    else:
        (folder, paths), names = open_folder(root, split, names, splits, holdout)
        label = {name: k for k, name in enumerate(names)}
        source = ImageFiles(folder, [(p, label[class_of(p)]) for p in paths], names)
    if not len(source):
        text = (
            f"no images for the {split!r} split of {path}: `holdout` {holdout:g} leaves none for it"
        )
        raise naming(FileNotFoundError(text), "holdout")
    source.channels = channels or source.form().channels
    return source


def _digits(split: Split, names: list[str] | None, holdout: float) -> Arrays:
    """scikit-learn's 1797 scanned digits of 8×8 pixels."""
    from sklearn.datasets import load_digits

    digits = load_digits()
    labels = digits.target.tolist()
    keys = [str(k) for k in range(len(labels))]
    part = hold_out(labels, keys, holdout, ("test", "val"))[split]
    images = np.round(digits.images[part] * (255 / 16)).astype(np.uint8)
    return Arrays(images, digits.target[part], names or [str(k) for k in range(10)])


# -- IDX files, the MNIST family --------------------------------------------------------------


def _idx(root: Path, split: Split, names: list[str] | None, holdout: float) -> Arrays:
    labels = read_idx(root, "train-labels-idx1-ubyte")
    names = names or [str(k) for k in range(int(labels.max(initial=0)) + 1)]
    if split == "test":
        images = read_idx(root, "t10k-images-idx3-ubyte")
        labels = read_idx(root, "t10k-labels-idx1-ubyte")
    else:
        images = read_idx(root, "train-images-idx3-ubyte")
        kept = len(images) - math.ceil(holdout * len(images))
        part = slice(kept) if split == "train" else slice(kept, None)
        images, labels = images[part], labels[part]
    if (last := int(labels.max(initial=0))) >= len(names):
        raise ValueError(
            f"{root} has labels up to {last} in the {split!r} split, but its classes are {names}"
        )
    return Arrays(images, labels, names)


def _idx_file(root: Path, name: str) -> Path | None:
    return next((p for p in (root / name, root / f"{name}.gz") if p.exists()), None)


def read_idx(root: Path, name: str) -> np.ndarray:
    """A file of unsigned bytes in the IDX format, possibly gzipped; ValueError for other files."""
    path = _idx_file(root, name)
    if path is None:
        raise FileNotFoundError(f"no {name} or .gz in {root}")
    try:
        with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
            head = file.read(4)
            if len(head) != 4 or head[:3] != b"\0\0\x08" or not 1 <= head[3] <= 4:
                raise ValueError(f"{path} is not an IDX file of unsigned bytes")
            sizes = np.frombuffer(file.read(4 * head[3]), ">u4")
            data = np.frombuffer(file.read(), np.uint8)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path} is not a complete gzip file: {error}") from error
    if len(sizes) != head[3] or data.size != math.prod(sizes.tolist()):
        raise ValueError(f"{path} must hold {sizes.tolist()} bytes, but holds {data.size}")
    return data.reshape(sizes)
