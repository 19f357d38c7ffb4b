"""Fast copies of models for inference on CPUs.

In float32 all blocks of a stage are one C++ operator, and in int8 too, if the CPU has AVX-512 VNNI.
Otherwise oneDNN computes the products, and each residual is added by the norm that follows it.
"""

import contextlib
import copy
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from darswin.deploy.packed import (
    PackedBlocks,
    PackedLinear,
    PackedNorm,
    PackedQuantizedLinear,
    fastest_dtype,
    has_own_int8,
    packed,
    packed_attention,
    packed_merging,
    packed_norm,
    taken,
)
from darswin.deploy.quantize import quantize_model
from darswin.layers.embed import PolarPatchEmbed, patch_samples
from darswin.layers.linear import onednn_lack
from darswin.layers.position_bias import RelativeBias, joined_coefficients
from darswin.layers.quantized import (
    Quantization,
    QuantizedLinear,
    quantized_layers,
    without_quantized_layers,
)
from darswin.layers.transformer import Block, PatchMerging, Stage, Tables, WindowAttention
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.models.conv_unet import ConvBlock, ConvUnet
from darswin.models.encoder import Encoder, FeatureMaps
from darswin.models.pixel import PixelHead, PixelModel
from darswin.models.stages import Pair
from darswin.models.unet import PatchExpand, SkipJoin, Unet

__all__ = ["optimize"]

Net = TypeVar("Net", bound=Model)
DTYPES = (torch.float32, torch.bfloat16, torch.int8)
# A stage processes a large batch in parts. A part is so small that the tensors between two products
# stay below this size: in the caches, and in memory that the allocator reuses.
CACHED_BYTES = 16 * 2**20


def optimize(
    model: Net,
    dtype: torch.dtype | Literal["fastest"] = torch.float32,
    *,
    lens: Lens | None = None,
    calibration: Iterable[Sequence] | None = None,
) -> Net:
    """A copy of a model that computes the same results faster, for inference on CPUs.

    The copy has the model's signature and methods. It cannot be trained, saved, copied or compiled,
    and it has no gradients. The model itself stays as it is.

    Args:
        model: a model of `create_model`, on the CPU.
        dtype: torch.float32, torch.bfloat16 or torch.int8. With bfloat16, the maps between the
            layers and the result are bfloat16; distances, and the layers that refine the pixels of
            dense models, stay float32. With int8, the products of a quantized model (see
            `quantize_model`) are computed with 8 bits, and the rest with float32; for a picture
            with infinite or NaN pixels the result is finite but meaningless. "fastest": int8 for a
            quantized model if this CPU supports it, otherwise float32 or bfloat16, whichever is
            faster here.
        lens: a single lens, if all images come from one camera. The copy is then called
            `optimized(images)`. It computes the grid and the position biases once for each image
            size.
        calibration: batches (images, lens) of typical pictures. With int8, they quantize a model
            that is not quantized yet.

    Warns if torch lacks oneDNN's bfloat16 products. The copy then uses torch's own, which are
    slower.

    Raises:
        TypeError: another kind of model.
        ValueError: an unsupported dtype or device; a `lens` that is not a single lens; a
            calibration without int8 or for a quantized model; int8 with neither.
        RuntimeError: int8 on a CPU without 8-bit products.
    """
    _check(model, dtype, lens)
    if dtype == "fastest":
        is_whole = calibration is None and not quantized_layers(model)
        lacks_int8 = onednn_lack(torch.int8) is not None
        dtype = fastest_dtype() if is_whole or lacks_int8 else torch.int8
        if lacks_int8:
            model, calibration = copy.deepcopy(model), None
            without_quantized_layers(model)
    if dtype == torch.int8:
        if (lack := onednn_lack(dtype)) is not None:
            raise RuntimeError(f'{lack}: optimize(model, "fastest") chooses a type that works here')
        model, dtype = _quantized(model, calibration), torch.float32
    elif calibration is not None or quantized_layers(model):
        raise ValueError(f"a quantized model or a calibration needs dtype=torch.int8, got {dtype}")
    if dtype == torch.bfloat16 and (lack := onednn_lack(dtype)) is not None:
        warnings.warn(f"optimize uses torch's own products, which are slower: {lack}", stacklevel=2)
    optimized = copy.deepcopy(model).eval().requires_grad_(False)
    for module in list(optimized.modules()):
        _pack(module, dtype)
    optimized.prepare = _with_tables(optimized, lens)  # type: ignore[assignment]
    for module in optimized.modules():
        if isinstance(module, Model):
            _restrict(module)
    return optimized


def _quantized(model: Net, calibration: Iterable[Sequence] | None) -> Net:
    if bool(quantized_layers(model)) == (calibration is not None):
        raise ValueError(
            "int8 needs either a quantized model (see quantize_model) or a calibration: batches "
            "(images, lens) of typical pictures"
        )
    return model if calibration is None else quantize_model(model, calibration)


def _check(model: nn.Module, dtype: torch.dtype | str, lens: Lens | None) -> None:
    if not isinstance(model, (Encoder, PixelModel, FeatureMaps)):
        raise TypeError(f"model must be a model of create_model, got {type(model).__name__}")
    if "prepare" in vars(model):
        raise TypeError("model must be a model of create_model, got an optimized model")
    if lens is not None and (not isinstance(lens, Lens) or len(lens) != 1):
        raise ValueError(f"lens must be one lens, got {lens!r}")
    if dtype not in (*DTYPES, "fastest"):
        known = ", ".join(map(str, DTYPES))
        raise ValueError(f'dtype must be one of {known} or "fastest", got {dtype}')
    devices = sorted({parameter.device.type for parameter in model.parameters()})
    if devices != ["cpu"]:
        raise ValueError(
            f"optimize is for CPUs, got a model on {' and '.join(devices)}: there use the model "
            "itself, torch.compile or a CUDA graph"
        )


class InDtype(nn.Module):
    """Runs a module, under autocast for bfloat16, converts its result to `dtype`, and runs `then`
    on it."""

    def __init__(
        self,
        module: Callable[..., Tensor],
        dtype: torch.dtype,
        then: Callable[[Tensor], Tensor] | None = None,
    ):
        super().__init__()
        self.module, self.dtype, self.then = module, dtype, then

    def forward(self, *arguments, **options) -> Tensor:
        narrow = self.dtype == torch.bfloat16
        autocast: Any = contextlib.nullcontext()
        if narrow or torch.is_autocast_enabled("cpu"):
            autocast = torch.autocast("cpu", torch.bfloat16, enabled=narrow)
        with autocast:
            result = self.module(*arguments, **options).to(self.dtype)
        if torch.is_grad_enabled() and result.requires_grad:
            raise RuntimeError(
                "an optimized model has no gradients, but its images or its lens require one: call "
                "it under torch.no_grad(), or use the original model"
            )
        return result if self.then is None else self.then(result)


def _pack(module: nn.Module, dtype: torch.dtype) -> None:
    """Replaces the layers of one module by packed ones, or converts them to `dtype`."""
    if isinstance(module, Encoder):
        _pack_norm(module, dtype)
        embed = module.patch_embed
        if isinstance(embed, PolarPatchEmbed):
            module.patch_embed = _packed_embed(embed, dtype)
            module.patch_embed.sample = embed.sample  # for `Model.sample`
        else:
            module.patch_embed = InDtype(embed, dtype)
        if isinstance(module.head, nn.Linear):  # else an identity
            _replace(module, head=PackedLinear(module.head, dtype))
    elif isinstance(module, Stage):
        _pack_stage(module, dtype)
    elif isinstance(module, PatchMerging):
        if _has_kernels(module, dtype):
            merging = packed_merging(module.norm, module.reduction)
            return _replace(module, reduction=merging, norm=lambda x: x)
        reduction = packed(module.reduction, dtype)
        _replace(module, reduction=reduction)
        _pack_norm(module, dtype, taken(reduction))
    elif isinstance(module, ConvBlock):
        layers: Any = module
        for conv in (0, 3):
            fused = fuse_conv_bn_eval(layers[conv], layers[conv + 1])
            layers[conv], layers[conv + 1] = InDtype(fused, dtype), nn.Identity()
    elif isinstance(module, (PatchExpand, SkipJoin, PixelHead)):
        for name, layer in list(module.named_children()):
            if isinstance(layer, nn.LayerNorm):
                layer.to(dtype)
            elif isinstance(layer, (nn.Linear, QuantizedLinear)):
                _replace(module, **{name: PackedLinear(layer, dtype)})
            elif isinstance(layer, nn.Conv2d):
                module.add_module(name, InDtype(layer, dtype))


def _packed_embed(embed: PolarPatchEmbed, dtype: torch.dtype) -> InDtype:
    if embed.proj.weight.dtype != torch.float32:
        return InDtype(embed, dtype)
    product, norm = PackedLinear(embed.proj, dtype), packed_norm(embed.norm, dtype)
    samples = partial(patch_samples, embed.sample, dtype=dtype)
    return InDtype(samples, dtype, lambda x: norm(product(x)))


def _has_kernels(module: nn.Module, dtype: torch.dtype) -> bool:
    """True if our own kernels compute the products of a module."""
    return dtype == torch.float32 and (not quantized_layers(module) or has_own_int8())


def _pack_stage(stage: Stage, dtype: torch.dtype) -> None:
    if not isinstance(stage.downsample, (PatchMerging, nn.Identity)):
        stage.downsample = InDtype(stage.downsample, dtype)
    blocks: list[Any] = list(stage.blocks)
    if not blocks:
        return
    attentions = [block.attn for block in blocks]
    fc1 = blocks[0].mlp.fc1
    widest = max(3, -(-fc1.out_features // fc1.in_features))  # queries, keys, values; or the MLP
    stage.most_numbers = max(CACHED_BYTES // (widest * dtype.itemsize), 1)
    in_windows = all(isinstance(attn, WindowAttention) for attn in attentions)
    for mlp in (block.mlp for block in blocks):
        if isinstance(mlp.fc1, QuantizedLinear) != isinstance(mlp.fc2, QuantizedLinear):
            raise ValueError("both products of an MLP must be quantized, or none")
    if in_windows and _has_kernels(stage.blocks, dtype):
        _replace(stage, _run=PackedBlocks(blocks))
        for block in blocks:
            _replace(block, norm1=None, norm2=None, mlp=None)
            _replace(block.attn, qkv=None, proj=None)
    else:
        stage.add = Tensor.add_
        for block in blocks:
            _pack_block(block, dtype)
    biases = [a.position_bias for a in attentions if isinstance(a, WindowAttention)]
    relative = [bias for bias in biases if isinstance(bias, RelativeBias)]
    if relative:
        joined = joined_coefficients(relative)
        stage.coefficients = {name: rows.float() for name, rows in joined.items()}


def _pack_block(block: Block, dtype: torch.dtype) -> None:
    attn, mlp = block.attn, block.mlp
    quantization = None
    if isinstance(attn, WindowAttention):
        qkv, proj = packed(attn.qkv, dtype), packed(attn.proj, dtype)
        quantization = taken(qkv)
        _replace(attn, qkv=qkv, proj=proj, attend=packed_attention(attn, taken(proj)))
    else:
        block.attn = InDtype(attn, dtype)
    fc1: PackedLinear | PackedQuantizedLinear
    fc2 = packed(mlp.fc2, dtype)
    if isinstance(mlp.fc1, QuantizedLinear):
        fc1 = PackedQuantizedLinear(mlp.fc1, gelu=taken(fc2))
    else:
        fc1 = PackedLinear(mlp.fc1, dtype, gelu=True)
    _replace(mlp, fc1=fc1, fc2=fc2, activation=None)
    norm1 = PackedNorm(block.norm1, dtype, quantization)
    norm2 = PackedNorm(block.norm2, dtype, taken(fc1))
    _replace(block, norm1=norm1, norm2=norm2, mlp=mlp.forward)


def _pack_norm(module: Any, dtype: torch.dtype, quantization: Quantization | None = None) -> None:
    if isinstance(module.norm, nn.LayerNorm):  # else an identity
        _replace(module, norm=packed_norm(module.norm, dtype, quantization))


def _replace(module: nn.Module, **layers: Any) -> None:
    """Replaces submodules and methods by plain functions."""
    for name, layer in layers.items():
        module._modules.pop(name, None)
        setattr(module, name, layer)


def _with_tables(model: Model, fixed_lens: Lens | None) -> Callable[[Lens | None, Pair], Any]:
    """A `prepare` that returns the position biases themselves. With a fixed lens it takes no lens,
    and computes once for each image size."""
    prepare, known = model.prepare, dict[Pair, Any]()

    def with_tables(lens: Lens | None, size: Pair) -> Any:
        if fixed_lens is None:
            return _tables(model, prepare(lens, size))
        if lens is not None:
            raise ValueError("this model was optimized for a fixed lens: call it without a lens")
        if size not in known:
            known[size] = _tables(model, prepare(fixed_lens, size))
        return known[size]

    return with_tables


def _tables(model: Any, prepared: Any) -> Any:
    if isinstance(model, FeatureMaps):
        return _tables(model.encoder, prepared)
    if isinstance(model, ConvUnet):
        return prepared
    if isinstance(model, Unet):
        prepared = prepared._replace(encoder=_tables(model.encoder, prepared.encoder))
        model = model.decoder
    found = []
    for stage, positions in zip(model.stages, prepared.positions, strict=True):
        tables = stage.tables(*positions)
        found.append((Tables(None if t is None else t.contiguous() for t in tables),))
    return prepared._replace(positions=found)


def _restrict(model: Model) -> None:
    """Replaces the methods that packed weights do not support by errors."""

    def refuse(message: str) -> Callable:
        def raise_error(*_arguments, **_options):
            raise TypeError(f"an optimized model cannot be {message}")

        return raise_error

    not_trained = refuse("trained: train the original model")
    model.__dict__.update(
        train=lambda mode=True: not_trained() if mode else model,
        state_dict=refuse("saved: save the original model"),
        prune_intermediate_layers=refuse("pruned: prune the original model, then optimize it"),
        __reduce_ex__=refuse("copied or pickled: copy the original model, then optimize the copy"),
    )
