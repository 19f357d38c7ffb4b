"""The layers of optimized models, made from the layers of a model."""

import copy
from collections.abc import Callable, Sequence
from functools import partial, singledispatch
from typing import Any

from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from darswin.deploy.own import OwnLinear, OwnNorm, own_linear, pack
from darswin.deploy.packed import InFloat32, blocks_of, refuse_gradients
from darswin.deploy.program import Weights
from darswin.layers.embed import PatchEmbed, PatchProjection, PolarPatchEmbed
from darswin.layers.position_bias import RelativeBias, joined_coefficients
from darswin.layers.quantized import QuantizedLinear, quantized_layers
from darswin.layers.transformer import PatchMerging, Stage
from darswin.models.conv_unet import ConvBlock
from darswin.models.unet import Unet
from darswin.views import PolarGrid


@singledispatch
def fast(layer: nn.Module, weights: Weights) -> nn.Module:
    """The layer that takes the place of another one. A kind of layer that is not registered here
    stays, with fast layers in it."""
    for name, part in layer.named_children():
        layer.add_module(name, fast(part, weights))
    return layer


@fast.register
def _(unet: Unet, weights: Weights) -> nn.Module:
    for part in (unet.encoder, unet.decoder, unet.head):  # the places of tokens stay in float32
        fast(part, weights)
    return unet


class FastLayer(nn.Module):
    """A layer of our own operators."""

    def __init__(self, layer: OwnLinear | OwnNorm):
        super().__init__()
        self.layer = layer

    def forward(self, x: Tensor) -> Tensor:
        return self.layer(x)


@fast.register
def _(linear: nn.Linear, weights: Weights) -> nn.Module:
    return FastLayer(own_linear(linear))


@fast.register
def _(layer: QuantizedLinear, weights: Weights) -> nn.Module:
    raise ValueError(f"this layer must be a linear one, got {type(layer).__name__}")


@fast.register
def _(norm: nn.LayerNorm, weights: Weights) -> nn.Module:
    return FastLayer(OwnNorm(norm))


@fast.register
def _(conv: nn.Conv2d, weights: Weights) -> nn.Module:
    return InFloat32(conv)


@fast.register(PatchProjection)
class FastProjection(nn.Module):
    """The joining of neighbours of a map, or of pixels, as a product of our own."""

    def __init__(self, layer: PatchProjection, weights: Weights):
        super().__init__()
        conv, self.of_images = layer.proj, isinstance(layer, PatchEmbed)
        self.patch = conv.kernel_size[0]
        rows = conv.weight.permute(0, 2, 3, 1).flatten(1)
        self.proj = OwnLinear(pack(rows, conv.bias), conv.out_channels)
        self.norm = OwnNorm(layer.norm)

    def forward(self, x: Tensor) -> Tensor:
        refuse_gradients(x)
        x = x.float().permute(0, 2, 3, 1) if self.of_images else x.float()
        batch, height, width, channels = x.shape
        side, rows, columns = self.patch, height // self.patch, width // self.patch
        x = x.reshape(batch, rows, side, columns, side, channels).transpose(2, 3)
        return self.norm(self.proj(x.flatten(3)))


@fast.register
def _(block: ConvBlock, weights: Weights) -> nn.Module:
    conv1, norm1, _, conv2, norm2, _ = list[Any](block)
    fused = fuse_conv_bn_eval(conv1, norm1), fuse_conv_bn_eval(conv2, norm2)
    first, second = (InFloat32(conv) for conv in fused)
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU())


@fast.register(PolarPatchEmbed)
class FastEmbed(nn.Module):
    """The embedding of samples."""

    def __init__(self, embed: PolarPatchEmbed, weights: Weights):
        super().__init__()
        self.proj, self.norm = own_linear(embed.proj), OwnNorm(embed.norm)

    def forward(self, x: Tensor) -> Tensor:
        refuse_gradients(x)
        return self.norm(self.proj(x.float()))


@fast.register(PatchMerging)
class FastMerging(PatchMerging):
    """The merging of tokens, with our own norm and product."""

    def __init__(self, merging: PatchMerging, weights: Weights):
        nn.Module.__init__(self)
        self.merge = merging.merge
        self.product = own_linear(merging.reduction, merging.norm)

    def forward(self, x: Tensor) -> Tensor:
        return self.product(self.joined(x))


@fast.register(Stage)
class FastStage(nn.Module):
    """A stage, its blocks by one operator if it can be."""

    def __init__(self, stage: Stage, weights: Weights):
        super().__init__()
        self.downsample = fast(stage.downsample, weights)
        blocks: list[Any] = list(stage.blocks)
        if any(len(quantized_layers(block.mlp)) == 1 for block in blocks):
            raise ValueError("both products of an MLP must be quantized, or none")
        self.blocks = blocks_of(blocks, weights)
        biases = [block.attn.position_bias for block in blocks]
        relative = [bias for bias in biases if isinstance(bias, RelativeBias)]
        self.heads = [bias.heads for bias in relative]
        if relative:
            self.table: Callable[[Tensor], Tensor] = partial(
                relative[0].table, **joined_coefficients(relative)
            )
            self.angles = copy.deepcopy(blocks[0].attn).to("meta").angles  # it needs no weights
        else:
            self.constant = [bias().contiguous() for bias in biases]

    def tables(self, grid: PolarGrid | None) -> Sequence[Tensor]:
        """As `Stage.tables`, contiguous."""
        if not self.heads:
            return self.constant
        tables = self.table(self.angles(grid)).split(self.heads, 1)
        return [table.contiguous() for table in tables]

    def forward(self, x: Tensor, tables: Sequence[Tensor]) -> Tensor:
        return self.blocks(self.downsample(x), tables)
