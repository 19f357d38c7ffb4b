"""Whole models as programs: the forward of `optimize` and of `darswin.frames.Network`."""

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from darswin.deploy.fast import FastEmbed, FastLayer, FastMerging, FastPatchEmbed, FastStage
from darswin.deploy.own import OwnLinear, OwnNorm, pack
from darswin.deploy.packed import InDtype, OwnBlocks, refuse_gradients
from darswin.deploy.program import AND_GELU, NOTHING, RUN, Program, Slot, Weights
from darswin.lens.pixels import OUTSIDE
from darswin.models.base import Model
from darswin.models.encoder import Encoder, FeatureMaps
from darswin.models.pixel import RAYS, DistanceHead, PixelHead
from darswin.models.prepared import Prepared
from darswin.models.unet import PatchExpand, Unet
from darswin.views import PolarView
from darswin.views.base import Pair

Run = Callable[[Tensor, Prepared, Tensor | None], Any]


class NoProgramError(TypeError):
    """The model has a part that is no instruction."""


def compiled(model: Model) -> Run | None:
    """The forward of an optimized model as programs, called as `forward_network`; None if the model
    has a part that is no instruction of a program."""
    try:
        return _UnetRun(model) if isinstance(model, Unet) else _EncoderRun(model)
    except NoProgramError:
        return None


class _EncoderRun:
    """An encoder, or the maps of a backbone."""

    def __init__(self, model: Model):
        weights = Weights()
        program = Program(weights)
        seen = program.input(*_seen(model))
        tables = _tables(program, model)
        for slot in _results(program, model, seen, tables):
            program.output(slot)
        _share(model, weights)
        self.words, self.weights = program.words(), weights.words
        self.is_list = isinstance(model, FeatureMaps)

    def __call__(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Any:
        refuse_gradients(x)
        outputs = RUN([x.float(), *chain(*prepared.tables)], self.weights, self.words)
        return outputs if self.is_list else outputs[0]


class _UnetRun:
    """A Unet: the maps, the way back to the pixels by the view, and the head."""

    def __init__(self, unet: Unet):
        self.unet = unet
        self.shared = Weights()
        program = Program(self.shared)
        seen = program.input(*_seen(unet))
        self.places = _place_layers(unet)
        tables, places = _tables(program, unet), _places(program, unet)
        x = carried(program, unet, seen, tables, places)
        if unet.view.in_pixels:
            x = _refined_view(program, unet, x, seen, _rays(program, unet, seen.shape[1:]))
        program.output(x)
        self.words = program.words()
        self.heads: dict[Pair, list[int]] = {}  # the program of the head, by the size of the images
        if unet.refines_with_images:
            self._of_head((4, 4))  # its weights
        _share(unet, self.shared)
        self.weights = self.shared.words

    def _of_head(self, size: Pair) -> list[int]:
        if size not in self.heads:
            unet, program = self.unet, Program(self.shared)
            x = program.input(*size, unet.head.skip_width)
            images = program.input(unet.in_chans, *size)
            rays = _rays(program, unet, size)
            program.output(refined(program, unet.head, x, program.channels_last(images, *rays)))
            self.heads[size] = program.words()
        return self.heads[size]

    def __call__(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Tensor:
        refuse_gradients(x)
        unet, view = self.unet, self.unet.view
        rays = [] if prepared.rays is None else [prepared.rays.float()]
        inputs = [x.float(), *chain(*prepared.tables), *_place_maps(self.places, prepared)]
        if view.in_pixels:
            (logits,) = RUN([*inputs, *rays], self.weights, self.words)
            pixels = view.back(logits.permute(0, 3, 1, 2), prepared.view)
            return unet.head.finish(pixels, prepared.view.shown)
        (maps,) = RUN(inputs, self.weights, self.words)
        pixels = view.back(maps, prepared.view)
        if unet.refines_with_images:
            assert images is not None
            images = view.floating(images, torch.float32)
            refuse_gradients(images)
            given = [pixels.permute(0, 2, 3, 1), images.float(), *rays]
            (logits,) = RUN(given, self.weights, self._of_head(prepared.view.size))
            pixels = logits.permute(0, 3, 1, 2)
        return unet.head.finish(pixels, prepared.view.shown)


def _share(model: Model, weights: Weights) -> None:
    """Lets the stages, which are called alone too, use the weights of the whole model."""
    for stage in model.stages:
        own(stage.blocks, OwnBlocks).weights = weights


class FrameProgram(NamedTuple):
    """A program for frames of one camera."""

    words: list[int]
    weights: Tensor  # (K,) int32
    constants: list[Tensor]  # float32, without the batch: all inputs but the sampled ones
    reads_frame: bool  # input 1 is the frame itself, (H, W, C) and normalized
    is_classifier: bool  # the output is logits of classes


def frame_program(model: Model, prepared: Prepared) -> FrameProgram:
    """The program of an optimized model for one lens and one size.

    Input 0 is what the view sees. The outputs are the logits, the maps, or the pixels (K, H, W).

    Raises:
        NoProgramError: the model has a part that is no instruction of a program.
    """
    program, constants = Program(Weights()), list(chain(*prepared.tables))
    seen = program.input(*_seen(model))
    reads_frame = isinstance(model, Unet) and model.refines_with_images
    if reads_frame:
        frame = program.input(*prepared.view.size, _channels(model))
    tables = _tables(program, model)
    if not isinstance(model, Unet):
        results = _results(program, model, seen, tables)
    else:
        places = _places(program, model)
        constants += _place_maps(_place_layers(model), prepared)
        if prepared.rays is not None:
            constants.append(prepared.rays)
        of_rays = prepared.view.size if reads_frame else seen.shape[1:]
        rays = _rays(program, model, of_rays)
        x = carried(program, model, seen, tables, places)
        if model.view.in_pixels:
            x = _refined_view(program, model, x, seen, rays)
        x = _back(program, model.view, x, prepared.view, constants)
        if reads_frame:
            pixels = program.joined(frame, *(program.channels_last(of) for of in rays))
            x = refined(program, model.head, x, pixels)
        if isinstance(model.head, DistanceHead):
            x = program.distance(x, model.head.typical_distance)
            x = _shown_alone(program, x, prepared.view, constants)
        results = [program.channels_first(x)]
    for slot in results:
        program.output(slot)
    constants = [one.detach().float()[0].contiguous() for one in constants]
    classifier = isinstance(model, Encoder) and model.num_classes > 0
    return FrameProgram(program.words(), program.weights.words, constants, reads_frame, classifier)


def _refined_view(program: Program, unet: Unet, x: Slot, seen: Slot, rays: Sequence[Slot]) -> Slot:
    """The carried channels → the logits of the pixels of the view."""
    x = program.resized(x, seen.shape[1:])
    pixels = program.channels_last(seen, *rays) if unet.head.skip_width else None
    return refined(program, unet.head, x, pixels)


def _back(program: Program, view: Any, x: Slot, prepared: Any, constants: list[Tensor]) -> Slot:
    """A map of the network → the pixels of the images."""
    back = prepared.back
    if isinstance(view, PolarView):
        assert back.plan is not None
        constants.append(back.plan)
        return program.to_image(x, program.input(*back.plan.shape[1:]))
    if back is None:
        return program.resized(x, prepared.size)
    points = view.back_points(prepared, x.shape[:2])
    constants.append(points)
    if prepared.around is not None:
        x = program.around(x)
    return program.sampled(x, program.input(*points.shape[1:]))


def _shown_alone(program: Program, x: Slot, prepared: Any, constants: list[Tensor]) -> Slot:
    """A map of the pixels of the images with 0 where the view shows nothing."""
    shown = prepared.shown
    if shown is None or shown.all():
        return x
    rows, columns = torch.meshgrid(*map(torch.arange, prepared.size), indexing="ij")
    pixels = torch.stack((columns, rows), -1)  # read where they are, or outside
    constants.append(torch.where(shown[..., None], pixels, OUTSIDE))
    return program.sampled(x, program.input(*pixels.shape))


def _results(
    program: Program, model: Any, seen: Slot, tables: Sequence[Sequence[Slot]]
) -> list[Slot]:
    """The logits or the mean features of an encoder, or the maps of a backbone."""
    if isinstance(model, FeatureMaps):
        maps = encoder_maps(program, model.encoder, seen, tables)
        chosen = [maps[k] for k in model.out_indices]
        return [program.channels_first(x) if model.output_fmt == "NCHW" else x for x in chosen]
    x = encoder_maps(program, model, seen, tables)[-1]
    if not isinstance(model.norm, torch.nn.Identity):
        x = program.norm(x, own(model.norm, OwnNorm))
    x = program.mean(x)
    return [program.linear(x, own(model.head, OwnLinear)) if model.num_classes else x]


def _channels(model: Model) -> int:
    if model.in_chans is None:
        raise NoProgramError("the model takes any number of channels")
    return model.in_chans


def _seen(model: Model) -> tuple[int, ...]:
    """The shape of what the view sees of one image."""
    if not isinstance(model, (Encoder, FeatureMaps, Unet)):
        raise NoProgramError(f"{type(model).__name__} is no program")
    view: Any = model.view
    channels = _channels(model)
    if isinstance(view, PolarView):
        if not view.in_pixels:
            return (*view.map_size, view.samples[0] * view.samples[1] * channels)
        return (channels, *view.map_size)
    size: Any = view.size or model.image_size
    return (channels, *size)


def _tables(program: Program, model: Model) -> list[list[Slot]]:
    """Inputs for the position biases of the stages."""
    tables = []
    for stage in model.stages:
        blocks = own(stage.blocks, OwnBlocks)
        tables.append([program.input(*shape) for shape in blocks.table_shapes])
    return tables


def _rays(program: Program, unet: Unet, size: Sequence[int]) -> list[Slot]:
    """An input for the viewing directions of pixels, if the network reads them."""
    return [program.input(RAYS, *size)] if unet.reads_rays else []


def _places(program: Program, unet: Unet) -> list[Slot]:
    """Inputs for what the positions of tokens add to the encoder's maps."""
    sizes = zip(unet.token_maps, unet.feature_info.channels(), strict=bool(unet.places))
    return [program.input(*size, width) for size, width in sizes]


def _place_layers(unet: Unet) -> list[OwnLinear]:
    layers: list[Any] = list(unet.places)
    return [OwnLinear(pack(layer.weight, layer.bias), layer.out_features) for layer in layers]


def _place_maps(layers: Sequence[OwnLinear], prepared: Prepared) -> list[Tensor]:
    """The inputs of `_places`. No layer of torch computes them: see `TorchThreads` in csrc."""
    steps = zip(layers, prepared.tokens, strict=bool(layers))
    return [layer(place.float()) for layer, place in steps]


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
    if not isinstance(embed, FastPatchEmbed):
        raise NoProgramError(f"{type(embed).__name__} is no instruction of a network's program")
    (channels, height, width), side = x.shape, embed.patch
    rows, columns = height // side, width // side
    patches = program.permuted(
        x, (channels, rows, side, columns, side), (1, 3, 0, 2, 4), rows, columns,
        channels * side * side,
    )  # fmt: skip
    return program.norm(program.linear(patches, embed.proj), embed.norm)


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
    skip = program.conv(images, _conv(head.stem), NOTHING)
    x = program.gelu(program.added(x, skip))
    x = program.added(program.conv(x, _conv(head.mix), AND_GELU), x)
    return program.linear(x, own(head.proj, OwnLinear))


def _conv(layer: Any) -> nn.Conv2d:
    if not (isinstance(layer, InDtype) and isinstance(layer.module, nn.Conv2d)):
        raise NoProgramError(f"{type(layer).__name__} is no instruction of a network's program")
    return layer.module
