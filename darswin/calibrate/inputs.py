"""The checks of what is calibrated from: corners, board and size."""

from numbers import Integral
from typing import Any

import torch
from torch import Tensor

from darswin.calibrate.refine import Views
from darswin.calibrate.steady import places
from darswin.utils.arrays import as_tensor
from darswin.utils.parameters import check, naming
from darswin.utils.words import in_px

LEAST_CORNERS, LEAST_PICTURES = 8, 3


class CalibrationError(ValueError):
    """Corners from which no lens can be found; the message is one sentence for the user."""


def _numbers(name: str, value: Any) -> Tensor:
    try:
        return as_tensor(value, torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise naming(TypeError(f"`{name}` must be numbers, got {value!r:.200}"), name) from error


def checked(corners: Any, board: Any, size: tuple[int, int]) -> tuple[Views, Tensor]:
    """The views, of a board with its middle at 0 and a size of 1, and the board's points."""
    points = _numbers("board", getattr(board, "points", board))
    shaped = points.dim() == 2 and points.shape[1] == 2
    check("board", tuple(points.shape), shaped, "a Board or points of shape (K, 2)")
    check("board", points.tolist(), bool(points.isfinite().all()), "finite")
    found, shape = _numbers("corners", corners), (len(points), 2)
    shaped = found.dim() == 3 and found.shape[1:] == shape
    check("corners", tuple(found.shape), shaped, f"of shape (P, {len(points)}, 2)")
    check("corners", "infinity", not bool(found.isinf().any()), "finite, or NaN where not seen")
    whole = isinstance(size, tuple | list | torch.Size) and len(size) == 2
    whole = whole and all(isinstance(side, Integral) and side > 0 for side in size)
    check("size", size, whole, "(H, W) in whole pixels")
    seen = ~found.isnan().any(-1)
    flat = points - points.mean(0)
    flat = flat / flat.norm(dim=1).amax().clamp(min=1e-300) if len(points) else flat
    if not _spans(flat, torch.ones(len(flat)).bool(), 1e-4):
        raise CalibrationError(
            f"A board needs {LEAST_CORNERS} points or more, not on one line, got {len(points)}."
        )
    board = torch.nn.functional.pad(flat, (0, 1))
    found = torch.where(seen[..., None], found, 0.0)
    return Views(found, seen, board, places(found, seen)), points


def _spans(points: Tensor, seen: Tensor, least: float) -> Tensor:
    """(...) bool: enough of the points (..., K, 2) are seen, (..., K), and they are not on one
    line: their mean square distance from a line is at least `least`."""
    count = seen.sum(-1).clamp(min=1)[..., None, None]
    points = torch.where(seen[..., None], points, 0.0)
    apart = torch.where(seen[..., None], points - points.sum(-2, keepdim=True) / count, 0.0)
    thin = torch.linalg.eigvalsh(apart.mT @ apart / count)[..., 0] < least
    return (seen.sum(-1) >= LEAST_CORNERS) & ~thin


def usable_pictures(views: Views, size: tuple[int, int], names: list[str]) -> Tensor:
    """(P,) bool: the pictures with enough corners, not all on one line."""
    sides = views.corners.new_tensor([size[1], size[0]])
    outside = ((views.corners < -1) | (views.corners > sides)).any(-1) & views.seen
    for k, i in outside.nonzero()[:1].tolist():
        x, y = views.corners[k, i].tolist()
        raise CalibrationError(
            f"{names[k]} has a corner at ({x:.4g}, {y:.4g}), outside of a picture of "
            f"{in_px(size)}: all pictures must be of one size."
        )
    usable = _spans(views.board[:, :2], views.seen, 1e-4) & _spans(views.corners, views.seen, 1.0)
    if usable.sum() < LEAST_PICTURES:
        raise CalibrationError(
            f"At least {LEAST_PICTURES} pictures that show {LEAST_CORNERS} corners, not on one "
            f"line, are needed, got {int(usable.sum())}: take 10 to 20 pictures."
        )
    return usable
