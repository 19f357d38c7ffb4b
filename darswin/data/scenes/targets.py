"""Reading what is known of each pixel: labels as PNG, distances as PNG or NPY."""

import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from darswin.data.splits import some
from darswin.utils.image import BrokenImageError

IGNORE = 255  # the label of a pixel that is of no class
PER_METRE = 256  # of a distance in a PNG of 16 bits
LABEL_SUFFIXES = (".png",)
DISTANCE_SUFFIXES = (".png", ".npy")


def nothing_of(target: np.ndarray) -> int:
    """What a target holds where it says nothing: `IGNORE` of labels (uint8), 0 of distances."""
    return IGNORE if target.dtype == np.uint8 else 0


def read_labels(path: Path, classes: int) -> np.ndarray:
    """A label PNG as (H, W) uint8: ids of so many classes, or `IGNORE`. Of a PNG with a palette
    the ids count, not their colours.

    Raises:
        BrokenImageError: a file that is missing or cannot be read. ValueError: one of 16 bits or of
            colours, or an id that is no class's. Both name the file.
    """
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as file:
            mode = file.mode
            if mode in ("L", "P", "1"):
                labels = np.array(file, np.uint8)
    except Exception as error:  # a file that is no PNG fails in many ways
        raise BrokenImageError(f"cannot read {path}: {_reason(error)}") from error
    if mode not in ("L", "P", "1"):
        raise ValueError(
            f"{path} must hold an id of 8 bits for each pixel, grey or with a palette, but "
            f"holds {'16 bits' if mode.startswith('I') else f'colours ({mode})'}"
        )
    ids = np.flatnonzero(np.bincount(labels.ravel(), minlength=256)).tolist()
    if wrong := [id_ for id_ in ids if classes <= id_ != IGNORE]:
        raise ValueError(
            f"{path} holds the ids {some(wrong)}, and there are {classes} classes, of the ids 0 to "
            f"{classes - 1}; {IGNORE} is no class"
        )
    return labels


def read_distance(path: Path, far: float | None = None) -> np.ndarray:
    """Distances along the rays (H, W) float32, metres; 0 where they are not known: where they are
    not finite, not above 0, or at least `far`.

    Args:
        path: a PNG of 16 bits, metres × 256; or a NumPy file of floating-point metres.

    Raises:
        BrokenImageError: a file that is missing or cannot be read. ValueError: one of another form.
            Both name the file.
    """
    metres = _numbers(path) if path.suffix.lower() == ".npy" else _sixteen_bits(path)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(metres) & (metres > 0)
        if far is not None:
            known &= metres < far
    return np.where(known, metres, np.float32(0))


def _numbers(path: Path) -> np.ndarray:
    try:
        metres = np.load(path, allow_pickle=False)
    except Exception as error:  # as above
        raise BrokenImageError(f"cannot read {path}: {_reason(error)}") from error
    if not isinstance(metres, np.ndarray) or metres.ndim != 2 or metres.dtype.kind != "f":
        form = f"{metres.dtype} {metres.shape}" if isinstance(metres, np.ndarray) else "an archive"
        raise ValueError(f"{path} must hold floating-point metres (H, W), but holds {form}")
    with np.errstate(over="ignore"):  # infinite is not known
        return metres.astype(np.float32)


def _sixteen_bits(path: Path) -> np.ndarray:
    try:
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except (OSError, cv2.error, MemoryError) as error:
        raise BrokenImageError(f"cannot read {path}: {_reason(error)}") from error
    if image is None:
        raise BrokenImageError(f"cannot read {path}: no image that OpenCV can decode")
    if image.dtype != np.uint16 or image.ndim != 2:
        colours = 1 if image.ndim == 2 else image.shape[2]
        raise ValueError(
            f"{path} must hold a distance of 16 bits for each pixel, metres × {PER_METRE}, but "
            f"holds {colours} × {8 * image.dtype.itemsize} bits"
        )
    return image.astype(np.float32) / np.float32(PER_METRE)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
