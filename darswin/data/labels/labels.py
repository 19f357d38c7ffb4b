"""The things in a picture: boxes, outlines, masks and keypoints, which move with the picture."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from darswin.boxes import carry, carry_points, decode_rle, encode_rle, turned
from darswin.boxes.carried import cut_polygon, ellipses
from darswin.boxes.regions import NO_AREA, Part, area_of, box_of, shown_parts
from darswin.data.cameras import Calibrations
from darswin.utils.image import read_header
from darswin.views import Remap

Size = tuple[int, int]

# A thing of which a smaller share is visible in the new picture is left out. The share counts from
# the picture that people labelled, so it adds up over several moves.
LEAST_VISIBLE = 0.2
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
        turn: rad, by which the box is turned about its middle, clockwise on a screen.
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
    turn: float = 0.0
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def area(self) -> float:
        """px², of the mask, the polygons, or else the box."""
        if self.rle is not None:
            return float(decode_rle(self.rle).sum())
        if len(self.polygons):
            return sum(map(area_of, self.polygons))
        return float(np.prod(self.box[2:] - self.box[:2]))


class Labels(NamedTuple):
    """The things in one picture: a target for `darswin.data.Sample`, which `Sample.through` moves.

    Attributes: things; size: (H, W) of the picture; lost: the number of things that have left the
    picture, because less than `LEAST_VISIBLE` of them, a fifth, is visible.
    """

    things: Sequence[Thing]
    size: Size
    lost: int = 0


def moved(labels: Labels, remap: Remap) -> Labels:
    """The labels of the picture that a view shows.

    Polygons, keypoints and masks move exactly, and boxes follow from them. Things of which only the
    box is known move as the ellipse inside it. All are cut at the borders of the new picture, and
    where it shows nothing.
    """
    found = move_things(labels.things, remap)
    things = [thing for thing in found if thing.visible >= LEAST_VISIBLE]
    return Labels(things, remap.view_size, labels.lost + len(found) - len(things))


def move_things(things: Sequence[Thing], remap: Remap) -> list[Thing]:
    """Each of the things in the new picture, with what is visible of it, also if it is nothing."""
    old = [_outlines(thing) for thing in things]
    shown = iter(shown_parts(
        [line for lines in old for line in lines],
        lambda points: carry_points(points, remap.to_view), remap.view_size,
    ))  # fmt: skip
    boxes = np.array([thing.box for thing in things if _is_box(thing)]).reshape(-1, 4)
    carried = zip(*carry(boxes, remap.to_view, remap.view_size), strict=True)

    def move(thing: Thing, lines: Sequence[np.ndarray]) -> Thing:
        if thing.rle is not None:
            return _with_mask(thing, remap)
        if _is_box(thing):
            box, seen = next(carried)
            return replace(thing, box=box, visible=thing.visible * float(seen))
        return _with_outlines(thing, lines, [next(shown) for _ in lines])

    return [
        _with_keypoints(move(thing, lines), thing, remap)
        for thing, lines in zip(things, old, strict=True)
    ]


def _is_box(thing: Thing) -> bool:
    """Whether only an upright box is known."""
    return thing.rle is None and not len(thing.polygons) and not thing.turn


def _outlines(thing: Thing) -> list[np.ndarray]:
    """The outlines by which a thing moves, cut finely."""
    if thing.rle is not None or _is_box(thing):
        return []
    if len(thing.polygons):
        return [cut_polygon(polygon) for polygon in thing.polygons]
    box = turned(thing.box[None])
    box[:, 4] = thing.turn
    return [*ellipses(box, 288)]


def _with_outlines(
    thing: Thing, old: Sequence[np.ndarray], shown: Sequence[tuple[list[Part], float]]
) -> Thing:
    areas = [area_of(line) for line in old]
    shares = [share for _, share in shown]
    seen = np.average(shares, weights=areas if sum(areas) > NO_AREA else None)
    polygons = [part.new for parts, _ in shown for part in parts]
    return replace(
        thing, box=box_of(polygons), polygons=polygons if len(thing.polygons) else (),
        visible=thing.visible * float(seen), turn=0.0,
    )  # fmt: skip


def _with_mask(thing: Thing, remap: Remap) -> Thing:
    assert thing.rle is not None
    old = decode_rle(thing.rle)
    pixels = np.argwhere(old)[:: 1 + old.sum() // _SAMPLES, ::-1]
    inside = _is_inside(remap.to_view(pixels.astype(float)) + 0.5, remap.view_size)
    visible = thing.visible * (inside.mean() if len(inside) else 0.0)
    new = remap.target(old.astype(np.uint8)) == 1
    visible = visible if new.any() else 0.0
    box = box_of_mask(new)
    rle = encode_rle(new, compressed=isinstance(thing.rle["counts"], str))
    return replace(thing, box=box, rle=rle, visible=visible)


def box_of_mask(mask: np.ndarray) -> np.ndarray:
    """The box (4,) of the pixels of a mask (H, W); all 0 if there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return np.zeros(4)
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], float)


def _with_keypoints(new: Thing, old: Thing, remap: Remap) -> Thing:
    """Keypoints (P, 3) move; those that are unknown or outside of the picture are 0, 0, 0."""
    if old.keypoints is None:
        return new
    places = carry_points(old.keypoints[:, :2], remap.to_view)
    known = (old.keypoints[:, 2] > 0) & _is_inside(places, remap.view_size)
    there = np.where(known[:, None], np.column_stack((places, old.keypoints[:, 2])), 0.0)
    mirror = list(old.mirror) if remap.mirrored and len(old.mirror) else slice(None)
    return replace(new, keypoints=there[mirror])


def _is_inside(points: np.ndarray, size: Size) -> np.ndarray:
    return np.all((points >= 0) & (points <= size[::-1]), axis=-1)  # False for NaN


# -- data sets ----------------------------------------------------------------------------------


@dataclass
class LabelledPictures:
    """The pictures of a data set and their things.

    Attributes:
        folder: of the pictures. files: relative to it.
        raw: of each picture, what `read(raw, size)` makes `Labels` of, and a list of what is wrong
            with the things that it leaves out, one text each.
        categories: as COCO has them: {"id": 1, "name": "person"}, and more.
        entries: of each picture, what COCO says of it; lenses: its own, if it has any.
        wrong: what is wrong with pictures and things that are left out, one text each.
    """

    folder: Path
    files: Sequence[str]
    raw: Sequence[Any]
    read: Callable[[Any, Size], tuple[Labels, list[str]]]
    categories: Sequence[Mapping[str, Any]]
    entries: Sequence[Mapping[str, Any]] = ()
    lenses: Calibrations | None = None
    wrong: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.files)

    def labels(self, index: int, size: Size | None = None) -> Labels:
        """The things in a picture; size: (H, W) of the upright picture, if it is known.

        Raises:
            ValueError: a thing cannot be read.
        """
        size = size or read_header(self.folder / self.files[index]).upright
        labels, wrong = self.read(self.raw[index], size)
        if wrong:
            raise ValueError(wrong[0])
        return labels
