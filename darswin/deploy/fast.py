"""The layers of optimized models, made from the layers of a model."""

from collections.abc import Callable, Sequence
from functools import partial, singledispatch
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from darswin.deploy.own import OwnLinear, OwnNorm, pack
from darswin.deploy.packed import InDtype, Layer, Own, OwnBlocks, refuse_gradients
from darswin.layers.embed import PatchEmbed, PatchProjection, PolarPatchEmbed
from darswin.layers.position_bias import RelativeBias, joined_coefficients
from darswin.layers.quantized import QuantizedLinear, quantized_layers
from darswin.layers.transformer import PatchMerging, Stage
from darswin.models.conv_unet import ConvBlock
from darswin.models.unet import Unet
from darswin.views import PolarGrid

# A stage processes a large batch in parts. A part is so small that the tensors between two products
# stay below this size: in the caches, and in memory that the allocator reuses.
CACHED_BYTES = 16 * 2**20


@singledispatch
def fast(layer: nn.Module, library: Own) -> nn.Module:
    """The layer that takes the place of another one. A kind of layer that is not registered here
    stays, with fast layers in it."""
    for name, part in layer.named_children():
        layer.add_module(name, fast(part, library))
    return layer


@fast.register
def _(unet: Unet, library: Own) -> nn.Module:
    for part in (unet.encoder, unet.decoder, unet.head):  # the places of tokens stay in float32
        fast(part, library)
    return unet


class FastLayer(nn.Module):
    """A layer of a `library`."""

    def __init__(self, layer: Layer):
        super().__init__()
        self.layer = layer

    def forward(self, x: Tensor) -> Tensor:
        return self.layer(x)


@fast.register
def _(linear: nn.Linear, library: Own) -> nn.Module:
    return FastLayer(library.linear(linear))


@fast.register
def _(layer: QuantizedLinear, library: Own) -> nn.Module:
    raise ValueError(f"this layer must be a linear one, got {type(layer).__name__}")


@fast.register
def _(norm: nn.LayerNorm, library: Own) -> nn.Module:
    return FastLayer(library.norm(norm))


@fast.register
def _(conv: nn.Conv2d, library: Own) -> nn.Module:
    return InDtype(conv, library.dtype)


@fast.register
def _(layer: PatchProjection, library: Own) -> nn.Module:
    own = library.dtype == torch.float32
    return FastProjection(layer) if own else InDtype(layer, library.dtype)


class FastProjection(nn.Module):
    """The joining of neighbours of a map, or of pixels, as a product of our own."""

    def __init__(self, layer: PatchProjection):
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
def _(block: ConvBlock, library: Own) -> nn.Module:
    conv1, norm1, _, conv2, norm2, _ = list[Any](block)
    fused = fuse_conv_bn_eval(conv1, norm1), fuse_conv_bn_eval(conv2, norm2)
    first, second = (InDtype(conv, library.dtype) for conv in fused)
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU())


@fast.register(PolarPatchEmbed)
class FastEmbed(nn.Module):
    """The embedding of samples, in float32."""

    def __init__(self, embed: PolarPatchEmbed, library: Own):
        super().__init__()
        own = Own(library.weights)
        self.proj, self.norm = own.linear(embed.proj), own.norm(embed.norm)
        self.dtype = library.dtype

    def forward(self, x: Tensor) -> Tensor:
        refuse_gradients(x)
        return self.norm(self.proj(x.float())).to(self.dtype)


@fast.register(PatchMerging)
class FastMerging(PatchMerging):
    """The merging of tokens, with the norm and the product of a library."""

    def __init__(self, merging: PatchMerging, library: Own):
        nn.Module.__init__(self)
        self.merge = merging.merge
        self.product = library.linear(merging.reduction, merging.norm)

    def forward(self, x: Tensor) -> Tensor:
        return self.product(self.joined(x))


@fast.register(Stage)
class FastStage(nn.Module):
    """A stage whose blocks a library computes, in parts if the batch is large. Our own operator
    takes parts itself."""

    def __init__(self, stage: Stage, library: Own):
        super().__init__()
        self.downsample = fast(stage.downsample, library)
        blocks: list[Any] = list(stage.blocks)
        if any(len(quantized_layers(block.mlp)) == 1 for block in blocks):
            raise ValueError("both products of an MLP must be quantized, or none")
        self.blocks = library.blocks(blocks)
        layers = [block.mlp.fc1 for block in blocks]
        # The widest tokens are queries, keys and values, or those within the MLP.
        widest = max([3, *(-(-layer.out_features // layer.in_features) for layer in layers)])
        self.most_numbers = max(CACHED_BYTES // (widest * library.dtype.itemsize), 1)
        biases = [block.attn.position_bias for block in blocks]
        relative = [bias for bias in biases if isinstance(bias, RelativeBias)]
        self.heads = [bias.heads for bias in relative]
        if relative:
            self.table: Callable[[Tensor], Tensor] = partial(
                relative[0].table, **joined_coefficients(relative)
            )
            self.angles = blocks[0].attn.to("meta").angles  # which needs no weights
        else:
            self.constant = [bias().contiguous() for bias in biases]

    def tables(self, grid: PolarGrid | None) -> Sequence[Tensor]:
        """As `Stage.tables`, contiguous."""
        if not self.heads:
            return self.constant
        tables = self.table(self.angles(grid)).split(self.heads, 1)
        return [table.contiguous() for table in tables]

    def forward(self, x: Tensor, tables: Sequence[Tensor]) -> Tensor:
        x = self.downsample(x)
        if isinstance(self.blocks, OwnBlocks) or x.numel() <= self.most_numbers:
            return self.blocks(x, tables)
        count = min(-(-x.numel() // self.most_numbers), len(x))
        x = x.contiguous()
        parts = zip(x.tensor_split(count), *(_split(t, count) for t in tables), strict=True)
        for part, *of_part in parts:
            self.blocks(part, of_part)  # in place
        return x


def _split(table: Tensor, count: int) -> Sequence[Tensor]:
    """The table for each part of the images. A table for all images serves every part."""
    return [table] * count if len(table) == 1 else table.tensor_split(count)
