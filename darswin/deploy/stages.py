"""Stages as calls of operators: what `optimize` puts in place of a model's."""

import copy
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor, nn

from darswin.layers.attention import WindowAttention
from darswin.layers.block import Block, Mlp, PatchMerging
from darswin.layers.linear import Linear
from darswin.layers.packed import PackedLinear, PackedQuantizedLinear
from darswin.layers.position_bias import RelativeBias, RelativeTable, joined_coefficients
from darswin.layers.quantized import Quantization, QuantizedLinear
from darswin.models.stages import Stage

_OPS = torch.ops.darswin
_ADD_NORM = _OPS._add_norm_.default
_ADD_NORM_QUANTIZED = _OPS._add_norm_quantized_.default
_CPU = torch._C.DispatchKeySet(torch._C.DispatchKey.CPU)
# A stage runs on so many images at once that what lies between two products stays below this: it
# is then in the caches, and in memory that the allocator has kept rather than in fresh pages.
CACHED_BYTES = 16 * 2**20

Product = PackedLinear | PackedQuantizedLinear


def packed(layer: nn.Linear | QuantizedLinear, dtype: torch.dtype) -> Product:
    """A linear layer, or a quantized one, as oneDNN's product."""
    if isinstance(layer, QuantizedLinear):
        return PackedQuantizedLinear(layer)
    return PackedLinear(layer, dtype)


def pack(module: nn.Module, dtype: torch.dtype) -> None:
    """Packs the linear layers of a module for oneDNN; norms get `dtype`."""
    for name, layer in list(module.named_modules()):
        if isinstance(layer, Linear):
            module.set_submodule(name, PackedLinear(layer, dtype))
        elif isinstance(layer, nn.LayerNorm):
            layer.to(dtype)


class InDtype(nn.Module):
    """A module as it is, in bfloat16 under autocast, and its result in `dtype`."""

    def __init__(self, module: nn.Module, dtype: torch.dtype):
        super().__init__()
        self.module, self.dtype = module, dtype
        self.sample = getattr(module, "sample", None)

    def forward(self, *arguments) -> Tensor:
        """What the module gives, in `dtype`."""
        with torch.autocast("cpu", torch.bfloat16, enabled=self.dtype == torch.bfloat16):
            return self.module(*arguments).to(self.dtype)


class OptimizedStage(nn.Module):
    """A stage as calls of operators."""

    def __init__(self, stage: Stage, dtype: torch.dtype):
        super().__init__()
        self.downsample: nn.Module = stage.downsample
        if isinstance(stage.downsample, PatchMerging):
            self.downsample = _Merging(stage.downsample, dtype)
        elif not isinstance(stage.downsample, nn.Identity):
            self.downsample = InDtype(stage.downsample, dtype)
        blocks = [block for block in stage.blocks if isinstance(block, Block)]
        self.blocks = [_Block(block, dtype) for block in blocks]
        self.followers = [*self.blocks[1:], None]
        self.mlp_ratio = blocks[0].mlp.fc1.out_features // blocks[0].mlp.fc1.in_features
        attentions = [block.attn for block in blocks]
        biases = [a.position_bias if isinstance(a, WindowAttention) else None for a in attentions]
        self.bias = _joined([bias for bias in biases if isinstance(bias, RelativeBias)])
        # Tables that depend on no position, and None for an attention that is not in windows.
        self.fixed = [
            bias().contiguous() if isinstance(bias, RelativeTable) else None for bias in biases
        ]

    def tables(self, *positions: Tensor | None) -> Sequence[Tensor | None]:
        """The position bias of each block, for `forward`: (B or 1, heads, ...), contiguous."""
        if self.bias is None:
            return self.fixed
        joined = self.bias(*positions)
        return [table.contiguous() for table in joined.chunk(len(self.blocks), 1)]

    def forward(self, x: Tensor, *tables: Tensor | None) -> Tensor:
        """The map of the stage before → this stage's. Where nothing merges, x itself changes."""
        if torch.is_grad_enabled() and x.requires_grad:
            raise RuntimeError(
                "an optimized model has no gradients, but its images or its lens require one: call "
                "it under torch.no_grad(), or use the model it was made of"
            )
        x = self.downsample(x).contiguous()
        widest = x[:1].numel() * self.mlp_ratio * x.element_size()
        parts = -(-len(x) * widest // CACHED_BYTES)
        if parts <= 1:
            self._blocks(x, tables)
            return x
        start = 0
        for part in x.tensor_split(min(parts, len(x))):
            end = start + len(part)
            self._blocks(part, [t if t is None or len(t) == 1 else t[start:end] for t in tables])
            start = end
        return x

    def _blocks(self, x: Tensor, tables: Sequence[Tensor | None]) -> None:
        """All blocks on x, in place: their residuals are added to it."""
        y = self.blocks[0].norm1(x)
        for block, follower, table in zip(self.blocks, self.followers, tables, strict=True):
            y = block.norm2.after(x, block.attention(y, table))
            y = block.mlp(y)
            if follower is None:
                x += y
            else:
                y = follower.norm1.after(x, y)


def _joined(biases: Sequence[RelativeBias]) -> RelativeBias | None:
    """The biases of several blocks as one with the heads of all: one computation for the stage."""
    if not biases:
        return None
    joined = copy.deepcopy(biases[0])
    for name, rows in joined_coefficients(biases).items():
        setattr(joined, name, nn.Parameter(rows.float(), requires_grad=False))
    return joined


class _Block:
    """A block's parts, with everything at hand that their operators take."""

    def __init__(self, block: Block, dtype: torch.dtype):
        self.attention: _Windows | _Deformable
        if isinstance(block.attn, WindowAttention):
            self.attention = _Windows(block.attn, dtype)
        else:
            self.attention = _Deformable(block.attn, dtype)
        self.mlp = _Mlp(block.mlp, dtype)
        self.norm1 = _Norm(block.norm1, self.attention.takes)
        self.norm2 = _Norm(block.norm2, self.mlp.takes)


class _Norm:
    """A layer norm; its parameters stay float32.

    Args:
        gives: how its result becomes 8 bits; None where it does not.
    """

    def __init__(self, norm: nn.LayerNorm, gives: Quantization | None = None):
        self.shape, self.eps, self.gives = norm.normalized_shape, norm.eps, gives
        self.weight, self.bias = norm.weight.float(), norm.bias.float()

    def __call__(self, x: Tensor) -> Tensor:
        if self.gives is not None:
            return self._quantized(x, None, self.gives)
        return torch.layer_norm(x, self.shape, self.weight, self.bias, self.eps)

    def after(self, x: Tensor, y: Tensor) -> Tensor:
        """Adds y to the residual x, in place, and normalizes the sum, maybe in place of y."""
        if self.gives is not None:
            return self._quantized(x, y, self.gives)
        # Not by way of autograd, which would look for gradients and count versions: there are none.
        _ADD_NORM.redispatch(_CPU, x, y, self.weight, self.bias, self.eps)
        return y

    def _quantized(self, x: Tensor, y: Tensor | None, gives: Quantization) -> Tensor:
        given = (self.weight, self.bias, self.eps, *gives)
        return _ADD_NORM_QUANTIZED.redispatch(_CPU, x, y, *given)


class _Merging(nn.Module):
    """`PatchMerging`."""

    def __init__(self, merging: PatchMerging, dtype: torch.dtype):
        super().__init__()
        self.join, self.reduction = merging.join, packed(merging.reduction, dtype)
        self.norm = _Norm(merging.norm, _taken(self.reduction))

    def forward(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R/m_r, A/m_φ, 2·D)."""
        return self.reduction(self.norm(self.join(x).contiguous()))


class _Mlp:
    """Linear, GELU, Linear: both products are quantized, or none."""

    def __init__(self, mlp: Mlp, dtype: torch.dtype):
        fc1, self.fc2 = packed(mlp.fc1, dtype), packed(mlp.fc2, dtype)
        self.takes = _taken(fc1)
        self.fc1_gelu: Callable[[Tensor], Tensor]
        if isinstance(fc1, PackedLinear) and isinstance(self.fc2, PackedLinear):
            self.fc1_gelu = fc1.gelu
        elif isinstance(fc1, PackedQuantizedLinear) and isinstance(self.fc2, PackedQuantizedLinear):
            self.fc1_gelu = partial(fc1.quantized_gelu, to=self.fc2.activation)
        else:
            raise ValueError("both products of an MLP must be quantized, or none")

    def __call__(self, x: Tensor) -> Tensor:
        return self.fc2(self.fc1_gelu(x))


class _Windows:
    """Attention in windows."""

    def __init__(self, attn: WindowAttention, dtype: torch.dtype):
        self.qkv, self.proj = packed(attn.qkv, dtype), packed(attn.proj, dtype)
        self.takes, self.gives = _taken(self.qkv), _taken(self.proj)
        dim = attn.proj.in_features // attn.num_heads
        self.shape = (*attn.map_size, 3, attn.num_heads, dim)
        self.settings = (attn.window, attn.shift, attn.periodic, dim**-0.5)

    def __call__(self, x: Tensor, table: Tensor | None) -> Tensor:
        qkv = self.qkv(x).view(x.shape[0], *self.shape)
        # Not by way of darswin.ops: all that it would check is known to fit.
        if self.gives is None:
            return self.proj(_OPS.window_attention.default(qkv, table, *self.settings))
        attend = _OPS._window_attention_quantized.default
        return self.proj(attend(qkv, table, *self.settings, *self.gives))


class _Deformable:
    """Any other attention, as it is."""

    takes = None

    def __init__(self, attn: nn.Module, dtype: torch.dtype):
        self.attn = InDtype(attn, dtype)

    def __call__(self, x: Tensor, table: Tensor | None) -> Tensor:
        return self.attn(x).contiguous()


def _taken(product: Product) -> Quantization | None:
    """How what a product takes becomes 8 bits; None where it does not."""
    return product.activation if isinstance(product, PackedQuantizedLinear) else None
