"""linear and mlp: linear layers, fast in training. Public functions, fakes and autograd."""

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd import forward_ad

from darswin.ops import _library, _module, reference

_LINEAR, _MLP = _library.operator("linear"), _library.operator("mlp")
# MKL takes slower paths on CPUs that are not Intel's. Our kernels need AVX2 to be faster.
IS_FASTER = torch.backends.mkl.is_available() and _module.is_fast_beside_mkl()
# With fewer rows, packing the weight takes longer than the product gains.
LEAST_ROWS = 128


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """The linear layer of tokens.

    Our own kernels compute the products, forward and backward, where they are faster: in float32,
    for 128 rows or more or in compiled training, where torch would use MKL on a CPU with AVX2 that
    is not Intel's. Elsewhere torch computes them: also under autocast, in exported graphs, in
    compiled inference, and for derivatives other than backward().

    Args:
        x: (..., D).
        weight: (D', D).
        bias: (D',).

    Returns:
        (..., D'). Results and gradients of our kernels do not depend on the number of threads.

    Raises:
        RuntimeError: a shape, dtype or device does not fit.
        NotImplementedError: second derivatives of our kernels are requested.
    """
    return _LINEAR(x, weight, bias) if _is_ours(x, weight) else F.linear(x, weight, bias)


def mlp(x: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """Linear, GELU, linear, by our own kernels under the conditions of `linear`.

    Our kernels keep the input of the GELU for the backward, but not its output.

    Args:
        x: (..., D).
        weight1, bias1: (D', D) and (D',).
        weight2, bias2: (D'', D') and (D'',).

    Returns:
        (..., D'').

    Raises:
        RuntimeError, NotImplementedError: as `linear`.
    """
    layers = (weight1, bias1, weight2, bias2)
    return _MLP(x, *layers)[0] if _is_ours(x, weight1) else reference.mlp(x, *layers)


def _is_ours(x: Tensor, weight: Tensor) -> bool:
    return (
        IS_FASTER
        and type(x) is Tensor
        and x.dtype == weight.dtype == torch.float32
        and x.is_cpu
        and weight.is_cpu
        and not _library.reference_in_use()
        and not torch.is_autocast_enabled("cpu")
        and (_is_compiled_training if torch.compiler.is_compiling() else _is_long)(x)
    )


def _is_compiled_training(x: Tensor) -> bool:
    # Of any length: a graph must not depend on the number of images.
    return torch.is_grad_enabled() and not torch.compiler.is_exporting()


def _is_long(x: Tensor) -> bool:
    """Also that no other derivative may be asked for, and nothing is traced."""
    is_plain = not torch.jit.is_tracing() and forward_ad._current_level < 0
    return is_plain and not _library.transformed() and x.numel() >= LEAST_ROWS * x.shape[-1] > 0


@_library.register_fake("linear")
def _fake_linear(x, weight, bias):
    return x.new_empty((*x.shape[:-1], weight.shape[0]))


@_library.register_fake("mlp")
def _fake_mlp(x, weight1, bias1, weight2, bias2):
    return tuple(x.new_empty((*x.shape[:-1], w.shape[0])) for w in (weight2, weight1))


_library.register_gradients("linear", {0: 0, 1: 1, 2: 2})
_library.register_gradients("mlp", {k: k for k in range(5)})
