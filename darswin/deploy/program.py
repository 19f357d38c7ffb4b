"""Programs of whole networks: the instructions of csrc/core/network.h, from the layers of an
optimized model."""

import struct
from collections.abc import Sequence
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from darswin.deploy.fast import FastEmbed, FastLayer, FastMerging, FastStage
from darswin.deploy.packed import InDtype, OwnBlocks, OwnLinear, OwnNorm, pack
from darswin.layers.embed import PatchEmbed
from darswin.models.encoder import Encoder
from darswin.models.pixel import PixelHead
from darswin.models.unet import PatchExpand, Unet

LINEAR, NORM, BLOCK, COPY, ADD, MEAN, GELU, CONV, RESIZE, SAMPLE, TO_IMAGE, DISTANCE = range(12)
_NOTHING, _GELU, _ADD = range(3)  # what follows a product


class NoProgramError(TypeError):
    """The model has a part that is no instruction."""


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
            self._offsets[id(piece)] = self._count
            self._pieces.append(piece)
            self._count += piece.numel()
        return self._offsets[id(piece)]

    def join(self) -> Tensor:
        """All words, (K,) int32. The pieces become views of them, so they take no memory twice."""
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

    def blocks(self, x: Slot, blocks: OwnBlocks, tables: Sequence[Slot]) -> None:
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
    ) -> Slot:
        """Copies an array of up to five axes between places with these strides; `to` is where
        writing begins."""
        axes = zip(sizes, reads, writes, strict=True)
        padded = [(1, 0, 0)] * (5 - len(sizes)) + list(axes)
        self._step(COPY, x, out, 0, to, *chain.from_iterable(zip(*padded, strict=True)))
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
        """A convolution of 3 × 3; after `_ADD` it is added to `out`."""
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


def own(layer: Any, kind: type) -> Any:
    """The layer of our own in an optimized layer."""
    if isinstance(layer, FastLayer):
        layer = layer.layer
    if not isinstance(layer, kind):
        raise NoProgramError(f"{type(layer).__name__} is no instruction of a network's program")
    return layer


def embedded(program: Program, embed: nn.Module, x: Slot) -> Slot:
    """What the view sees → the first map."""
    if isinstance(embed, FastEmbed):
        return program.norm(program.linear(x, own(embed.proj, OwnLinear)), own(embed.norm, OwnNorm))
    if not (isinstance(embed, InDtype) and isinstance(embed.module, PatchEmbed)):
        raise NoProgramError(f"{type(embed).__name__} is no instruction of a network's program")
    conv, (channels, height, width) = embed.module.proj, x.shape
    side = conv.kernel_size[0]
    rows, columns = height // side, width // side
    patches = program.permuted(
        x, (channels, rows, side, columns, side), (1, 3, 0, 2, 4), rows, columns,
        channels * side * side,
    )  # fmt: skip
    layer = OwnLinear(pack(conv.weight.flatten(1), conv.bias), conv.out_channels)
    return program.norm(program.linear(patches, layer), OwnNorm(embed.module.norm))


def stage(program: Program, layer: nn.Module, x: Slot, tables: Sequence[Slot]) -> Slot:
    """The map of the previous stage → the map of this one."""
    if not isinstance(layer, FastStage):
        raise NoProgramError(f"{type(layer).__name__} is no instruction of a network's program")
    if isinstance(layer.downsample, FastMerging):
        rings, sectors, dim = x.shape
        mr, ma = layer.downsample.merge
        x = program.permuted(
            x, (rings // mr, mr, sectors // ma, ma, dim), (0, 2, 3, 1, 4),
            rings // mr, sectors // ma, mr * ma * dim,
        )  # fmt: skip
        x = program.linear(x, own(layer.downsample.product, OwnLinear))
    elif not isinstance(layer.downsample, nn.Identity):
        raise NoProgramError(f"{type(layer.downsample).__name__} is no instruction of a program")
    program.blocks(x, own(layer.blocks, OwnBlocks), tables)
    return x


def encoder_maps(
    program: Program, encoder: Encoder, x: Slot, tables: Sequence[Sequence[Slot]]
) -> list[Slot]:
    """The maps after each stage, as `Encoder.maps`. The stages change no earlier map."""
    x = embedded(program, encoder.patch_embed, x)
    maps = []
    for layer, of_stage in zip(encoder.stages, tables, strict=False):
        x = stage(program, layer, x, of_stage)
        maps.append(x)
    return maps


def expanded(program: Program, x: Slot, layer: PatchExpand, after: Any = None) -> Slot:
    """Tokens split as in `PatchExpand`, each followed by a linear layer if one is given."""
    rings, sectors, _ = x.shape
    mr, ma = layer.split
    x = program.linear(x, own(layer.expansion, OwnLinear))
    x = x._replace(shape=(rings * sectors * ma * mr, layer.out_dim))
    x = program.norm(x, own(layer.norm, OwnNorm))
    if after is not None:
        x = program.linear(x, own(after, OwnLinear))
    width = x.shape[-1]
    return program.permuted(
        x, (rings, sectors, ma, mr, width), (0, 3, 1, 2, 4), rings * mr, sectors * ma, width
    )


def carried(
    program: Program, unet: Unet, x: Slot, tables: Sequence[Sequence[Slot]], places: Sequence[Slot]
) -> Slot:
    """What the view sees → the channels that are resampled to the pixels."""
    encoder, decoder, head = unet.encoder, unet.decoder, unet.head
    maps = encoder_maps(program, encoder, x, tables)
    maps[-1] = program.norm(maps[-1], own(encoder.norm, OwnNorm), program.buffer(*maps[-1].shape))
    for slot, place in zip(maps, places, strict=bool(places)):
        program.added(place, slot)
    x, of_decoder = maps[-1], tables[len(maps) :]
    joins: list[Any] = list(decoder.joins)
    steps = zip(joins, decoder.stages, maps[:-1], of_decoder, strict=True)
    for join, layer, skip, of_stage in reversed(list(steps)):
        x = program.joined(expanded(program, x, join.expand), skip)
        x = stage(program, layer, program.linear(x, own(join.fuse, OwnLinear)), of_stage)
    return expanded(program, x, decoder.expand, head.carry if head.skip_width else head.proj)


def refined(program: Program, head: PixelHead, x: Slot, images: Slot | None) -> Slot:
    """As `PixelHead.refine`, channels last."""
    if images is None:
        return x
    skip = program.conv(images, _conv(head.stem), _NOTHING)
    x = program.gelu(program.added(x, skip))
    x = program.added(program.conv(x, _conv(head.mix), _GELU), x)
    return program.linear(x, own(head.proj, OwnLinear))


def _conv(layer: Any) -> nn.Conv2d:
    if not (isinstance(layer, InDtype) and isinstance(layer.module, nn.Conv2d)):
        raise NoProgramError(f"{type(layer).__name__} is no instruction of a network's program")
    return layer.module
