"""The layers of optimized models, made from the layers of a model.

Only a layer that is exactly one of those below, with the parts that it was made with, has a fast
form. A subclass, or a layer with a hook or another part, stays, with fast layers in it.
"""

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from darswin.deploy.own import OwnLinear, OwnNorm, own_linear, pack
from darswin.deploy.packed import InFloat32, InPlaceOf, OwnBlocks, refuse_gradients
from darswin.deploy.program import NoProgramError, Weights
from darswin.deploy.record import Recorded
from darswin.layers.attention import PolarWindowAttention, WindowAttention
from darswin.layers.embed import PatchEmbed, PatchProjection, PolarPatchEmbed
from darswin.layers.linear import Linear
from darswin.layers.quantized import QuantizedLinear, quantized_layers
from darswin.layers.transformer import Block, DropPath, Mlp, PatchMerging, Stage
from darswin.models.conv_unet import ConvBlock
from darswin.models.unet import Unet
from darswin.views import PolarGrid

_LINEAR, _NORM, _CONV = (nn.Linear, Linear, QuantizedLinear), (nn.LayerNorm,), (nn.Conv2d,)
_ATTENTION = (WindowAttention, PolarWindowAttention)
_BLOCK: dict[str, Sequence[type[nn.Module]]] = dict(
    norm1=_NORM, attn=_ATTENTION, norm2=_NORM, mlp=(Mlp,), drop_path=(DropPath,)
)
_CONVS = (nn.Conv2d, nn.BatchNorm2d, nn.ReLU) * 2
# The kinds of layers that are known, and those of their parts. A position bias may be any.
_PARTS: dict[type[nn.Module], dict[str, Sequence[type[nn.Module]]]] = {
    **{kind: {} for kind in (*_LINEAR, *_NORM, *_CONVS, DropPath)},
    **{kind: dict(proj=_CONV, norm=_NORM) for kind in (PatchProjection, PatchEmbed)},
    **{kind: dict(qkv=_LINEAR, proj=_LINEAR, position_bias=()) for kind in _ATTENTION},
    PolarPatchEmbed: dict(proj=_LINEAR, norm=_NORM),
    PatchMerging: dict(norm=_NORM, reduction=_LINEAR),
    ConvBlock: {str(k): (kind,) for k, kind in enumerate(_CONVS)},
    Mlp: dict(fc1=_LINEAR, fc2=_LINEAR),
    Block: _BLOCK,
}


def other_part(layer: nn.Module) -> nn.Module | None:
    """The first part of a layer, or the layer, that is not as it is known; None if all are."""
    parts = _PARTS.get(kind_of(layer))
    if parts is None or not is_plain(layer) or layer._modules.keys() != parts.keys():
        return layer
    for name, kinds in parts.items():
        part = layer.get_submodule(name)
        if kinds and (other := other_part(part) if kind_of(part) in kinds else part) is not None:
            return other
    return None


def kind_of(layer: nn.Module) -> type:
    """The class of a layer. Other `angles` make other position biases, which are inputs here."""
    kind = type(layer)
    while {name for name, value in vars(kind).items() if callable(value)} == {"angles"}:
        (kind,) = kind.__bases__
    return kind


def is_plain(layer: nn.Module) -> bool:
    """Whether a layer has no hooks, methods or options that make it another one."""
    changed = any(callable(getattr(type(layer), name, None)) for name in vars(layer))
    if changed or layer._forward_hooks or layer._forward_pre_hooks:
        return False
    if isinstance(layer, nn.LayerNorm):
        return len(layer.normalized_shape) == 1 and layer.bias is not None
    if isinstance(layer, nn.BatchNorm2d):
        return layer.running_mean is not None
    if isinstance(layer, PatchProjection) and isinstance(conv := layer.proj, nn.Conv2d):
        sides = {*conv.kernel_size, *conv.stride}
        return len(sides) == 1 and (conv.padding, conv.dilation, conv.groups) == ((0, 0), (1, 1), 1)
    return True


def fast(layer: nn.Module, weights: Weights) -> nn.Module:
    """The layer that takes the place of another one: it may be this one, with fast layers in it."""
    if type(layer) is Stage and is_plain(layer) and _is_one_operator(layer):
        return FastStage(layer, weights)
    if type(layer) in FORMS and other_part(layer) is None:
        return FORMS[type(layer)](layer, weights)
    if isinstance(layer, Block):
        return OneBlock(layer, weights)
    for name, part in layer.named_children():
        if not (isinstance(layer, Unet) and name == "places"):  # these stay in float32
            layer.add_module(name, fast(part, weights))
    return layer


class FastLayer(InPlaceOf):
    """A layer by our own operators."""

    def __init__(self, layer: nn.Module, own: OwnLinear | OwnNorm):
        super().__init__(layer)
        self.own = own

    def forward(self, x: Tensor) -> Tensor:
        return self.own(x)


def _linear(layer: Any, weights: Weights) -> nn.Module:
    if isinstance(layer, QuantizedLinear):
        raise ValueError(f"this layer must be a linear one, got {type(layer).__name__}")
    return FastLayer(layer, own_linear(layer))


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


def _conv_block(block: ConvBlock, weights: Weights) -> nn.Module:
    conv1, norm1, _, conv2, norm2, _ = list[Any](block)
    fused = fuse_conv_bn_eval(conv1, norm1), fuse_conv_bn_eval(conv2, norm2)
    first, second = (InFloat32(conv) for conv in fused)
    return nn.Sequential(first, nn.ReLU(), second, nn.ReLU())


class FastEmbed(nn.Module):
    """The embedding of samples."""

    def __init__(self, embed: PolarPatchEmbed, weights: Weights):
        super().__init__()
        self.proj, self.norm = own_linear(embed.proj), OwnNorm(embed.norm)

    def forward(self, x: Tensor) -> Tensor:
        refuse_gradients(x)
        return self.norm(self.proj(x.float()))


class FastMerging(PatchMerging):
    """The merging of tokens, with our own norm and product."""

    def __init__(self, merging: PatchMerging, weights: Weights):
        nn.Module.__init__(self)
        self.merge = merging.merge
        self.product = own_linear(merging.reduction, merging.norm)

    def forward(self, x: Tensor) -> Tensor:
        return self.product(self.joined(x))


class FastStage(Stage):
    """A stage, its blocks by one operator."""

    def __init__(self, stage: Stage, weights: Weights):
        nn.Module.__init__(self)
        self.downsample = fast(stage.downsample, weights)
        self.own, self.blocks = OwnBlocks(list(stage.blocks), weights), stage.blocks
        blocks: Any = stage.blocks
        for block in blocks:  # what is left makes the position biases
            block.norm1 = block.norm2 = block.mlp = block.attn.qkv = block.attn.proj = nn.Identity()

    def tables(self, grid: PolarGrid | None) -> Sequence[Tensor]:
        """As `Stage.tables`, contiguous."""
        return [table.contiguous() for table in super().tables(grid)]

    def forward(self, x: Tensor, tables: Sequence[Tensor]) -> Tensor:
        return self.own(self.downsample(x), tables)


def _is_one_operator(stage: Stage) -> bool:
    """Whether the blocks of a stage are known ones of the same sizes."""
    blocks: list[Any] = list(stage.blocks)
    if not blocks or any(other_part(block) is not None for block in blocks):
        return False
    if any(len(quantized_layers(block.mlp)) == 1 for block in blocks):
        raise ValueError("both products of an MLP must be quantized, or none")
    sizes = {
        (b.attn.num_heads, b.attn.map_size, b.attn.dim, b.mlp.fc1.out_features) for b in blocks
    }
    return type(stage.blocks) is nn.ModuleList and len(sizes) == 1


class OneBlock(InFloat32):
    """A block of another kind of stage, or another kind of block, which torch runs."""

    def __init__(self, block: Block, weights: Weights):
        super().__init__(block)
        self.other = other_part(block)
        self.own = OwnBlocks([block], weights) if self.other is None else None

    def forward(self, x: Tensor, *tables: Tensor) -> Tensor:
        if self.own is not None:
            return self.own(x, tables)
        if isinstance(x, Recorded):
            raise NoProgramError(f"this {type(self.other).__name__} is no instruction")
        return super().forward(x, *tables)


FORMS: dict[type[nn.Module], Callable[[Any, Weights], nn.Module]] = {
    **dict.fromkeys(_LINEAR, _linear),
    nn.LayerNorm: lambda norm, _: FastLayer(norm, OwnNorm(norm)),
    nn.Conv2d: lambda conv, _: InFloat32(conv),
    **dict.fromkeys((PatchProjection, PatchEmbed), FastProjection),
    ConvBlock: _conv_block,
    PolarPatchEmbed: FastEmbed,
    PatchMerging: FastMerging,
}
