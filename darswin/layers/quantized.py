"""A linear layer with 8-bit weights and 8-bit activations."""

import copy
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.linear import Linear

Net = TypeVar("Net", bound=nn.Module)

_LARGEST = 127  # weights lie in -127 … 127, so that they are symmetric


class Quantization(NamedTuple):
    """The mapping of numbers to 8 bits: q = round(x / scale) + zero_point, clipped to 0 … 255."""

    scale: float  # the size of one step, positive
    zero_point: int  # the q of 0, in 0 … 255


def quantize(x: Tensor, quantization: Quantization) -> Tensor:
    """float32 → uint8 of the same shape. Ties go to even, and NaN counts as 0."""
    scale, zero_point = quantization
    steps = torch.round(x * (1 / scale)).nan_to_num(0.0)
    return (steps + zero_point).clamp(0, 255).to(torch.uint8)


def dequantize(q: Tensor, quantization: Quantization) -> Tensor:
    """uint8 → the float32 values that they represent."""
    scale, zero_point = quantization
    return (q.float() - zero_point) * scale


class QuantizedLinear(nn.Module):
    """A linear layer with int8 weights on uint8 activations, after Jacob et al., CVPR 2018.

    The weights are symmetric, and each row has its own scale. The layer has no gradients. It
    computes the integer products in float32, so it runs and can be exported everywhere.
    """

    weight: Tensor  # (D', D), int8
    weight_scale: Tensor  # (D',), the size of one step of a row's weights
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
        """The quantized form of a linear layer; the largest weight of each row becomes 127."""
        layer = cls(
            linear.in_features, linear.out_features, bias=linear.bias is not None,
            activation=activation,
        )  # fmt: skip
        weight = linear.weight.detach().float()
        largest = weight.abs().amax(1) if linear.in_features else weight.new_zeros(len(weight))
        # A row of zeros may have any scale but 0.
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
                "a quantized layer has no gradient, but its input requires one: use the model from "
                "before quantization, or `darswin.layers.quantized.without_quantized_layers`"
            )
        x = dequantize(quantize(x.float(), self.activation), self.activation)
        bias = None if self.bias is None else self.bias.float()
        return F.linear(x, self._dequantized(), bias)

    def _dequantized(self) -> Tensor:
        """The float32 values of the weights, (D', D)."""
        steps = self.weight.float() - self._zero_points[:, None]
        return steps * self.weight_scale.float()[:, None]

    def _for_graphs(self, x: Tensor) -> Tensor:
        """The result of `forward`, by torch's graph operators, which ONNX has too."""
        import torch.ao.quantization.fx._decomposed  # registers them

        operators = torch.ops.quantized_decomposed
        steps = (*self.activation, 0, 255, torch.uint8)
        x = operators.dequantize_per_tensor(operators.quantize_per_tensor(x, *steps), *steps)
        dtype = self.weight.dtype
        limits = torch.iinfo(dtype)
        rows = (self.weight_scale, self._zero_points, 0, limits.min, limits.max, dtype)
        return F.linear(x, operators.dequantize_per_channel(self.weight, *rows), self.bias)

    def to_linear(self) -> Linear:
        """A float32 linear layer with the same weights; it does not quantize its input."""
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
    """The names of a model's quantized layers, and the quantization of their inputs."""
    named = model.named_modules()
    return {name: m.activation for name, m in named if isinstance(m, QuantizedLinear)}


def with_quantized_layers(
    model: nn.Module, activations: Mapping[str, Quantization | tuple[float, int]]
) -> None:
    """Replaces the linear layers with these names by quantized ones; ValueError if there is no such
    layer. The values are the quantizations of the inputs."""
    layers = dict(model.named_modules())
    for name, activation in activations.items():
        if not isinstance(linear := layers.get(name), nn.Linear):
            raise ValueError(f"the model has no linear layer {name!r}")
        model.set_submodule(name, QuantizedLinear.of(linear, Quantization(*activation)))


def with_unsigned_weights(model: Net) -> Net:
    """A copy of a model for graphs, whose quantized layers have uint8 weights with zero point 128.

    ONNX Runtime multiplies uint8 by uint8 exactly on every CPU. It multiplies uint8 by int8 exactly
    only on x86 CPUs with VNNI; on others the sum of two products overflows in 16 bits.
    """
    model = copy.deepcopy(model)
    for name in quantized_layers(model):
        layer = model.get_submodule(name)
        assert isinstance(layer, QuantizedLinear)
        layer.weight = (layer.weight.short() + 128).to(torch.uint8)
        layer._zero_points += 128
    return model


def without_quantized_layers(model: nn.Module) -> None:
    """Replaces the quantized layers of a model by float32 linear layers with the same weights."""
    for name in quantized_layers(model):
        layer = model.get_submodule(name)
        assert isinstance(layer, QuantizedLinear)
        model.set_submodule(name, layer.to_linear())
