"""Programs of networks: the instructions of csrc/core/network.h."""

import struct
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor

from darswin.deploy.own import OwnLinear, OwnNorm, PackedBlocks, own_operator, pack

_NETWORK, _FORGET, _RUN = map(own_operator, ("_network", "_forget_network", "_run"))

(LINEAR, NORM, BLOCK, COPY, ADD, MEAN, APPLY, CONV, RESIZE, SAMPLE, TO_IMAGE, DISTANCE,
 POOL) = range(13)  # fmt: skip
NOTHING, GELU, RELU = range(3)  # what follows a product
COPY_AXES = 5
Axes = Sequence[tuple[int, int, int]]  # sizes, and the strides of reading and of writing


class NoProgramError(Exception):
    """The model has a part that is no instruction."""

    # No TypeError: torch's `x + y` would take that for an operand that it does not support.


class Slot(NamedTuple):
    """Numbers that instructions read or write: an input or a buffer."""

    is_buffer: bool
    number: int
    shape: tuple[int, ...]  # of one image

    @property
    def key(self) -> tuple[bool, int]:
        """What tells it from other slots."""
        return self.is_buffer, self.number

    @property
    def rows(self) -> int:
        """The number of tokens."""
        return self.numbers // self.shape[-1]

    @property
    def numbers(self) -> int:
        """The count of numbers of one image."""
        return torch.Size(self.shape).numel()


class Weights:
    """Packed weights, one after the other in one tensor. The programs of a model share them."""

    def __init__(self) -> None:
        self._pieces: list[Tensor] = []
        self._offsets: dict[int, int] = {}
        self._count = 0
        self._convs: dict[tuple[int, int], tuple[Tensor, Tensor | None, Tensor]] = {}
        self._words = torch.zeros(0, dtype=torch.int32)

    def of_conv(self, weight: Tensor, bias: Tensor | None) -> Tensor:
        """The packed words of a convolution, the inner order of whose depth is (y, x, channel)."""
        key = id(weight), id(bias)
        if key not in self._convs:
            rows = weight.permute(0, 2, 3, 1).flatten(1)
            self._convs[key] = weight, bias, pack(rows, bias)  # kept, so the ids stay theirs
        return self._convs[key][-1]

    def offset(self, piece: Tensor) -> int:
        """The place of packed words of 32 bits, which are added if they are new."""
        if id(piece) not in self._offsets:
            self._offsets[id(piece)] = self._count
            self._pieces.append(piece)
            self._count += piece.numel()
        return self._offsets[id(piece)]

    @property
    def words(self) -> Tensor:
        """All words, (K,) int32. The pieces become views of them, so they take no memory twice."""
        if len(self._words) != self._count:
            self._words = torch.cat([piece.flatten().view(torch.int32) for piece in self._pieces])
            for piece in self._pieces:
                storage, place = self._words.untyped_storage(), self._offsets[id(piece)]
                piece.set_(storage, place, piece.shape, piece.stride())
        return self._words


@dataclass
class Step:
    """An instruction. Its arguments that are slots are what it reads and `out`.

    If there is a `base`, the instruction changes numbers in place: those of the slot `base`, of
    which `out` is the new name.
    """

    opcode: int
    out: Slot
    reads: Sequence[Slot]
    arguments: Sequence[Any]
    base: Slot | None = None


class Checked:
    """A program that is checked once, on its weights, (K,) int32: inputs → outputs.

    Raises:
        ValueError: the program does not fit its weights.
    """

    def __init__(self, weights: Tensor, words: Sequence[int]):
        number = _NETWORK(weights, words)
        self._run = partial(_RUN, network=number)
        weakref.finalize(self, _FORGET, number)

    def __call__(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        return self._run(inputs)


class Program:
    """Instructions, written one after the other. Maps are channels last.

    Each instruction writes a slot of its own. `words` lets it take the memory of the slot that it
    changes, if nobody reads that any more.
    """

    def __init__(self, weights: Weights):
        self.weights = weights
        self._inputs: list[Slot] = []
        self._buffers: list[Slot] = []
        self._outputs: list[Slot] = []
        self._steps: list[Step] = []

    def input(self, *shape: int) -> Slot:
        """The next input, of this shape for one image."""
        self._inputs.append(Slot(False, len(self._inputs), shape))
        return self._inputs[-1]

    def buffer(self, *shape: int) -> Slot:
        """A new buffer."""
        self._buffers.append(Slot(True, len(self._buffers), shape))
        return self._buffers[-1]

    def output(self, slot: Slot) -> None:
        """Makes the numbers of a slot the next output, in its shape."""
        if not slot.is_buffer or slot.key in {output.key for output in self._outputs}:
            slot = self.copy(slot, self.buffer(*slot.shape), [(slot.numbers, 1, 1)])
        self._outputs.append(slot)

    def checked(self) -> Checked:
        """The program, ready to run."""
        return Checked(self.weights.words, self.words())

    def words(self) -> list[int]:
        """The program as one array of integers."""
        steps, place = self._in_place()
        numbers = {slot.key: k for k, slot in enumerate(self._inputs)}
        used = [slot for slot in self._buffers if place.get(slot.key, slot.key) == slot.key]
        numbers |= {slot.key: len(self._inputs) + k for k, slot in enumerate(used)}
        buffer = {slot.key: k for k, slot in enumerate(used)}

        def number(slot: Slot) -> int:
            return numbers[place.get(slot.key, slot.key)]

        words = [len(self._inputs), *(slot.numbers for slot in self._inputs)]
        words += [len(used), *(slot.numbers for slot in used), len(self._outputs)]
        for output in self._outputs:
            words += [buffer[place.get(output.key, output.key)], len(output.shape), *output.shape]
        for step in steps:
            arguments = [number(a) if isinstance(a, Slot) else int(a) for a in step.arguments]
            words += [step.opcode, len(arguments), *arguments]
        return words

    def _in_place(self) -> tuple[list[Step], dict[tuple[bool, int], tuple[bool, int]]]:
        """The steps, of which those with a `base` change it in place or a copy of it; and the
        buffer whose memory a buffer takes."""
        last = {slot.key: k for k, step in enumerate(self._steps) for slot in step.reads}
        last |= {slot.key: len(self._steps) for slot in self._outputs}
        steps: list[Step] = []
        place: dict[tuple[bool, int], tuple[bool, int]] = {}
        for k, step in enumerate(self._steps):
            base, free = step.base, step.base is not None and last[step.base.key] == k
            if step.opcode == ADD:
                base, other = step.reads
                # What the last step wrote is still in the cache: a convolution adds to its result.
                is_newest = k > 0 and self._steps[k - 1].out.key == other.key
                if (is_newest and last[other.key] == k) or not (base.is_buffer and free):
                    base, other = other, base
                free = last[base.key] == k and base.key != other.key
                step = replace(step, base=base, arguments=(other, step.out))
            if base is not None and base.is_buffer and free:
                place[step.out.key] = place.get(base.key, base.key)
            elif base is not None and step.opcode != NORM:
                steps.append(_copy(base, step.out, [(base.numbers, 1, 1)]))
            steps.append(step)
        return steps, place

    def _step(
        self, opcode: int, out: Slot, reads: Sequence[Slot], *arguments: Any,
        base: Slot | None = None,
    ) -> Slot:  # fmt: skip
        self._steps.append(Step(opcode, out, reads, arguments, base))
        return out

    def linear(self, x: Slot, layer: OwnLinear) -> Slot:
        """A linear layer, with its norm and its GELU if it has them."""
        out = self.buffer(*x.shape[:-1], layer.columns)
        norm = -1 if layer.norm is None else self._norm_offset(layer.norm)
        return self._step(
            LINEAR, out, [x], x, out, x.rows, x.shape[-1], layer.columns,
            *self._layer(layer.packed), norm, layer.gelu,
        )  # fmt: skip

    def norm(self, x: Slot, norm: OwnNorm) -> Slot:
        """A layer norm of tokens as wide as the norm."""
        out, dim = self.buffer(*x.shape), norm.parameters.shape[1]
        offset = self._norm_offset(norm)
        return self._step(NORM, out, [x], x, out, x.numbers // dim, dim, offset, base=x)

    def _layer(self, packed: Tensor) -> tuple[int, bool]:
        """The place of a packed layer, and whether it is quantized."""
        return self.weights.offset(packed), packed.dtype == torch.int32

    def _norm_offset(self, norm: OwnNorm) -> int:
        return self.weights.offset(norm.words)

    def blocks(self, x: Slot, blocks: PackedBlocks, tables: Sequence[Slot]) -> Slot:
        """The blocks of a stage."""
        (rings, sectors, dim), out = x.shape, self.buffer(*x.shape)
        base: Slot | None = x
        steps = zip(blocks.layers, blocks.windows, tables, strict=True)
        for (norm1, qkv, proj, norm2, fc1, fc2), windows, table in steps:
            self._step(
                BLOCK, out, [x if base else out, table], out, rings, sectors, dim, blocks.heads,
                blocks.mlp_dim, self._norm_offset(norm1), *self._layer(qkv), *self._layer(proj),
                self._norm_offset(norm2), *self._layer(fc1), *self._layer(fc2), *windows, table,
                base=base,
            )  # fmt: skip
            base = None
        return out

    def copy(self, x: Slot, out: Slot, axes: Axes, begin: int = 0, to: int = 0) -> Slot:
        """Copies an array of up to five axes; `begin` and `to` are where reading and writing
        begin."""
        self._steps.append(_copy(x, out, axes, begin, to))
        return out

    def added(self, x: Slot, y: Slot) -> Slot:
        """The sum of two slots."""
        out = self.buffer(*x.shape)
        return self._step(ADD, out, [x, y], y, out, base=x)

    def mean(self, x: Slot) -> Slot:
        """The mean of the tokens."""
        out = self.buffer(x.shape[-1])
        return self._step(MEAN, out, [x], x, out, x.rows, x.shape[-1])

    def apply(self, x: Slot, function: int) -> Slot:
        """The GELU or the ReLU."""
        out = self.buffer(*x.shape)
        return self._step(APPLY, out, [x], out, function, base=x)

    def pooled(self, x: Slot) -> Slot:
        """The largest numbers of 2 × 2 pixels, also of fewer at the ends."""
        height, width, channels = x.shape
        out = self.buffer(-(-height // 2), -(-width // 2), channels)
        return self._step(POOL, out, [x], x, out, height, width, channels)

    def conv(self, x: Slot, weight: Tensor, bias: Tensor | None) -> Slot:
        """A convolution of 3 × 3."""
        (height, width, channels), columns = x.shape, weight.shape[0]
        out, packed = self.buffer(height, width, columns), self.weights.of_conv(weight, bias)
        return self._step(
            CONV, out, [x], x, out, height, width, channels, columns, self.weights.offset(packed),
            NOTHING,
        )  # fmt: skip

    def resized(self, x: Slot, size: Sequence[int]) -> Slot:
        """A map in another size, bilinearly, as `F.interpolate`."""
        height, width, channels = x.shape
        out = self.buffer(*size, channels)
        return self._step(RESIZE, out, [x], x, out, height, width, *size, channels)

    def sampled(self, x: Slot, points: Slot) -> Slot:
        """A map at points (H', W', 2) between its pixels, 0 outside."""
        (height, width, channels), size = x.shape, points.shape[:2]
        out = self.buffer(*size, channels)
        return self._step(SAMPLE, out, [x, points], x, out, height, width, *size, channels, points)

    def to_image(self, x: Slot, plan: Slot) -> Slot:
        """A polar map at the pixels of the images, by a plan (H, 3, W)."""
        height, _, width = plan.shape
        out = self.buffer(height, width, x.shape[-1])
        return self._step(TO_IMAGE, out, [x, plan], x, out, *x.shape, height, width, plan)

    def distance(self, x: Slot, typical: float) -> Slot:
        """The distances of a `DistanceHead`."""
        bits, out = struct.unpack("<i", struct.pack("<f", typical)), self.buffer(*x.shape)
        return self._step(DISTANCE, out, [x], out, *bits, base=x)


def _copy(x: Slot, out: Slot, axes: Axes, begin: int = 0, to: int = 0) -> Step:
    """The step of `Program.copy`."""
    if len(axes) > COPY_AXES:
        raise NoProgramError(f"a copy with {len(axes)} axes is no instruction")
    padded = [(1, 0, 0)] * (COPY_AXES - len(axes)) + list(axes)
    places = chain.from_iterable(zip(*padded, strict=True))
    return Step(COPY, out, [x], (x, out, begin, to, *places))
