"""What is found or labelled in a picture: one type for detections and for labels."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np

from darswin.boxes.arrays import PointMap, floats, table_of
from darswin.boxes.carried import carry, carry_points, cut_polygon
from darswin.boxes.overlap import clip, mend, merge
from darswin.boxes.regions import NO_AREA, area_of, box_of, box_of_mask, shown_parts
from darswin.boxes.rle import decode_rle, encode_rle
from darswin.boxes.turned import as_turned, upright

Size = tuple[int, int]
Column = Any  # an array or a list of K values, or None
_SAMPLES = 1000  # pixels of a mask by which its visible share is measured
_BORDER = 0.01  # of the longer side of a view: boxes that end so near to its border may be cut
_ROUNDING = 1e-3  # px: a keypoint that is this little beyond the edge of a picture is on it


@dataclass(frozen=True, eq=False)
class Instances:
    """The detections or the labels of a picture, as columns of K rows.

    `Instances(boxes=np.array([[10.0, 20, 50, 80]]), scores=np.array([0.9]), labels=np.array([1]))`
    is one detection. `instances[rows]` are some instances; rows: an index, a slice, or an array.
    Iteration gives them one by one. A column is None if nothing is known of it.

    Attributes:
        boxes: (K, 4) x0, y0, x1, y1 in px, or turned (K, 5), see `darswin.boxes`; NaN if the
            picture does not show the instance. `upright` is (K, 4) of both.
        scores: (K,).
        labels: (K,) numbers of classes or ids of categories.
        keypoints: (K, P, 2 or 3): x and y in px, NaN if they are unknown or not shown, and a score,
            or COCO's v for labels: 0 not labelled, 1 not visible, 2 visible. Rows beyond the
            keypoints of an instance are NaN.
        masks: of each, the run lengths of `darswin.boxes.encode_rle`, or None. `OnnxNetwork` gives
            the probabilities of pixels (K, h, w) in their place, of the picture or of a whole
            fraction of it; `areas`, `masks` of `through` and files need run lengths.
        outlines: of each, the parts of its outline, polygons (P, 2); none if it is not known.
        more: other columns by their names, such as "visible" (K,), the share of an instance that
            its picture shows, 0 to 1. Each is an array or a list.

    Raises:
        TypeError: the boxes are no array.
        ValueError: boxes of another shape, or a column of another length.
    """

    boxes: np.ndarray
    scores: Column = None
    labels: Column = None
    keypoints: Column = None
    masks: Column = None
    outlines: Column = None
    more: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.boxes, np.ndarray):
            raise TypeError(f"boxes must be an array, got {type(self.boxes).__name__}")
        count = len(table_of(self.boxes))
        for name, column in (*self._columns(), *self.more.items()):
            if column is not None and len(column) != count:
                raise ValueError(f"{name} must have {count} rows, as the boxes, got {len(column)}")

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, rows: Any) -> Self:
        number = np.atleast_1d(np.arange(len(self))[rows])

        def taken(column: Any) -> Any:
            if isinstance(column, np.ndarray):
                return column[number]
            return None if column is None else [column[k] for k in number.tolist()]

        columns = {name: taken(column) for name, column in self._columns()}
        more = {name: taken(column) for name, column in self.more.items()}
        return replace(self, **columns, more=more)

    def _columns(self) -> Iterator[tuple[str, Any]]:
        return ((of.name, getattr(self, of.name)) for of in fields(self) if of.name != "more")

    def with_columns(self, **more: Any) -> Self:
        """The same instances with these columns in `more`."""
        return replace(self, more={**self.more, **more})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The instances of all parts, one after another.

        If some boxes are turned, all are. Keypoints get rows of NaN up to the largest number of
        points, and masks and outlines of parts without them are unknown. Of `more`, the columns
        that all have stay. If all have "cut", "view" (K,) is the number of the part, by which
        `merged` tells the parts of a thing from its neighbours.

        Raises:
            ValueError: some parts with rows have scores or labels, and others have none; or some
                keypoints have 2 columns, and others 3.
        """
        if not parts:
            return cls(np.zeros((0, 4)), labels=np.zeros(0, int))
        parts = [
            part.with_columns(view=np.full(len(part), k)) if "cut" in part.more else part
            for k, part in enumerate(parts) if len(part)
        ] or parts[:1]  # fmt: skip
        columns = {name: [getattr(part, name) for part in parts] for name, _ in parts[0]._columns()}
        if len({table.shape[1] for table in columns["boxes"]}) > 1:
            columns["boxes"] = [as_turned(table) for table in columns["boxes"]]
        if any(points is not None for points in columns["keypoints"]):
            columns["keypoints"] = _padded(columns["keypoints"], [*map(len, parts)])
        for name, unknown in (("masks", None), ("outlines", ())):
            if any(column is not None for column in columns[name]):
                each = zip(columns[name], parts, strict=True)
                columns[name] = [[unknown] * len(p) if c is None else c for c, p in each]
        for name in ("scores", "labels"):
            if 0 < sum(column is None for column in columns[name]) < len(parts):
                raise ValueError(f"either all parts or none must have {name}")
        names = [name for name in parts[0].more if all(name in part.more for part in parts)]
        more = {name: _concatenated([part.more[name] for part in parts]) for name in names}
        return cls(**{name: _concatenated(of) for name, of in columns.items()}, more=more)

    def merged(self, *, iou: float = 0.5, inside: float = 0.7) -> Self:
        """The best of those that show the same object, best first; see `darswin.boxes.merge`.

        A box that the border of its view cuts ("cut" of `through`) is left out if a larger whole
        one of another view covers half of it, and this one gets the higher score of both. Other cut
        boxes of one thing are joined. Masks and keypoints are those of the best part.

        Raises:
            ValueError: there are no scores or no labels.
        """
        if self.scores is None or self.labels is None:
            raise ValueError("instances need scores and labels to be merged")
        boxes, scores = self.boxes, floats(self.scores)
        if {"cut", "view"} <= {*self.more}:
            of = np.asarray(self.labels), self.more["cut"], self.more["view"]
            boxes, scores = mend(boxes, scores, *of)
        kept = merge(boxes, scores, self.labels, iou=iou, inside=inside)
        return replace(self, boxes=boxes, scores=scores)[kept]

    @property
    def upright(self) -> np.ndarray:
        """The boxes, or the upright ones around turned boxes, (K, 4)."""
        return upright(self.boxes)

    @property
    def areas(self) -> np.ndarray:
        """px², of the masks, the outlines, or else the boxes, (K,)."""
        areas = np.prod(as_turned(self.boxes)[:, 2:4], axis=1)
        for k in range(len(self)):
            if (mask := self.mask_of(k)) is not None:
                areas[k] = decode_rle(mask).sum()
            elif len(outline := self.outline_of(k)):
                areas[k] = sum(map(area_of, outline))
        return areas

    def mask_of(self, row: int) -> Mapping[str, Any] | None:
        """The run lengths of the mask of an instance; None if it is not known."""
        return None if self.masks is None else self.masks[row]

    def outline_of(self, row: int) -> Sequence[np.ndarray]:
        """The parts (P, 2) of the outline of an instance; none if it is not known."""
        return () if self.outlines is None else self.outlines[row]

    def through(
        self, points_map: PointMap, size: Size, *, cut: Size | None = None,
        masks: Callable[[np.ndarray], np.ndarray] | None = None, rays: PointMap | None = None,
    ) -> Self:  # fmt: skip
        """The instances in another picture, in the same order.

        Outlines and keypoints move point by point, and masks pixel by pixel; boxes are those of
        what is left of outlines and masks, or else of the ellipses inside them. All end at the
        borders of the new picture, and where it shows nothing.

        Args:
            points_map: from this picture to the new one.
            size: (H, W) of the new picture.
            cut: (H, W) of this picture, to which upright boxes are clipped first. Turned ones that
                are wholly beyond it are not shown.
            masks: resamples a mask (H, W), bool, to the new picture. Without it, masks are left
                out, and boxes do not follow them.
            rays: from points of this picture to rays.

        Returns:
            The instances with "visible" (K,), the share that is shown, multiplied by the share that
            was visible before; with "cut" (K,) bool if `cut` is given: whether a box ends at the
            border of this picture, beyond which its thing may go on; and with "rays" (K, 3) if
            `rays` is given: the directions of the middles of the boxes here, 0 where there are
            none. Of what is not shown at all, boxes are NaN.
        """
        old, more = self.boxes, dict(self.more)
        if cut is not None:
            clipped = clip(self.upright, cut)
            sides = np.hstack((clipped[:, 2:] - clipped[:, :2], as_turned(old)[:, 2:4]))
            shown = (sides > 0).all(1, keepdims=True)
            old = np.where(shown, clipped if old.shape[1] == 4 else old, np.nan)
            near = _BORDER * max(cut)
            ends = (clipped[:, :2] < near) | (clipped[:, 2:] > np.subtract(cut[::-1], near))
            more["cut"] = ends.any(1) | more.get("cut", False)
        by_mask = _known(None if masks is None else self.masks, len(old))
        by_outline = _known(self.outlines, len(old)) & ~by_mask
        alone = ~(by_mask | by_outline)
        boxes, visible = np.zeros(old.shape), np.zeros(len(old))
        boxes[alone], visible[alone] = carry(old[alone], points_map, size)
        columns: dict[str, Column] = {"masks": None, "outlines": None}
        if self.outlines is not None:
            columns["outlines"] = [[] for _ in old]
            rows = np.flatnonzero(by_outline).tolist()
            moved = _outlines_through([self.outlines[k] for k in rows], points_map, size)
            for k, (outline, share) in zip(rows, moved, strict=True):
                boxes[k, :4], visible[k] = box_of(outline), share
                columns["outlines"][k] = outline
        if masks is not None and self.masks is not None:
            columns["masks"] = [None for _ in old]
            for k in np.flatnonzero(by_mask).tolist():
                mask, share = _mask_through(self.masks[k], points_map, size, masks)
                boxes[k, :4], visible[k] = box_of_mask(mask), share
                compressed = isinstance(self.masks[k]["counts"], str)
                columns["masks"][k] = encode_rle(mask, compressed=compressed)
        if old.shape[1] == 5:
            boxes[~alone] = as_turned(boxes[~alone, :4])
        more["visible"] = visible * more.get("visible", 1.0)
        if rays is not None:
            more["rays"] = np.nan_to_num(rays(as_turned(old)[:, :2] - 0.5))
        columns["keypoints"] = _keypoints_through(self.keypoints, points_map, size)
        return replace(self, boxes=boxes, more=more, **columns)


def _known(column: Sequence[Any] | None, count: int) -> np.ndarray:
    """The rows of a column of outlines or masks of which something is known, (K,)."""
    if column is None:
        return np.zeros(count, bool)
    return np.array([value is not None and len(value) > 0 for value in column], bool)


def _concatenated(parts: Sequence[Any]) -> Any:
    """The values of a column of several parts; None if all have none."""
    if all(part is None for part in parts):
        return None
    if all(isinstance(part, np.ndarray) for part in parts):
        return np.concatenate(parts)
    return [value for part in parts for value in part]


def _padded(parts: Sequence[np.ndarray | None], counts: Sequence[int]) -> list[np.ndarray]:
    """Keypoints of several parts, with rows of NaN up to the largest number of points."""
    shapes = [part.shape[1:] for part in parts if part is not None]
    if len({shape[1] for shape in shapes}) > 1:
        raise ValueError("keypoints must have 2 columns in all parts, or 3 in all")
    most, width = max(shape[0] for shape in shapes), shapes[0][1]
    padded = [np.full((count, most, width), np.nan) for count in counts]
    for table, part in zip(padded, parts, strict=True):
        if part is not None:
            table[:, : part.shape[1]] = part
    return padded


def _outlines_through(
    outlines: Sequence[Sequence[np.ndarray]], points_map: PointMap, size: Size
) -> Iterator[tuple[list[np.ndarray], float]]:
    """The parts of each outline that are shown, and their share of its area."""
    lines = [[*map(cut_polygon, polygons)] for polygons in outlines]
    shown = iter(shown_parts(
        [line for polygons in lines for line in polygons],
        lambda points: carry_points(points, points_map), size,
    ))  # fmt: skip
    for polygons in lines:
        parts, shares = zip(*(next(shown) for _ in polygons), strict=True)
        areas = [area_of(polygon) for polygon in polygons]
        share = np.average(shares, weights=areas if sum(areas) > NO_AREA else None)
        yield [part.new for of_polygon in parts for part in of_polygon], float(share)


def _mask_through(
    rle: Mapping[str, Any], points_map: PointMap, size: Size,
    masks: Callable[[np.ndarray], np.ndarray],
) -> tuple[np.ndarray, float]:  # fmt: skip
    """The new mask (H, W), and the share of its pixels that are shown."""
    old = decode_rle(rle)
    new = masks(old)
    if not new.any():
        return new, 0.0
    pixels = np.argwhere(old)[:: 1 + old.sum() // _SAMPLES, ::-1]
    points = points_map(pixels.astype(float)) + 0.5
    return new, float(((points >= 0) & (points <= size[::-1])).all(1).mean())  # False for NaN


def _keypoints_through(
    keypoints: np.ndarray | None, points_map: PointMap, size: Size
) -> np.ndarray | None:
    if keypoints is None:
        return None
    points = carry_points(keypoints[..., :2], points_map)
    inside = (points >= -_ROUNDING) & (points <= np.add(size[::-1], _ROUNDING))
    points = np.where(inside.all(-1, keepdims=True), points.clip(0, size[::-1]), np.nan)
    return np.concatenate((points, keypoints[..., 2:]), -1)
