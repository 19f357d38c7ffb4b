"""Where a view of a rig reads the pictures of its cameras, and with which weights."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from darswin.lens.rig import Camera, Rig, is_in
from darswin.utils.named import in_order
from darswin.views.base import Pair

Seam = Literal["hard", "narrow", "wide"]
Frames = Sequence[Any] | Mapping[str, Any]

_APART, _MOST = 1.5, 16  # pixels of a picture between two points of a pixel, and points along it
_NARROW = 0.04  # of the room of a camera, see `Seen`, half the width of a narrow seam
_CHUNK = 2**18  # points


class Seen(NamedTuple):
    """What n cameras see of P points of a view.

    pixels: (n, P, 2), NaN beyond θ_max. room: (n, P), from 1 on a camera's axis, if that is in the
    middle of its picture, to 0 at θ_max or at the border; below 0 where it sees nothing.
    """

    pixels: np.ndarray
    room: np.ndarray


class Reads(NamedTuple):
    """The points at which frames are read for the pixels of a view, in the pixels' order.

    pixels: (E,) int64, row by row; sources: (E,) uint8, the cameras; points: (E, 2) px; weights:
    (E,) float32, whose sum is 1 for each pixel.
    """

    pixels: np.ndarray
    sources: np.ndarray
    points: np.ndarray
    weights: np.ndarray


def local(camera: Camera, rig: Rig, at: np.ndarray, are_places: bool) -> np.ndarray:
    """Directions or places (..., 3) in the level frame of a rig → those in a camera's frame."""
    turn = camera.pose[:3, :3].T
    moved = at @ (turn @ rig.level).T
    return moved - turn @ camera.pose[:3, 3] if are_places else moved


def see(view: Any, rig: Rig, distance: float | None, points: np.ndarray) -> Seen:
    """What the cameras see of points (P, 2) of a view; `distance` is that of `RigRemap`."""
    at = view.places(torch.from_numpy(points)[None])[0].numpy()
    if distance is not None:
        at = distance * at + rig.middle @ rig.level
    pixels = np.full((len(rig), *points.shape), np.nan)
    room = np.full((len(rig), len(points)), -1.0)
    for k, camera in enumerate(rig.cameras.values()):
        rays = local(camera, rig, at, view.is_surface or distance is not None)
        theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
        theta_max = camera.lens.theta_max.item()
        near = np.flatnonzero(theta <= theta_max * (1 + 1e-12))  # False for NaN
        onto = camera.lens.project_points(torch.from_numpy(rays[near])[None], camera.size)
        pixels[k, near] = onto[0].numpy()
        sides = np.array(camera.size[::-1])
        to_border = 1 - np.abs((2 * pixels[k, near] + 1) / sides - 1).max(-1)
        rooms = np.minimum(1 - theta[near] / theta_max, to_border).clip(min=0)
        room[k, near] = np.where(is_in(pixels[k, near], camera.size), rooms, -1.0)
    return Seen(pixels, room)


def shares(room: np.ndarray, seam: Seam) -> tuple[np.ndarray, np.ndarray]:
    """The cameras from which P points are read, (m, P), and their weights, (m, P): m is 1 for hard
    seams, 2 for narrow and n for wide ones. Weights are 0 where no camera sees a point."""
    first = room.argmax(0)[None]
    most = np.take_along_axis(room, first, 0)
    seen = (most >= 0).astype(np.float64)
    if seam == "wide":
        rooms = room.clip(min=0)
        total = rooms.sum(0)
        # At the rims of all cameras that see it, a point is of the first one.
        alone = np.arange(len(room))[:, None] == first
        weights = np.where(total > 0, rooms / np.where(total > 0, total, 1), alone * seen)
        return np.broadcast_to(np.arange(len(room))[:, None], room.shape), weights
    if seam == "hard" or len(room) == 1:
        return first, seen
    others = room.copy()
    np.put_along_axis(others, first, -1.0, 0)
    second = others.argmax(0)[None]
    more = np.take_along_axis(others, second, 0)
    share = np.where(more >= 0, 0.5 - (most - more) / (2 * _NARROW), 0).clip(min=0) * seen
    return np.concatenate((first, second)), np.concatenate((seen - share, share))


def grid(pixels: np.ndarray, size: Pair, along: int) -> np.ndarray:
    """`along`² points in each of some pixels of (H, W), (K · along², 2)."""
    part = (np.arange(along) + 0.5) / along - 0.5
    y, x = np.divmod(pixels, size[1])
    points = np.empty((len(pixels), along, along, 2))
    points[..., 0] = x[:, None, None] + part
    points[..., 1] = y[:, None, None] + part[:, None]
    return points.reshape(-1, 2)


def points_along(seen: Seen, size: Pair) -> np.ndarray:
    """The number of points along each pixel of a view of (H, W), (H·W,): as many as its camera has
    pixels there, divided by 1.5."""
    best = seen.room.argmax(0)
    scale = np.zeros(size)
    for k in range(len(seen.room)):
        at = seen.pixels[k].reshape(*size, 2)
        squares = np.zeros((2, *size))
        for axis in (0, 1):
            step = np.square(np.diff(at, axis=axis)).sum(-1)  # NaN beyond θ_max
            pad = [(1, 1) if a == axis else (0, 0) for a in (0, 1)]
            step = np.pad(np.nan_to_num(step), pad)
            lower, upper = (step[:-1], step[1:]) if axis == 0 else (step[:, :-1], step[:, 1:])
            squares[axis] = np.maximum(lower, upper)
        # A pixel without neighbours along one axis takes the other one's.
        both = np.where(squares == 0, squares[::-1], squares).mean(0)
        scale = np.where(best.reshape(size) == k, np.sqrt(both), scale)
    return np.ceil(scale.ravel() / _APART).clip(1, _MOST).astype(np.int64)


def reads_of(view: Any, rig: Rig, seen: Seen, seam: Seam, distance: float | None) -> Reads:
    """The reads of a view; `seen` is what the cameras see of the middles of its pixels."""
    size = view.size
    along = points_along(seen, size)
    if view.supersampling is not None:
        along[:] = view.supersampling
    parts: list[Reads] = []
    for count in np.unique(along):
        pixels = np.flatnonzero(along == count)
        for part in np.array_split(pixels, -(-len(pixels) * count**2 // _CHUNK)):
            at = see(view, rig, distance, grid(part, size, count))
            sources, weights = shares(at.room, seam)
            owner = np.broadcast_to(np.repeat(np.arange(len(part)), count**2), sources.shape)
            total = np.bincount(owner.ravel(), weights.ravel(), len(part))
            layer, point = np.nonzero(weights > 0)
            which, of = sources[layer, point], owner[layer, point]
            weight = weights[layer, point] / total[of]
            parts.append(
                Reads(part[of], which.astype(np.uint8), at.pixels[which, point],
                      weight.astype(np.float32))
            )  # fmt: skip
    joined = Reads(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    order = np.argsort(joined.pixels * 256 + joined.sources, kind="stable")
    return Reads(*(column[order] for column in joined))


def corners(points: np.ndarray, size: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The column and the row of the upper left one of the four pixels around points (E, 2), all in
    the picture, and the distances from it to the right and down, (E,) each. Points beyond the
    middles of the outer pixels count as there. size: (H, W), or (2, E) of them."""
    found = []
    for at, side in zip(points.T, size[::-1], strict=True):
        inside = np.clip(at, 0, np.asarray(side) - 1)
        first = np.minimum(np.floor(inside), np.asarray(side) - 2)
        found.append((first.astype(np.intp), inside - first))
    (columns, right), (rows, lower) = found
    return columns, rows, right, lower


def read_at(image: Tensor, points: np.ndarray) -> Tensor:
    """Reads images (B, C, H, W) bilinearly at points (E, 2), as `corners` has them: (B, C, E)."""
    size = tuple(image.shape[2:])
    columns, rows, right, lower = map(torch.from_numpy, corners(points, size))
    flat, first = image.flatten(2), (rows * size[1] + columns).to(image.device)
    right, lower = right.to(image), lower.to(image)
    upper, under = (
        torch.lerp(flat[..., first + row * size[1]], flat[..., first + row * size[1] + 1], right)
        for row in (0, 1)
    )
    return torch.lerp(upper, under, lower)


def checked(frames: Frames, rig: Rig, maps: bool = False) -> tuple[Any, ...]:
    """Frames of the cameras of a rig in their order, or maps of labels or distances.

    Raises:
        TypeError: a frame is no array and no tensor, or they are of several types or channels.
        ValueError: a frame is missing, unknown or of another size. Both errors name the camera.
    """
    frames = in_order(frames, rig.names)
    kinds = set()
    for frame, (name, camera) in zip(frames, rig.cameras.items(), strict=True):
        if not isinstance(frame, np.ndarray) and (maps or not isinstance(frame, Tensor)):
            kind = "an array" if maps else "an array or a tensor"
            raise TypeError(f"the frame of {name} must be {kind}, got {type(frame).__name__}")
        is_array, shape, dtype = isinstance(frame, np.ndarray), tuple(frame.shape), frame.dtype
        size, channels = (shape[:2], shape[2:]) if is_array else (shape[2:], shape[:2])
        if size != camera.size or len(shape) > (4 - is_array if not maps else 2):
            form = "(H, W)" if maps else "(H, W) or (H, W, C)" if is_array else "(B, C, H, W)"
            raise ValueError(
                f"the frame of {name} must be {form} with (H, W) = {camera.size}, got {shape}"
            )
        if isinstance(dtype, np.dtype) and not maps and dtype.kind in "iu" and dtype.itemsize > 2:
            raise TypeError(f"frames of {dtype} would be mixed: remap.target moves ids")
        kinds.add((is_array, dtype, channels))
    if len(kinds) > 1:
        raise TypeError(f"all frames must have one type and one number of channels, got {kinds}")
    return frames
