"""A linear layer whose three products, the gradients' included, may be oneDNN's or torch's BLAS.

In float32 torch asks its BLAS, which is MKL in the wheels for x86-64 and slow on AMD's CPUs.
"""

import time
from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from darswin.layers import onednn

MatmulBackend = Literal["torch", "onednn", "autotune"]
MATMUL_BACKENDS = get_args(MatmulBackend)


def _parameter_gradients(g: Tensor, x: Tensor, with_bias: bool) -> tuple[Tensor, Tensor | None]:
    return g.t() @ x, g.sum(0) if with_bias else None


# Of rows x (M, D), a weight w (D', D) and the gradient g (M, D') of the result.
_WAYS: dict[str, dict[str, Callable]] = {
    "forward": {"torch": F.linear, "onednn": onednn.product},
    "input gradient": {
        "torch": lambda g, w: g @ w,
        "onednn": lambda g, w: onednn.product(g, w.t()),
    },
    # The bias's gradient comes along.
    "weight gradient": {"torch": _parameter_gradients, "onednn": onednn.parameter_gradients},
}


class Shape(NamedTuple):
    """What a measurement is of."""

    product: str  # "forward", "input gradient" or "weight gradient"
    rows: int  # of the input, rounded up to a power of two
    in_features: int
    out_features: int
    threads: int


_measured: dict[Shape, dict[str, float]] = {}


def autotune_results() -> dict[Shape, dict[str, float]]:
    """What was measured so far: for each shape the seconds of each way, the one taken first."""
    return {
        shape: dict(sorted(seconds.items(), key=lambda item: item[1]))
        for shape, seconds in _measured.items()
    }


class Linear(nn.Linear):
    """`nn.Linear` with a choice of the library that computes its products.

    `matmul_backend` is "torch", as `nn.Linear`; "onednn"; or "autotune", which measures both at the
    first call with a shape, takes the faster from then on, and shows what it found in
    `autotune_results`. Both compute in float32. They round differently, so a run that must repeat
    bit for bit names one of the two. Second derivatives need "torch".

    It concerns float32 on the CPU in eager mode. Elsewhere torch computes the product as ever: in
    compiled graphs; under autocast and in bfloat16, where it asks oneDNN by itself; and where there
    is no oneDNN.
    """

    matmul_backend: MatmulBackend = "torch"

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D')."""
        if self.matmul_backend == "torch" or not _concerned(x, self.weight):
            return super().forward(x)
        return _Product.apply(x, self.weight, self.bias, self.matmul_backend)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, matmul_backend={self.matmul_backend!r}"


def _concerned(x: Tensor, weight: Tensor) -> bool:
    return (
        not torch.compiler.is_compiling()
        and x.dtype == weight.dtype == torch.float32
        and x.device.type == weight.device.type == "cpu"
        and x.numel() > 0
        and not torch.is_autocast_enabled("cpu")
        and onednn.missing(torch.float32) is None
    )


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, weight, bias, matmul_backend):
        ctx.save_for_backward(x, weight)
        ctx.matmul_backend = matmul_backend
        rows = x.reshape(-1, x.shape[-1])
        out = _multiply("forward", matmul_backend, weight, rows, weight, bias)
        return out.view(*x.shape[:-1], weight.shape[0])

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        x, weight = ctx.saved_tensors
        rows, grad_rows = x.reshape(-1, x.shape[-1]), grad.reshape(-1, grad.shape[-1])
        wants_x, wants_weight, wants_bias, _ = ctx.needs_input_grad
        grad_x = grad_weight = grad_bias = None
        if wants_x:
            grad_x = _multiply("input gradient", ctx.matmul_backend, weight, grad_rows, weight)
            grad_x = grad_x.view(x.shape)
        if wants_weight:
            arguments = (grad_rows, rows, wants_bias)
            grad_weight, grad_bias = _multiply(
                "weight gradient", ctx.matmul_backend, weight, *arguments
            )
        elif wants_bias:
            grad_bias = grad_rows.sum(0)
        return grad_x, grad_weight, grad_bias, None


def _multiply(product: str, matmul_backend: MatmulBackend, weight: Tensor, rows: Tensor, *others):
    """The product of a layer with `weight`, of (M, ...) rows and others, in the way to take."""
    ways = _WAYS[product]
    if matmul_backend == "onednn":
        return ways["onednn"](rows, *others)
    height = 1 << (rows.shape[0] - 1).bit_length()
    out_features, in_features = weight.shape
    shape = Shape(product, height, in_features, out_features, torch.get_num_threads())
    if shape not in _measured:
        _measured[shape] = _measure(ways, (rows, *others))
    seconds = _measured[shape]
    return ways[min(seconds, key=seconds.__getitem__)](rows, *others)


def _measure(ways: dict[str, Callable], arguments: tuple) -> dict[str, float]:
    """Seconds of each way: the best of a few, taken in turns."""
    seconds = dict.fromkeys(ways, float("inf"))
    for turn in range(5):
        for name, way in ways.items():
            start = time.perf_counter()
            way(*arguments)
            if turn:  # the first one makes what oneDNN keeps for the shape
                seconds[name] = min(seconds[name], time.perf_counter() - start)
    return seconds
