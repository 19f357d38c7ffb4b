"""Reading the targets of scenes: a label or a distance for each pixel."""

import warnings
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from darswin.data.splits import some
from darswin.utils.image import BrokenImageError, Header, decoded, file_content, read_header
from darswin.utils.parameters import naming
from darswin.utils.tasks import IGNORE, PixelTask

PER_METRE = 256  # the scale of distances in a PNG of 16 bits
Target = Literal["labels", "distance"]
# The targets of the tasks that predict each pixel.
TARGETS: dict[PixelTask, Target] = {"segmentation": "labels", "distance": "distance"}


class OddLabels(UserWarning):
    """A warning of label PNGs whose ids may not be those that were meant."""


def nothing_of(target: np.ndarray) -> int:
    """The target of unknown pixels: `IGNORE` in labels (uint8), 0 in distances."""
    return IGNORE if target.dtype == np.uint8 else 0


def read_labels(path: Path, classes: int, class_of: Mapping[int, int] | None = None) -> np.ndarray:
    """The ids of classes, or `IGNORE`, in a PNG that is grey or has a palette, (H, W) uint8.

    `class_of` maps every id that the file may hold to its class or to `IGNORE`; without it, the ids
    are those of the classes.
    """
    labels = read_ids(path)
    known = {k: k for k in range(classes)} if class_of is None else class_of
    table = np.full(256, IGNORE, np.uint8)
    table[[id_ for id_ in known if id_ < 256]] = [known[id_] for id_ in known if id_ < 256]
    ids = np.flatnonzero(np.bincount(labels.ravel(), minlength=256)).tolist()
    if wrong := [id_ for id_ in ids if id_ not in known and id_ != IGNORE]:
        told = f"the {classes} classes have the ids 0 to {classes - 1}"
        if class_of is not None:
            told = f"the known ids are {some(sorted(known))}"
        text = (
            f"{path} holds the ids {some(wrong)}, but {told}; {IGNORE} means unlabelled, and "
            "`label_map` maps other ids to classes or to null"
        )
        raise naming(ValueError(text), "label_map")
    if classes == 2 and class_of is None and ids == [0, IGNORE]:
        _tell_once(
            f"{path.parent} holds masks of 0 and {IGNORE}, but {IGNORE} means unlabelled: if it is "
            f'a class here, give a `label_map`, {{"0": 0, "{IGNORE}": 1}}',
            "label_map",
        )
    return table[labels]


def read_ids(path: Path) -> np.ndarray:
    """The ids in a PNG of 1 to 8 bits, grey or with a palette, (H, W) uint8.

    They are the numbers that the file stores. A palette of different greys alone is an exception:
    optimisers write a grey picture so, and its greys were the ids. Some pad it with black.
    """
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=["PNG"]) as file:
            mode, stored = file.mode, str(file.tile[0].args)
            if mode in ("L", "P", "1"):
                labels = np.array(file, np.uint8)
                colors = np.reshape(file.getpalette() or [], (-1, 3))
    except UnidentifiedImageError as error:  # its own message repeats the path
        raise BrokenImageError(f"cannot read {path}: no PNG") from error
    except Exception as error:  # Pillow raises many exceptions for broken files
        raise BrokenImageError(f"cannot read {path}: {_reason(error)}") from error
    if mode not in ("L", "P", "1"):
        kinds = {"I": "16 bits", "LA": "grey with transparency (LA)"}
        raise ValueError(
            f"{path} must hold an id of 8 bits for each pixel, grey or with a palette, but holds "
            f"{kinds.get(mode.partition(';')[0], f'colours ({mode})')}"
        )
    labels //= _SCALES.get(stored, 1)
    if mode == "P" and bool((colors == colors[:, :1]).all()):
        return _greys_or_numbers(labels, colors[:, 0], path)
    return labels


# Pillow stretches grey values of few bits to 0 … 255.
_SCALES = {"L;2": 85, "L;4": 17}


def _greys_or_numbers(labels: np.ndarray, palette: np.ndarray, path: Path) -> np.ndarray:
    """The ids in a PNG whose palette has only greys: its greys if they differ, apart from a padding
    of black at the end, else the numbers of its entries."""
    greys = np.arange(256, dtype=np.uint8)  # also of numbers without an entry
    greys[: len(palette)] = palette
    used = np.unique(labels)
    if np.array_equal(greys[used], used):
        return labels
    known = used[used < len(palette)]
    meant = max(known.max(initial=0), np.flatnonzero(palette).max(initial=0)) + 1
    kind = f"{path.parent} holds label PNGs whose palette has only greys"
    if len(set(palette[:meant])) == meant:
        _tell_once(
            f"{kind}, as programs that shrink PNGs write them: their ids are these greys, not the "
            "numbers of the palette's entries"
        )
        return greys[labels]
    if len(set(greys[known])) == len(known):  # else the greys cannot be ids
        _tell_once(
            f"{kind}, and repeats one of them: their ids are the numbers of the palette's entries; "
            "if the greys are the ids, convert the PNGs to grey ones"
        )
    return labels


@cache
def _tell_once(text: str, *parameters: str) -> None:
    warnings.warn(naming(OddLabels(text), *parameters), stacklevel=3)


def read_distance(path: Path, far: float | None = None) -> np.ndarray:
    """The distances (H, W) float32, metres, in a PNG of 16 bits or a NumPy file; 0 for values that
    are not finite, not above 0, or at least `far`."""
    if path.suffix.lower() == ".npy":
        metres = _open_metres(path)
        with np.errstate(over="ignore"):  # infinite means unknown
            metres = metres.astype(np.float32)
    else:
        image = decoded(file_content(path), path, cv2.IMREAD_UNCHANGED)
        if image.dtype != np.uint16 or image.ndim != 2:
            colours = 1 if image.ndim == 2 else image.shape[2]
            raise ValueError(
                f"{path} must hold a distance of 16 bits for each pixel, metres × {PER_METRE}, but "
                f"holds {colours} × {8 * image.dtype.itemsize} bits"
            )
        metres = image.astype(np.float32) / np.float32(PER_METRE)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(metres) & (metres > 0)
        if far is not None:
            known &= metres < far
    return np.where(known, metres, np.float32(0))


def _open_metres(path: Path) -> np.ndarray:
    """The metres (H, W) in a NumPy file, which are read from the file when they are needed."""
    try:
        metres = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # NumPy raises many exceptions for broken files
        raise BrokenImageError(f"cannot read {path}: {_reason(error)}") from error
    if not isinstance(metres, np.ndarray) or metres.ndim != 2 or metres.dtype.kind != "f":
        form = "an archive"
        if isinstance(metres, np.ndarray):
            form = f"{metres.dtype} {metres.shape}"
        raise ValueError(f"{path} must hold floating-point metres (H, W), but holds {form}")
    return metres


def target_header(path: Path) -> Header:
    """The header of a file of labels or distances."""
    if path.suffix.lower() == ".npy":
        height, width = _open_metres(path).shape
        return Header((height, width))
    return read_header(path)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


class Kind(NamedTuple):
    """A kind of targets. Attributes: suffixes: of its files; dtype: of its arrays (H, W); read: the
    function that reads a file."""

    suffixes: tuple[str, ...]
    dtype: type
    read: Callable[..., np.ndarray]


KINDS: dict[Target, Kind] = {
    "labels": Kind((".png",), np.uint8, read_labels),
    "distance": Kind((".png", ".npy"), np.float32, read_distance),
}


def nothing(kind: Target, shape: tuple[int, int]) -> np.ndarray:
    """A target without any known pixel."""
    target: np.ndarray = np.empty(shape, KINDS[kind].dtype)
    target[:] = nothing_of(target)
    return target
