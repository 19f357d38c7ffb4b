"""Programs of networks: the instructions of csrc/core/network.h."""

import struct
from collections.abc import Sequence
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from darswin.deploy.own import OwnLinear, OwnNorm, PackedBlocks, own_operator, pack

RUN = own_operator("_run")

LINEAR, NORM, BLOCK, COPY, ADD, MEAN, GELU, CONV, RESIZE, SAMPLE, TO_IMAGE, DISTANCE = range(12)
NOTHING, AND_GELU, AND_ADD = range(3)  # what follows a product


class Slot(NamedTuple):
    """Numbers that instructions read or write: an input or a buffer."""

    is_buffer: bool
    number: int
    shape: tuple[int, ...]  # of one image

    @property
    def rows(self) -> int:
        """The number of tokens."""
        return self.numbers // self.shape[-1]

    @property
    def numbers(self) -> int:
        """The count of numbers of one image."""
        return torch.Size(self.shape).numel()


class Weights:
    """Packed weights, one after the other in one tensor. Programs share them."""

    def __init__(self) -> None:
        self._pieces: list[Tensor] = []
        self._offsets: dict[int, int] = {}
        self._count = 0
        self._convs: dict[int, Tensor] = {}

    def of_conv(self, layer: nn.Conv2d) -> Tensor:
        """The packed words of a convolution, the inner order of whose depth is (y, x, channel)."""
        if id(layer) not in self._convs:
            rows = layer.weight.permute(0, 2, 3, 1).flatten(1)
            self._convs[id(layer)] = pack(rows, layer.bias)
        return self._convs[id(layer)]

    def offset(self, piece: Tensor) -> int:
        """The place of packed words of 32 bits, which are added if they are new."""
        if id(piece) not in self._offsets:
            assert "words" not in vars(self), "a piece is new to weights that are joined already"
            self._offsets[id(piece)] = self._count
            self._pieces.append(piece)
            self._count += piece.numel()
        return self._offsets[id(piece)]

    @cached_property
    def words(self) -> Tensor:
        """All words, (K,) int32. Nothing new is added after. The pieces become views of them, so
        they take no memory twice."""
        pieces = [piece.flatten().view(torch.int32) for piece in self._pieces]
        words = torch.cat(pieces)
        for piece in self._pieces:
            place = self._offsets[id(piece)]
            piece.set_(words.untyped_storage(), place, piece.shape, piece.stride())
        return words


class Program:
    """Instructions, written one after the other. Maps are channels last."""

    def __init__(self, weights: Weights):
        self.weights = weights
        self._inputs: list[Slot] = []
        self._buffers: list[Slot] = []
        self._outputs: list[Slot] = []
        self._steps: list[tuple[int, tuple]] = []

    def input(self, *shape: int) -> Slot:
        """The next input, of this shape for one image."""
        self._inputs.append(Slot(False, len(self._inputs), shape))
        return self._inputs[-1]

    def buffer(self, *shape: int) -> Slot:
        """A new buffer."""
        self._buffers.append(Slot(True, len(self._buffers), shape))
        return self._buffers[-1]

    def output(self, slot: Slot) -> None:
        """Makes a buffer the next output."""
        self._outputs.append(slot)

    def words(self) -> list[int]:
        """The program as one array of integers."""
        head = [slot.numbers for slot in self._inputs], [slot.numbers for slot in self._buffers]
        words = [len(head[0]), *head[0], len(head[1]), *head[1], len(self._outputs)]
        for output in self._outputs:
            words += [output.number, len(output.shape), *output.shape]
        for opcode, arguments in self._steps:
            numbers = [
                len(self._inputs) * a.is_buffer + a.number if isinstance(a, Slot) else int(a)
                for a in arguments
            ]
            words += [opcode, len(numbers), *numbers]
        return words

    def _step(self, opcode: int, *arguments: Any) -> None:
        self._steps.append((opcode, arguments))

    def linear(self, x: Slot, layer: OwnLinear) -> Slot:
        """A linear layer, with its norm and its GELU if it has them."""
        out = self.buffer(*x.shape[:-1], layer.columns)
        norm = -1 if layer.norm is None else self._norm_offset(layer.norm)
        self._step(
            LINEAR, x, out, x.rows, x.shape[-1], layer.columns, *self._layer(layer.packed), norm,
            layer.gelu,
        )  # fmt: skip
        return out

    def norm(self, x: Slot, norm: OwnNorm, out: Slot | None = None) -> Slot:
        """A layer norm of tokens as wide as the norm, in place unless `out` is given."""
        out, dim = out or x, norm.parameters.shape[1]
        self._step(NORM, x, out, x.numbers // dim, dim, self._norm_offset(norm))
        return out

    def _layer(self, packed: Tensor) -> tuple[int, bool]:
        """The place of a packed layer, and whether it is quantized."""
        return self.weights.offset(packed), packed.dtype == torch.int32

    def _norm_offset(self, norm: OwnNorm) -> int:
        return self.weights.offset(norm.words)

    def blocks(self, x: Slot, blocks: PackedBlocks, tables: Sequence[Slot]) -> None:
        """The blocks of a stage, in place."""
        rings, sectors, dim = x.shape
        steps = zip(blocks.layers, blocks.windows, tables, strict=True)
        for (norm1, qkv, proj, norm2, fc1, fc2), windows, table in steps:
            self._step(
                BLOCK, x, rings, sectors, dim, blocks.heads, blocks.mlp_dim,
                self._norm_offset(norm1), *self._layer(qkv), *self._layer(proj),
                self._norm_offset(norm2), *self._layer(fc1), *self._layer(fc2), *windows, table,
            )  # fmt: skip

    def copy(
        self,
        x: Slot,
        out: Slot,
        sizes: Sequence[int],
        reads: Sequence[int],
        writes: Sequence[int],
        to: int = 0,
        begin: int = 0,
    ) -> Slot:
        """Copies an array of up to five axes between places with these strides; `begin` and `to`
        are where reading and writing begin."""
        axes = zip(sizes, reads, writes, strict=True)
        padded = [(1, 0, 0)] * (5 - len(sizes)) + list(axes)
        self._step(COPY, x, out, begin, to, *chain.from_iterable(zip(*padded, strict=True)))
        return out

    def permuted(self, x: Slot, sizes: Sequence[int], order: Sequence[int], *shape: int) -> Slot:
        """The axes of x, which has these sizes, in another order, as a new buffer of a shape."""
        reads, writes = (
            _strides(sizes),
            dict(zip(order, _strides([sizes[axis] for axis in order]), strict=True)),
        )
        moved = [sizes[axis] for axis in order]
        return self.copy(
            x, self.buffer(*shape), moved, [reads[axis] for axis in order],
            [writes[axis] for axis in order],
        )  # fmt: skip

    def joined(self, *maps: Slot) -> Slot:
        """Maps of the same tokens, side by side."""
        width = sum(x.shape[-1] for x in maps)
        out, begin = self.buffer(*maps[0].shape[:-1], width), 0
        for x in maps:
            own = x.shape[-1]
            self.copy(x, out, (x.rows, own), (own, 1), (width, 1), begin)
            begin += own
        return out

    def around(self, x: Slot) -> Slot:
        """A map with its last column before its first, and its first after its last."""
        rows, columns, channels = x.shape
        out = self.buffer(rows, columns + 2, channels)
        reads, writes = (columns * channels, 1), ((columns + 2) * channels, 1)
        last = (columns - 1) * channels
        self.copy(x, out, (rows, columns * channels), reads, writes, channels)
        self.copy(x, out, (rows, channels), reads, writes, 0, begin=last)
        return self.copy(x, out, (rows, channels), reads, writes, last + 2 * channels)

    def channels_last(self, *images: Slot) -> Slot:
        """Images (C, H, W) of the same size, joined to one map (H, W, C)."""
        width, (_, rows, columns) = sum(x.shape[0] for x in images), images[0].shape
        out, begin, pixels = self.buffer(rows, columns, width), 0, rows * columns
        for x in images:
            self.copy(x, out, (pixels, x.shape[0]), (1, pixels), (width, 1), begin)
            begin += x.shape[0]
        return out

    def channels_first(self, x: Slot) -> Slot:
        """A map (H, W, C) as (C, H, W)."""
        return self.permuted(x, x.shape, (2, 0, 1), x.shape[2], *x.shape[:2])

    def added(self, x: Slot, to: Slot) -> Slot:
        """Adds x to a buffer."""
        self._step(ADD, x, to)
        return to

    def mean(self, x: Slot) -> Slot:
        """The mean of the tokens."""
        out = self.buffer(x.shape[-1])
        self._step(MEAN, x, out, x.rows, x.shape[-1])
        return out

    def gelu(self, x: Slot) -> Slot:
        """The GELU, in place."""
        self._step(GELU, x)
        return x

    def conv(self, x: Slot, layer: nn.Conv2d, after: int, out: Slot | None = None) -> Slot:
        """A convolution of 3 × 3; after `AND_ADD` it is added to `out`."""
        height, width, channels = x.shape
        out = out or self.buffer(height, width, layer.out_channels)
        self._step(
            CONV, x, out, height, width, channels, layer.out_channels,
            self.weights.offset(self.weights.of_conv(layer)), after,
        )  # fmt: skip
        return out

    def resized(self, x: Slot, size: Sequence[int]) -> Slot:
        """A map in another size, bilinearly, as `F.interpolate`."""
        height, width, channels = x.shape
        if (height, width) == tuple(size):
            return x
        out = self.buffer(*size, channels)
        self._step(RESIZE, x, out, height, width, *size, channels)
        return out

    def sampled(self, x: Slot, points: Slot) -> Slot:
        """A map at points (H', W', 2) between its pixels, 0 outside."""
        height, width, channels = x.shape
        out = self.buffer(*points.shape[:2], channels)
        self._step(SAMPLE, x, out, height, width, *points.shape[:2], channels, points)
        return out

    def to_image(self, x: Slot, plan: Slot) -> Slot:
        """A polar map at the pixels of the images, by a plan (H, 3, W)."""
        height, _, width = plan.shape
        out = self.buffer(height, width, x.shape[-1])
        self._step(TO_IMAGE, x, out, *x.shape, height, width, plan)
        return out

    def distance(self, x: Slot, typical: float) -> Slot:
        """The distances of a `DistanceHead`, in place."""
        self._step(DISTANCE, x, *struct.unpack("<i", struct.pack("<f", typical)))
        return x


def _strides(sizes: Sequence[int]) -> list[int]:
    strides = [1]
    for size in reversed(sizes[1:]):
        strides.insert(0, strides[0] * size)
    return strides
