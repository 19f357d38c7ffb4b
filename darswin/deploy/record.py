"""Writes the program of a network: its own forward runs once, on values that are recorded.

A recorded value is a tensor on the device "meta", with a shape and strides but no numbers. Its
numbers are those of a slot of the program. What torch knows how to do with strides alone, such as
`permute`, makes another view of the slot. Each other function has a rule here, which writes its
instruction. Functions of darswin take part by torch's protocol for overrides.
"""

import traceback
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.overrides import resolve_name

from darswin.deploy.program import NoProgramError, Program, Slot, Weights
from darswin.models.prepared import Prepared

RULES: dict[Any, Callable[..., Any]] = {}  # lowering.py has them
_RESHAPES = (Tensor.reshape, torch.reshape, Tensor.flatten, torch.flatten)


def lowers(*functions: Any) -> Callable[[Callable], Callable]:
    """Registers the rule of functions: it takes their arguments, and writes instructions."""

    def register(rule: Callable) -> Callable:
        RULES.update(dict.fromkeys(functions, rule))
        return rule

    return register


class Recorded(Tensor):
    """A value of one image, (1, ...), in a program that is being written.

    Attributes:
        meta: its shape and strides, on the device "meta".
        slot: whose numbers these are a view of; None if they are a copy that is not made yet.
        source: the value, of another shape, of which the copy is made.
    """

    writer: "Trace"
    meta: Tensor
    slot: Slot | None
    source: "Recorded"

    @classmethod
    def __torch_function__(cls, function, types, arguments=(), named=None):
        named = named or {}
        if function in RULES:
            return RULES[function](*arguments, **named)
        values = [value for value in arguments if isinstance(value, Recorded)]
        if any(isinstance(v, Tensor) and not isinstance(v, Recorded) for v in arguments):
            raise NoProgramError(f"{resolve_name(function)} is no instruction")
        with torch._C.DisableTorchFunctionSubclass():
            plain = (v.meta if isinstance(v, Recorded) else v for v in arguments)
            try:
                result = function(*plain, **named)
            except RuntimeError as error:  # such as a shape that depends on the number of pictures
                raise NoProgramError(f"{resolve_name(function)} is no instruction") from error
        results = result if isinstance(result, (tuple, list)) else (result,)
        if not any(isinstance(one, Tensor) for one in results):
            return result  # a size, a dtype
        if len(values) != 1:
            raise NoProgramError(f"{resolve_name(function)} is no instruction")
        (value,) = values
        if function in _RESHAPES and not _shares(result, value.meta):
            return value.writer.copy_of(value, result)
        if value.slot is None:
            return function(value.made(), *arguments[1:], **named)
        if not all(_shares(one, value.meta) for one in results):
            raise NoProgramError(f"{resolve_name(function)} is no instruction")
        found = [value.writer.view(value, one) for one in results]
        return found[0] if isinstance(result, Tensor) else found

    def made(self) -> "Recorded":
        """The value with a slot."""
        if self.slot is None:
            self.slot = self.writer.dense(self.source)
        return self

    def order(self) -> list[int]:
        """The axes from the longest stride to the shortest: the order in memory."""
        strides = self.meta.stride()
        return [0, *sorted(range(1, self.meta.dim()), key=lambda axis: -strides[axis])]


def _shares(one: Tensor, other: Tensor) -> bool:
    """Whether a tensor is a view of the other's numbers."""
    storages = one.untyped_storage(), other.untyped_storage()
    return storages[0]._cdata == storages[1]._cdata


class Output(NamedTuple):
    """The numbers of a result, and the axes of the program's output in their order."""

    slot: Slot
    order: Sequence[int]


class Trace:
    """The program of a network for what it sees of one image, in the course of its writing.

    Attributes:
        for_file: whether the program is of one lens alone, in a file.
        given: the tensors that are inputs, after those that every image has.
        results: the outputs; is_list: whether the network returns a list of them.
    """

    def __init__(self, weights: Weights, *, for_file: bool = False):
        self.program, self.for_file = Program(weights), for_file
        self.given: list[Tensor] = []
        self._inputs: dict[Any, Slot] = {}
        self.results: list[Output] = []
        self.is_list = False

    def value(self, slot: Slot | None, meta: Tensor) -> Recorded:
        """A view of a slot."""
        value = meta.as_subclass(Recorded)
        value.writer, value.meta, value.slot = self, meta, slot
        return value

    def view(self, value: Recorded, meta: Tensor) -> Recorded:
        """Another view of the numbers of a value."""
        return self.value(value.slot, meta)

    def filled(self, slot: Slot, order: Sequence[int] | None = None) -> Recorded:
        """A whole slot in its shape; `order`: the axes of the slot's, in the order of the value."""
        meta = torch.empty((1, *slot.shape), device="meta")
        return self.value(slot, meta if order is None else meta.permute(*order))

    def input(self, *shape: int, order: Sequence[int] | None = None) -> Recorded:
        """An input that every image has."""
        return self.filled(self.program.input(*shape), order)

    def of(self, value: Tensor) -> Recorded:
        """A value of the network; a tensor that depends on the lens alone is an input."""
        if isinstance(value, Recorded):
            return value
        key = value.data_ptr(), value.shape, value.stride()
        if key not in self._inputs:
            self._inputs[key] = self.program.input(*value.shape[1:])
            self.given.append(value)
        return self.filled(self._inputs[key])

    def input_of(self, value: Tensor) -> Slot:
        """The input of a tensor that depends on the lens alone; another value, densely."""
        return self.dense(self.of(value))

    def copy_of(self, source: Recorded, meta: Tensor) -> Recorded:
        """The numbers of a value in C order, in another shape. They are copied if they are used."""
        while source.slot is None:
            source = source.source
        value = self.value(None, torch.empty(meta.shape, device="meta"))
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
        sizes, reads, writes = zip(*(merged or [(1, 1, 1)]), strict=True)
        assert target.slot is not None
        places = int(to.storage_offset()), int(meta.storage_offset())
        self.program.copy(x, target.slot, sizes, reads, writes, *places)

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
        strides = [stride // dim * width for stride in x.meta.stride()[:-1]]
        sizes = (*x.shape[:-1], width)
        return self.value(out, torch.empty_strided(sizes, (*strides, 1), device="meta"))

    def finish(self, results: Any) -> None:
        """Makes recorded results the outputs. In a file, their axes are in order in memory."""
        self.is_list = not isinstance(results, Tensor)
        for result in results if self.is_list else [results]:
            value = self.of(result)
            order = list(range(value.dim())) if self.for_file else value.made().order()
            slot = self.dense(value, order)
            self.program.output(slot)
            self.results.append(Output(slot, order))


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
    trace = Trace(weights, for_file=for_file)
    x, pixels = trace.input(*seen), None
    if images is not None:
        channels, *size = images
        pixels = (
            trace.input(*size, channels, order=(0, 3, 1, 2)) if for_file else trace.input(*images)
        )
    try:
        with torch.no_grad():
            trace.finish(forward(x, prepared, pixels))
    except NoProgramError as error:
        raise NoProgramError(f"{_module_of(error, network)}: {error}") from error
    return trace


def _module_of(error: Exception, network: nn.Module) -> str:
    """The name and the type of the innermost module of a network in which an error was raised."""
    names = {id(module): name for name, module in network.named_modules()}
    found = type(network).__name__
    for frame, _ in traceback.walk_tb(error.__traceback__):
        module = frame.f_locals.get("self")
        if name := names.get(id(module)):
            found = f"{name} ({type(module).__name__})"
    return found
