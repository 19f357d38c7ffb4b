"""What the numbers of a file of labels are, judged by all of them together: any one may be odd.

Formats do not say in which unit and order a program has written its numbers. What cannot be as the
format has it is an error, which says what it looks like.
"""

import re
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SIDES, MIDDLE, CORNERS = "x, y, width, height", "the middle, width, height", "x0, y0, x1, y1"
# Of the four numbers of a box, its corners x0, y0, x1, y1; and how many boxes it takes to tell,
# since boxes of things that are cut off reach beyond the picture, and seldom begin at the left.
_FORMS = {
    name: (np.kron(table, np.eye(2)), least)
    for name, table, least in (
        (CORNERS, [[1, 0], [0, 1]], 3), (SIDES, [[1, 1], [0, 1]], 20),
        (MIDDLE, [[1, 1], [-0.5, 0.5]], 20),
    )
}  # fmt: skip
_OVER = 0.02  # a share of a side: boxes that reach farther beyond the picture are odd
_ODD, _FEW = 0.1, 0.02  # shares of odd boxes: more do not fit the format, and fewer fit another one
_SAME = 0.02  # of areas, relatively
_FAR = 3.0  # times a side of the picture: nothing reaches that far
_PIXEL = 1.1  # px: no file has all its numbers in the first pixel


def check_form(path: str | Path, form: str, boxes: np.ndarray, areas: Any = 0) -> None:
    """ValueError if the boxes of a file have another form than that of its format.

    Args:
        boxes: (N, 4), as shares of the sides of their pictures.
        areas: (N,), what the file says of them, as shares of the picture; 0 where it is silent.
    """
    areas = np.broadcast_to(areas, len(boxes))
    table = np.unique(np.column_stack((boxes, areas)), axis=0)
    odd, same = {}, {}
    for name, (matrix, _) in _FORMS.items():
        low, high = np.split(table[:, :4] @ matrix, 2, axis=1)
        odd[name] = ~((low >= -_OVER) & (high <= 1 + _OVER) & (low < high)).all(1)
        same[name] = np.isclose((high - low).prod(1), table[:, 4], _SAME, 0)
    for name, (_, least) in _FORMS.items():
        says_other, says_own = same[name] & ~same[form], same[form] & ~same[name]
        misfits = says_other | odd[form]
        if (odd[name] | says_own).sum() <= _FEW * len(table) and (
            misfits.sum() >= _ODD * len(table) and misfits.sum() + 2 * says_other.sum() >= least
        ):
            raise ValueError(
                f"{path}: {misfits.sum()} of {len(table)} boxes cannot be {form}, as the format "
                f"has them, but look like {name}: write them as the format has them"
            )


def check_pixels(path: str | Path, what: str, rows: Iterable[Any]) -> None:
    """ValueError if all of the numbers are shares of 1 in place of pixels."""
    is_broken = False
    for row in rows:
        numbers = np.asarray(row, float)
        if not (np.abs(numbers) <= _PIXEL).all():
            return
        is_broken |= bool((numbers % 1).any())
    if is_broken:
        raise ValueError(
            f"{path}: the {what} lie all within the first pixel, so they look like shares of the "
            "sides of the pictures: write them in pixels"
        )


def check_shares(rows: Sequence[tuple[str, np.ndarray]]) -> None:
    """ValueError if most rows, each with its place in words, are in another unit than shares."""
    far = [(place, row) for place, row in rows if np.median(np.abs(row)) > _FAR / 2]
    if len(far) > len(rows) / 2:
        other = "per cent or pixels" if max(row.max() for _, row in far) <= 100 else "pixels"
        raise ValueError(
            f"{far[0][0]} has numbers that look like {other}, as "
            f"{len(far)} of {len(rows)} lines do: "
            "write them as shares of the sides of the picture"
        )


def boxes_with_more(rows: Sequence[np.ndarray]) -> list[bool]:
    """Which rows, of 6, 8 or more numbers, are no outlines, but boxes with more numbers: as the
    score and the number of a track, in any order, or keypoints. These are whole in all rows."""
    is_short = np.array([len(row) == 6 for row in rows], bool)
    is_more = np.zeros(len(rows), bool)
    for part in (is_short, ~is_short):
        ends = np.array([(*rows[k][:6], *rows[k][-2:]) for k in np.flatnonzero(part)])
        ends = ends.reshape(-1, 8)
        whole = (ends % 1 == 0).all(0)
        low, high = np.split(ends[:, :4] @ _FORMS[MIDDLE][0], 2, axis=1)
        are_boxes = part is is_short and ((low >= -_OVER) & (high <= 1 + _OVER)).all()
        if (ends[:, whole] > 1).any() or (len(ends) > 2 and whole[-2:].any() and are_boxes):
            is_more |= part
    return is_more.tolist()


def check_place(
    unit: str, sides: Sequence[float], box: np.ndarray, outlines: Sequence[np.ndarray],
    keypoints: np.ndarray | None,
) -> None:  # fmt: skip
    """ValueError for what cannot be seen in a picture with these sides (W, H): a box (4,) that lies
    outside of it, outlines (P, 2) or keypoints (P, 3) that are far from it; or for another v."""
    points = np.zeros((0, 3)) if keypoints is None else keypoints
    if not ((points[:, 2] >= 0) & (points[:, 2] <= 2)).all():
        raise ValueError("has keypoints whose third number, v, is not 0, 1 or 2")
    shown = points[points[:, 2] > 0, :2]
    places = [place.reshape(-1, 2) / sides for place in (box, *outlines, shown)]
    if any((np.abs(place) > _FAR).any() for place in places):
        raise ValueError(f"reaches farther than {_FAR:g} pictures: its numbers must be {unit}")
    if not ((places[0][0] < 1) & (places[0][1] > 0)).all():
        raise ValueError(f"lies outside of its picture: its numbers must be {unit}")


def similar(name: str, names: Iterable[str]) -> str | None:
    """The longest of the names that `name` begins or ends with, or they with it, but for signs."""
    plain = {_plain(other): other for other in names}
    own, ways = _plain(name), (str.startswith, str.endswith)
    fits = [
        other for other in plain
        if own and other and any(way(own, other) or way(other, own) for way in ways)
    ]  # fmt: skip
    return plain[max(fits, key=len)] if fits else None


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "", unicodedata.normalize("NFKD", Path(name).name).casefold())
