"""What the numbers of a file of labels are, judged by all of them together, since any may be odd.

Programs write them in other units and orders than those of the format. What cannot be as the format
has it is an error, which says what it looks like.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

SIDES, MIDDLE, CORNERS = "x, y, width, height", "the middle, width, height", "x0, y0, x1, y1"
# Of a box (a, b): how many of them a decision needs, as boxes of cut-off objects may reach beyond
# the picture; and the factors of its first corner, a + start b, and its last, step first + b.
_FORMS = {CORNERS: (3, 0.0, 0.0), SIDES: (20, 0.0, 1.0), MIDDLE: (20, -0.5, 1.0)}
_OVER = 0.02  # a share of a side: boxes that reach farther beyond the picture are odd
_ODD, _FEW = 0.1, 0.02  # with more odd boxes a form does not fit, with fewer it does
_FAR = 1.5  # times a side: most numbers of a box are less
_PIXEL = 1.1  # px: no file has all its numbers in the first pixel


def check_form(path: Path, form: str, boxes: Any, areas: Any = 0.0) -> None:
    """ValueError if the boxes of a file have another form than that of its format.

    Args:
        boxes: (N, 4), as shares of the sides of their pictures.
        areas: (N,), as the file has them, as shares of the picture; 0 where it is silent.
    """
    table = np.reshape(boxes, (-1, 4))
    table = np.unique(np.column_stack((table, np.broadcast_to(areas, len(table)))), axis=0)
    odd, same = {}, {}
    for name in _FORMS:
        odd[name], sizes = _odd(name, table)
        same[name] = np.isclose(sizes, table[:, 4], 0.02, 0)
    for name, (least, *_) in _FORMS.items():
        by_area = same[name] & ~same[form]
        misfits = (by_area | odd[form]).sum()
        doubts = (odd[name] | (same[form] & ~same[name])).sum()
        enough = max(_ODD * len(table), least - 2 * by_area.sum())
        if doubts <= _FEW * len(table) and misfits >= enough:
            raise ValueError(
                f"{path}: {misfits} of {len(table)} boxes cannot be {form}, as its format has "
                f"them, but look like {name}: write them as the format has them"
            )


def _odd(form: str, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which boxes (N, 4) reach beyond the picture, or have no area; and their areas."""
    _, start, step = _FORMS[form]
    low = boxes[:, :2] + start * boxes[:, 2:4]
    high = step * low + boxes[:, 2:4]
    fits = (low >= -_OVER) & (high <= 1 + _OVER) & (low < high)
    return ~np.all(fits, axis=1), (high - low).prod(1)


def check_pixels(path: Path, what: str, rows: Iterable[np.ndarray]) -> None:
    """ValueError if all numbers are shares of 1 in place of pixels."""
    has_parts = False
    for numbers in rows:
        if (np.abs(numbers) > _PIXEL).any():
            return
        has_parts |= bool((numbers % 1 > 0).any())
    if has_parts:
        raise ValueError(
            f"{path}: the {what} lie all within the first pixel, so they look like shares of the "
            "sides of the pictures: write them in pixels"
        )


def check_shares(rows: Mapping[str, np.ndarray]) -> None:
    """ValueError if most rows, by their places in words, are in another unit than shares."""
    is_far = {place: np.abs(row) > _FAR for place, row in rows.items()}
    far = {
        place: rows[place].max() for place in rows if 2 * is_far[place].sum() >= len(rows[place])
    }
    if len(far) > len(rows) / 2:
        unit = "pixels" if max(far.values()) > 100 else "per cent or pixels"
        raise ValueError(
            f"{min(far)} has numbers that look like {unit}, as {len(far)} of {len(rows)} lines do: "
            "write them as shares of the sides of the picture"
        )


def boxes_with_more(rows: Mapping[str, np.ndarray]) -> set[str]:
    """The places of rows, of 6 or more numbers, that are no outlines, but boxes with more: the
    score and the number of a track, in any order, or keypoints. Those are whole, in all rows."""
    places: set[str] = set()
    for count in (range(6, 7), range(8, 2**31, 2)):
        part = {place: row for place, row in rows.items() if len(row) in count}
        ends = np.array([(*row[:6], *row[-2:]) for row in part.values()]).reshape(-1, 8)
        whole = (ends % 1 == 0).all(0)
        are_boxes = len(ends) > 2 and 6 in count and not _odd(MIDDLE, ends)[0].any()
        are_all = (ends[:, whole] > 1).any() or (are_boxes and whole[-2:].any())
        is_track = {place: ((row % 1 == 0) & (row > 1)).any() for place, row in part.items()}
        places |= {place for place in part if are_all or is_track[place]}
    return places
