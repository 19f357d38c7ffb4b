"""The Unet: a label or a distance for each pixel, from polar maps or from views of the images."""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.lens import Lens
from darswin.models.base import Model, init_weights
from darswin.models.darswin import PRESETS, DarSwin
from darswin.models.encoder import Prepared
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair
from darswin.models.swin import Swin
from darswin.models.views import PlainView, PolarView, Way

PixelTask = Literal["segmentation", "distance"]
EXPANSION = 4  # how many tokens along each axis the decoder's last expansion makes of one
# exp(±8): from a three-thousandth of the typical distance to three thousand times as far.
LARGEST_EXPONENT = 8.0

_NANO = dict(decoder_depths=1, skip_width=8)
_POLAR: Presets = dict(micro=PRESETS["micro"], nano=dict(_NANO, samples=(4, 4)))
_PLAIN: Presets = dict(nano=_NANO)


class PatchExpand(nn.Module):
    """Splits each token into m_r × m_φ, as Swin-Unet's sec. 3.4: the inverse of `PatchMerging`."""

    def __init__(self, dim: int, out_dim: int, split: Pair):
        super().__init__()
        self.out_dim, self.split = out_dim, tuple(split)
        self.expansion = Linear(dim, out_dim * split[0] * split[1], bias=False)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R·m_r, A·m_φ, D')."""
        batch, rings, sectors, _ = x.shape
        mr, ma = self.split
        # Inner order (φ, r, D), as `PatchMerging` has it.
        x = self.norm(self.expansion(x).reshape(batch, rings, sectors, ma, mr, self.out_dim))
        x = x.permute(0, 1, 4, 2, 3, 5)
        return x.reshape(batch, rings * mr, sectors * ma, self.out_dim)

    def extra_repr(self) -> str:
        return f"split={self.split}"


class SkipJoin(nn.Module):
    """Splits the tokens of a map, and joins them with the encoder's map of that resolution."""

    def __init__(self, dim: int, split: Pair):
        super().__init__()
        self.expand = PatchExpand(2 * dim, dim, split)
        self.fuse = Linear(2 * dim, dim)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """(B, R, A, 2·D) and (B, R·m_r, A·m_φ, D) → the shape of the latter."""
        return self.fuse(torch.cat((self.expand(x), skip), -1))


class Decoder(nn.Module):
    """Mirrors an encoder: each stage is a `SkipJoin`, then blocks; at the end ×4 on both axes."""

    def __init__(self, encoder: DarSwin | Swin, depths: int | Sequence[int]):
        super().__init__()
        count, dim = len(encoder.plans) - 1, encoder.embed_dim
        depths = [depths] * count if isinstance(depths, int) else list(depths)
        if len(depths) != count or min(depths, default=1) < 1:
            raise ValueError(
                "decoder_depths must be an int of at least 1, or one for each stage but the last, "
                f"{count}, got {depths}"
            )
        self.joins = nn.ModuleList(
            SkipJoin(dim * 2 ** (plan.index - 1), plan.merge)
            for plan in encoder.plans
            if plan.merge
        )
        self.stages = encoder.make_stages(depths, lambda _dim, _merge: nn.Identity())
        self.expand = PatchExpand(dim, dim, (EXPANSION, EXPANSION))

    def forward(
        self, maps: Sequence[Tensor], positions: Sequence[Sequence[Tensor | None]]
    ) -> Tensor:
        """The encoder's maps, and `positions` for all but the last → (B, 4·R, 4·A, D)."""
        x = maps[-1]
        steps = zip(self.joins, self.stages, maps[:-1], positions, strict=True)
        for join, stage, skip, of_stage in reversed(list(steps)):
            x = stage(join(x, skip), *of_stage)
        return self.expand(x)


class PixelHead(nn.Module):
    """The decoder's map → K logits of each pixel, refined by what the image shows there."""

    # The map is projected before it is brought to the pixels: the same as after it, and cheaper.

    def __init__(self, dim: int, channels: int, in_chans: int, skip_width: int):
        super().__init__()
        self.skip_width = skip_width
        self.proj = Linear(dim, channels)
        if skip_width:
            self.stem = nn.Conv2d(in_chans, skip_width, 3, padding=1)
            self.mix = nn.Conv2d(skip_width + channels, skip_width, 3, padding=1)
            self.out = nn.Conv2d(skip_width, channels, 1, bias=False)
            nn.init.trunc_normal_(self.out.weight, std=0.02)

    def refine(self, coarse: Tensor, images: Tensor) -> Tensor:
        """The projected map at the pixels, (B, K, H, W), and the images (B, C, H, W) → logits."""
        if not self.skip_width:
            return coarse
        # Convolutions of few channels take half the time with channels last, as `coarse` comes.
        skip = self.stem(images.contiguous(memory_format=torch.channels_last)).relu()
        skip = self.mix(torch.cat((skip, coarse.to(skip.dtype)), 1)).relu()
        return coarse + self.out(skip).to(coarse.dtype)

    def finish(self, logits: Tensor) -> Tensor:
        """The logits (B, K, H, W) → the model's result."""
        return logits

    def extra_repr(self) -> str:
        return f"skip_width={self.skip_width}"


class DistanceHead(PixelHead):
    """Distances, m: `typical_distance` times e^x, with x bounded, so above 0 and finite."""

    def __init__(self, dim: int, in_chans: int, skip_width: int, typical_distance: float):
        super().__init__(dim, 1, in_chans, skip_width)
        if not 0 < typical_distance < math.inf:
            raise ValueError(f"typical_distance must be above 0 m, got {typical_distance}")
        self.typical_distance = float(typical_distance)

    def finish(self, logits: Tensor) -> Tensor:
        """x (B, 1, H, W) → distances (B, 1, H, W), m, in float32 at least."""
        x = logits.to(torch.promote_types(logits.dtype, torch.float32))
        x = LARGEST_EXPONENT * torch.tanh(x / LARGEST_EXPONENT)
        return self.typical_distance * torch.exp(x)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, typical_distance={self.typical_distance}"


class UnetPrepared(NamedTuple):
    """All that the lenses alone decide about images of one size."""

    encoder: Prepared
    positions: Sequence[Sequence[Tensor | None]]  # of the decoder's stages
    way: Way  # to the view of the images, and back


@register_model("darswin_unet_a", variant="A", presets=_POLAR)
@register_model("darswin_unet_ra", variant="RA", presets=_POLAR)
@register_model("swin_unet", view="none", image_size=128, presets=_PLAIN)
@register_model("swin_unet_undis", view="perspective", image_size=128, presets=_PLAIN)
@register_model("swin_unet_adapted", view="square", image_size=128, presets=_PLAIN)
class Unet(Model):
    """DarSwin or Swin as the encoder, its mirror as the decoder, and the way back to the pixels.

    The result has the images' height and width: for "segmentation" logits (B, num_classes, H, W),
    for "distance" metres along the ray, (B, 1, H, W), above 0. At pixels that no ray of the lens
    reaches it has no meaning. The decoder ends on a map 4 times as fine along both axes as the
    encoder's first; its projection to the classes is brought to the pixels, and refined by a few
    convolutions that see the image too, since the map is coarser than the image.

    The `view` is what the network looks at:

    - "polar", DarSwin-Unet: DarSwin reads images of any size through any lens;
    - "none", Swin-Unet: Swin takes the images as they are and ignores the lens;
    - "perspective", Swin-Unet on perspective views; pixels beyond them are 0: unknown;
    - "square", Swin-Unet on the image disc as a square, as `LensAdapter` makes it.

    The encoder is a classifier without its head, whose weights it takes:
    `classifier.reset_classifier(0)`, `model.encoder.load_state_dict(classifier.state_dict())`.

    Args:
        num_classes: of "segmentation"; "distance" ignores it. in_chans: C of the images.
        view: as above. task: "segmentation" or "distance".
        decoder_depths: blocks of each stage of the decoder, one for each of the encoder but the
            last; an int is for all.
        skip_width: channels of the skip from the image; 0 leaves it out.
        typical_distance: m, what "distance" starts from.
        places: adds to each of the encoder's maps, before the decoder, a learned linear function of
            where its tokens are: for "polar" the direction (x, y, z) in which they look, as without
            it the network does not know which way is up; else x and y in the view, in [-1, 1].
        options: of the encoder: of `DarSwin` for "polar"; else of `Swin`, where image_size is 128
            and patch_size is 4 by default, with those of the view.

    "darswin_unet_*_nano" has R×A = 16×64, unlike the classifier of that size.

    Rotation:
        In eval mode, without `places` and the skip (skip_width=0), whose convolutions are not
        symmetric, a turn of a square image about the principal point by 90° turns the result, up
        to rounding, where it turns the maps of `DarSwin`: for "darswin_unet_ra_nano", and with
        `periodic_bias` for RA of every size and "darswin_unet_a_nano".

    Attributes:
        encoder, decoder: of maps. segmentation_head or distance_head: from maps to pixels.
        feature_info, pretrained_cfg: as `Model`, of the encoder.

    Raises:
        ValueError: as `DarSwin` or `Swin`, or an option out of its range.
        TypeError: in forward, no lens where the view needs one.

    Source: DarSwin-Unet, WACV 2025, with a differentiable interpolation in place of its nearest
        neighbours, and skips from the end of each stage rather than its beginning. Swin-Unet, ECCV
        2022 workshops; it has two blocks a stage.
    """

    encoder: DarSwin | Swin
    view: PlainView

    def __init__(
        self,
        num_classes: int = 10,
        in_chans: int = 3,
        *,
        view: Literal["polar", "none", "perspective", "square"] = "polar",
        task: PixelTask = "segmentation",
        decoder_depths: int | Sequence[int] = 2,
        skip_width: int = 16,
        typical_distance: float = 10.0,
        places: bool = True,
        **options: Any,
    ):
        super().__init__()
        if task not in get_args(PixelTask):
            raise ValueError(f"task must be one of {get_args(PixelTask)}, got {task!r}")
        if skip_width < 0:
            raise ValueError(f"skip_width must be at least 0, got {skip_width}")
        if view == "polar":
            self.encoder = DarSwin(0, in_chans, **options)
            sizes = [plan.map_size for plan in self.encoder.plans] if places else []
            self.view = PolarView(self.encoder.spec, EXPANSION, sizes)
        else:
            options = dict(image_size=128, patch_size=4) | options
            self.encoder = Swin(0, in_chans, view=view, **options)
            self.image_size = self.encoder.image_size
            self.square_images = self.encoder.square_images
            # The head sees the view too, so it is made here, and the encoder takes it as it is.
            self.view, self.encoder.view = self.encoder.view, PlainView(self.image_size)
        self.task, self.in_chans = task, in_chans
        self.mean, self.std = self.encoder.mean, self.encoder.std
        self.feature_info = self.encoder.feature_info
        self._head_options = dict(in_chans=in_chans, skip_width=skip_width)
        self._typical_distance = typical_distance
        self.decoder = Decoder(self.encoder, decoder_depths).apply(init_weights)
        self.places = nn.ModuleList(
            Linear(self.view.coordinates, channels, bias=False)
            for channels in (self.feature_info.channels() if places else ())
        ).apply(init_weights)
        self.reset_classifier(num_classes)
        self.pretrained_cfg = self.encoder.pretrained_cfg | dict(
            num_classes=self.num_classes,
            input_size=(in_chans, *(self.image_size or (128, 128))),
            first_conv="encoder.patch_embed.proj",
            classifier=f"{task}_head.proj",
        )

    @property
    def head(self) -> PixelHead:
        """`segmentation_head` or `distance_head`."""
        return self.get_submodule(f"{self.task}_head")  # type: ignore[return-value]

    def get_classifier(self) -> nn.Module:
        """The head."""
        return self.head

    def reset_classifier(self, num_classes: int) -> None:
        """A new head: for `num_classes` classes, or for distances, where that number is ignored.

        It has the dtype, the device and the backend (see `set_matmul_backend`) of the model.

        Raises:
            ValueError: fewer than one class.
        """
        dim = self.feature_info.channels(0)
        head: PixelHead
        if self.task == "distance":
            self.num_classes = 1
            head = DistanceHead(dim, typical_distance=self._typical_distance, **self._head_options)
        elif num_classes < 1:
            raise ValueError(f"num_classes must be at least 1, got {num_classes}")
        else:
            self.num_classes = num_classes
            head = PixelHead(dim, num_classes, **self._head_options)
        init_weights(head.proj)
        head.proj.matmul_backend = self.matmul_backend
        like = next(self.decoder.parameters())
        self.add_module(f"{self.task}_head", head.to(like).train(self.training))

    def prepare(self, lens: Lens | None, size: Pair) -> UnetPrepared:
        """As `Model`: what the encoder and the decoder take, and the way to the pixels."""
        encoder = self.encoder.prepare(lens, size)
        return UnetPrepared(encoder, encoder.positions[:-1], self.view.prepare(lens, size))

    def _run(self, images: Tensor, prepared: UnetPrepared) -> Tensor:
        there, back = prepared.way
        seen = self.view.to_view(self._floating(images), there)
        maps = self.encoder.maps(seen, prepared.encoder)
        maps[-1] = self.encoder.norm(maps[-1])
        if self.places:
            maps = self._with_places(maps, back)
        head = self.head
        x = head.proj(self.decoder(maps, prepared.positions))
        height, width = seen.shape[2:]
        logits = head.refine(self.view.to_pixels(x, back, (height, width)), seen)
        return head.finish(self.view.back(logits, back))

    def _with_places(self, maps: Sequence[Tensor], back: Any) -> list[Tensor]:
        """The encoder's maps, plus a function of where their tokens are."""
        weight = next(self.places.parameters())
        places = self.view.token_places(self.feature_info.get("map_size"), back, weight)
        steps = zip(maps, self.places, places, strict=True)
        return [x + layer(place.to(weight)).to(x.dtype) for x, layer, place in steps]
