"""Models for inference: weights packed for oneDNN, GELU inside of the products, each residual and
the norm behind it in one."""

import copy
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, Literal, Self, TypeVar

import torch
from torch import Tensor, nn

from darswin.deploy.quantize import quantize_model
from darswin.deploy.stages import InDtype, OptimizedStage, pack
from darswin.layers import onednn
from darswin.layers.packed import PackedLinear, fastest_dtype
from darswin.layers.quantized import quantized_layers, without_quantized_layers
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.models.encoder import Encoder, FeatureMaps, Prepared
from darswin.models.stages import Pair, Stage
from darswin.models.unet import Unet, UnetPrepared

Net = TypeVar("Net", bound=Model)
DTYPES = (torch.float32, torch.bfloat16, torch.int8)


def optimize(
    model: Net,
    dtype: torch.dtype | Literal["fastest"] = torch.float32,
    *,
    lens: Lens | None = None,
    calibration: Iterable[Sequence] | None = None,
) -> Net:
    """A copy of a model that computes the same, faster: on CPU, in inference only.

    Its products are oneDNN's, with weights laid out for them, and take bias and GELU along; a
    residual and the norm behind it are one operator. It is called as the model is and has its
    methods, but it is neither trained, saved, copied nor compiled, and has no gradients: the model,
    which stays as it is, is there for that.

    Args:
        model: one of `create_model`, on the CPU. On a GPU a model needs none of this: it computes
            a stage's position biases at once by itself, and is called as it is.
        dtype: float32 or bfloat16, of what flows between the layers and of the result; distances
            are float32, and so is what refines the pixels of dense models. int8: products of 8
            bits, of a model of `quantize_model`; what lies between them is float32, and a picture
            with numbers that are not finite gets a result that is finite and means nothing.
            "fastest": int8 of a quantized model, where this CPU has it; else float32 or bfloat16,
            whichever `fastest_dtype` measured.
        lens: one camera's, for all images; the result is then called `optimized(images)`, and
            computes the grid and the position biases once for each image size.
        calibration: batches (images, lens) of pictures like those to come: with int8, for a model
            that is not quantized yet; it then goes through `quantize_model`.

    Where torch lacks oneDNN's products it warns, and uses its own.

    Raises:
        TypeError: another kind of model.
        ValueError: another dtype or device, `lens` is not a single lens, or a calibration where
            there is nothing to calibrate, or none where there is.
        RuntimeError: int8 on a CPU that has no products of 8 bits.
    """
    _check(model, dtype, lens)
    if dtype == "fastest":
        whole = calibration is None and not quantized_layers(model)
        lacks = onednn.missing(torch.int8) is not None
        dtype = fastest_dtype() if whole or lacks else torch.int8
        if lacks:
            model, calibration = _without_8_bits(model), None
    if dtype == torch.int8:
        if (lack := onednn.missing(dtype)) is not None:
            raise RuntimeError(f'{lack}: optimize(model, "fastest") takes what runs here')
        model, dtype = _quantized(model, calibration), torch.float32
    elif calibration is not None or quantized_layers(model):
        raise ValueError(f"a quantized model and a calibration are for torch.int8, got {dtype}")
    if (lack := onednn.missing(dtype)) is not None:
        warnings.warn(f"optimize goes on with torch's own products: {lack}", stacklevel=2)
    optimized = copy.deepcopy(model).eval().requires_grad_(False)
    kind: type[_Optimized] = _OptimizedEncoder
    if isinstance(optimized, Unet):
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


def _without_8_bits(model: Net) -> Net:
    if not quantized_layers(model):
        return model
    model = copy.deepcopy(model)
    without_quantized_layers(model)
    return model


def _quantized(model: Net, calibration: Iterable[Sequence] | None) -> Net:
    if bool(quantized_layers(model)) == (calibration is not None):
        raise ValueError(
            "int8 needs either a model of quantize_model or a calibration: batches (images, lens) "
            "of pictures like those to come"
        )
    return model if calibration is None else quantize_model(model, calibration)


def _check(model: nn.Module, dtype: torch.dtype | str, lens: Lens | None) -> None:
    if not isinstance(model, (Encoder, Unet, FeatureMaps)):
        raise TypeError(f"model must be one of create_model, got {type(model).__name__}")
    if isinstance(model, _Optimized):
        raise TypeError("model must be one of create_model, got one that is optimized already")
    if lens is not None and (not isinstance(lens, Lens) or len(lens) != 1):
        raise ValueError(f"lens must be one lens, got {lens!r}")
    if dtype not in (*DTYPES, "fastest"):
        known = ", ".join(map(str, DTYPES))
        raise ValueError(f'dtype must be one of {known} or "fastest", got {dtype}')
    devices = sorted({parameter.device.type for parameter in model.parameters()})
    if devices != ["cpu"]:
        raise ValueError(
            f"model must be on the CPU, whose products it is packed for, got one on "
            f"{' and '.join(devices)}: call that as it is, by torch.compile or as a CUDA graph"
        )


def _become(model: Model, *bases: type, **attributes: Any) -> None:
    """Gives a model the class that it has, behind `bases`."""
    name = f"Optimized{type(model).__name__}"
    model.__class__ = type(name, (*bases, type(model)), attributes)


def _pack_encoder(encoder: Encoder, dtype: torch.dtype) -> None:
    encoder.patch_embed = InDtype(encoder.patch_embed, dtype)
    encoder.stages = _stages(encoder.stages, dtype)
    encoder.norm.to(dtype)
    encoder.head.to(dtype)


def _pack_dense(model: Unet, dtype: torch.dtype) -> None:
    _pack_encoder(model.encoder, dtype)
    _become(model.encoder, _OptimizedEncoder)
    decoder, head = model.decoder, model.head
    pack(decoder.joins, dtype)
    pack(decoder.expand, dtype)
    decoder.stages = _stages(decoder.stages, dtype)
    head.set_submodule("proj", PackedLinear(head.proj, dtype))


def _stages(stages: nn.ModuleList, dtype: torch.dtype) -> nn.ModuleList:
    return nn.ModuleList(
        OptimizedStage(stage, dtype) for stage in stages if isinstance(stage, Stage)
    )


def _tables(
    stages: nn.ModuleList, positions: Sequence[Sequence[Tensor | None]]
) -> list[Sequence[Tensor | None]]:
    """The position biases of each stage's blocks."""
    optimized = [stage for stage in stages if isinstance(stage, OptimizedStage)]
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


class _OptimizedDense(_Optimized, Unet):
    """How an optimized dense model differs from the one it was made of."""

    encoder: _OptimizedEncoder  # type: ignore[assignment]  # of a class that is made of both

    def prepare(self, lens: Lens | None, size: Pair) -> UnetPrepared:
        """As the model it was made of, but `positions` are the tables of each stage's blocks."""
        angles = self.encoder.prepare_angles(lens, size)
        tables = _tables(self.decoder.stages, angles.positions[:-1])
        way = self.view.prepare(lens, size)
        return UnetPrepared(self.encoder.with_tables(angles), tables, way)


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
