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
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

__all__ = [
    "carry", "carry_mask", "carry_points", "carry_polygon", "clip", "decode_rle", "encode_rle",
    "iou", "merge", "spherical",
]  # fmt: skip

Array = Any  # a NumPy array, a tensor, or lists of numbers
PointMap = Callable[[np.ndarray], np.ndarray]

_ANGLES = np.linspace(0, 2 * np.pi, 72, endpoint=False)
# The points of the ellipse inside a box are the product of the box and this matrix, (4, 144).
_SHARES = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)), -1)[..., None] / 2 + 0.5
_ELLIPSE = np.concatenate(((1 - _SHARES) * np.eye(2), _SHARES * np.eye(2)), -1).reshape(144, 4).T
_STEP = 4.0  # px: a curve differs less than 0.1 px from its chords, if its radius is above 20 px
_ROWS = 128  # boxes that are compared with all worse ones at once


# -- through a map of points --------------------------------------------------------------------


def carry(boxes: Array, points_map: PointMap) -> tuple[Any, Any]:
    """Carries boxes through a point map, by the ellipses inside them.

    Args:
        boxes: (K, 4). points_map: called once, with points (K, 72, 2).

    Returns:
        The boxes of the points that are seen, (K, 4), NaN if none is; and the visible shares of the
        points, (K,), 0 to 1.

    Raises:
        ValueError: boxes of another shape.
    """
    # Reductions along a contiguous axis are several times as fast.
    found = np.ascontiguousarray(np.moveaxis(_through(points_map, ellipses(boxes)), -1, 0))
    unseen = np.isnan(found)
    low, high = np.where(unseen, np.inf, found).min(2), np.where(unseen, -np.inf, found).max(2)
    visible = 1 - unseen[0].mean(1)
    carried = np.where(visible[:, None] > 0, np.concatenate((low, high)).T, np.nan)
    return _like(boxes, carried), _like(boxes, visible)


def ellipses(boxes: Array) -> np.ndarray:
    """The points of the ellipses inside boxes, (K, 72, 2); NaN for boxes that are not finite."""
    table = _table(boxes)
    return (np.where(np.isfinite(table), table, np.nan) @ _ELLIPSE).reshape(-1, 72, 2)


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
            where nothing is seen. Only the seen points count; without any, all is NaN.

    Returns:
        A named tuple of the boxes as a camera sees them that looks at their middles, level with the
        camera's frame: azimuth and elevation of the middles (K,) rad, to the right and up from the
        optical axis; width and height (K,) rad, the horizontal and the vertical angle of view; ray
        (K, 3), the unit vectors of the middles in the camera's frame (x right, y down, z forward);
        and solid_angle (K,) sr, of the rectangle in that view.
    """
    rays = np.asarray(to_rays(ellipses(boxes) - 0.5), np.float64)
    length = np.linalg.norm(rays, axis=-1, keepdims=True)
    rays = np.divide(rays, length, out=np.full(rays.shape, np.nan), where=length > 0)
    ray = np.nan_to_num(rays).sum(1)
    ray[np.isnan(rays).all((1, 2))] = np.nan
    for _ in range(4):  # each turn halves the digits that the middle lacks
        azimuth = np.arctan2(ray[:, 0], ray[:, 2])
        elevation = np.arctan2(-ray[:, 1], np.hypot(ray[:, 0], ray[:, 2]))
        frame = _looking(azimuth, elevation)
        x, y, z = np.moveaxis(rays @ frame.mT, -1, 0)
        across, down = np.arctan2(x, z), np.arctan2(y, z)
        low = np.stack((np.fmin.reduce(across, axis=1), np.fmin.reduce(down, axis=1)))
        high = np.stack((np.fmax.reduce(across, axis=1), np.fmax.reduce(down, axis=1)))
        (sin_u, sin_v), (cos_u, cos_v) = np.sin((low + high) / 2), np.cos((low + high) / 2)
        middle = np.stack((sin_u * cos_v, cos_u * sin_v, cos_u * cos_v), -1)
        ray = (middle[:, None] @ frame)[:, 0]
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    width, height = high - low
    solid = 4 * np.arcsin(np.sin(width / 2) * np.sin(height / 2))
    found = (azimuth, elevation, width, height, ray, solid)
    return SphericalBoxes(*(_like(boxes, value) for value in found))


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
    return {"size": size, "counts": _to_text(counts) if compressed else counts}


def decode_rle(rle: Mapping[str, Any]) -> np.ndarray:
    """The mask (H, W), bool, of COCO's run-length encoding, compressed or not.

    Raises:
        ValueError: size or counts are missing, or runs do not fill the mask.
    """
    try:
        (height, width), counts = rle["size"], rle["counts"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError("a run-length encoding must have a size [H, W] and counts") from error
    if isinstance(counts, bytes):
        counts = counts.decode("ascii")
    runs = np.asarray(_from_text(counts) if isinstance(counts, str) else counts, np.int64)
    if runs.ndim != 1 or (runs < 0).any() or runs.sum() != height * width:
        raise ValueError(
            f"the counts of a run-length encoding of {height} × {width} px must be at least 0 and "
            f"have the sum {height * width}, got {runs.sum()}"
        )
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape((height, width), order="F")


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
    counts: list[int] = []
    value = shift = 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"a run-length encoding must not contain {character!r}")
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            value -= (1 << shift) * bool(bits & 16)
            counts.append(value + (counts[-2] if len(counts) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("a run-length encoding ends within a number")
    return counts


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
