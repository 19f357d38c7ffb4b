"""What host and device exchange so that neither waits for the other."""

from collections.abc import Sequence

import torch
from torch import Tensor


def readable(value: Tensor) -> bool:
    """Whether values are there to be looked at: not in a graph that is being compiled, and not on a
    device, which would be waited for."""
    return not torch.compiler.is_compiling() and value.device.type == "cpu"


def tensor_there(
    numbers: Sequence[float], like: Tensor, dtype: torch.dtype | None = None
) -> Tensor:
    """Numbers as a tensor (K,), as `like.new_tensor`; on a device they are not copied from the
    host, which would be waited for, but made."""
    if like.device.type == "cpu":
        return like.new_tensor(numbers, dtype=dtype)
    made = [like.new_full((1,), number, dtype=dtype) for number in numbers]
    return torch.cat(made) if len(made) > 1 else made[0]
