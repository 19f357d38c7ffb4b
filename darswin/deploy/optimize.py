"""Models for inference: weights packed for oneDNN, GELU inside of the products, each residual and
the norm behind it in one."""

import copy
import warnings
from collections.abc import Sequence
from typing import Any, Self, TypeVar

import torch
from torch import Tensor, nn

from darswin.layers import onednn
from darswin.layers.attention import WindowAttention
from darswin.layers.block import Block, PatchMerging
from darswin.layers.linear import Linear
from darswin.layers.onednn import PackedLinear
from darswin.layers.position_bias import RelativeBias, RelativeTable, joined_coefficients
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.models.dense import DenseModel, DensePrepared
from darswin.models.encoder import Encoder, Prepared
from darswin.models.feature_maps import FeatureMaps
from darswin.models.stages import Pair, Stage

Net = TypeVar("Net", bound=Model)
DTYPES = (torch.float32, torch.bfloat16)
_ADD_NORM = torch.ops.darswin._add_norm_.default
_CPU = torch._C.DispatchKeySet(torch._C.DispatchKey.CPU)
# A stage runs on so many images at once that what lies between two products stays below this: it
# is then in the caches, and in memory that the allocator has kept rather than in fresh pages.
CACHED_BYTES = 16 * 2**20


def optimize(model: Net, dtype: torch.dtype = torch.float32, *, lens: Lens | None = None) -> Net:
    """A copy of a model that computes the same, faster: on CPU, in inference only.

    Its products are oneDNN's, with weights laid out for them, and take bias and GELU along; a
    residual and the norm behind it are one operator. It is called as the model is and has its
    methods, but it is neither trained, saved, copied nor compiled, and has no gradients: the model,
    which stays as it is, is there for that.

    Args:
        model: one of `create_model`, on the CPU.
        dtype: float32 or bfloat16, of what flows between the layers and of the result; distances
            are float32, and so is what refines the pixels of dense models.
        lens: one camera's, for all images; the result is then called `optimized(images)`, and
            computes the grid and the position biases once for each image size.

    Where torch lacks oneDNN's products it warns, and uses its own.

    Raises:
        TypeError: another kind of model.
        ValueError: another dtype or device, or `lens` is not a single lens.
    """
    _check(model, dtype, lens)
    if (lack := onednn.missing(dtype)) is not None:
        warnings.warn(f"optimize goes on with torch's own products: {lack}", stacklevel=2)
    optimized = copy.deepcopy(model).eval().requires_grad_(False)
    kind: type[_Optimized] = _OptimizedEncoder
    if isinstance(optimized, DenseModel):
        _pack_dense(optimized, dtype)
        kind = _OptimizedDense
    elif isinstance(optimized, FeatureMaps):
        _pack_encoder(optimized.encoder, dtype)
        _become(optimized.encoder, _OptimizedEncoder)
        kind = _Optimized
    elif isinstance(optimized, Encoder):
        _pack_encoder(optimized, dtype)
    if lens is None:
        _become(optimized, kind)
    else:
        _become(optimized, FixedLens, kind, fixed_lens=lens, _prepared={})
    return optimized


def _check(model: nn.Module, dtype: torch.dtype, lens: Lens | None) -> None:
    if not isinstance(model, (Encoder, DenseModel, FeatureMaps)):
        raise TypeError(f"model must be one of create_model, got {type(model).__name__}")
    if isinstance(model, _Optimized):
        raise TypeError("model must be one of create_model, got one that is optimized already")
    if lens is not None and (not isinstance(lens, Lens) or len(lens) != 1):
        raise ValueError(f"lens must be one lens, got {lens!r}")
    if dtype not in DTYPES:
        raise ValueError(f"dtype must be torch.float32 or torch.bfloat16, got {dtype}")
    devices = sorted({parameter.device.type for parameter in model.parameters()})
    if devices != ["cpu"]:
        raise ValueError(f"model must be on the CPU, got one on {' and '.join(devices)}")


def _become(model: Model, *bases: type, **attributes: Any) -> None:
    """Gives a model the class that it has, behind `bases`."""
    name = f"Optimized{type(model).__name__}"
    model.__class__ = type(name, (*bases, type(model)), attributes)


def _pack_encoder(encoder: Encoder, dtype: torch.dtype) -> None:
    encoder.patch_embed = _InDtype(encoder.patch_embed, dtype)
    encoder.stages = _stages(encoder.stages, dtype)
    encoder.norm.to(dtype)
    encoder.head.to(dtype)


def _pack_dense(model: DenseModel, dtype: torch.dtype) -> None:
    _pack_encoder(model.encoder, dtype)
    _become(model.encoder, _OptimizedEncoder)
    decoder, head = model.decoder, model.head
    _pack(decoder.joins, dtype)
    _pack(decoder.expand, dtype)
    decoder.stages = _stages(decoder.stages, dtype)
    head.set_submodule("proj", PackedLinear(head.proj, dtype))


def _pack(module: nn.Module, dtype: torch.dtype) -> None:
    """Packs the linear layers of a module for oneDNN; norms get `dtype`."""
    for name, layer in list(module.named_modules()):
        if isinstance(layer, Linear):
            module.set_submodule(name, PackedLinear(layer, dtype))
        elif isinstance(layer, nn.LayerNorm):
            layer.to(dtype)


def _stages(stages: nn.ModuleList, dtype: torch.dtype) -> nn.ModuleList:
    return nn.ModuleList(_Stage(stage, dtype) for stage in stages if isinstance(stage, Stage))


def _tables(
    stages: nn.ModuleList, positions: Sequence[Sequence[Tensor | None]]
) -> list[Sequence[Tensor | None]]:
    """The position biases of each stage's blocks."""
    optimized = [stage for stage in stages if isinstance(stage, _Stage)]
    return [s.tables(*p) for s, p in zip(optimized, positions, strict=True)]


class _Optimized(Model):
    """What an optimized model refuses."""

    def train(self, mode: bool = True) -> Self:
        if mode:
            raise TypeError("an optimized model is not trained: train the model it was made of")
        return super().train(mode)

    def prune_intermediate_layers(self, *args, **kwargs):
        raise TypeError(
            "an optimized model is not pruned: prune it first, and optimize what is left"
        )

    def state_dict(self, *args, **kwargs):
        raise TypeError("an optimized model is not saved: save the model it was made of")

    def __reduce_ex__(self, protocol):
        raise TypeError(
            "an optimized model is neither copied nor pickled, since oneDNN's weights cannot be: "
            "copy the model it was made of, and optimize that"
        )


class _OptimizedEncoder(_Optimized, Encoder):
    """How an optimized encoder differs from the one it was made of."""

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        """As the model it was made of, but `positions` are the tables of each stage's blocks."""
        return self.with_tables(self.prepare_angles(lens, size))

    def prepare_angles(self, lens: Lens | None, size: Pair) -> Prepared:
        """As the model it was made of."""
        return super().prepare(lens, size)

    def with_tables(self, prepared: Prepared) -> Prepared:
        """Tables in place of what they are computed from."""
        return prepared._replace(positions=_tables(self.stages, prepared.positions))


class _OptimizedDense(_Optimized, DenseModel):
    """How an optimized dense model differs from the one it was made of."""

    encoder: _OptimizedEncoder  # type: ignore[assignment]  # of a class that is made of both

    def prepare(self, lens: Lens | None, size: Pair) -> DensePrepared:
        """As the model it was made of, but `positions` are the tables of each stage's blocks."""
        angles = self.encoder.prepare_angles(lens, size)
        tables = _tables(self.decoder.stages, angles.positions[:-1])
        return DensePrepared(self.encoder.with_tables(angles), tables, self.way(lens, size))


class FixedLens(_Optimized):
    """An optimized model and the single lens of all its images, which it is called without."""

    fixed_lens: Lens
    _prepared: dict[Pair, Any]  # by image size

    def prepare(self, lens: Lens | None, size: Pair) -> Any:
        """What the fixed lens decides about images of (H, W), computed once for each size.

        Raises:
            ValueError: a lens, or images of another size than the fixed lens's.
        """
        if lens is not None:
            raise ValueError("this model is optimized for a fixed lens: call it without one")
        prepared = self._prepared.get(size)
        if prepared is None:
            prepared = self._prepared[size] = super().prepare(self.fixed_lens, size)
        return prepared


class _InDtype(nn.Module):
    """A module as it is, in bfloat16 under autocast, and its result in `dtype`."""

    def __init__(self, module: nn.Module, dtype: torch.dtype):
        super().__init__()
        self.module, self.dtype = module, dtype
        self.sample = getattr(module, "sample", None)

    def forward(self, *arguments) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=self.dtype == torch.bfloat16):
            return self.module(*arguments).to(self.dtype)


class _Stage(nn.Module):
    """A stage as calls of operators."""

    def __init__(self, stage: Stage, dtype: torch.dtype):
        super().__init__()
        self.downsample = stage.downsample
        if isinstance(stage.downsample, PatchMerging):
            _pack(stage.downsample, dtype)
        elif not isinstance(stage.downsample, nn.Identity):
            self.downsample = _InDtype(stage.downsample, dtype)
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
            y = block.fc2(block.fc1.gelu(y))
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
        self.norm1, self.norm2 = _Norm(block.norm1), _Norm(block.norm2)
        self.fc1, self.fc2 = (PackedLinear(fc, dtype) for fc in (block.mlp.fc1, block.mlp.fc2))


class _Norm:
    """A layer norm; its parameters stay float32."""

    def __init__(self, norm: nn.LayerNorm):
        self.shape, self.eps = norm.normalized_shape, norm.eps
        self.weight, self.bias = norm.weight.float(), norm.bias.float()

    def __call__(self, x: Tensor) -> Tensor:
        return torch.layer_norm(x, self.shape, self.weight, self.bias, self.eps)

    def after(self, x: Tensor, y: Tensor) -> Tensor:
        """Adds y to the residual x, in place, and normalizes the sum, in place of y."""
        # Not by way of autograd, which would look for gradients and count versions: there are none.
        _ADD_NORM.redispatch(_CPU, x, y, self.weight, self.bias, self.eps)
        return y


class _Windows:
    """Attention in windows."""

    def __init__(self, attn: WindowAttention, dtype: torch.dtype):
        self.qkv, self.proj = PackedLinear(attn.qkv, dtype), PackedLinear(attn.proj, dtype)
        dim = attn.proj.in_features // attn.num_heads
        self.shape = (*attn.map_size, 3, attn.num_heads, dim)
        self.settings = (attn.window, attn.shift, attn.periodic, dim**-0.5)

    def __call__(self, x: Tensor, table: Tensor | None) -> Tensor:
        qkv = self.qkv(x).view(x.shape[0], *self.shape)
        # Not by way of darswin.ops: all that it would check is known to fit.
        out = torch.ops.darswin.window_attention.default(qkv, table, *self.settings)
        return self.proj(out)


class _Deformable:
    """Any other attention, as it is."""

    def __init__(self, attn: nn.Module, dtype: torch.dtype):
        self.attn = _InDtype(attn, dtype)

    def __call__(self, x: Tensor, table: Tensor | None) -> Tensor:
        return self.attn(x).contiguous()
