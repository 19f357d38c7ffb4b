"""Other roundings: what another CPU, or another version of a library, might compute.

`make test-numerics NUMERICS=rounding` runs the tests within `Rounded`. A test that fails there
compares bits with somebody else's library, or stands on a tie.
"""

import random

import torch
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

# What libraries round in their own way. Sums and products of two numbers are the same everywhere.
OF_NUMBERS = {
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "expm1",
    "log", "log1p", "log2", "log10", "erf", "sigmoid", "hypot", "rsqrt", "gelu", "silu", "lerp",
    "addcmul", "addcdiv", "linspace",
}  # fmt: skip
OF_SUMS = {
    "mm", "addmm", "bmm", "baddbmm", "mv", "dot", "sum", "mean", "var", "std", "cumsum", "norm",
    "linalg_vector_norm", "logsumexp", "native_layer_norm", "native_layer_norm_backward",
    "native_group_norm", "native_batch_norm", "_softmax", "_log_softmax", "_softmax_backward_data",
    "_log_softmax_backward_data", "gelu_backward", "convolution", "convolution_backward",
    "grid_sampler_2d", "grid_sampler_2d_backward", "upsample_bilinear2d", "_linear_pointwise",
    "_scaled_dot_product_flash_attention_for_cpu", "linalg_solve_ex", "_linalg_solve_ex",
}  # fmt: skip
_BITS = {torch.float32: torch.int32, torch.float64: torch.int64}


def moved(x: torch.Tensor, salt: int) -> torch.Tensor:
    """Half of the numbers, chosen by their bits, one step up or down; a copy at any address.

    Numbers with few digits stay, because everybody computes these exactly.
    """
    bits = (x.view(_BITS[x.dtype]) * 0x3779B1 + salt) >> 7
    up = torch.full_like(x, float("inf"))
    other = torch.nextafter(x, torch.where(bits & 2 == 0, up, -up))
    exact = ~x.isfinite() | (torch.frac(x * 2**12) == 0)
    room = x.new_empty(x.numel() + 16)
    place = room[random.randrange(16) :][: x.numel()].view(x.shape)
    return place.copy_(torch.where(exact | (bits & 1 == 0), x, other))


class Rounded(TorchDispatchMode):
    """Moves the results of torch's functions by a step of their last digit.

    The same numbers move in the same way again. Sums also round by their shape: libraries add in
    another order for each.
    """

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        name = func._schema.name.rpartition("::")[2]
        if name not in OF_NUMBERS | OF_SUMS:
            return out

        def change(x):
            plain = type(x) is torch.Tensor and x.dtype in _BITS and x.is_contiguous()
            if not plain or not x.is_cpu or not x.numel() or torch._is_functional_tensor(x):
                return x
            return moved(x, 0 if name in OF_NUMBERS else sum(31 * s for s in x.shape))

        return pytree.tree_map(change, out)
