"""What a map of points shows of regions: the rest is cut off along the rim of what it shows.

A region is given by its outline. Where the outline leaves what is shown, the rim goes on in its
place, as Weiler and Atherton (1977) cut a polygon with another one. The rim is found by halving,
along rays from a point that is shown.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from darswin.boxes.arrays import PointMap

NO_AREA = 1e-6  # px², of rounding
_STEPS, _HALVINGS = 24, 26
_RAYS = 360
_TURN = np.linspace(-np.pi, np.pi, _RAYS, endpoint=False)
_GRID = np.stack(np.meshgrid(*[(np.arange(16) + 0.5) / 16] * 2), -1).reshape(-1, 2)
_SAME = 1e-3  # rad, or px at a border: places that differ by rounding
# Points of an object have a seam between them if they are far apart in the new picture, and nearer
# than this part of the object in the old one.
_NEAR = 1 / 3


class Part(NamedTuple):
    """A part that is shown, by its outline: `old` (P, 2), and `new` (P, D), where the map leads."""

    old: np.ndarray
    new: np.ndarray


def area_of(outline: np.ndarray) -> float:
    """The area inside an outline (P, 2)."""
    return abs(_signed_area(outline))


def box_of(outlines: Sequence[np.ndarray]) -> np.ndarray:
    """The box (4,) around outlines (P, 2); NaN without a point."""
    points = np.concatenate([np.zeros((0, 2)), *outlines])
    if not len(points):
        return np.full(4, np.nan)
    return np.concatenate((points.min(0), points.max(0)))


def box_of_mask(mask: np.ndarray) -> np.ndarray:
    """The box (4,) of the pixels of a mask (H, W); NaN without any."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return np.full(4, np.nan)
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], float)


def contains(outline: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point (2,) is inside an outline (P, 2)."""
    x, y = (outline - point).T
    ahead_x, ahead_y = np.roll(x, -1), np.roll(y, -1)
    crosses = (y > 0) != (ahead_y > 0)
    side = (x * ahead_y - y * ahead_x) * np.where(ahead_y > y, 1, -1)
    return bool((crosses & (side > 0)).sum() % 2)


def shown_parts(
    outlines: Sequence[np.ndarray], points_map: PointMap, size: tuple[int, int] | None = None
) -> list[tuple[list[Part], float]]:
    """What a map shows of regions.

    A region that jumps from one end of a picture all around to the other has one part, the largest:
    a box has one place.

    Args:
        outlines: (P, 2), with points that are close to each other.
        points_map: a function from points (Q, 2) to (Q, D), NaN where nothing is shown.
        size: (H, W) of the new picture, which covers (0, 0) to (W, H). Things end at its borders.

    Returns:
        For each region, the parts that are shown; and their share of its area, 0 to 1.
    """

    def carry(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        new = points_map(points)
        shown = np.asarray(np.isfinite(new).all(axis=-1))
        if size is not None:
            shown &= ((new >= 0) & (new <= size[::-1])).all(axis=-1)
        return new, shown

    if not len(outlines):
        return []
    lines = [line if _signed_area(line) >= 0 else line[::-1] for line in outlines]
    ends = np.cumsum([len(line) for line in lines])[:-1]
    new, shown = carry(np.concatenate(lines))
    parts: list[list[Part]] = [[] for _ in lines]
    cut: list[_Region] = []
    for k, (line, there, is_shown) in enumerate(
        zip(lines, np.split(new, ends), np.split(shown, ends), strict=True)
    ):
        if len(line) and is_shown.all():
            parts[k] = [Part(line, there)]
        elif len(line) and np.isfinite(line).all():
            cut.append(_Region(k, line, there, is_shown))
    for region, shown_of in zip(cut, _cut_parts(cut, carry), strict=True):
        parts[region.number] = shown_of
    answers = []
    for line, shown_of, is_shown in zip(lines, parts, np.split(shown, ends), strict=True):
        if size is not None:
            shown_of = _in_one_place([_with_corners(part, size) for part in shown_of], size[1])
        whole = area_of(line)
        if whole > NO_AREA:
            share = min(sum(area_of(part.old) for part in shown_of) / whole, 1.0)
        else:
            share = float(is_shown.mean()) if len(shown_of) else 0.0
        answers.append((shown_of, share))
    return answers


class _Region(NamedTuple):
    """A region of which a part is not shown."""

    number: int
    line: np.ndarray
    new: np.ndarray
    is_shown: np.ndarray


def _cut_parts(
    cut: Sequence[_Region], carry: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> list[list[Part]]:
    """The parts of regions inside the rim. All rims are searched at once."""
    if not cut:
        return []
    low = np.array([region.line.min(0) for region in cut])
    sides = np.array([region.line.max(0) for region in cut]) - low
    grids = low[:, None] + _GRID * sides[:, None]
    on_grid = carry(grids.reshape(-1, 2))[1].reshape(len(cut), -1)
    rays = np.stack((np.cos(_TURN), np.sin(_TURN)), -1)
    middles: list[np.ndarray | None] = []
    inner: list[np.ndarray] = []
    outer: list[np.ndarray] = []
    for region, grid, is_shown, side in zip(cut, grids, on_grid, sides, strict=True):
        candidates = np.concatenate((grid[is_shown], region.line[region.is_shown]))
        if not len(candidates):
            middles.append(None)
            continue
        gaps = candidates - (grid[is_shown] if is_shown.any() else candidates).mean(0)
        middle = candidates[np.argmin((gaps**2).sum(1))]
        middles.append(middle)
        ahead = np.roll(region.line, -1, 0)
        crosses = region.is_shown != np.roll(region.is_shown, -1)
        starts = region.is_shown[crosses, None]
        inner += [
            np.where(starts, region.line[crosses], ahead[crosses]),
            np.tile(middle, (_RAYS, 1)),
        ]
        outer += [np.where(starts, ahead[crosses], region.line[crosses]),
                  middle + 1.01 * np.hypot(*side) * rays]  # fmt: skip
    if not inner:
        return [[] for _ in cut]
    lengths = np.cumsum([len(points) for points in inner])[:-1]
    ends = _last_shown(np.concatenate(inner), np.concatenate(outer), carry)
    pieces = iter(zip(*(np.split(points, lengths) for points in ends), strict=True))
    return [
        [] if middle is None else _walk(region, middle, Part(*next(pieces)), Part(*next(pieces)))
        for region, middle in zip(cut, middles, strict=True)
    ]


def _last_shown(
    inner: np.ndarray,
    outer: np.ndarray,
    carry: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """The last points that are shown on the ways from points that are to points that are not, and
    where the map leads."""
    # What is shown may begin again farther out: the first end counts.
    steps = np.linspace(0, 1, _STEPS + 1)[:, None, None]
    way = inner + steps * (outer - inner)
    new, shown = carry(way.reshape(-1, 2))
    new, shown = new.reshape(*way.shape[:2], -1), shown.reshape(way.shape[:2])
    last = np.where(shown.all(0), _STEPS, np.argmin(shown, 0) - 1)
    each = np.arange(len(inner))
    inner, outer, new = way[last, each], way[np.minimum(last + 1, _STEPS), each], new[last, each]
    for _ in range(_HALVINGS):
        middle = (inner + outer) / 2
        there, shown = carry(middle)
        inner = np.where(shown[:, None], middle, inner)
        new = np.where(shown[:, None], there, new)
        outer = np.where(shown[:, None], outer, middle)
    return inner, new


def _walk(region: _Region, middle: np.ndarray, crossings: Part, rim: Part) -> list[Part]:
    """The parts of a region, along its outline and along the rim, both with increasing azimuth."""
    places = np.flatnonzero(region.is_shown != np.roll(region.is_shown, -1))
    if not len(places):
        return [rim] if contains(region.line, middle) else []
    order = np.arange(len(places))
    if region.is_shown[places[0]]:  # begins where the outline comes in
        order = np.roll(order, -1)
    entries, exits = order[::2], order[1::2]
    azimuth = np.arctan2(*(crossings.old - middle).T[::-1])
    rings, todo = [], set(range(len(entries)))
    while todo:
        k, pieces = min(todo), []
        while k in todo:
            todo.remove(k)
            first, last = places[entries[k]] + 1, places[exits[k]] + 1
            if last <= first:
                last += len(region.line)
            within = np.arange(first, last) % len(region.line)
            ahead = (azimuth[entries] - azimuth[exits[k]] + _SAME) % (2 * np.pi) - _SAME
            after = int(np.argmin(ahead))
            on_rim = (_TURN - azimuth[exits[k]]) % (2 * np.pi)
            chosen = np.flatnonzero(on_rim < ahead[after])
            chosen = chosen[np.argsort(on_rim[chosen])]
            pieces += [
                Part(*(of[entries[k : k + 1]] for of in crossings)),
                Part(region.line[within], region.new[within]),
                Part(*(of[exits[k : k + 1]] for of in crossings)),
                Part(*(of[chosen] for of in rim)),
            ]
            k = after
        rings.append(Part(*(np.concatenate(of) for of in zip(*pieces, strict=True))))
    return rings


def _with_corners(part: Part, size: tuple[int, int]) -> Part:
    """A part with the corners of the picture that lie between neighbours on two borders."""
    sides = np.array(size[::-1])
    on = (np.abs(part.new) < _SAME) | (np.abs(part.new - sides) < _SAME)
    ahead, new = np.roll(on, -1, 0), np.roll(part.new, -1, 0)
    turns = (on[:, 0] != on[:, 1]) & (on == ahead[:, ::-1]).all(1)
    corners = np.where(on, part.new, new)[turns]
    between = ((part.old + np.roll(part.old, -1, 0)) / 2)[turns]
    places = np.flatnonzero(turns) + 1
    return Part(np.insert(part.old, places, between, 0), np.insert(part.new, places, corners, 0))


def _in_one_place(parts: list[Part], width: int) -> list[Part]:
    """The parts; or if one jumps from one end of a picture to the other, only the largest."""
    pieces, jumped = [], False
    for old, new in parts:
        leaps = np.abs(np.roll(new[:, 0], -1) - new[:, 0]) > width / 2
        near = np.abs(np.roll(old, -1, 0) - old).max(1) < _NEAR * np.ptp(old, axis=0).max()
        places = np.flatnonzero(leaps & near)
        if not len(places):
            pieces.append(Part(old, new))
            continue
        jumped = True
        turned = [np.roll(of, -places[0] - 1, 0) for of in (old, new)]
        split = (np.split(of, places[1:] - places[0]) for of in turned)
        pieces += [Part(*both) for both in zip(*split, strict=True)]
    return [max(pieces, key=lambda part: area_of(part.new))] if jumped else pieces


def _signed_area(outline: np.ndarray) -> float:
    if not len(outline):
        return 0.0
    x, y = (outline - outline[0]).T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
