"""add_norm_: a residual and the layer norm behind it, in place. Public function and fake."""

import torch
from torch import Tensor


def add_norm_(x: Tensor, y: Tensor, weight: Tensor, bias: Tensor, eps: float) -> Tensor:
    """Adds y to x, then makes y the layer norm of the sum: one pass over memory, for inference.

    Args:
        x: (..., D), contiguous, float32 or bfloat16; it becomes x + y.
        y: of the same type and size, contiguous; it becomes the norm, and is returned.
        weight, bias: (D,), float32. eps: added to the variance.

    With bfloat16 the arithmetic is float32, and the sum is rounded before it is normalized. There
    is no gradient: nothing may require one. Results do not depend on the number of threads.

    Raises:
        RuntimeError: tensors that do not fit.
    """
    torch.ops.darswin.add_norm_.default(x, y, weight, bias, eps)
    return y


@torch.library.register_fake("darswin::add_norm_")
def _fake(x, y, weight, bias, eps):
    return None
