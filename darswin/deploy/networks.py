"""Whole models as programs: the forward of `optimize` and of `darswin.frames.Network`."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

import darswin.deploy.lowering  # noqa: F401  (it registers the rules)
from darswin.deploy.packed import refuse_gradients
from darswin.deploy.program import Checked, NoProgramError, Weights
from darswin.deploy.record import Trace, identity, inverse, traced
from darswin.lens import Equidistant
from darswin.models.adapter import adapted
from darswin.models.base import Model
from darswin.models.encoder import Encoder
from darswin.models.prepared import Prepared
from darswin.views import PolarView
from darswin.views.base import Pair, PreparedPolar, size_of

_MOST = 4  # results of `prepare` whose inputs are kept
_FOVS = 2.0, 6.0  # rad, of lenses for which programs are tried


class _Known(NamedTuple):
    """A program, and which tensors of a result of `prepare` are its inputs; None if they are
    computed from these tensors."""

    program: Checked
    trace: Trace
    fields: Sequence[int] | None


class _Bound(NamedTuple):
    """The inputs of a program for a result of `prepare`."""

    prepared: Prepared
    shapes: Any
    known: _Known
    inputs: Sequence[Tensor]
    learned: Sequence[Tensor]  # those of `prepared` that require gradients


class Programs:
    """The forward of an optimized model as programs, called as `forward_network`.

    A program is written for the sizes of the images, and its inputs are found for each result of
    `prepare`.

    Args:
        model: the optimized model. layers: its methods `prepare` and `forward_network` without
            programs. weights: of the programs.

    Raises:
        NoProgramError: the model has a part that is no instruction.
    """

    def __init__(self, model: Model, layers: Any, weights: Weights):
        self._model, self._forward, self._weights = model, layers.forward_network, weights
        self._known: dict[Any, _Known] = {}
        self._bound: dict[int, _Bound] = {}
        size = model.image_size or tuple(adapted(model).pretrained_cfg["input_size"][1:])
        shapes = [of for of in (seen_by(model, size), _images(model, size)) if of is not None]
        with torch.no_grad():
            self._bind(_prepared_for_some_lens(model, layers, size), tuple(shapes))

    def __call__(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Any:
        refuse_gradients(x)
        model, given = self._model, [x.float()]
        if model.refines_with_images:
            assert images is not None
            given.append(model.view.floating(images, torch.float32).float())
            refuse_gradients(given[1])
        shapes = tuple(one.shape[1:] for one in given)
        bound = self._bound.get(id(prepared))
        if bound is None or bound.shapes != shapes:
            bound = self._bind(prepared, shapes)
        known = bound.known
        for learned in bound.learned:
            refuse_gradients(learned)
        found = known.program([*given, *bound.inputs])
        results = zip(found, known.trace.results, strict=True)
        outputs = [output.permute(inverse(of.order)) for output, of in results]
        return outputs if known.trace.is_list else outputs[0]

    def _bind(self, prepared: Prepared, shapes: Any) -> _Bound:
        read = _read(prepared)
        leaves = pytree.tree_leaves(read)
        key = shapes, *(one.shape[1:] if isinstance(one, Tensor) else one for one in leaves)
        if key not in self._known:
            self._known[key] = self._written(_of_lens(read, 0), shapes)
        known = self._known[key]
        inputs: Sequence[Tensor]
        if known.fields is not None:
            inputs = [leaves[k].detach().float().contiguous() for k in known.fields]
        else:
            count = max((len(one) for one in leaves if isinstance(one, Tensor)), default=1)
            each = [self._trace(_of_lens(read, k), shapes).given for k in range(count)]
            inputs = [torch.cat(of_lenses) for of_lenses in zip(*each, strict=True)]
        learned = [one for one in leaves if isinstance(one, Tensor) and one.requires_grad]
        bound = _Bound(prepared, shapes, known, inputs, learned)
        kept = [*self._bound.items()][1 - _MOST :]
        self._bound = dict(kept) | {id(prepared): bound}  # a new one, for other threads
        return bound

    def _written(self, prepared: Prepared, shapes: Any) -> _Known:
        trace = self._trace(prepared, shapes)
        places = {
            identity(one): k
            for k, one in enumerate(pytree.tree_leaves(prepared))
            if isinstance(one, Tensor)
        }
        fields = [places.get(identity(one)) for one in trace.given]
        found = [k for k in fields if k is not None]
        return _Known(trace.program.checked(), trace, found if len(found) == len(fields) else None)

    def _trace(self, prepared: Prepared, shapes: Any) -> Trace:
        seen, *images = shapes
        return traced(self._model, self._forward, self._weights, seen, prepared, *images or [None])


def _prepared_for_some_lens(model: Model, layers: Any, size: Pair) -> Prepared:
    if not model.uses_lens:
        return layers.prepare(None, size)
    for fov in _FOVS:
        try:
            return layers.prepare(Equidistant.from_fov(fov, min(size) / 2), size)
        except ValueError:  # the view sees nothing of it, or takes no such angles
            continue
    raise NoProgramError("its view, which shows nothing of usual lenses")


class FrameProgram(NamedTuple):
    """A program for frames of one camera."""

    words: list[int]
    weights: Tensor  # (K,) int32
    constants: list[Tensor]  # float32, without the batch: all inputs but the sampled ones
    reads_frame: bool  # input 1 is the frame itself, (H, W, C) and normalized
    finish: str  # "probabilities" of the logits, a "list" of maps, or an "array"


def frame_program(model: Any, lens: Any, size: Pair) -> FrameProgram:
    """The program of an optimized model for one lens and one size.

    Input 0 is what the view sees. The outputs are the logits, the maps, or the pixels (K, H, W).

    Raises:
        NoProgramError: the model has a part that is no instruction of a program.
    """
    if model.view.count != 1:
        raise NoProgramError(f"its view shows {model.view.count} pictures of each image")
    layers, weights = model.layers, model.weights
    prepared = _read(layers.prepare(lens, size))
    images = _images(model, size)
    trace = traced(
        model, layers.forward_network, weights, seen_by(model, size), prepared, images,
        for_file=True,
    )  # fmt: skip
    words = trace.program.words()
    constants = [one.detach().float()[0].contiguous() for one in trace.given]
    classifies = isinstance(adapted(model), Encoder) and model.num_classes > 0
    finish = "probabilities" if classifies else "list" if trace.is_list else "array"
    return FrameProgram(words, weights.words, constants, images is not None, finish)


def _images(model: Model, size: Pair) -> tuple[int, ...] | None:
    """The shape of an image of (H, W), if the network reads it."""
    return (_channels(model), *size) if model.refines_with_images else None


def _channels(model: Model) -> int:
    if model.in_chans is None:
        raise NoProgramError("the model takes any number of channels")
    return model.in_chans


def seen_by(model: Model, size: Pair) -> tuple[int, ...]:
    """The shape of what the view sees of one image of (H, W)."""
    view, channels = model.view, _channels(model)
    if isinstance(view, PolarView) and not view.in_pixels:
        return (*view.map_size, view.samples[0] * view.samples[1] * channels)
    return (channels, *(size_of(view) or size))


def _read(prepared: Prepared) -> Prepared:
    """What a network reads of it, without what the view alone reads."""
    view: Any = prepared.view
    unread = dict(grid=None) if isinstance(view, PreparedPolar) else dict(points=None)
    return prepared._replace(view=view._replace(**unread), remaps=None)


def _of_lens(prepared: Prepared, k: int) -> Prepared:
    """The part of a lens."""

    def part(value: Any) -> Any:
        return value[k : k + 1] if isinstance(value, Tensor) and len(value) > 1 else value

    return pytree.tree_map(part, prepared)
