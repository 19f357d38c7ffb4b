"""A linear layer that computes its products with oneDNN or with torch's BLAS, gradients included.

In float32, torch uses its BLAS. In the wheels for x86-64 this is MKL, which is half as fast as
oneDNN on AMD's CPUs. oneDNN is part of torch's own library.
"""

from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

MatmulBackend = Literal["torch", "onednn"]
MATMUL_BACKENDS = get_args(MatmulBackend)


def onednn_lack() -> str | None:
    """The reason why oneDNN cannot compute products in float32 here, or None if it can."""
    if not torch.backends.mkldnn.is_available():
        return f"torch {torch.__version__} is built without oneDNN"
    if not torch.backends.mkldnn.enabled:
        return "torch.backends.mkldnn.enabled is False"
    if not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        return f"torch {torch.__version__} has no linear operator of oneDNN"
    return None


def _onednn_product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise.default(x, weight, bias, "none", [], "")


class Linear(nn.Linear):
    """`nn.Linear` with a choice of the library that computes its matrix products.

    `matmul_backend` is "torch" or "onednn". Both libraries compute in float32 but round
    differently. Second derivatives need "torch".

    The choice applies to float32 on the CPU in eager mode. In all other cases torch computes the
    products: in compiled graphs, without oneDNN, and in bfloat16 or under autocast, where torch
    uses oneDNN by itself.
    """

    matmul_backend: MatmulBackend = "torch"

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D')."""
        if self.matmul_backend == "torch" or not _is_concerned(x, self.weight):
            return super().forward(x)
        return _Product.apply(x, self.weight, self.bias)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, matmul_backend={self.matmul_backend!r}"


def _is_concerned(x: Tensor, weight: Tensor) -> bool:
    return (
        not torch.compiler.is_compiling()
        and x.dtype == weight.dtype == torch.float32
        and x.device.type == weight.device.type == "cpu"
        and x.numel() > 0
        and not torch.is_autocast_enabled("cpu")
        and onednn_lack() is None
    )


class _Product(torch.autograd.Function):
    """By oneDNN: the product, and both of its backward."""

    @staticmethod
    def forward(ctx, x, weight, bias):
        ctx.save_for_backward(x, weight)
        out = _onednn_product(x.reshape(-1, x.shape[-1]), weight, bias)
        return out.view(*x.shape[:-1], weight.shape[0])

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        x, weight = ctx.saved_tensors
        rows, grad_rows = x.reshape(-1, x.shape[-1]), grad.reshape(-1, grad.shape[-1])
        wants_x, wants_weight, wants_bias = ctx.needs_input_grad
        grad_x = grad_weight = grad_bias = None
        if wants_x:
            grad_x = _onednn_product(grad_rows, weight.t()).view(x.shape)
        if wants_weight:
            # oneDNN needs one of the two matrices transposed in memory.
            grad_weight = _onednn_product(grad_rows.t().contiguous(), rows.t())
        if wants_bias:
            grad_bias = grad_rows.sum(0)
        return grad_x, grad_weight, grad_bias
