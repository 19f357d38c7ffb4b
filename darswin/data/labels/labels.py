"""The things in a picture: boxes, outlines, masks and keypoints, which move with the picture."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from darswin.boxes import carry_points, cut_polygon, decode_rle, ellipses, encode_rle
from darswin.data.cameras import Calibrations
from darswin.utils.image import read_header

Size = tuple[int, int]

# A thing of which a smaller share is visible in the new picture is left out. The share counts from
# the picture that people labelled, so it adds up over several moves.
LEAST_VISIBLE = 0.2
_NO_AREA = 1e-6  # px², of rounding
_SAMPLES = 1000  # pixels of a mask by which its visible share is measured


@dataclass(frozen=True, eq=False)
class Thing:
    """A thing in a picture, in the coordinates of `darswin.boxes`.

    Attributes:
        category: the id of its category.
        box: (4,) x0, y0, x1, y1.
        polygons: its outline, in one or several parts (P, 2); none if only the box is known.
        rle: its mask as `darswin.boxes.encode_rle` writes it, in place of polygons.
        keypoints: (P, 3), x, y and COCO's v: 0 unknown, 1 hidden, 2 seen; or None.
        mirror: for each keypoint, the one that becomes it in a mirrored picture; none if unknown.
        crowd: whether it is a group of things.
        visible: the share of the thing that its picture shows, 0 to 1.
        more: other entries of the data set.
    """

    category: int
    box: np.ndarray
    polygons: Sequence[np.ndarray] = ()
    rle: Mapping[str, Any] | None = None
    keypoints: np.ndarray | None = None
    mirror: Sequence[int] = ()
    crowd: bool = False
    visible: float = 1.0
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def area(self) -> float:
        """px², of the mask, the polygons, or else the box."""
        if self.rle is not None:
            return float(decode_rle(self.rle).sum())
        if len(self.polygons):
            return sum(map(_area, self.polygons))
        return float(np.prod(self.box[2:] - self.box[:2]))


class Labels(NamedTuple):
    """The things in one picture: a target for `darswin.data.Sample`, which `reframe` moves.

    Attributes: things; size: (H, W) of the picture; lost: the number of things that have left the
    picture, because less than `LEAST_VISIBLE` of them, a fifth, is visible.
    """

    things: Sequence[Thing]
    size: Size
    lost: int = 0


class Move(Protocol):
    """A picture that becomes another one, such as a `darswin.data.Reframing`."""

    size: Size

    @property
    def mirrored(self) -> bool:
        """Whether left and right are swapped."""

    def to_new(self, points: np.ndarray) -> np.ndarray:
        """Pixels of the old picture in the new one."""

    def target(self, target: np.ndarray) -> np.ndarray:
        """A map (H, W), uint8, in the new picture; 255 where nothing is known."""


def moved(labels: Labels, move: Move) -> Labels:
    """The labels of the new picture.

    Polygons, keypoints and masks move exactly, and boxes follow from them. Things of which only the
    box is known move as the ellipse inside it. All are cut at the borders of the new picture.
    """
    things = [thing for thing in move_things(labels.things, move) if thing is not None]
    return Labels(things, move.size, labels.lost + len(labels.things) - len(things))


def move_things(things: Sequence[Thing], move: Move) -> list[Thing | None]:
    """Each of the things in the new picture; None for those that have left it, see `moved`."""
    old = [_outlines(thing) for thing in things]
    points = [thing.keypoints[:, :2] for thing in things if thing.keypoints is not None]
    lines = [*(line for lines in old for line in lines), *points]
    ends = np.cumsum([len(line) for line in lines])
    # One call of the map for all.
    flat = carry_points(np.concatenate([*lines, np.zeros((0, 2))]), move.to_new)
    new = iter(np.split(flat, ends[:-1]) if lines else ())
    found = []
    for thing, lines in zip(things, old, strict=True):
        carried = [next(new) for _ in lines]
        found.append(
            _with_mask(thing, move)
            if thing.rle is not None
            else _with_outlines(thing, lines, carried, move.size)
        )
    for place, thing in enumerate(things):
        if thing.keypoints is not None:
            keypoints = _keypoints(thing, next(new), move)
            if (there := found[place]) is not None:
                found[place] = replace(there, keypoints=keypoints)
    return found


def _outlines(thing: Thing) -> list[np.ndarray]:
    """The outlines by which a thing moves, cut finely."""
    if thing.rle is not None:
        return []
    if not len(thing.polygons):
        return [ellipses(thing.box[None])[0]]
    return [cut_polygon(polygon) for polygon in thing.polygons]


def _with_outlines(
    thing: Thing, old: Sequence[np.ndarray], new: Sequence[np.ndarray], size: Size
) -> Thing | None:
    parts, seen = [], 0.0
    for before, after in zip(old, new, strict=True):
        whole = _parts(after, size[1])
        cut = max((_cut(part, size) for part in whole), key=_area)
        if _area(cut) > _NO_AREA:
            share = np.isfinite(after[:, 0]).mean() * _area(cut) / sum(map(_area, whole))
            seen += share * _area(before)
            parts.append(cut)
    visible = thing.visible * min(seen / max(sum(map(_area, old)), _NO_AREA), 1.0)
    if not parts or visible < LEAST_VISIBLE:
        return None
    corners = np.concatenate(parts)
    box = np.concatenate((corners.min(0), corners.max(0)))
    return replace(thing, box=box, polygons=parts if len(thing.polygons) else (), visible=visible)


def _with_mask(thing: Thing, move: Move) -> Thing | None:
    assert thing.rle is not None
    old = decode_rle(thing.rle)
    pixels = np.argwhere(old)[:: 1 + old.sum() // _SAMPLES, ::-1]
    inside = _is_inside(move.to_new(pixels.astype(float)) + 0.5, move.size)
    visible = thing.visible * (inside.mean() if len(inside) else 0.0)
    new = move.target(old.astype(np.uint8)) == 1
    if visible < LEAST_VISIBLE or not new.any():
        return None
    box = box_of_mask(new)
    rle = encode_rle(new, compressed=isinstance(thing.rle["counts"], str))
    return replace(thing, box=box, rle=rle, visible=visible)


def box_of_mask(mask: np.ndarray) -> np.ndarray:
    """The box (4,) of the pixels of a mask (H, W); all 0 if there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return np.zeros(4)
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], float)


def _keypoints(thing: Thing, places: np.ndarray, move: Move) -> np.ndarray:
    """The keypoints (P, 3); those that are unknown or outside of the picture are 0, 0, 0."""
    assert thing.keypoints is not None
    known = (thing.keypoints[:, 2] > 0) & _is_inside(places, move.size)
    new = np.where(known[:, None], np.column_stack((places, thing.keypoints[:, 2])), 0.0)
    return new[list(thing.mirror)] if move.mirrored and len(thing.mirror) else new


def _is_inside(points: np.ndarray, size: Size) -> np.ndarray:
    return np.all((points >= 0) & (points <= size[::-1]), axis=-1)  # False for NaN


def _parts(outline: np.ndarray, width: int) -> list[np.ndarray]:
    """The points of an outline that are seen. It becomes several if it jumps from one end of a view
    all around to the other: the larger one of them is kept, because a box has one place."""
    ahead = np.abs(np.roll(outline[:, 0], -1) - outline[:, 0])
    jumps = np.flatnonzero(ahead > width / 2)  # not for NaN
    parts = [outline]
    if len(jumps):
        parts = np.split(np.roll(outline, -jumps[0] - 1, 0), jumps[1:] - jumps[0])
    return [part[~np.isnan(part[:, 0])] for part in parts]


def _cut(polygon: np.ndarray, size: Size) -> np.ndarray:
    """The part of a polygon (P, 2) inside a picture. Source: Sutherland and Hodgman, 1974."""
    height, width = size
    for axis, limit, sign in ((0, 0, 1), (0, width, -1), (1, 0, 1), (1, height, -1)):
        depth = sign * (polygon[:, axis] - limit)
        inside = depth >= 0
        if inside.all():
            continue
        crosses = inside != np.roll(inside, -1)
        share = depth / np.where(crosses, depth - np.roll(depth, -1), 1.0)
        hits = polygon + share[:, None] * (np.roll(polygon, -1, 0) - polygon)
        kept = np.stack((inside, crosses), 1).ravel()
        polygon = np.stack((polygon, hits), 1).reshape(-1, 2)[kept]
    return polygon


def _area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)


# -- data sets ----------------------------------------------------------------------------------


@dataclass
class LabelledPictures:
    """The pictures of a data set and their things.

    Attributes:
        folder: of the pictures. files: relative to it.
        raw: of each picture, what `read(raw, size)` makes `Labels` of.
        categories: as COCO has them: {"id": 1, "name": "person"}, and more.
        entries: of each picture, what COCO says of it; lenses: its own, if it has any.
    """

    folder: Path
    files: Sequence[str]
    raw: Sequence[Any]
    read: Callable[[Any, Size], Labels]
    categories: Sequence[Mapping[str, Any]]
    entries: Sequence[Mapping[str, Any]] = ()
    lenses: Calibrations | None = None

    def __len__(self) -> int:
        return len(self.files)

    def labels(self, index: int, size: Size | None = None) -> Labels:
        """The things in a picture; size: (H, W) of the upright picture, if it is known."""
        size = size or read_header(self.folder / self.files[index]).upright
        return self.read(self.raw[index], size)
