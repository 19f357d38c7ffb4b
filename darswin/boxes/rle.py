"""Run lengths of masks as COCO writes them.

Source: github.com/cocodataset/cocoapi, maskApi.c.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from darswin.boxes.arrays import Array, shape_of, to_numpy

_MOST_PIXELS = 2**28  # of a mask; a file of a few bytes may declare any size
_MOST_GROUPS = 12  # of 5 bits, for a number of 60 bits


def encode_rle(mask: Array, *, compressed: bool = True) -> dict[str, Any]:
    """A mask (H, W) in COCO's run-length encoding: {"size": [H, W], "counts": text, or a list of
    numbers unless `compressed`}."""
    pixels = np.asarray(to_numpy(mask)) != 0
    if pixels.ndim != 2:
        raise ValueError(f"a mask must have shape (H, W), got {shape_of(pixels)}")
    flat = pixels.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts = np.diff(changes, prepend=0, append=flat.size).tolist()
    counts = [0] * bool(flat.size and flat[0]) + counts
    size = list(pixels.shape)
    return {"size": size, "counts": _to_text(counts) if compressed else counts}


def decode_rle(rle: Mapping[str, Any]) -> np.ndarray:
    """The mask (H, W), bool, of COCO's run-length encoding, compressed or not.

    Raises:
        ValueError: size or counts are missing or wrong, or runs do not fill the mask.
    """
    try:
        size, counts = rle["size"], rle["counts"]
    except (KeyError, TypeError) as error:
        raise ValueError("a run-length encoding must have a size [H, W] and counts") from error
    height, width, runs = _checked_runs(size, counts)
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape((height, width), order="F")


def _checked_runs(size: Any, counts: Any) -> tuple[int, int, np.ndarray]:
    """Height, width and the runs, int64, which fill the mask; ValueError if they do not."""
    sides = size if isinstance(size, Sequence | np.ndarray) and len(size) == 2 else ()
    sides = [int(side) for side in sides if _is_whole(side) and 0 <= side <= _MOST_PIXELS]
    if len(sides) != 2 or sides[0] * sides[1] > _MOST_PIXELS:
        raise ValueError(
            "a run-length encoding must have a size [H, W] and counts, and at most "
            f"{_MOST_PIXELS} pixels, got the size {str(size)[:80]}"
        )
    height, width = sides
    if isinstance(counts, bytes):
        counts = counts.decode("ascii")
    runs = _numbers(_from_text(counts) if isinstance(counts, str) else counts)
    total = height * width
    said = f"the counts of a run-length encoding of {height} × {width} px must be"
    if runs.ndim != 1 or (runs < 0).any() or (runs > total).any():
        raise ValueError(f"{said} numbers from 0 to {total}, got {str(runs)[:80]}")
    runs = runs.astype(np.int64)  # whose sum is now far below 2⁶³
    if runs.sum() != total:
        raise ValueError(f"{said} at least 0 and have the sum {total}, got {runs.sum()}")
    return height, width, runs


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and value == value // 1


def _numbers(counts: Any) -> np.ndarray:
    try:
        runs = np.asarray(counts)
    except ValueError:  # lists of several lengths
        runs = np.zeros(1, object)
    if not runs.size:
        return np.zeros(0, np.int64)
    if runs.dtype.kind not in "iuf" or not (np.isfinite(runs) & (runs == np.rint(runs))).all():
        raise ValueError("the counts of a run-length encoding must be whole numbers, or a text")
    return runs


def _to_text(counts: Sequence[int]) -> str:
    """Counts as differences to the count before the last, in groups of 5 bits, lowest first."""
    text = []
    for place, count in enumerate(counts):
        value = count - counts[place - 2] if place > 2 else count
        while True:
            bits, value = value & 31, value >> 5
            more = value != (-1 if bits & 16 else 0)
            text.append(chr(48 + bits + 32 * more))
            if not more:
                break
    return "".join(text)


def _from_text(text: str) -> list[int]:
    """The counts of a text; ValueError if it is none."""
    counts: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"a run-length encoding must not contain {character!r}")
        value |= (bits & 31) << shift
        shift += 5
        if shift > 5 * _MOST_GROUPS:
            raise ValueError("a run-length encoding has a number of more than 60 bits")
        if not bits & 32:
            value -= (1 << shift) * bool(bits & 16)
            value += counts[-2] if len(counts) > 2 else 0
            if not 0 <= value <= _MOST_PIXELS:
                raise ValueError(
                    f"the counts of a run-length encoding must be whole numbers, at least 0 and at "
                    f"most {_MOST_PIXELS}, got {value}"
                )
            counts.append(value)
            value = shift = 0
    if shift:
        raise ValueError("a run-length encoding ends within a number")
    return counts
