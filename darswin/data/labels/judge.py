"""What the numbers of a file of labels are, judged by all of them together, since any may be odd.

Programs write them in other units and orders than those of the format. What cannot be as the format
has it is an error, which says what it looks like.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SIDES, MIDDLE, CORNERS = "x, y, width, height", "the middle, width, height", "x0, y0, x1, y1"
# Factors of the four numbers of a box, for the corners (first, last) of either side.
_CORNERS_OF = {
    name: np.kron(np.array(table), np.eye(2))
    for name, table in (
        (CORNERS, [[1.0, 0.0], [0.0, 1.0]]), (SIDES, [[1.0, 1.0], [0.0, 1.0]]),
        (MIDDLE, [[1.0, 1.0], [-0.5, 0.5]]),
    )
}  # fmt: skip
# How many boxes it takes to tell: those of things that are cut off reach beyond the picture.
_LEAST = {CORNERS: 3, SIDES: 20, MIDDLE: 20}
_OVER = 0.02  # a share of a side: boxes that reach farther beyond the picture are odd
_ODD, _FEW = 0.1, 0.02  # with more odd boxes a form does not fit, with fewer it does
_FAR = 3.0  # times a side of the picture: nothing reaches that far
_PIXEL = 1.1  # px: no file has all its numbers in the first pixel


def check_form(path: Path, form: str, boxes: Any, areas: Any = 0.0) -> None:
    """ValueError if the boxes of a file have another form than that of its format.

    Args:
        boxes: (N, 4), as shares of the sides of their pictures.
        areas: (N,), as the file has them, as shares of the picture; 0 where it is silent.
    """
    table = np.reshape(boxes, (-1, 4))
    table = np.unique(np.column_stack((table, np.broadcast_to(areas, len(table)))), axis=0)
    odd = {name: _odd(name, table[:, :4]) for name in _LEAST}
    wide = {name: np.subtract(*np.split(table[:, :4] @ _CORNERS_OF[name], 2, 1)) for name in _LEAST}
    same = {name: np.isclose(wide[name].prod(1), table[:, 4], 0.02, 0) for name in _LEAST}
    for name, least in _LEAST.items():
        by_area = same[name] & ~same[form]
        misfits = (by_area | odd[form]).sum()
        doubts = (odd[name] | (same[form] & ~same[name])).sum()
        if doubts <= _FEW * len(table) and misfits >= max(
            _ODD * len(table), least - 2 * by_area.sum()
        ):
            raise ValueError(
                f"{path}: {misfits} of {len(table)} boxes cannot be {form}, as its format has "
                f"them, but look like {name}: write them as the format has them"
            )


def _odd(form: str, boxes: np.ndarray) -> np.ndarray:
    """Which boxes (N, 4) reach beyond the picture, or have no area."""
    low, high = np.split(boxes @ _CORNERS_OF[form], 2, axis=1)
    return ~np.all((low >= -_OVER) & (high <= 1 + _OVER) & (low < high), axis=1)


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


def check_shares(rows: Sequence[tuple[str, np.ndarray]]) -> None:
    """ValueError if most rows, each with its place in words, are in another unit than shares."""
    far = [(place, row.max()) for place, row in rows if np.median(np.abs(row)) > _FAR / 2]
    if len(far) > len(rows) / 2:
        unit = "pixels" if max(most for _, most in far) > 100 else "per cent or pixels"
        raise ValueError(
            f"{far[0][0]} has numbers that look like {unit}, as {len(far)} of {len(rows)} lines "
            "do: write them as shares of the sides of the picture"
        )


def boxes_with_more(rows: Sequence[tuple[str, np.ndarray]]) -> list[str]:
    """The places of rows, of 6, 8 or more numbers, that are no outlines, but boxes with more: the
    score and the number of a track, in any order, or keypoints. Those are whole, in all rows."""
    places = []
    for is_short in (True, False):
        part = [(place, row) for place, row in rows if (len(row) == 6) == is_short]
        ends = np.array([(*row[:6], *row[-2:]) for _, row in part]).reshape(-1, 8)
        whole = (ends % 1 == 0).all(0)
        are_boxes = is_short and len(ends) > 2 and not _odd(MIDDLE, ends[:, :4]).any()
        are_all = (ends[:, whole] > 1).any() or (are_boxes and whole[-2:].any())
        places += [place for place, row in part if are_all or ((row % 1 == 0) & (row > 1)).any()]
    return places


def check_place(
    unit: str, sides: Sequence[float] | np.ndarray, box: np.ndarray,
    outlines: Sequence[np.ndarray], keypoints: np.ndarray | None,
) -> None:  # fmt: skip
    """ValueError for what cannot be seen in a picture with these sides (W, H): a box (4,) that lies
    outside of it, outlines (P, 2) or keypoints (P, 3) that are far from it; or for another v."""
    points = np.zeros((0, 3)) if keypoints is None else keypoints
    if not ((points[:, 2] >= 0) & (points[:, 2] <= 2)).all():
        raise ValueError("has keypoints whose third number, v, is not 0, 1 or 2")
    places = [
        place.reshape(-1, 2) / sides for place in (box, *outlines, points[points[:, 2] > 0, :2])
    ]
    is_far = any((np.abs(place) > _FAR).any() for place in places)
    if is_far or not ((places[0][0] < 1) & (places[0][1] > 0)).all():
        raise ValueError(f"must lie in its picture, with numbers that are {unit}")
