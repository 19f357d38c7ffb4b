"""Whole models as programs: the forward of `optimize` and of `darswin.frames.Network`."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

import darswin.deploy.lowering  # noqa: F401  (it registers the rules)
from darswin.deploy.compare import compare, tolerance_of
from darswin.deploy.packed import refuse_gradients
from darswin.deploy.program import Checked, NoProgramError
from darswin.deploy.record import Trace, identity, traced
from darswin.lens import Equidistant, Lens
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
    """The inputs of a program for a result of `prepare`; without a program, the model goes layer by
    layer."""

    prepared: Prepared
    shapes: Any
    known: _Known | None
    inputs: Sequence[Tensor]
    learned: Sequence[Tensor]  # those of `prepared` that require gradients


class Programs:
    """The forward of an optimized model as programs, called as `forward_network`.

    A program is written for the sizes of the images, and its inputs are found for each result of
    `prepare`. It is compared with the model before it is used.

    Args:
        model: the optimized model. reference: the model.
        strict: refuses sizes for which there is no program; without it, they go layer by layer.

    Raises:
        NoProgramError: the model has a part that is no instruction.
    """

    def __init__(self, model: Any, reference: Model, *, strict: bool):
        layers, self._model, self._strict = model.layers, model, strict
        self._forward, self._weights = layers.forward_network, model.weights
        self._tolerance = tolerance_of(reference)
        self._known: dict[Any, _Known | None] = {}
        self._bound: dict[int, _Bound] = {}
        size = model.image_size or tuple(adapted(model).pretrained_cfg["input_size"][1:])
        shapes = tuple(of for of in (seen_by(model, size), _images(model, size)) if of is not None)
        with torch.no_grad():
            lens = _some_lenses(model, layers, size)
            expected = partial(_run, reference.forward_network, reference.prepare(lens, size))
            prepared = _read(layers.prepare(lens, size))
            self._known[_key(prepared, shapes)] = self._written(prepared, shapes, expected)

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
        for learned in bound.learned:
            refuse_gradients(learned)
        if bound.known is None:
            return self._forward(x, prepared, images)
        return bound.known.trace.returned(bound.known.program([*given, *bound.inputs]))

    def _bind(self, prepared: Prepared, shapes: Any) -> _Bound:
        read = _read(prepared)
        key = _key(read, shapes)
        if key not in self._known:
            try:
                with torch.no_grad():
                    self._known[key] = self._written(read, shapes)
            except NoProgramError as error:
                if self._strict:
                    raise TypeError(f"model must become one program: {error}") from error
                self._known[key] = None
        known, leaves = self._known[key], pytree.tree_leaves(read)
        inputs = [] if known is None else self._inputs(known, read, shapes)
        learned = [one for one in leaves if isinstance(one, Tensor) and one.requires_grad]
        bound = _Bound(prepared, shapes, known, inputs, learned)
        kept = [*self._bound.items()][1 - _MOST :]
        self._bound = dict(kept) | {id(prepared): bound}  # a new one, for other threads
        return bound

    def _inputs(self, known: _Known, read: Prepared, shapes: Any) -> Sequence[Tensor]:
        """What a program reads of a result of `prepare`."""
        leaves = pytree.tree_leaves(read)
        if known.fields is not None:
            return [leaves[k].detach().float().contiguous() for k in known.fields]
        count = max((len(one) for one in leaves if isinstance(one, Tensor)), default=1)
        each = [self._trace(_of_lenses(read, k), shapes).given for k in range(count)]
        rows = [torch.cat(of_lenses) for of_lenses in zip(*each, strict=True)]
        return [row[:1] if (row == row[:1]).all() else row for row in rows]  # for several tiles

    def _written(self, read: Prepared, shapes: Any, expected: Any = None) -> _Known:
        """A program for what a network reads of lenses, after a comparison with two of them."""
        read = _of_lenses(read, 0, 2)
        of_lens = _of_lenses(read, 0)
        trace, leaves = self._trace(of_lens, shapes), pytree.tree_leaves(of_lens)
        places = {identity(one): k for k, one in enumerate(leaves) if isinstance(one, Tensor)}
        fields = [places.get(identity(one)) for one in trace.given]
        found = [k for k in fields if k is not None]
        known = _Known(trace.program.checked(), trace, found if len(found) == len(fields) else None)
        random, count = torch.Generator().manual_seed(0), 2 * self._model.view.count
        pictures = [torch.randn(count, *shape, generator=random) for shape in shapes]
        inputs = [*pictures, *self._inputs(known, read, shapes)]
        layers = partial(_run, self._forward, read)
        model = partial(expected or layers, *pictures)
        compare(trace, inputs, model, layers, pictures, self._tolerance)
        return known

    def _trace(self, prepared: Prepared, shapes: Any) -> Trace:
        seen, *images = shapes
        return traced(self._model, self._forward, self._weights, seen, prepared, *images or [None])


def _run(forward: Any, prepared: Prepared, x: Tensor, images: Tensor | None = None) -> Any:
    return forward(x, _read(prepared), images)


def _key(read: Prepared, shapes: Any) -> Any:
    """What a program is written for."""
    leaves = pytree.tree_leaves(read)
    return shapes, *(one.shape[1:] if isinstance(one, Tensor) else one for one in leaves)


def _some_lenses(model: Model, layers: Any, size: Pair) -> Lens | None:
    """Two lenses of which the view shows something; one for several pictures of each image."""
    if not model.uses_lens:
        return None
    for fov in _FOVS:
        fovs = torch.tensor([fov, 0.9 * fov][: 2 if model.view.count == 1 else 1])
        try:
            layers.prepare(lens := Equidistant.from_fov(fovs, min(size) / 2), size)
        except ValueError:  # the view sees nothing of it, or takes no such angles
            continue
        return lens
    raise NoProgramError("its view, which shows nothing of usual lenses")


class FrameProgram(NamedTuple):
    """A program for frames of one camera."""

    words: list[int]
    weights: Tensor  # (K,) int32
    constants: list[Tensor]  # float32, without the batch: all inputs but the sampled ones
    reads_frame: bool  # input 1 is the frame itself, (H, W, C) and normalized
    finish: str  # "probabilities" of the logits, a "list" of maps, or an "array"


def frame_program(model: Any, lens: Any, size: Pair, reference: Any) -> FrameProgram:
    """The program of an optimized model for one lens and one size, compared with the `reference`.

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
    frames = torch.rand(2, model.in_chans, *size, generator=torch.Generator().manual_seed(0))
    pictures = [reference.sample(frames, reference.prepare(lens, size))]
    pictures += [] if images is None else [frames]
    inputs = [pictures[0], *(one.permute(0, 2, 3, 1).contiguous() for one in pictures[1:])]
    compare(
        trace, [*inputs, *(one[None] for one in constants)], partial(reference, frames, lens),
        partial(_run, layers.forward_network, prepared), pictures, tolerance_of(reference),
    )  # fmt: skip
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


def _of_lenses(prepared: Prepared, first: int, count: int = 1) -> Prepared:
    """The part of some lenses."""

    def part(value: Any) -> Any:
        several = isinstance(value, Tensor) and len(value) > 1
        return value[first : first + count] if several else value

    return pytree.tree_map(part, prepared)
