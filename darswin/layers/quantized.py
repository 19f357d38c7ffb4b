"""A linear layer with weights of 8 bits, on activations of 8 bits."""

import copy
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.linear import Linear

__all__ = ["quantized_layers", "without_quantized_layers"]

Net = TypeVar("Net", bound=nn.Module)

_LARGEST = 127  # of a weight: -128 is left out, so that weights are symmetric


class Quantization(NamedTuple):
    """The way of numbers to 8 bits: q = round(x / scale) + zero_point, kept in 0 … 255."""

    scale: float  # of one step, positive
    zero_point: int  # of 0, in 0 … 255


def quantize(x: Tensor, quantization: Quantization) -> Tensor:
    """float32 → uint8 of the same shape; ties go to even, and NaN becomes what 0 does."""
    scale, zero_point = quantization
    steps = torch.round(x * (1 / scale)).nan_to_num(0.0)
    return (steps + zero_point).clamp(0, 255).to(torch.uint8)


def dequantize(q: Tensor, quantization: Quantization) -> Tensor:
    """uint8 → the float32 that stands for it."""
    scale, zero_point = quantization
    return (q.float() - zero_point) * scale


class QuantizedLinear(nn.Module):
    """A linear layer of symmetric int8 weights, each row with its scale, on activations quantized
    to uint8, after Jacob et al., CVPR 2018. It has no gradients.

    It computes in float32 what integer products compute, so it runs everywhere and is exported.
    """

    weight: Tensor  # (D', D), int8
    weight_scale: Tensor  # (D',), of one step of a row's weights
    bias: Tensor | None  # (D',)
    _zero_points: Tensor

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        bias: bool = True,
        activation: Quantization | tuple[float, int] = (1.0, 0),
    ):
        super().__init__()
        self.in_features, self.out_features = in_features, out_features
        self.activation = Quantization(*activation)
        self.register_buffer("weight", torch.zeros(out_features, in_features, dtype=torch.int8))
        self.register_buffer("weight_scale", torch.ones(out_features))
        self.register_buffer("bias", torch.zeros(out_features) if bias else None)
        zeros = torch.zeros(out_features, dtype=torch.int64)
        self.register_buffer("_zero_points", zeros, persistent=False)

    @classmethod
    def of(cls, linear: nn.Linear, activation: Quantization) -> "QuantizedLinear":
        """The quantized layer of a linear one; a row's largest weight becomes 127."""
        layer = cls(
            linear.in_features, linear.out_features, bias=linear.bias is not None,
            activation=activation,
        )  # fmt: skip
        weight = linear.weight.detach().float()
        largest = weight.abs().amax(1) if linear.in_features else weight.new_zeros(len(weight))
        # A row of zeros has any scale, but not 0.
        layer.weight_scale = torch.where(largest > 0, largest / _LARGEST, 1.0)
        layer.weight = torch.round(weight / layer.weight_scale[:, None]).to(torch.int8)
        if linear.bias is not None:
            layer.bias = linear.bias.detach().float().clone()
        return layer

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D'), float32."""
        if torch.compiler.is_exporting():
            return self._for_graphs(x.float())
        if torch.is_grad_enabled() and x.requires_grad:
            raise RuntimeError(
                "a quantized layer has no gradient, but its input requires one: use the model that "
                "was quantized, or `darswin.layers.quantized.without_quantized_layers`"
            )
        x = dequantize(quantize(x.float(), self.activation), self.activation)
        bias = None if self.bias is None else self.bias.float()
        return F.linear(x, self._dequantized(), bias)

    def _dequantized(self) -> Tensor:
        """The weights that stand for those of 8 bits, (D', D), float32."""
        steps = self.weight.float() - self._zero_points[:, None]
        return steps * self.weight_scale.float()[:, None]

    def _for_graphs(self, x: Tensor) -> Tensor:
        """The same by torch's operators for graphs, which ONNX has by the same names."""
        import torch.ao.quantization.fx._decomposed  # registers them

        operators = torch.ops.quantized_decomposed
        steps = (*self.activation, 0, 255, torch.uint8)
        x = operators.dequantize_per_tensor(operators.quantize_per_tensor(x, *steps), *steps)
        dtype = self.weight.dtype
        limits = torch.iinfo(dtype)
        rows = (self.weight_scale, self._zero_points, 0, limits.min, limits.max, dtype)
        return F.linear(x, operators.dequantize_per_channel(self.weight, *rows), self.bias)

    def to_linear(self) -> Linear:
        """A linear layer with the same weights, in float32; activations stay as they are."""
        linear = Linear(self.in_features, self.out_features, bias=self.bias is not None)
        linear.weight = nn.Parameter(self._dequantized())
        if self.bias is not None:
            linear.bias = nn.Parameter(self.bias.clone())
        return linear

    def extra_repr(self) -> str:
        scale, zero_point = self.activation
        return (
            f"in_features={self.in_features}, out_features={self.out_features}, "
            f"bias={self.bias is not None}, scale={scale:.3g}, zero_point={zero_point}"
        )


def quantized_layers(model: nn.Module) -> dict[str, Quantization]:
    """The names of a model's quantized layers, and how their inputs become 8 bits."""
    named = model.named_modules()
    return {name: m.activation for name, m in named if isinstance(m, QuantizedLinear)}


def with_quantized_layers(
    model: nn.Module, activations: Mapping[str, Quantization | tuple[float, int]]
) -> None:
    """Puts quantized layers in place of the linear ones of these names; ValueError where no linear
    layer has a name. The values say how their inputs become 8 bits."""
    layers = dict(model.named_modules())
    for name, activation in activations.items():
        if not isinstance(linear := layers.get(name), nn.Linear):
            raise ValueError(f"the model has no linear layer {name!r}")
        model.set_submodule(name, QuantizedLinear.of(linear, Quantization(*activation)))


def with_unsigned_weights(model: Net) -> Net:
    """A copy of a model, for graphs, whose quantized layers have uint8 weights, with a zero point
    of 128. ONNX Runtime multiplies uint8 with uint8 exactly on every CPU, but uint8 with int8 on
    x86 CPUs with VNNI only: on others the sum of two products overflows in 16 bits."""
    model = copy.deepcopy(model)
    for name in quantized_layers(model):
        layer = model.get_submodule(name)
        assert isinstance(layer, QuantizedLinear)
        layer.weight = (layer.weight.short() + 128).to(torch.uint8)
        layer._zero_points += 128
    return model


def without_quantized_layers(model: nn.Module) -> None:
    """Puts float32 linear layers of the same weights in place of a model's quantized ones."""
    for name in quantized_layers(model):
        layer = model.get_submodule(name)
        assert isinstance(layer, QuantizedLinear)
        model.set_submodule(name, layer.to_linear())
