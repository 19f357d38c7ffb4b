"""Arrays of NumPy as tensors."""

from typing import Any

import numpy as np
import torch
from torch import Tensor


def as_tensor(
    value: Any, dtype: torch.dtype | None = None, device: torch.device | None = None
) -> Tensor:
    """`torch.as_tensor`, which also takes arrays that torch refuses or warns of: turned round by a
    view (`a[::-1]`), big-endian and read-only ones, and lists of arrays."""
    if isinstance(value, list | tuple) and all(isinstance(entry, np.ndarray) for entry in value):
        value = np.array(value)  # ValueError for arrays of different shapes
    if isinstance(value, np.ndarray):
        # A copy: the strides of one number may be negative, and count as contiguous.
        value = np.array(value, value.dtype.newbyteorder("="), order="C")
    return torch.as_tensor(value, dtype=dtype, device=device)
