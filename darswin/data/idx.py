"""Data sets as IDX files, the MNIST family."""

import gzip
import math
import zlib
from pathlib import Path

import numpy as np

from darswin.data.sources import Arrays
from darswin.data.splits import Split


def fits(path: Path) -> bool:
    """Whether a folder holds IDX files."""
    return _file(path, "train-images-idx3-ubyte") is not None


def _file(root: Path, name: str) -> Path | None:
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


def open_split(
    root: Path, split: Split, channels: int, names: list[str] | None, holdout: float
) -> Arrays:
    """A split; arguments and errors as `darswin.data.open_source`."""
    labels = _array(root, "train-labels-idx1-ubyte")
    names = names or [str(k) for k in range(int(labels.max(initial=0)) + 1)]
    if split == "test":
        images = _array(root, "t10k-images-idx3-ubyte")
        labels = _array(root, "t10k-labels-idx1-ubyte")
    else:
        images = _array(root, "train-images-idx3-ubyte")
        kept = len(images) - math.ceil(holdout * len(images))
        part = slice(kept) if split == "train" else slice(kept, None)
        images, labels = images[part], labels[part]
    if (last := int(labels.max(initial=0))) >= len(names):
        raise ValueError(
            f"{root} has labels up to {last} for the {split!r} split, but its classes are {names}"
        )
    return Arrays(images, labels, names, channels)


def _array(root: Path, name: str) -> np.ndarray:
    file = _file(root, name)
    if file is None:
        raise FileNotFoundError(f"no {name} or .gz in {root}")
    return read_idx(file)
