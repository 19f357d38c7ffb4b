"""Where pictures come from: folders of images, IDX files, the bundled digits.

A source is a sequence: `source[i]` is (image (H, W, C) uint8, label), and it has `classes`, the
names behind the labels. `open_source` finds out which kind a path is and which part of it a split
means.
"""

import gzip
import hashlib
import json
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np

Split = Literal["train", "val", "test"]
SPLITS = ("train", "val", "test")
SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".pgm")


class BrokenImageError(OSError):
    """A file that is no readable image."""


class Source(Protocol):
    """What every source offers."""

    classes: list[str]

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> tuple[np.ndarray, int]:
        """The image (H, W, C) uint8 and its label; BrokenImageError names a file that is none."""


def read_image(path: str | Path, channels: int = 3) -> np.ndarray:
    """A picture file as (H, W, C) uint8, C = 3 (RGB) or 1 (grey), turned upright as its EXIF says.

    Raises:
        BrokenImageError: a file that is missing, unreadable or no image; it names the file.
    """
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise BrokenImageError(f"cannot read {path}: {error.strerror}") from error
    image = None
    if data.size:
        image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB if channels == 3 else cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise BrokenImageError(f"cannot read {path}: no image that OpenCV can decode")
    return image.reshape(*image.shape[:2], channels)


def with_channels(image: np.ndarray, channels: int) -> np.ndarray:
    """The image (H, W, C) with 1 or 3 channels: grey is repeated, RGB becomes its luminance."""
    if image.shape[2] == channels:
        return image
    if channels == 3:
        return np.repeat(image, 3, 2)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None]


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
    - a folder of images, one folder a class; or `train/`, `val/` and `test/` folders of that kind
      (without `test/`, "val" serves as the test set).

    Where a set has no split of its own, "val" and "test" are `holdout` of each class each, chosen
    by a hash of their names.

    Args:
        channels: 3 or 1, of the images that come out.
        classes: a list of class names, as a text file with one a line or a JSON list: which
            folders to take and in which order. For IDX files and digits, the labels' names.
        splits: a JSON file `{"train": ["class/a.jpg", …], "val": …, "test": …}` with paths relative
            to `path`, or a folder of `train.txt`, `val.txt`, `test.txt` with one path a line. The
            first folder of a path is its class.
        holdout: a share, in [0, 0.5).

    Raises:
        FileNotFoundError: no such folder, or nothing in it. ValueError: lists that do not fit it.
    """
    if split not in SPLITS:
        raise ValueError(f"split must be one of {SPLITS}, got {split!r}")
    if not 0 <= holdout < 0.5:
        raise ValueError(f"holdout must be in [0, 0.5), got {holdout}")
    names = None if classes is None else read_list(classes)
    if str(path) == "digits":
        return _digits(split, channels, names, holdout)
    root = Path(path)
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    if _idx_file(root, "train-images-idx3-ubyte"):
        return _idx(root, split, channels, names, holdout)
    return _folder(root, split, channels, names, splits, holdout)


def read_list(path: str | Path) -> list[str]:
    """Names from a text file, one a line, or from a JSON list."""
    text = Path(path).read_text()
    if Path(path).suffix != ".json":
        return [line.strip() for line in text.splitlines() if line.strip()]
    names = json.loads(text)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path} must hold a JSON list of names")
    return names


# -- folders ----------------------------------------------------------------------------------


def _folder(
    root: Path,
    split: Split,
    channels: int,
    names: list[str] | None,
    splits: str | Path | None,
    holdout: float,
) -> Source:
    if splits is not None:
        lists = {name: _listed(Path(splits), name) for name in SPLITS}
        paths = lists[split]
        names = names or _classes(path for part in lists.values() for path in part)
    elif (root / "train").is_dir() and (root / "val").is_dir():
        part = "val" if split == "test" and not (root / "test").is_dir() else split
        training = _images_under(root / "train", names)
        names = names or _classes(training)
        root /= part
        present = [name for name in names if (root / name).is_dir()]
        paths = training if part == "train" else _images_under(root, present)
    else:
        everything = _images_under(root, names)
        names = names or _classes(everything)
        labels = [Path(path).parts[0] for path in everything]
        paths = [everything[k] for k in _held_out(labels, everything, split, holdout)]
    if not paths:
        raise FileNotFoundError(
            f"no images for the {split!r} split in {root}: darswin looks for ROOT/CLASS/*.jpg "
            "(and png, bmp, webp, tif, ppm), or ROOT/train, ROOT/val and ROOT/test of that kind"
        )
    index = {name: label for label, name in enumerate(names)}
    unknown = sorted({Path(p).parts[0] for p in paths} - index.keys())
    if unknown:
        raise ValueError(f"images of {unknown[:5]}, which the list of classes does not name")
    return ImageFiles(root, [(p, index[Path(p).parts[0]]) for p in paths], names, channels)


def _classes(paths: Iterable[str]) -> list[str]:
    """The first folders of paths."""
    return sorted({Path(path).parts[0] for path in paths})


def _images_under(root: Path, names: list[str] | None) -> list[str]:
    """Paths "class/….jpg" below the root, sorted, of these classes or of all; no hidden ones."""
    if names is None:
        names = sorted(p.name for p in root.iterdir() if p.is_dir() and not _hidden(p.name))
    missing = [name for name in names if not (root / name).is_dir()]
    if missing:
        raise FileNotFoundError(f"no folder for the classes {missing[:5]} in {root}")
    return [
        str(path.relative_to(root))
        for name in names
        for path in sorted((root / name).rglob("*"))
        if path.suffix.lower() in SUFFIXES and not _hidden(path.name) and path.is_file()
    ]


def _hidden(name: str) -> bool:
    return name.startswith(".")


def _listed(splits: Path, split: Split) -> list[str]:
    if splits.is_dir():
        file = splits / f"{split}.txt"
        return read_list(file) if file.exists() else []
    lists = json.loads(splits.read_text())
    if not isinstance(lists, dict) or not all(
        isinstance(paths, list) and all(isinstance(path, str) for path in paths)
        for paths in lists.values()
    ):
        raise ValueError(
            f'{splits} must hold {{"train": [paths], "val": [paths], "test": [paths]}}'
        )
    return lists.get(split, [])


def _held_out(labels: Sequence, keys: Sequence[str], split: Split, share: float) -> list[int]:
    """Indices of a split where "val" and "test" take a share of each class.

    Each class is shuffled by hashes of its keys, so that a picture more or less moves hardly any.
    """
    classes: dict[Any, list[int]] = {}
    for index in sorted(
        range(len(keys)), key=lambda k: hashlib.sha1(os.fsencode(keys[k])).digest()
    ):
        classes.setdefault(labels[index], []).append(index)
    chosen = []
    for members in classes.values():
        count = math.ceil(share * len(members))
        ends = dict(test=(0, count), val=(count, 2 * count), train=(2 * count, None))
        chosen += members[slice(*ends[split])]
    return sorted(chosen)


# -- IDX files and digits ---------------------------------------------------------------------


def _idx_file(root: Path, name: str) -> Path | None:
    return next((p for p in (root / name, root / f"{name}.gz") if p.exists()), None)


def read_idx(path: Path) -> np.ndarray:
    """A file of unsigned bytes in the IDX format, gzipped or not; ValueError where it is none."""
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        head = file.read(4)
        if len(head) != 4 or head[:3] != b"\0\0\x08" or not 1 <= head[3] <= 4:
            raise ValueError(f"{path} is no IDX file of unsigned bytes")
        sizes = np.frombuffer(file.read(4 * head[3]), ">u4")
        data = np.frombuffer(file.read(), np.uint8)
    if len(sizes) != head[3] or data.size != math.prod(sizes.tolist()):
        raise ValueError(f"{path} says it holds {sizes.tolist()} bytes, but holds {data.size}")
    return data.reshape(sizes)


def _idx(
    root: Path, split: Split, channels: int, names: list[str] | None, holdout: float
) -> Source:
    part = "t10k" if split == "test" else "train"
    arrays = []
    for kind in ("images-idx3", "labels-idx1"):
        file = _idx_file(root, f"{part}-{kind}-ubyte")
        if file is None:
            raise FileNotFoundError(f"no {part}-{kind}-ubyte or .gz in {root}")
        arrays.append(read_idx(file))
    images, labels = arrays
    names = names or [str(k) for k in range(int(labels.max(initial=0)) + 1)]
    if split != "test":
        kept = len(images) - math.ceil(holdout * len(images))
        part = slice(kept) if split == "train" else slice(kept, None)
        images, labels = images[part], labels[part]
    return Arrays(images, labels, names, channels)


def _digits(split: Split, channels: int, names: list[str] | None, holdout: float) -> Source:
    from sklearn.datasets import load_digits

    digits = load_digits()
    labels = digits.target.tolist()
    part = _held_out(labels, [str(k) for k in range(len(labels))], split, holdout)
    images = np.round(digits.images[part] * (255 / 16)).astype(np.uint8)
    return Arrays(images, digits.target[part], names or [str(k) for k in range(10)], channels)
