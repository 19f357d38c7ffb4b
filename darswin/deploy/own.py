"""Layers by our own operators. They are plain callables: a module would take a microsecond more for
each call."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import handle_torch_function, has_torch_function_unary

import darswin.ops  # noqa: F401  (it registers our operators)
from darswin.layers.quantized import quantized_layers
from darswin.ops import _module

_CPU = torch._C.DispatchKeySet(torch._C.DispatchKey.CPU)


def own_operator(name: str) -> Callable[..., Any]:
    """One of our operators for the CPU. Without the compiled module, it refuses calls."""
    if _module.LACK is not None:
        return partial(_module.require, name)
    # Not by way of autograd, which would look for gradients and count versions: there are none.
    return partial(getattr(torch.ops.darswin, name).default.redispatch, _CPU)


_NORM = own_operator("_norm")
_PACK = own_operator("_pack_linear")
_LINEAR = own_operator("_linear")


def packed_weights(linear: Any) -> Tensor:
    """A linear layer as `_linear` reads it, (K,): float32, or int32 if quantized."""
    if (taken := quantized_layers(linear).get("")) is not None:
        bias = None if linear.bias is None else linear.bias.detach().float()
        return _PACK(linear.weight.detach(), bias, linear.weight_scale.float(), *taken)
    return pack(linear.weight, linear.bias)


def norm_parameters(norm: nn.LayerNorm) -> Tensor:
    """The weight and the bias of a norm, (2, D) float32."""
    return torch.stack((norm.weight, norm.bias)).detach().float()


def pack(weight: Tensor, bias: Tensor | None) -> Tensor:
    """A weight (D', D) and a bias as `_linear` reads them, (K,) float32."""
    return _PACK(weight.detach().float(), None if bias is None else bias.detach().float())


class OwnLinear:
    """A linear layer by our own operators, behind a norm or before a GELU if asked."""

    def __init__(
        self, packed: Tensor, columns: int, *, gelu: bool = False, norm: "OwnNorm | None" = None
    ):
        self.packed, self.columns, self.gelu, self.norm = packed, columns, gelu, norm
        self._given: tuple = (packed, columns, gelu)
        if norm is not None:
            self._given = (*self._given, norm.parameters, norm.eps)

    def __call__(self, x: Tensor) -> Tensor:
        if has_torch_function_unary(x):
            return handle_torch_function(OwnLinear.__call__, (x,), self, x)
        return _LINEAR(x, *self._given)


class OwnNorm:
    """A layer norm by our own operators."""

    def __init__(self, norm: nn.LayerNorm):
        self.eps, self.parameters = norm.eps, norm_parameters(norm)
        # As the programs of networks have it: the weight, the bias and eps.
        self.words = torch.cat((self.parameters.flatten(), torch.tensor([norm.eps])))

    def __call__(self, x: Tensor) -> Tensor:
        if has_torch_function_unary(x):
            return handle_torch_function(OwnNorm.__call__, (x,), self, x)
        return _NORM(x, self.parameters, self.eps)


def own_linear(layer: Any, norm: nn.LayerNorm | None = None, *, gelu: bool = False) -> OwnLinear:
    """A linear layer, behind a norm or before a GELU if asked."""
    before = None if norm is None else OwnNorm(norm)
    return OwnLinear(packed_weights(layer), layer.out_features, gelu=gelu, norm=before)


class PackedBlocks:
    """The blocks of a stage, packed. All of them have window attention."""

    def __init__(self, blocks: Sequence[Any]):
        # Of each block: norm1, qkv, proj, norm2, fc1 and fc2.
        self.layers: list[tuple[OwnNorm, Tensor, Tensor, OwnNorm, Tensor, Tensor]] = [
            (
                OwnNorm(block.norm1),
                packed_weights(block.attn.qkv),
                packed_weights(block.attn.proj),
                OwnNorm(block.norm2),
                packed_weights(block.mlp.fc1),
                packed_weights(block.mlp.fc2),
            )
            for block in blocks
        ]
        # Of each block: the window, the shift, and whether an axis is periodic.
        self.windows: list[list[int]] = [
            [*block.attn.window, *block.attn.shift, *block.attn.periodic] for block in blocks
        ]
        attn = blocks[0].attn
        self.heads, self.mlp_dim = attn.num_heads, blocks[0].mlp.fc1.out_features
        self.map_shape = (*attn.map_size, attn.dim)

    @property
    def table_shapes(self) -> list[tuple[int, int, int]]:
        """The shape of the position bias of each block."""
        return [(self.heads, 2 * w[0] - 1, 2 * w[1] - 1) for w in self.windows]
