"""Argument checks that the operators and their layers share, and functions that avoid waiting for a
device.

Each message states the expected and the actual value.
"""

import math
import numbers
import operator
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from darswin.ops._library import transformed

DTYPES = (torch.float32, torch.float64)
LAYOUTS = ("tokens", "image")
FRAME_CHANNELS = (1, 3, 4)  # possible numbers of channels of a camera frame


def check_tensor(
    name: str,
    value: object,
    dtypes: Sequence[torch.dtype],
    form: str,
    *shapes: Sequence[int | None],
    like: Tensor | None = None,
) -> None:
    """Raises TypeError or ValueError unless `value` is a tensor with one of the dtypes and shapes
    (None: any size), on the device of `like`. `form` is the shape for the message; the known sizes
    of the first shape replace its fields {}."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(value).__name__}")
    if value.dtype not in dtypes:
        names = [str(dtype).removeprefix("torch.") for dtype in dtypes]
        known = " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))
        raise TypeError(f"{name} must be {known}, got {value.dtype}")
    if like is not None and value.device != like.device:
        raise ValueError(f"{name} must be on the same device, {like.device}, got {value.device}")
    shape = tuple(value.shape)
    for sizes in shapes:
        if shape == sizes or _fits(shape, sizes):
            return
    # Formatted only here: an f-string in the caller would tie a compiled graph to these sizes.
    expected = form.format(*(size for size in shapes[0] if size is not None))
    raise ValueError(f"{name} must have shape {expected}, got {shape}")


def _fits(shape: Sequence[int], sizes: Sequence[int | None]) -> bool:
    if len(shape) != len(sizes):
        return False
    for size, allowed in zip(shape, sizes, strict=True):  # Dynamo of torch 2.10 cannot trace all()
        if allowed is not None and size != allowed:
            return False
    return True


def check_rising(name: str, value: Tensor) -> None:
    """Raises ValueError unless each row of (N, R) is finite, at least 0, and rises. It checks only
    plain, `readable` tensors, and nothing within the transforms of torch.func."""
    if not readable(value) or transformed() or type(value) not in (Tensor, torch.nn.Parameter):
        return
    rows = value.detach().numpy()
    if not ((rows[:, 1:] > rows[:, :-1]).all() and (rows >= 0).all() and (rows < math.inf).all()):
        raise ValueError(f"{name} must be finite, at least 0, and rise from ring to ring")


def readable(value: Tensor) -> bool:
    """True if the host can read `value` without waiting: in eager mode, on the CPU."""
    return not torch.compiler.is_compiling() and value.device.type == "cpu"


def tensor_there(
    numbers: Sequence[float], like: Tensor, dtype: torch.dtype | None = None
) -> Tensor:
    """A tensor (K,) of the numbers on the device of `like`. On a GPU the numbers are created
    there, since the host would have to wait for a copy; in a graph too, as a loop has no constants
    of its own."""
    if readable(like):
        return like.new_tensor(numbers, dtype=dtype)
    made = [like.new_full((1,), number, dtype=dtype) for number in numbers]
    return torch.cat(made) if len(made) > 1 else made[0]


def as_int(value: Any) -> int | None:
    """A Python int for an int of Python or NumPy, else None. Bools and floats are no ints here."""
    if isinstance(value, (bool, Tensor)):
        return None
    known = isinstance(value, (int, torch.SymInt))
    try:
        return value if known else operator.index(value)
    except TypeError:
        return None


def check_pair(name: str, value: Any, lowest: int) -> tuple[int, int]:
    """The pair, checked: raises TypeError or ValueError unless it is two ints ≥ `lowest`."""
    if not isinstance(value, (tuple, list, torch.Size)) or len(value) != 2:
        raise TypeError(f"{name} must be a pair of ints, got {value!r}")
    first, second = value
    if type(first) is not int or type(second) is not int:
        first, second = as_int(first), as_int(second)
    if first is None or second is None:
        raise TypeError(f"{name} must be a pair of ints, got {value!r}")
    if first < lowest or second < lowest:
        raise ValueError(f"{name} must be at least {lowest} along both axes, got {value!r}")
    return first, second


def side_or_pair(name: str, size: int | Sequence[int]) -> tuple[int, int]:
    """(H, W) of at least 1, from such a pair or the side of a square; else as `check_pair`."""
    return check_pair(name, (size, size) if as_int(size) is not None else size, lowest=1)


def check_has_batch(
    name: str, image: Tensor, channels_last: bool | None = None, channels: int | None = None
) -> None:
    """Raises ValueError, with advice, unless an image has four dimensions."""
    if image.dim() == 4:
        return
    shape = tuple(image.shape)
    sizes = FRAME_CHANNELS if channels is None else (channels,)
    advice = {2: f"; for one gray image, pass {name}[None, None]"}.get(len(shape), "")
    if len(shape) == 3:
        last = not channels_last and shape[2] in sizes and shape[0] not in sizes
        turned = last and (image.dtype != torch.uint8 or channels_last is False)
        order = ".permute(2, 0, 1)" if turned else ""
        first = ", with the channels first" if turned else ""
        advice = f"; for one image, pass {name}{order}[None]{first}"
    raise ValueError(f"{name} must have shape (B, C, H, W), got {shape}{advice}")


def channels_first(
    name: str, image: Tensor, channels_last: bool | None = None, channels: int | None = None
) -> Tensor:
    """A view (B, C, H, W) of an image. If channels_last is None, the channel axis of a uint8 image
    is its second or last axis, depending on which has `channels` or one of `FRAME_CHANNELS`."""
    if channels_last is None:
        if image.dtype != torch.uint8:
            return image
        shape, sizes = image.shape, FRAME_CHANNELS if channels is None else (channels,)
        first, last = shape[1] in sizes, shape[3] in sizes
        # If all three sizes are 1, both layouts give the same image.
        if (first and last and shape[1:] != (1, 1, 1)) or not (first or last):
            known: object = channels
            hint = ""
            if channels is None:
                known = "1, 3 or 4"
                hint = ": pass channels_last=True for (B, H, W, C), or False for (B, C, H, W)"
            elif first:
                hint = ": pass it in floating point, which is always (B, C, H, W)"
            raise ValueError(
                f"{name} of uint8 must have {known} channels along either its second or its last "
                f"axis, {'both have' if first else 'neither has'} in shape {tuple(shape)}{hint}"
            )
        channels_last = not first
    elif not isinstance(channels_last, bool):
        raise TypeError(f"channels_last must be True, False or None, got {channels_last!r}")
    return image.permute(0, 3, 1, 2) if channels_last else image


def per_channel(name: str, value: float | Sequence[float], channels: int) -> tuple[float, ...]:
    """`mean` or `std` as one number per channel. Raises ValueError if the count does not fit."""
    values = tuple(value) if isinstance(value, Iterable) else (value,) * channels
    if len(values) != channels:
        raise ValueError(
            f"{name} must be one number or one per channel ({channels}), got {value!r}"
        )
    if name == "std" and not all(v > 0 for v in values):
        raise ValueError(f"std must be positive, got {value!r}")
    return tuple(float(v) for v in values)


def check_layout(layout: str) -> None:
    """Raises ValueError unless the layout is one of `LAYOUTS`."""
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {LAYOUTS}, got {layout!r}")


def check_jitter(jitter: float) -> float:
    """Jitter as a Python float. Raises TypeError or ValueError unless it is in [0, 1]."""
    if not isinstance(jitter, (float, torch.SymFloat)):
        if isinstance(jitter, Tensor) or not isinstance(jitter, numbers.Real):
            raise TypeError(f"jitter must be a float, got {type(jitter).__name__}")
        jitter = float(jitter)
    if not 0 <= jitter <= 1:
        raise ValueError(f"jitter must be in [0, 1], got {jitter}")
    return jitter
