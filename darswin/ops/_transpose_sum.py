"""transpose_sum: a transpose and sums of columns in one. Private: it has no reference."""

import torch
from torch import Tensor

from darswin.ops import _library


def transpose_sum(x: Tensor) -> tuple[Tensor, Tensor]:
    """The transpose of a matrix, contiguous, and the sums of its columns: one pass over memory.

    For the gradients of a linear layer's weight and bias. Its own gradient is torch's transpose and
    sum. Results do not depend on the number of threads.

    Args:
        x: (M, N), contiguous, float32.

    Returns:
        (N, M) and (N,).

    Raises:
        RuntimeError: another kind of tensor.
        NotImplementedError: forward-mode derivatives and those of torch.func.
    """
    _library.refuse_other_derivatives("transpose_sum", (x,))
    return torch.ops.darswin._transpose_sum.default(x)


@torch.library.register_fake("darswin::_transpose_sum")
def _fake(x):
    return x.new_empty(x.shape[::-1]), x.new_empty(x.shape[1:])


def _backward(ctx, grad_transposed, grad_sums):
    return grad_transposed.t() + grad_sums


torch.library.register_autograd("darswin::_transpose_sum", _backward)
