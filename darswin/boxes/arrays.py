"""Boxes and points as NumPy arrays, from arrays, tensors and lists."""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

Array = Any  # a NumPy array, a tensor, or lists of numbers
PointMap = Callable[[np.ndarray], np.ndarray]


def _is_tensor(value: object) -> bool:
    torch = sys.modules.get("torch")  # without it, there are no tensors
    return torch is not None and isinstance(value, torch.Tensor)


def to_numpy(value: Any) -> Any:
    return value.detach().cpu().numpy() if _is_tensor(value) else value


def floats(value: Any) -> np.ndarray:
    return np.asarray(to_numpy(value.double() if _is_tensor(value) else value), np.float64)


def like(original: Any, value: np.ndarray) -> Any:
    """A result with the kind, device and floating dtype of what was original."""
    if _is_tensor(original):
        torch = sys.modules["torch"]
        dtype = original.dtype if value.dtype.kind == "f" and original.is_floating_point() else None
        return torch.from_numpy(np.ascontiguousarray(value)).to(original.device, dtype)
    dtype = np.asarray(original).dtype.newbyteorder("=")
    both_float = value.dtype.kind == "f" and dtype.kind == "f"
    return value.astype(dtype, copy=False) if both_float else value


def table_of(boxes: Any, columns: tuple[int, ...] = (4, 5)) -> np.ndarray:
    """Boxes as an array of upright ones, (K, 4), or of turned ones, (K, 5)."""
    table = floats(boxes)
    if table.shape == (0,):  # of an empty list
        table = table.reshape(0, 4)
    if table.ndim != 2 or table.shape[1] not in columns:
        known = " or ".join(f"(K, {count})" for count in columns)
        raise ValueError(f"boxes must have shape {known}, got {shape_of(table)}")
    return table


def shape_of(array: np.ndarray) -> str:
    return str(tuple(array.shape))


def through(points_map: PointMap, points: np.ndarray) -> np.ndarray:
    """Points of COCO through a map of darswin's pixels; both coordinates are NaN if one is not
    finite."""
    moved = np.asarray(points_map(points - 0.5), np.float64) + 0.5
    is_seen = np.isfinite(moved[..., 0] + moved[..., 1])
    return moved if is_seen.all() else np.where(is_seen[..., None], moved, np.nan)
