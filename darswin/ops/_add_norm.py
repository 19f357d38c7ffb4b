"""add_norm_: a residual and the layer norm behind it, in place. Private: it has no reference."""

import torch
from torch import Tensor

from darswin.ops import _library


def add_norm_(x: Tensor, y: Tensor, weight: Tensor, bias: Tensor, eps: float) -> Tensor:
    """Adds y to x, then makes y the layer norm of the sum: one pass over memory, for inference.

    Args:
        x: (..., D), contiguous, float32 or bfloat16; it becomes x + y.
        y: of the same type and size, contiguous; it becomes the norm, and is returned.
        weight, bias: (D,), float32. eps: added to the variance.

    With bfloat16 the arithmetic is float32, and the sum is rounded before it is normalized.
    Results do not depend on the number of threads.

    Raises:
        RuntimeError: tensors that do not fit, that share memory, or that require a gradient where
            one would be recorded: there is none.
    """
    torch.ops.darswin._add_norm_.default(x, y, weight, bias, eps)
    return y


@torch.library.register_fake("darswin::_add_norm_")
def _fake(x, y, weight, bias, eps):
    return None


_library.without_gradient("_add_norm_", changes=2, instead="torch.layer_norm(x + y, ...)")
