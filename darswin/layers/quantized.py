"""A linear layer with weights of 8 bits, on activations of 8 bits."""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.ops._quantized import Quantization, dequantize, quantize

_LARGEST = 127  # of a weight: -128 is left out, so that weights are symmetric


class QuantizedLinear(nn.Module):
    """A linear layer of int8 weights, each row with its scale, on activations quantized to uint8.

    It computes in float32 what integer products compute, so it runs everywhere and is exported;
    `darswin.optimize` makes integer products of it. For inference: it has no gradients.

    Args:
        in_features, out_features: D and D'. bias: whether there is one.
        activation: how the input becomes 8 bits.

    Attributes:
        weight: (D', D), int8. weight_scale: (D',), what one step of a row's weights is worth.
        bias: (D',) or None.

    Source: Jacob et al., "Quantization and training of neural networks for efficient
    integer-arithmetic-only inference", CVPR 2018; weights symmetric, a scale for each output.
    """

    weight: Tensor
    weight_scale: Tensor
    bias: Tensor | None

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
        x = dequantize(quantize(x.float(), self.activation), self.activation)
        return F.linear(x, self.weight.float() * self.weight_scale[:, None], self.bias)

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
    """Puts quantized layers in place of linear ones, with their weights.

    Args:
        activations: for each layer's name, how its input becomes 8 bits.

    Raises:
        ValueError: a name that no linear layer has.
    """
    layers = dict(model.named_modules())
    for name, activation in activations.items():
        if not isinstance(linear := layers.get(name), nn.Linear):
            raise ValueError(f"the model has no linear layer {name!r}")
        model.set_submodule(name, QuantizedLinear.of(linear, Quantization(*activation)))
