"""Boxes, points, polygons and masks that follow a picture through a lens or a view.

Boxes (x0, y0, x1, y1), polygons and points have the coordinates of COCO and torchvision: a picture
covers (0, 0) to (W, H), and pixel i has its centre at i + 1/2. A *point map* is a function from
points (..., 2) to points (..., 2), NumPy float64, in darswin's pixels, whose centres are integers;
it gives NaN where nothing is seen. Examples are `Reframing.to_new`, `frames.Plan.points` and a
view's `to_image`. Tensors give tensors of the same device and dtype, all else gives NumPy arrays.

A box travels as the ellipse inside it: things touch the middles of the sides of their boxes, while
the corners are mostly empty, so a rectangle would grow with every step.
"""

import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from darswin.utils.regions import box_of, shown_parts
from darswin.utils.run_lengths import checked_runs, to_text

__all__ = [
    "carry", "carry_mask", "carry_points", "carry_polygon", "clip", "decode_rle", "encode_rle",
    "iou", "merge", "spherical",
]  # fmt: skip

Array = Any  # a NumPy array, a tensor, or lists of numbers
PointMap = Callable[[np.ndarray], np.ndarray]

_COUNT, _FINELY = 72, 288  # points of an ellipse, and of one that is cut
_BETWEEN = 33  # points at which the end of a curve is looked for


def _shares(count: int) -> np.ndarray:
    """The points of the ellipse inside a box are the product of the box and this, (4, 2·count)."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    shares = np.stack((np.cos(angles), np.sin(angles)), -1)[..., None] / 2 + 0.5
    both = np.concatenate(((1 - shares) * np.eye(2), shares * np.eye(2)), -1)
    return both.reshape(2 * count, 4).T


_ELLIPSE = _shares(_COUNT)
_STEP = 4.0  # px: a curve differs less than 0.1 px from its chords, if its radius is above 20 px
_INNER = np.linspace(0, 1, 4)[:, None, None]  # radii of points inside an ellipse
_MOST_POINTS = 100_000  # of a polygon: a corner that is far away must not fill the memory
_ROWS = 128  # boxes that are compared with all worse ones at once


# -- through a map of points --------------------------------------------------------------------


def carry(
    boxes: Array, points_map: PointMap, size: tuple[int, int] | None = None
) -> tuple[Any, Any]:
    """Carries boxes through a point map, by the ellipses inside them.

    The ellipse of a thing that is seen in part ends where the map does, and at the borders of the
    new picture. Its new box is that of what is left.

    Args:
        boxes: (K, 4).
        points_map: called twice for all boxes, and more often if boxes are cut.
        size: (H, W) of the new picture. Without it, boxes may go on beyond the picture.

    Returns:
        The boxes of what is seen, (K, 4), NaN if nothing is; and the visible shares of the areas of
        the ellipses, (K,), 0 to 1.

    Raises:
        ValueError: boxes of another shape.
    """
    table = _table(boxes)
    # Reductions along a contiguous axis are several times as fast.
    x, y = np.ascontiguousarray(np.moveaxis(_through(points_map, ellipses(table)), -1, 0))
    carried = np.stack((x.min(1), y.min(1), x.max(1), y.max(1)), 1) if len(table) else table
    whole = ~np.isnan(carried[:, 0])
    if size is not None:
        whole &= (clip(carried, size) == carried).all(1)
        whole &= (np.abs(np.diff(x, append=x[:, :1])) <= size[1] / 2).all(1)  # not at a seam
    if whole.any():
        carried[whole] = _ends(table[whole], points_map, x[whole], y[whole])
    visible = np.ones(len(table))
    cut = np.flatnonzero(~whole)
    outlines = [*ellipses(table[cut], _FINELY)]
    shown = shown_parts(outlines, lambda points: _through(points_map, points), size)
    for k, (parts, share) in zip(cut, shown, strict=True):
        carried[k], visible[k] = box_of([part.new for part in parts]), share
    return _like(boxes, carried), _like(boxes, visible)


def _ends(table: np.ndarray, points_map: PointMap, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The boxes of curves whose points are x and y (K, P): each of the four ends is looked for
    between the neighbours of the outermost point, since a curve may have corners."""
    outermost = np.stack((x, y, -x, -y)).argmin(2)  # (4, K)
    around = outermost[..., None] + np.linspace(-1, 1, _BETWEEN)
    angle = 2 * np.pi / x.shape[1] * around
    middle, half = (table[:, :2] + table[:, 2:]) / 2, (table[:, 2:] - table[:, :2]) / 2
    circle = np.stack((np.cos(angle), np.sin(angle)), -1)
    found = _through(points_map, middle[:, None] + half[:, None] * circle)
    x, y = np.moveaxis(np.where(np.isnan(found), np.inf, found), -1, 0)
    x_high, y_high = np.moveaxis(np.where(np.isnan(found), -np.inf, found), -1, 0)
    return np.stack((_least(x[0]), _least(y[1]), -_least(-x_high[2]), -_least(-y_high[3])), 1)


def _least(values: np.ndarray) -> np.ndarray:
    """The least value of curves (K, P), between the points too: that of the parabola through the
    least one and its neighbours."""
    row, k = np.arange(len(values)), values.argmin(1).clip(1, values.shape[1] - 2)
    last, least, ahead = (values[row, k + step] for step in (-1, 0, 1))
    bend = last - 2 * least + ahead
    below = np.divide((ahead - last) ** 2, 8 * bend, out=np.zeros(len(row)), where=bend > 0)
    best = np.minimum(np.minimum(last, ahead), least)
    return np.where(below < 0.1 * (values.max(1) - best), least - below, best)  # not at a seam


def ellipses(boxes: Array, count: int = _COUNT) -> np.ndarray:
    """Points of the ellipses inside boxes, (K, count, 2); NaN for boxes that are not finite."""
    table = _table(boxes)
    shares = _ELLIPSE if count == _COUNT else _shares(count)
    return (np.where(np.isfinite(table), table, np.nan) @ shares).reshape(-1, count, 2)


def carry_points(points: Array, points_map: PointMap) -> Any:
    """Carries points (..., 2) through a point map; NaN where nothing is seen."""
    table = _floats(points)
    if table.shape[-1:] != (2,):
        raise ValueError(f"points must have shape (..., 2), got {_shape(table)}")
    return _like(points, _through(points_map, table))


def carry_polygon(polygon: Array, points_map: PointMap, step: float = _STEP) -> Any:
    """Carries a polygon (P, 2) through a point map, its sides cut into pieces of at most `step` px.

    Returns:
        The polygon (Q, 2) of the points that are seen; Q = 0 if none is.
    """
    found = carry_points(cut_polygon(_floats(polygon), step), points_map)
    return _like(polygon, found[~np.isnan(found[:, 0])])


def cut_polygon(polygon: np.ndarray, step: float = _STEP) -> np.ndarray:
    """The corners (P, 2) of a polygon, and points between them at most `step` px apart, (Q, 2)."""
    if polygon.ndim != 2 or polygon.shape[1] != 2:
        raise ValueError(f"a polygon must have shape (P, 2), got {_shape(polygon)}")
    if not step > 0:
        raise ValueError(f"step must be above 0 px, got {step}")
    sides = np.roll(polygon, -1, 0) - polygon
    lengths = np.nan_to_num(np.hypot(*sides.T), posinf=0)  # a side to nowhere stays as it is
    step = max(step, lengths.sum() / _MOST_POINTS)
    pieces = np.maximum(np.ceil(lengths / step), 1).astype(int)
    side = np.repeat(np.arange(len(polygon)), pieces)
    piece = np.arange(len(side)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = (piece / pieces[side])[:, None]
    return np.where(share > 0, polygon[side] + share * sides[side], polygon[side])


def carry_mask(mask: Array, to_old: PointMap, size: tuple[int, int]) -> Any:
    """Carries a mask: each new pixel has the value of the nearest old one, or 0 beyond.

    Args:
        mask: (H, W), of any dtype. size: (H', W') of the new mask.
        to_old: the point map from the pixels of the *new* mask to those of the old one.
    """
    old = np.asarray(_numpy(mask))
    if old.ndim != 2:
        raise ValueError(f"a mask must have shape (H, W), got {_shape(old)}")
    x, y = np.meshgrid(np.arange(size[1], dtype=float), np.arange(size[0], dtype=float))
    places = np.rint(to_old(np.stack((x, y), -1)))
    x, y = places[..., 0], places[..., 1]
    inside = (x >= 0) & (x < old.shape[1]) & (y >= 0) & (y < old.shape[0])  # not for NaN
    new = np.zeros(size, old.dtype)
    new[inside] = old[y[inside].astype(np.intp), x[inside].astype(np.intp)]
    return _like(mask, new)


# -- in a picture -------------------------------------------------------------------------------


def clip(boxes: Array, size: tuple[int, int]) -> Any:
    """Cuts boxes (K, 4) at the borders of a picture of (H, W); NaN stays NaN."""
    height, width = size
    return _like(boxes, np.clip(_table(boxes), 0.0, [width, height, width, height]))


def iou(boxes: Array, others: Array) -> Any:
    """The intersection over the union of each box (K, 4) with each of the others (L, 4): (K, L),
    0 for boxes that are NaN or have no area."""
    a, b = _table(boxes)[:, None], _table(others)[None]
    common = _common(a, b)
    return _like(boxes, _ratio(common, _area(a) + _area(b) - common))


def merge(
    boxes: Array, scores: Array, labels: Array, *, iou: float = 0.5, inside: float = 0.7
) -> Any:
    """Merges the detections of several views of one picture.

    From the best to the worst, a detection is kept unless a better one of its class that was kept
    has an intersection over union with it above `iou`, or covers more than `inside` of its area,
    as the whole of a thing covers the part that another tile saw.

    Args:
        boxes: (K, 4). scores: (K,). labels: (K,), the classes.

    Returns:
        The indices of the kept detections, the best first. NaN boxes and scores are left out.

    Raises:
        ValueError: other shapes, or a limit that is not in [0, 1].
    """
    for name, limit in (("iou", iou), ("inside", inside)):
        if not 0 <= limit <= 1:
            raise ValueError(f"{name} must be in [0, 1], got {limit}")
    table, score, label = _table(boxes), _floats(scores), np.asarray(_numpy(labels))
    for name, given in (("scores", score), ("labels", label)):
        if given.shape != (len(table),):
            raise ValueError(
                f"{name} must have shape ({len(table)},), as the boxes, got {_shape(given)}"
            )
    order = np.argsort(-score, kind="stable")
    order = order[np.isfinite(table).all(1)[order] & ~np.isnan(score)[order]]
    table, label = table[order], label[order]
    area, kept = _area(table), np.ones(len(order), bool)
    x0, x1 = np.ascontiguousarray(table[:, ::2].T)
    for start in range(0, len(order), _ROWS):
        one, rest = np.s_[start : start + _ROWS, None], np.s_[None, start:]
        meet = label[one] == label[rest]
        meet &= x0[one] < x1[rest]
        meet &= x1[one] > x0[rest]
        better, worse = np.nonzero(meet)
        ahead = better < worse
        better, worse = better[ahead] + start, worse[ahead] + start
        common = _common(table[better], table[worse])
        drops = _ratio(common, area[better] + area[worse] - common) > iou
        drops |= _ratio(common, area[worse]) > inside
        better, worse = better[drops], worse[drops]  # sorted by the better one
        starts = np.flatnonzero(np.diff(better, prepend=-1))
        groups = np.split(worse, starts[1:])
        for one, dropped in zip(better[starts].tolist(), groups, strict=False):
            if kept[one]:
                kept[dropped] = False
    return _like(boxes, order[kept])


# -- on the sphere ------------------------------------------------------------------------------


class SphericalBoxes(NamedTuple):
    """The result of `spherical`."""

    azimuth: Any
    elevation: Any
    width: Any
    height: Any
    ray: Any
    solid_angle: Any


def spherical(boxes: Array, to_rays: PointMap) -> SphericalBoxes:
    """Boxes (K, 4) of a picture as directions and angles, by the ellipses inside them.

    Args:
        to_rays: a function from points (..., 2), in darswin's pixels, to rays (..., 3), NaN or 0
            where nothing is seen. Boxes end there, as those of `carry`; without any ray, all is
            NaN.

    Returns:
        A named tuple of the boxes as a camera sees them that looks at their middles, level with the
        camera's frame: azimuth and elevation of the middles (K,) rad, to the right and up from the
        optical axis; width and height (K,) rad, the horizontal and the vertical angle of view, 0 to
        2π; ray (K, 3), the unit vectors of the middles in the camera's frame (x right, y down, z
        forward); and solid_angle (K,) sr, of the rectangle in that view, NaN if width or height is
        above π, because no rectangle has them.
    """

    def to_units(points: np.ndarray) -> np.ndarray:
        rays = np.asarray(to_rays(points - 0.5), np.float64)
        length = np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.divide(rays, length, out=np.full(rays.shape, np.nan), where=length > 0)

    table = _table(boxes)
    rays = to_units(ellipses(table))
    inner = ellipses(table, 12)[:, None]  # a mean of outlines beyond 90° would look backwards
    inner = inner.mean(2, keepdims=True) * (1 - _INNER) + inner * _INNER
    ray = np.nan_to_num(to_units(inner.reshape(len(table), 48, 2))).sum(1)
    cut = np.flatnonzero(np.isnan(rays).any((1, 2)))
    if len(cut):
        found = [
            np.concatenate([np.zeros((0, 3)), *(part.new for part in parts)])
            for parts, _ in shown_parts([*ellipses(table[cut], _FINELY)], to_units)
        ]
        most = max(rays.shape[1], *map(len, found))
        rays = np.pad(rays, ((0, 0), (0, most - rays.shape[1]), (0, 0)), constant_values=np.nan)
        for k, of_box in zip(cut, found, strict=True):
            rays[k, : len(of_box)], rays[k, len(of_box) :] = of_box, np.nan
            if not ray[k].any():
                ray[k] = of_box.sum(0)
    ray[np.isnan(rays).all((1, 2))] = np.nan
    for _ in range(8):  # each turn halves the digits that the middle lacks
        azimuth = np.arctan2(ray[:, 0], ray[:, 2])
        elevation = np.arctan2(-ray[:, 1], np.hypot(ray[:, 0], ray[:, 2]))
        frame = _looking(azimuth, elevation)
        x, y, z = np.moveaxis(rays @ frame.mT, -1, 0)
        aside = np.hypot(x, y)
        # θ, along the direction from the middle: good for angles beyond 90°.
        scale = np.divide(np.arctan2(aside, z), aside, out=np.ones(x.shape), where=aside > 0)
        across, down = x * scale, y * scale
        low = np.stack((np.fmin.reduce(across, axis=1), np.fmin.reduce(down, axis=1)))
        high = np.stack((np.fmax.reduce(across, axis=1), np.fmax.reduce(down, axis=1)))
        u, v = (low + high) / 2
        theta = np.hypot(u, v)
        aside = np.sinc(theta / np.pi)  # sin θ / θ
        ray = (np.stack((u * aside, v * aside, np.cos(theta)), -1)[:, None] @ frame)[:, 0]
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    width, height = high - low
    solid = 4 * np.arcsin(np.sin(width / 2) * np.sin(height / 2))
    solid[(width > np.pi) | (height > np.pi)] = np.nan
    values = (azimuth, elevation, width, height, ray, solid)
    return SphericalBoxes(*(_like(boxes, value) for value in values))


def _looking(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """The axes right, down and forward of cameras that look in level directions, (K, 3, 3)."""
    (sin_a, sin_e), (cos_a, cos_e) = np.sin((azimuth, elevation)), np.cos((azimuth, elevation))
    right = (cos_a, np.zeros_like(cos_a), -sin_a)
    down = (sin_e * sin_a, cos_e, sin_e * cos_a)
    forward = (cos_e * sin_a, -sin_e, cos_e * cos_a)
    return np.moveaxis(np.array((right, down, forward)), -1, 0)


# -- COCO's run-length encoding -------------------------------------------------------------------


def encode_rle(mask: Array, *, compressed: bool = True) -> dict[str, Any]:
    """A mask (H, W) in COCO's run-length encoding: {"size": [H, W], "counts": text, or a list of
    numbers unless `compressed`}.

    Source: github.com/cocodataset/cocoapi, maskApi.c.
    """
    pixels = np.asarray(_numpy(mask)) != 0
    if pixels.ndim != 2:
        raise ValueError(f"a mask must have shape (H, W), got {_shape(pixels)}")
    flat = pixels.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts = np.diff(changes, prepend=0, append=flat.size).tolist()
    counts = [0] * bool(flat.size and flat[0]) + counts
    size = list(pixels.shape)
    return {"size": size, "counts": to_text(counts) if compressed else counts}


def decode_rle(rle: Mapping[str, Any]) -> np.ndarray:
    """The mask (H, W), bool, of COCO's run-length encoding, compressed or not.

    Raises:
        ValueError: size or counts are missing or wrong, or runs do not fill the mask.
    """
    try:
        size, counts = rle["size"], rle["counts"]
    except (KeyError, TypeError) as error:
        raise ValueError("a run-length encoding must have a size [H, W] and counts") from error
    height, width, runs = checked_runs(size, counts)
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape((height, width), order="F")


# -- arrays ---------------------------------------------------------------------------------------


def _is_tensor(value: object) -> bool:
    torch = sys.modules.get("torch")  # without it, there are no tensors
    return torch is not None and isinstance(value, torch.Tensor)


def _numpy(value: Any) -> Any:
    return value.detach().cpu().numpy() if _is_tensor(value) else value


def _floats(value: Any) -> np.ndarray:
    return np.asarray(_numpy(value.double() if _is_tensor(value) else value), np.float64)


def _like(given: Any, value: np.ndarray) -> Any:
    """A result with the kind, device and floating dtype of what was given."""
    if _is_tensor(given):
        torch = sys.modules["torch"]
        dtype = given.dtype if value.dtype.kind == "f" and given.is_floating_point() else None
        return torch.from_numpy(np.ascontiguousarray(value)).to(given.device, dtype)
    dtype = np.asarray(given).dtype.newbyteorder("=")
    both_float = value.dtype.kind == "f" and dtype.kind == "f"
    return value.astype(dtype, copy=False) if both_float else value


def _table(boxes: Any) -> np.ndarray:
    table = _floats(boxes)
    if table.shape == (0,):  # of an empty list
        table = table.reshape(0, 4)
    if table.ndim != 2 or table.shape[1] != 4:
        raise ValueError(f"boxes must have shape (K, 4), got {_shape(table)}")
    return table


def _shape(array: np.ndarray) -> str:
    return str(tuple(array.shape))


def _through(points_map: PointMap, points: np.ndarray) -> np.ndarray:
    """Points of COCO through a map of darswin's pixels; both coordinates are NaN if one is not
    finite."""
    found = np.asarray(points_map(points - 0.5), np.float64) + 0.5
    seen = np.isfinite(found[..., 0] + found[..., 1])
    return found if seen.all() else np.where(seen[..., None], found, np.nan)


def _area(boxes: np.ndarray) -> np.ndarray:
    return _common(boxes, boxes)


def _common(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The area of the intersection of boxes."""
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    sides = np.maximum(high - low, 0)
    return sides[..., 0] * sides[..., 1]  # several times as fast as `prod`


def _ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.divide(part, whole, out=np.zeros(part.shape), where=whole > 0)
