"""Where objects stand on the floor, by their boxes in a level view."""

import math
from typing import Any

import numpy as np
import torch

from darswin.boxes.arrays import like, table_of
from darswin.utils.parameters import check
from darswin.utils.poses import ahead_of, frame_of
from darswin.views.orientation import Vector, unit_vector

_LEVEL = math.radians(5)  # by which a view may lean
_CUT = 1.0  # px: a box that ends so near to the lower edge of a view may be cut there
_STEPS, _STEP, _NEAR = 12, 1e-4, 0.1  # of the search: at most, m, and px that may remain
_LEVELS = np.linspace(0, 1, 3)[:, None]  # of a cylinder, and the points of its circles
_TURN = np.linspace(0, 2 * np.pi, 36, endpoint=False)
_CIRCLE = np.stack((np.cos(_TURN), np.sin(_TURN)), -1)


@np.errstate(invalid="ignore")  # boxes may end nowhere
def on_floor(remap: Any, boxes: Any, height: float, up: Vector, radius: float) -> Any:
    """`Remap.floor`."""
    above = check_floor(remap.view, height, up, radius)
    table = table_of(boxes, (4,))
    frame = np.array(frame_of(above, ahead_of(above), True))
    foot = np.stack(((table[:, 0] + table[:, 2]) / 2, table[:, 3]), -1)
    right, down, ahead = (remap.rays(foot - 0.5) @ frame).T
    meets = (down > 1e-9) & (table[:, 3] < remap.view_size[0] - _CUT)
    meets &= (table[:, :2] < table[:, 2:]).all(1)
    far = np.divide(height, down, out=np.full(len(table), np.nan), where=meets)
    place = far[:, None] * np.stack((right, ahead), -1)
    distance = np.hypot(*place.T)[:, None]
    place *= 1 + np.divide(radius, distance, out=np.zeros(distance.shape), where=distance > 0)
    if not remap.view.upright and meets.any():
        place[meets] = _search(remap, table[meets], place[meets], height, radius, frame)
    return like(boxes, place)


def check_floor(view: Any, height: float, up: Any, radius: float) -> tuple[float, float, float]:
    """The unit vector of `up`; ValueError for a number that is out of its range, and for a view
    that is not level with it."""
    check("height", height, height is not None and 0 < height < math.inf, "above 0 m")
    check("radius", radius, 0 <= radius < math.inf, "at least 0 m")
    above, own = unit_vector("up", up), getattr(view, "up", None)
    if own is None:
        raise ValueError(
            "boxes show where objects stand only in a level view, such as mercator, panorama or a "
            f"tile of tiles, got {view}"
        )
    if math.dist(own, above) > 2 * math.sin(_LEVEL / 2):
        shown = "({:.3g}, {:.3g}, {:.3g})".format
        raise ValueError(f"the view is level with up={shown(*own)}, not {shown(*above)}")
    return above


def _search(
    remap: Any, table: np.ndarray, place: np.ndarray, height: float, radius: float,
    frame: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The places (K, 2) of upright cylinders whose boxes in the view are those of a table (K, 4).

    Where columns are not vertical, objects lean, and the middle of a box's lower side is not below
    them. Newton's method finds the place and the length of each, by three numbers of its box: the
    ends along the lean, and the middle across it. The width is not used: arms may stick out.
    """
    state = np.concatenate((place, np.full((len(place), 1), height / 2)), 1)
    change = np.concatenate((np.zeros((1, 3)), _STEP * np.eye(3)))
    for _ in range(_STEPS):
        box, wide = _boxes_of(remap, state + change[:, None], height, radius, frame)
        wide = np.broadcast_to(wide[0], wide.shape)
        numbers, goal = _numbers(box, wide), _numbers(table, wide[0])
        gap = goal - numbers[0]
        slopes = np.moveaxis(numbers[1:] - numbers[0], 0, -1) / _STEP
        known = np.isfinite(slopes).all((1, 2)) & (np.abs(np.linalg.det(slopes)) > 0)
        state[~known] = np.nan
        if not known.any() or np.abs(gap[known]).max() < 0.01 * _NEAR:
            break
        step = np.linalg.solve(slopes[known], gap[known, :, None])[..., 0]
        most = np.hypot(*state[known, :2].T) / 2 + radius
        step *= np.minimum(1, most / np.linalg.norm(step, axis=1).clip(1e-9))[:, None]
        state[known] += step
    state[~(np.abs(gap) < _NEAR).all(1)] = np.nan
    return state[:, :2]


def _numbers(boxes: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Both ends of boxes along y, and the middle along x; or the reverse for those that lie."""
    x0, y0, x1, y1 = np.moveaxis(boxes, -1, 0)
    stands = np.stack((y0, y1, (x0 + x1) / 2), -1)
    return np.where(wide[..., None], np.stack((x0, x1, (y0 + y1) / 2), -1), stands)


def _boxes_of(
    remap: Any, state: np.ndarray, height: float, radius: float, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The boxes (..., 4) of cylinders in the view, by x, y and length (..., 3) in metres, and
    whether they lie rather than stand there."""
    level = state[..., None, None, :2] + radius * _CIRCLE
    level = np.broadcast_to(level, (*state.shape[:-1], len(_LEVELS), len(_TURN), 2))
    depth = np.broadcast_to(height - state[..., 2, None, None] * _LEVELS, level.shape[:-1])
    rays = torch.from_numpy(np.insert(level, 1, depth, -1) @ frame.T)
    points = remap.view.to_points(rays[None], remap.lens, remap.size)[0].numpy() + 0.5
    x, y = np.ascontiguousarray(np.moveaxis(points, -1, 0))
    across, along = (np.abs(of[..., -1, :].mean(-1) - of[..., 0, :].mean(-1)) for of in (x, y))
    x, y = x.reshape(*state.shape[:-1], -1), y.reshape(*state.shape[:-1], -1)
    return np.stack((x.min(-1), y.min(-1), x.max(-1), y.max(-1)), -1), across > along
