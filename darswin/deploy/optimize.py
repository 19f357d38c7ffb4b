"""Fast copies of models for inference on CPUs.

The whole network is one C++ operator, on every CPU, in float32 and with 8 bits.
"""

import copy
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn, Self, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized

from darswin.deploy.fast import fast
from darswin.deploy.networks import Programs
from darswin.deploy.program import NoProgramError, Weights
from darswin.deploy.quantize import quantize_model
from darswin.layers.quantized import quantized_layers, without_quantized_layers
from darswin.lens import Lens
from darswin.models.adapter import adapted
from darswin.models.base import Model
from darswin.models.encoder import Encoder, FeatureMaps
from darswin.models.pixel import PixelModel
from darswin.models.prepared import Prepared
from darswin.ops import _module
from darswin.views.base import Pair

__all__ = ["optimize"]

Net = TypeVar("Net", bound=Model)
DTYPES = (torch.float32, torch.int8)


def optimize(
    model: Net,
    dtype: torch.dtype = torch.float32,
    *,
    lens: Lens | None = None,
    batches: Iterable[Sequence] | None = None,
    strict: bool = False,
) -> Net:
    """A copy of a model that computes the same results faster, for inference on CPUs.

    The copy has the model's signature and methods. It cannot be trained, saved, copied or compiled,
    and it has no gradients. The model itself stays as it is.

    Args:
        model: a model of `create_model`, or a `LensAdapter` of one, on the CPU.
        dtype: torch.float32 or torch.int8. With int8, the products of a quantized model (see
            `quantize_model`) are computed with 8 bits, and the rest with float32; for a picture
            with infinite or NaN pixels the result is finite but meaningless.
        lens: a single lens, if all images come from one camera. The copy is then called
            `optimized(images)`. It computes the grid and the position biases once for each image
            size.
        batches: of (images, lens), typical pictures. With int8, they quantize a model that is not
            quantized yet.
        strict: refuses a model that cannot be one program. Without it, such a model runs layer by
            layer, which is slower, and its `repr` says why.

    Raises:
        TypeError: another kind of model; or with `strict`, one with a part that is no instruction
            of a program.
        ValueError: an unsupported dtype or device; a `lens` that is not a single lens; batches
            without int8 or for a quantized model; int8 with neither.
        ImportError: darswin's compiled module cannot be loaded.
    """
    check_model(model, dtype, lens)
    _module.require("optimize")
    if dtype == torch.int8:
        model = _quantized(model, batches)
    elif batches is not None or quantized_layers(model):
        raise ValueError(f"a quantized model or batches need dtype=torch.int8, got {dtype}")
    with torch.random.fork_rng(devices=[]):
        made, lack = fast_copy(model), ""
        vars(made).update(fixed_lens=lens, known={})
        try:
            *before, reference = references(model)
            for each in before:
                Programs(fast_copy(each), each, strict=strict)
            vars(made).update(programs=Programs(made, reference, strict=strict))
        except NoProgramError as error:
            lack = str(error)
    if lack and strict:
        raise TypeError(f"model must become one program, but it runs layer by layer: {lack}")
    vars(made).update(lack=lack and f"layer by layer, because of {lack}")
    return made


def references(model: Net) -> list[Net]:
    """Copies of a model in eval mode and float32, with which its program is compared: before its
    numbers have 8 bits, if they have, and last as it is. They share its weights."""
    weights: Any = {id(p): nn.Parameter(p.detach(), False) for p in model.parameters()}
    copies = [copy.deepcopy(model, weights).eval().float()]
    if quantized_layers(model):
        copies.insert(0, copy.deepcopy(copies[0]))
        without_quantized_layers(copies[0])
    return copies


def fast_copy(model: Any) -> Any:
    """A copy of a model with fast layers, still without programs."""
    made: Any = copy.deepcopy(model).eval().requires_grad_(False).float()
    for part in filter(is_parametrized, [*made.modules()]):
        values = {name: getattr(part, name).detach().clone() for name in part.parametrizations}
        part.__class__ = type(part).__bases__[0]  # torch's own removal would change all copies
        del part.parametrizations
        for name, value in values.items():
            part.register_parameter(name, nn.Parameter(value, False))
    weights = Weights()
    fast(made, weights)
    for part in made.modules():
        if isinstance(part, Model):  # an encoder may be part of another model
            kind = type(part)
            part.__class__ = type(f"Optimized{kind.__name__}", (Optimized, kind), {})
            vars(part).update(dtype=model.dtype)
    vars(made).update(weights=weights)
    return made


def _quantized(model: Net, batches: Iterable[Sequence] | None) -> Net:
    if bool(quantized_layers(model)) == (batches is not None):
        raise ValueError(
            "int8 needs either a quantized model (see quantize_model) or batches of "
            "(images, lens), typical pictures"
        )
    return model if batches is None else quantize_model(model, batches)


def check_model(model: nn.Module, dtype: torch.dtype, lens: Lens | None) -> None:
    """TypeError or ValueError for what `optimize` does not take."""
    if not isinstance(network := adapted(model), (Encoder, PixelModel, FeatureMaps)):
        raise TypeError(
            "model must be a model of create_model, or a LensAdapter of one, "
            f"got {type(network).__name__}"
        )
    if isinstance(model, Optimized):
        raise TypeError("model must be a model of create_model, got an optimized model")
    if lens is not None and (not isinstance(lens, Lens) or len(lens) != 1):
        raise ValueError(f"lens must be one lens, got {lens!r}")
    if dtype not in DTYPES:
        raise ValueError(f"dtype must be {' or '.join(map(str, DTYPES))}, got {dtype}")
    devices = sorted({parameter.device.type for parameter in model.parameters()})
    if devices != ["cpu"]:
        raise ValueError(
            f"optimize is for CPUs, got a model on {' and '.join(devices)}: there use the model "
            "itself, torch.compile or a CUDA graph"
        )


class Optimized(Model[Any]):
    """What an optimized model does in another way than its model. Its class inherits from both."""

    dtype = torch.float32  # of the original weights
    fixed_lens: Lens | None = None
    known: dict[Pair, Prepared]  # the result of `prepare` for the fixed lens and each size
    programs: Programs | None = None  # `forward_network` as programs
    lack: str = ""  # why there are none
    weights: Weights  # of its programs

    @property
    def layers(self) -> Any:
        """The methods of the model, which go layer by layer."""
        return super()

    def forward_network(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Any:
        if self.programs is None:
            return super().forward_network(x, prepared, images)
        return self.programs(x, prepared, images)

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        if self.fixed_lens is None:
            return super().prepare(lens, size)
        if lens is not None:
            raise ValueError("this model was optimized for a fixed lens: call it without a lens")
        if size not in self.known:
            self.known[size] = super().prepare(self.fixed_lens, size)
        return self.known[size]

    def _check_device(self, name: str, images: Tensor) -> None:
        if images.device.type != "cpu":
            raise ValueError(f"{name} must be on the CPU, as the model is, got {images.device}")

    def extra_repr(self) -> str:
        return ", ".join(filter(None, (super().extra_repr(), self.lack)))

    def train(self, mode: bool = True) -> Self:
        if mode:
            _refuse("trained: train the original model")
        return self

    def state_dict(self, *arguments: Any, **options: Any) -> Any:
        _refuse("saved: save the original model")

    def prune_intermediate_layers(self, *arguments: Any, **options: Any) -> Any:
        _refuse("pruned: prune the original model, then optimize it")

    def reset_classifier(self, num_classes: int) -> None:
        _refuse("given a new head: give it to the original model, then optimize it")

    def __reduce_ex__(self, protocol: Any) -> Any:
        _refuse("copied or pickled: copy the original model, then optimize the copy")


def _refuse(action: str) -> NoReturn:
    raise TypeError(f"an optimized model cannot be {action}")
