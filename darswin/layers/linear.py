"""A linear layer that computes its products with oneDNN or with torch's BLAS, gradients included.

In float32, torch uses its BLAS. In the wheels for x86-64 this is MKL, which is half as fast as
oneDNN on AMD's CPUs. oneDNN is part of torch's own library.
"""

import time
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

__all__ = ["Linear", "autotune_results"]

Key = TypeVar("Key")
MatmulBackend = Literal["torch", "onednn", "autotune"]
MATMUL_BACKENDS = get_args(MatmulBackend)


def onednn_lack(dtype: torch.dtype) -> str | None:
    """The reason why oneDNN cannot compute products in `dtype` here, or None if it can."""
    if dtype not in (torch.float32, torch.bfloat16, torch.int8):
        return f"oneDNN has no products in {dtype}"
    if not torch.backends.mkldnn.is_available():
        return f"torch {torch.__version__} is built without oneDNN"
    if not torch.backends.mkldnn.enabled:
        return "torch.backends.mkldnn.enabled is False"
    if not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        return f"torch {torch.__version__} has no linear operator of oneDNN"
    if dtype == torch.bfloat16 and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return "oneDNN has no bfloat16 products on this CPU"
    if dtype == torch.int8:
        if not hasattr(torch.ops.onednn, "qlinear_pointwise"):
            return f"torch {torch.__version__} has no int8 products of oneDNN"
        if not _has_int8():
            return "this CPU has no VNNI, the instructions of int8 products"
        if not _int8_is_exact():
            return "oneDNN's int8 products overflow: ONEDNN_MAX_CPU_ISA keeps it from using VNNI"
    return None


def _has_int8() -> bool:
    # With VNNI, products of 8 bits are added in 32 bits; without it, they overflow in 16 bits.
    if torch.cpu._is_vnni_supported():
        return True
    capabilities: Any = getattr(torch.cpu, "get_capabilities", dict)  # missing in older torch
    return any(capabilities().get(name) for name in ("avx_vnni", "amx_int8"))


@cache
def _int8_is_exact() -> bool:
    """True if the largest possible product is right; it is wrong without VNNI."""
    size, largest = 64, 127
    weight = torch.full((size, size), largest, dtype=torch.int8)
    packed = torch.ops.onednn.qlinear_prepack(weight, None)
    scales, zero_points = torch.ones(size), torch.zeros(size, dtype=torch.int64)
    q = torch.full((size, size), 255, dtype=torch.uint8)
    found = torch.ops.onednn.qlinear_pointwise.default(
        q, 1.0, 0, packed, scales, zero_points, None, 1.0, 0, torch.float32, "none", [], "none"
    )
    return bool((found == size * largest * 255).all())


def _onednn_product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    return torch.ops.mkldnn._linear_pointwise.default(x, weight, bias, "none", [], "")


# The inputs: rows x (M, D), a weight w (D', D), and the gradient g (M, D') of the result.
_PRODUCTS: dict[str, dict[str, Callable]] = {
    "forward": {"torch": F.linear, "onednn": _onednn_product},
    "input gradient": {
        "torch": lambda g, w: g @ w,
        "onednn": lambda g, w: _onednn_product(g, w.t()),
    },
    "weight gradient": {
        "torch": lambda g, x: g.t() @ x,
        # oneDNN needs one of the two matrices transposed in memory.
        "onednn": lambda g, x: _onednn_product(g.t().contiguous(), x.t()),
    },
}


class Shape(NamedTuple):
    """The key of an autotune measurement."""

    product: str  # "forward", "input gradient" or "weight gradient"
    rows: int  # of the input, rounded up to a power of two
    in_features: int
    out_features: int
    threads: int


_measured: dict[Shape, dict[str, float]] = {}


def autotune_results() -> dict[Shape, dict[str, float]]:
    """The measured seconds of each library for each shape so far, with the fastest one first."""
    return {
        shape: dict(sorted(seconds.items(), key=lambda item: item[1]))
        for shape, seconds in _measured.items()
    }


class Linear(nn.Linear):
    """`nn.Linear` with a choice of the library that computes its matrix products.

    `matmul_backend` is "torch", "onednn" or "autotune". "autotune" measures both libraries at the
    first call with a shape and uses the faster one from then on; `autotune_results` shows the
    measurements. Both libraries compute in float32 but round differently, so choose one of them if
    a run must repeat bit for bit. Second derivatives need "torch".

    The choice applies to float32 on the CPU in eager mode. In all other cases torch computes the
    products: in compiled graphs, without oneDNN, and in bfloat16 or under autocast, where torch
    uses oneDNN by itself.
    """

    matmul_backend: MatmulBackend = "torch"

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D')."""
        if self.matmul_backend == "torch" or not _is_concerned(x, self.weight):
            return super().forward(x)
        return _Product.apply(x, self.weight, self.bias, self.matmul_backend)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, matmul_backend={self.matmul_backend!r}"


def _is_concerned(x: Tensor, weight: Tensor) -> bool:
    return (
        not torch.compiler.is_compiling()
        and x.dtype == weight.dtype == torch.float32
        and x.device.type == weight.device.type == "cpu"
        and x.numel() > 0
        and not torch.is_autocast_enabled("cpu")
        and onednn_lack(torch.float32) is None
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
            grad_weight = _multiply("weight gradient", ctx.matmul_backend, weight, grad_rows, rows)
        if wants_bias:
            grad_bias = grad_rows.sum(0)
        return grad_x, grad_weight, grad_bias, None


def _multiply(product: str, matmul_backend: MatmulBackend, weight: Tensor, rows: Tensor, *others):
    """A product of (M, ...) rows and other operands, by the chosen or the faster library."""
    libraries = _PRODUCTS[product]
    if matmul_backend == "onednn":
        return libraries["onednn"](rows, *others)
    height = 1 << (rows.shape[0] - 1).bit_length()
    out_features, in_features = weight.shape
    shape = Shape(product, height, in_features, out_features, torch.get_num_threads())
    if shape not in _measured:
        runs = {name: partial(library, rows, *others) for name, library in libraries.items()}
        _measured[shape] = best_seconds(runs, turns=5)
    seconds = _measured[shape]
    return libraries[min(seconds, key=seconds.__getitem__)](rows, *others)


def best_seconds(runs: Mapping[Key, Callable[[], object]], turns: int) -> dict[Key, float]:
    """The shortest time of each run in seconds. Runs take turns; the first turn does not count."""
    seconds = dict.fromkeys(runs, float("inf"))
    for turn in range(turns):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if turn:  # in the first turn oneDNN prepares itself for the shape
                seconds[name] = min(seconds[name], time.perf_counter() - start)
    return seconds
