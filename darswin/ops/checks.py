"""The argument checks that the operators and their layers share.

A message says what was expected and what came.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

DTYPES = (torch.float32, torch.float64)
LAYOUTS = ("tokens", "image")


def check_tensor(name: str, value: object, like: Tensor | None = None) -> None:
    """TypeError unless `value` is a float32/float64 tensor, with the type and device of `like`."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
    if value.dtype not in DTYPES:
        raise TypeError(f"{name} must be float32 or float64, got {value.dtype}")
    if like is not None and value.dtype != like.dtype:
        raise TypeError(f"{name} must have the same dtype, {like.dtype}, got {value.dtype}")
    if like is not None and value.device != like.device:
        raise ValueError(f"{name} must be on the same device, {like.device}, got {value.device}")


def check_dtype(name: str, value: object, dtypes: Sequence[torch.dtype]) -> None:
    """TypeError unless `value` is a tensor of one of `dtypes`."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
    if value.dtype not in dtypes:
        *others, last = (str(dtype).removeprefix("torch.") for dtype in dtypes)
        raise TypeError(f"{name} must be {', '.join(others)} or {last}, got {value.dtype}")


def check_shape(name: str, value: Tensor, form: str, *allowed: Sequence[int | None]) -> None:
    """ValueError unless the shape is one of `allowed` (None: any size); `form` says it in words."""
    shape = tuple(value.shape)
    for sizes in allowed:
        if len(shape) == len(sizes) and all(
            s is None or s == size for s, size in zip(sizes, shape, strict=True)
        ):
            return
    raise ValueError(f"{name} must have shape {form}, got {shape}")


def check_pair(name: str, value: Sequence[int], lowest: int) -> tuple[int, int]:
    """Two ints of at least `lowest`, else TypeError or ValueError."""
    if not isinstance(value, (tuple, list, torch.Size)) or len(value) != 2:
        raise TypeError(f"{name} must be a pair of ints, got {value!r}")
    for item in value:
        if isinstance(item, bool) or not isinstance(item, (int, torch.SymInt)):
            raise TypeError(f"{name} must be a pair of ints, got {value!r}")
        if item < lowest:
            raise ValueError(f"{name} must be at least {lowest} along both axes, got {value!r}")
    return tuple(value)


def check_sampling(jitter: float, layout: str) -> None:
    """TypeError or ValueError unless jitter is in [0, 1] and the layout one that there is."""
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {LAYOUTS}, got {layout!r}")
    if not isinstance(jitter, (int, float)):
        raise TypeError(f"jitter must be a float, got {type(jitter).__name__}")
    if not 0 <= jitter <= 1:
        raise ValueError(f"jitter must be in [0, 1], got {jitter}")
