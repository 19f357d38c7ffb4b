"""transpose_sum, a private operator without a reference for the gradients of a linear layer."""

import torch
from torch import Tensor

from darswin.ops import _library


def transpose_sum(x: Tensor) -> tuple[Tensor, Tensor]:
    """The transpose (N, M) of a contiguous float32 matrix (M, N), and its column sums (N,).

    The gradients of a linear layer use it. Its own gradient is torch's transpose and sum."""
    _library.refuse_other_derivatives("transpose_sum", (x,))
    return torch.ops.darswin._transpose_sum.default(x)


@torch.library.register_fake("darswin::_transpose_sum")
def _fake(x):
    return x.new_empty(x.shape[::-1]), x.new_empty(x.shape[1:])


def _backward(ctx, grad_transposed, grad_sums):
    return grad_transposed.t() + grad_sums


torch.library.register_autograd("darswin::_transpose_sum", _backward)
