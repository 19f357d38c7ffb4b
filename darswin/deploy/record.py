"""Writes the program of a network: its own forward runs once, on values that are recorded.

A recorded value is a tensor on the device "meta", with a shape and strides but no numbers. Its
numbers are those of a slot of the program. What torch knows how to do with strides alone, such as
`permute`, makes another view of the slot. Each other function has a rule here, which writes its
instruction. Functions of darswin take part by torch's protocol for overrides.
"""

import inspect
import traceback
from collections.abc import Callable, Iterable, Sequence
from types import FrameType
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from darswin.deploy.hidden import PICTURES, OfLens, refuse, state_of, unchanged
from darswin.deploy.program import NoProgramError, Program, Slot, Weights
from darswin.models.prepared import Prepared

RULES: dict[Any, tuple[Callable[..., Any], inspect.Signature]] = {}  # lowering.py has them
# What a program knows of a value.
_FORM = (
    Tensor.dim, Tensor.ndim.__get__, Tensor.dtype.__get__,  # type: ignore[attr-defined]
    Tensor.requires_grad.__get__,  # type: ignore[attr-defined]
    Tensor.is_floating_point, torch.is_floating_point,
)  # fmt: skip
# Views that depend on the order in memory, or on the number of pictures if that is one.
_OTHER_VIEWS = (Tensor.as_strided, torch.as_strided, Tensor.squeeze, torch.squeeze)
_RESHAPES = (Tensor.reshape, torch.reshape, Tensor.flatten, torch.flatten)
_TENSORS = (Tensor, Tensor | None, Sequence[Tensor])


def lowers(*functions: Any) -> Callable[[Callable], Callable]:
    """Registers the rule of functions: it takes their arguments, and writes instructions.

    An argument is a `Recorded`, or it may be one or a tensor of the lens if its type says `Tensor`.
    """

    def register(rule: Callable) -> Callable:
        RULES.update(dict.fromkeys(functions, (rule, inspect.signature(rule))))
        return rule

    return register


class Recorded(Tensor):
    """Values of all pictures, (B, ...), in a program that is being written.

    Attributes:
        whole: their shape and strides, on the device "meta".
        slot: whose numbers these are a view of; None if they are a copy that is not made yet.
        source: the value, of another shape, of which the copy is made.
    """

    writer: "Trace"
    whole: Tensor
    slot: Slot | None
    source: "Recorded"

    @classmethod
    def __torch_function__(cls, function, types, arguments=(), named=None):
        if function in RULES:
            return _by_rule(function, arguments, named or {})
        return _viewed(function, arguments, named or {})

    @property
    def meta(self) -> Tensor:
        """The shape and strides of one picture, (1, ...)."""
        return self.whole[:1]

    def made(self) -> "Recorded":
        """The value with a slot."""
        if self.slot is None:
            self.slot = self.writer.dense(self.source)
        return self

    def order(self) -> list[int]:
        """The axes from the longest stride to the shortest: the order in memory."""
        strides = self.whole.stride()
        return [0, *sorted(range(1, len(strides)), key=lambda axis: -strides[axis])]


def _by_rule(function: Any, arguments: Sequence[Any], named: dict[str, Any]) -> Any:
    """What the rule of a function makes of its arguments, which must be of the rule's types."""
    rule, signature = RULES[function]
    try:
        values = signature.bind(*arguments, **named).arguments
    except TypeError as error:
        refuse(function, error)
    for name, value in values.items():
        kind, leaves = signature.parameters[name].annotation, pytree.tree_leaves(value)
        fits = kind in _TENSORS or not any(isinstance(v, (Recorded, OfLens)) for v in leaves)
        if not (isinstance(value, Recorded) if kind is Recorded else fits):
            refuse(function, f"its `{name}` is another one than a program knows")
    result = rule(*arguments, **named)
    if isinstance(result, Recorded) and result.slot is not None:
        trace, frames = result.writer, (frame for frame, _ in traceback.walk_stack(None))
        trace.steps.append(Made(trace.module_of(frames), function, result))
    return result


def _viewed(function: Any, arguments: Sequence[Any], named: dict[str, Any]) -> Any:
    """The views that a function makes of one value. It must read and change no numbers."""
    leaves = pytree.tree_leaves((arguments, named))
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    if (
        len(tensors) > 1
        or not isinstance(value := tensors[0], Recorded)
        or function in _OTHER_VIEWS
    ):
        refuse(function)
    if function in _FORM:
        return function(value.whole)
    arguments, named = pytree.tree_map_only(Recorded, lambda v: v.whole, (arguments, named))
    try:
        result = unchanged(function, function, arguments, named)
    except NoProgramError:
        raise
    except Exception as error:
        refuse(function, error)
    results = result if isinstance(result, (tuple, list)) else [result]
    for part in results:
        if not (isinstance(part, Tensor) and part.dim() and part.shape[0] == len(value.whole)):
            refuse(function)
    if function in _RESHAPES and not _shares(result, value.whole):
        return value.writer.copy_of(value, result)
    if not results or not all(_is_view(part, value.whole) for part in results):
        refuse(function)
    value.made()
    views = [value.writer.value(value.slot, part) for part in results]
    return views[0] if isinstance(result, Tensor) else views


def _shares(part: Tensor, other: Tensor) -> bool:
    """Whether a tensor is made of the other's memory."""
    return part.untyped_storage()._cdata == other.untyped_storage()._cdata


def _is_view(part: Tensor, whole: Tensor) -> bool:
    """Whether a tensor has some of the numbers of each picture of a value, as they are."""
    as_they_are = part.dtype == whole.dtype and not part.is_neg()
    return as_they_are and _shares(part, whole) and part.stride(0) == whole.stride(0)


class Made(NamedTuple):
    """A value that a function made in a module."""

    module: str
    function: Any
    value: Recorded


class Output(NamedTuple):
    """The numbers of a result, and the axes of the program's output in their order."""

    slot: Slot
    order: Sequence[int]

    def ordered(self, numbers: Tensor) -> Tensor:
        """The output with its axes in the order of the result."""
        return numbers.permute(inverse(self.order))


class Trace:
    """The program of a network for what it sees of one image, in the course of its writing.

    Attributes:
        for_file: whether the program is of one lens alone, in a file.
        given: the tensors that are inputs, after those that every image has.
        steps: each value that instructions make, with its module and its function.
        results: the outputs; is_list: whether the network returns a list of them.
    """

    def __init__(self, network: nn.Module, weights: Weights, *, for_file: bool = False):
        self.program, self.for_file = Program(weights), for_file
        self._names = {id(module): name for name, module in network.named_modules()}
        self.network = network
        self.dtypes = torch.float32, getattr(network, "dtype", torch.float32)
        self.given: list[Tensor] = []
        self.steps: list[Made] = []
        self._inputs: dict[Any, Slot] = {}
        self.results: list[Output] = []
        self.is_list = False

    def module_of(self, frames: Iterable[FrameType]) -> str:
        """The name and the type of the innermost module of the network that runs in frames."""
        for frame in frames:
            module = frame.f_locals.get("self")
            if name := self._names.get(id(module)):
                return f"{name} ({type(module).__name__})"
        return type(self.network).__name__

    def value(self, slot: Slot | None, whole: Tensor) -> Recorded:
        """A view of a slot."""
        value = whole.as_subclass(Recorded)
        value.writer, value.whole, value.slot = self, whole, slot
        return value

    def filled(self, slot: Slot, order: Sequence[int] | None = None) -> Recorded:
        """A whole slot in its shape; `order`: the axes of the slot's, in the order of the value."""
        whole = torch.empty((PICTURES, *slot.shape), device="meta")
        return self.value(slot, whole if order is None else whole.permute(*order))

    def input(self, *shape: int, order: Sequence[int] | None = None) -> Recorded:
        """An input that every image has."""
        return self.filled(self.program.input(*shape), order)

    def of(self, value: Tensor) -> Recorded:
        """A value of the network; a tensor that depends on the lens alone is an input."""
        if isinstance(value, Recorded):
            return value
        if not isinstance(value, Tensor):
            raise NoProgramError(f"{type(value).__name__} beside values is no instruction")
        with torch._C.DisableTorchFunctionSubclass():
            value = value.as_subclass(Tensor)
        if value.dim() and value.stride(0) == 0:
            value = value[:1]  # expanded
        if value.dim() < 2 or len(value) != 1:
            raise NoProgramError(f"a tensor {tuple(value.shape)} beside pictures is no instruction")
        key = identity(value)
        if key not in self._inputs:
            self._inputs[key] = self.program.input(*value.shape[1:])
            self.given.append(value)
        return self.filled(self._inputs[key])

    def input_of(self, value: Tensor) -> Slot:
        """The input of a tensor that depends on the lens alone; another value, densely."""
        return self.dense(self.of(value))

    def copy_of(self, source: Recorded, like: Tensor) -> Recorded:
        """The numbers of a value in C order, in another shape. They are copied if they are used."""
        while source.slot is None:
            source = source.source
        value = self.value(None, torch.empty(like.shape, device="meta"))
        value.source = source
        return value

    def dense(self, value: Recorded, order: Sequence[int] | None = None) -> Slot:
        """A slot of the numbers in C order, with the axes in an order; its shape is theirs."""
        meta = value.made().meta
        meta = meta if order is None else meta.permute(*order)
        slot, shape = value.slot, tuple(meta.shape[1:])
        assert slot is not None
        if _is_whole(meta, slot):
            return slot._replace(shape=shape)
        target = self.filled(self.program.buffer(*shape))
        self.move(slot, meta, target)
        assert target.slot is not None
        return target.slot

    def move(self, x: Slot, meta: Tensor, target: Recorded) -> None:
        """Copies a view of a slot to a view of another one, of the same shape."""
        to = target.meta
        axes = [a for a in zip(meta.shape, meta.stride(), to.stride(), strict=True) if a[0] != 1]
        merged: list[tuple[int, int, int]] = []
        for size, read, write in sorted(axes, key=lambda axis: -axis[2]):
            if merged and merged[-1][1:] == (read * size, write * size):
                size *= merged.pop()[0]
            merged.append((size, read, write))
        assert target.slot is not None
        places = int(meta.storage_offset()), int(to.storage_offset())
        self.program.copy(x, target.slot, merged or [(1, 1, 1)], *places)

    def by_rows(self, x: Recorded, width: int, write: Callable[[Slot], Slot]) -> Recorded:
        """What an instruction makes of the last axis. The rows keep their order in memory."""
        if x.slot is None and x.source.shape[-1] == x.shape[-1] and _has_rows(x.source):
            made = self.by_rows(x.source, width, write)
            return self.copy_of(made, torch.empty((*x.shape[:-1], width), device="meta"))
        x.made()
        if not _has_rows(x):
            x = self.filled(self.dense(x))
        dim, slot = x.shape[-1], x.slot
        assert slot is not None
        out = write(slot._replace(shape=(slot.numbers // dim, dim)))
        strides = [stride // dim * width for stride in x.whole.stride()[:-1]]
        sizes = (*x.shape[:-1], width)
        return self.value(out, torch.empty_strided(sizes, (*strides, 1), device="meta"))

    def finish(self, results: Any) -> None:
        """Makes recorded results the outputs."""
        self.is_list = isinstance(results, list)
        for result in results if self.is_list else [results]:
            self.output(self.of(result))

    def output(self, value: Recorded) -> None:
        """Makes a value the next output. In a file, its axes are in order in memory."""
        order = list(range(value.dim())) if self.for_file else value.made().order()
        slot = self.dense(value, order)
        self.program.output(slot)
        self.results.append(Output(slot, order))

    def returned(self, outputs: Sequence[Tensor]) -> Any:
        """What the network returns for these outputs of the program."""
        results = [of.ordered(each) for of, each in zip(self.results, outputs, strict=True)]
        return results if self.is_list else results[0]


def identity(value: Tensor) -> tuple:
    """What tells the numbers of a tensor from those of others."""
    return value.data_ptr(), value.shape, value.stride(), value.dtype


def inverse(order: Sequence[int]) -> list[int]:
    """The order that undoes an order of axes."""
    return sorted(range(len(order)), key=order.__getitem__)


def _is_whole(meta: Tensor, slot: Slot) -> bool:
    """Whether a view is the whole slot in C order."""
    return meta.is_contiguous() and not meta.storage_offset() and meta.numel() == slot.numbers


def _has_rows(x: Recorded) -> bool:
    """Whether a value is a whole slot of rows, in any order, whose last axis is dense."""
    order = x.order()
    last = order[-1] == x.dim() - 1 or x.shape[-1] == 1
    return last and x.slot is not None and _is_whole(x.meta.permute(*order), x.slot)


def traced(
    network: nn.Module, forward: Callable[..., Any], weights: Weights, seen: Sequence[int],
    prepared: Prepared, images: Sequence[int] | None, *, for_file: bool = False,
) -> Trace:  # fmt: skip
    """Records `forward(seen, prepared, images)` of a network.

    Args:
        seen, images: the shapes, without the batch, of what the network sees of an image and of
            the image; None without images.
        prepared: of one lens.
        for_file: the images are channels last, and the results are in C order.

    Raises:
        NoProgramError: names the module and the function that is no instruction.
    """
    trace = Trace(network, weights, for_file=for_file)
    x, pixels = trace.input(*seen), None
    if images is not None:
        channels, *size = images
        pixels = (
            trace.input(*size, channels, order=(0, 3, 1, 2)) if for_file else trace.input(*images)
        )
    own = [*network.parameters(), *network.buffers()]  # kept, so that new ones are others
    before = [*map(state_of, own)]
    if not for_file:
        prepared = pytree.tree_map_only(Tensor, lambda t: t.as_subclass(OfLens), prepared)
    try:
        with torch.no_grad(), torch.inference_mode(False):
            trace.finish(forward(x, prepared, pixels))
        if before != [state_of(part) for part in (*network.parameters(), *network.buffers())]:
            raise NoProgramError("a change of its own tensors is no instruction")
    except Exception as error:  # also of the network, of values that it cannot take
        text = error if isinstance(error, NoProgramError) else f"{type(error).__name__}: {error}"
        frames = (frame for frame, _ in reversed([*traceback.walk_tb(error.__traceback__)]))
        raise NoProgramError(f"{trace.module_of(frames)}: {text}") from error
    return trace
