"""The Unet: a class or a distance for every pixel, from polar maps or views of the images."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.lens.pixels import ray_channels
from darswin.models.base import init_by_width
from darswin.models.darswin import PRESETS, DarSwin
from darswin.models.encoder import Prepared
from darswin.models.pixel import RAYS, PixelModel, PixelTask, with_rays
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair
from darswin.models.swin import Swin
from darswin.models.views import PlainView, PolarView, make_view

EXPANSION = 4  # The decoder's last expansion splits each token into 4 × 4.

# Two blocks per stage, as in all other sizes: without shifted windows, windows do not overlap.
_NANO = dict(depths=(2, 2, 2))
_POLAR: Presets = dict(micro=PRESETS["micro"], nano=dict(_NANO, samples=(4, 4)))
_PLAIN: Presets = dict(nano=_NANO)


class PatchExpand(nn.Module):
    """Splits each token into m_r × m_φ tokens, as Swin-Unet (sec. 3.4); undoes `PatchMerging`."""

    def __init__(self, dim: int, out_dim: int, split: Pair):
        super().__init__()
        self.out_dim, self.split = out_dim, tuple(split)
        self.expansion = Linear(dim, out_dim * split[0] * split[1], bias=False)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R·m_r, A·m_φ, D')."""
        batch, rings, sectors, _ = x.shape
        mr, ma = self.split
        # Inner order (φ, r, D), as in `PatchMerging`.
        x = self.norm(self.expansion(x).reshape(batch, rings, sectors, ma, mr, self.out_dim))
        x = x.permute(0, 1, 4, 2, 3, 5)
        return x.reshape(batch, rings * mr, sectors * ma, self.out_dim)

    def extra_repr(self) -> str:
        return f"split={self.split}"


class SkipJoin(nn.Module):
    """Splits the tokens of a map and joins them with the encoder's map of the same resolution."""

    def __init__(self, dim: int, split: Pair):
        super().__init__()
        self.expand = PatchExpand(2 * dim, dim, split)
        self.fuse = Linear(2 * dim, dim)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """(B, R, A, 2·D) and (B, R·m_r, A·m_φ, D) → (B, R·m_r, A·m_φ, D)."""
        return self.fuse(torch.cat((self.expand(x), skip), -1))


class Decoder(nn.Module):
    """Mirrors an encoder: a `SkipJoin` and blocks per stage, then each token splits into 4×4."""

    def __init__(self, encoder: DarSwin | Swin, depths: int | Sequence[int]):
        super().__init__()
        count, dim = len(encoder.plans) - 1, encoder.embed_dim
        depths = [depths] * count if isinstance(depths, int) else list(depths)
        if len(depths) != count or min(depths, default=1) < 1:
            raise ValueError(
                "decoder_depths must be an int of at least 1, or one int for each stage but the "
                f"last, {count}, got {depths}"
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
        """The encoder's maps, and the positions of all stages but the last → (B, 4·R, 4·A, D)."""
        x = maps[-1]
        steps = zip(self.joins, self.stages, maps[:-1], positions, strict=True)
        for join, stage, skip, of_stage in reversed(list(steps)):
            x = stage(join(x, skip), *of_stage)
        return self.expand(x)


class UnetPrepared(NamedTuple):
    """The result of a Unet's `prepare`."""

    encoder: Prepared
    positions: Sequence[Sequence[Tensor | None]]  # of the decoder's stages
    image_points: Tensor | None  # see `PlainView.image_points`
    view_points: Any  # see `PlainView.view_points`
    rays: Tensor | None  # `PlainView.rays` as channels
    size: Pair  # (H, W) of the images


@register_model("darswin_unet_a", variant="A", presets=_POLAR)
@register_model("darswin_unet_ra", variant="RA", presets=_POLAR)
@register_model("swin_unet", view="none", image_size=128, presets=_PLAIN)
@register_model("swin_unet_undis", view="perspective", image_size=128, presets=_PLAIN)
@register_model("swin_unet_adapted", view="square", image_size=128, presets=_PLAIN)
class Unet(PixelModel):
    """A class or a distance for every pixel: a DarSwin or Swin encoder and a mirrored decoder.

    The result has the height and the width of the images. For "segmentation" it is logits (B,
    num_classes, H, W); for "distance" it is metres along the ray, (B, 1, H, W), and positive. At
    pixels that no ray of the lens reaches, the result has no meaning.

    The decoder's last map is 4 times finer along both axes than the encoder's first map. It is
    projected to `skip_width` channels and resampled to the pixels. A few convolutions, which also
    read the image, then add the details that the map is too coarse for, and predict. For "distance"
    they also read the viewing direction of each pixel.

    The `view` is the form in which the network sees the images:

    - "polar" is DarSwin-Unet. DarSwin takes images of any size through any lens.
    - "none" is Swin-Unet. Swin takes the images as they are and ignores the lens.
    - "perspective" is Swin-Unet on perspective views. Pixels outside the view get 0.
    - "square" is Swin-Unet on the image disc, mapped to a square as in `LensAdapter`.

    The encoder can start from the weights of a trained classifier:
    `classifier.reset_classifier(0)`, `model.encoder.load_state_dict(classifier.state_dict())`.

    Args:
        num_classes: the number of classes; "distance" ignores it.
        in_chans: C, the number of channels of the images.
        view: "polar", "none", "perspective" or "square".
        task: "segmentation" or "distance".
        decoder_depths: the number of blocks of each decoder stage. There is one decoder stage for
            each encoder stage but the last. An int applies to all.
        skip_width: the number of channels of these convolutions; 0 leaves them out.
        rays: whether these convolutions read the viewing direction of each pixel. None means for
            "distance" only, because classes did worse with them. The view "none" has no viewing
            directions.
        typical_distance: the distance, in m, around which "distance" starts.
        places: adds a learned linear function of each token's position to the encoder's maps before
            the decoder. For "polar" the position is the viewing direction (x, y, z), which tells
            the network which way is up. For other views it is x and y in the view, in [-1, 1].
        options: the options of the encoder: of `DarSwin` for "polar", else of `Swin`, whose
            defaults are here image_size=128 and patch_size=4.

    Unlike the classifiers of that size, a Unet of size "nano" has two blocks per stage, and
    "darswin_unet_*_nano" has R×A = 16×64.

    Rotation:
        Turning a square image by 90° about the principal point turns the result, up to rounding, in
        eval mode, if it turns the maps of the `DarSwin` encoder. `places` must be False and
        skip_width must be 0, because these parts are not symmetric. "darswin_unet_ra_nano" meets
        the condition; RA of every size and "darswin_unet_a_nano" meet it with `periodic_bias`.

    Attributes:
        encoder, decoder: the parts that make the maps.
        segmentation_head or distance_head: the part that makes the result from the last map.
        feature_info: the sizes of the encoder's stages.

    Raises:
        ValueError: an option of the encoder or of the Unet is wrong.
        TypeError: in forward, the lens is missing and the view uses it.

    Source: DarSwin-Unet, WACV 2025. Here the way back to the pixels is a differentiable
        interpolation instead of the nearest neighbour, and the skips start at the end of each
        stage, not at its beginning. Swin-Unet, ECCV 2022 workshops; it has two blocks per stage.
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
        skip_width: int = 32,
        rays: bool | None = None,
        typical_distance: float = 10.0,
        places: bool = True,
        **options: Any,
    ):
        super().__init__(task, typical_distance)
        if view == "polar":
            self.encoder = DarSwin(0, in_chans, **options)
            sizes = [plan.map_size for plan in self.encoder.plans] if places else []
            self.view = PolarView(self.encoder.spec, EXPANSION, sizes)
        else:
            # The head needs the view too, so the Unet makes it, and the encoder gets it as images.
            options = dict(image_size=128, patch_size=4) | options
            self.view = make_view(view, options["image_size"], options)
            self.encoder = Swin(0, in_chans, **options)
            self.image_size = self.encoder.image_size
            self.square_images = self.encoder.square_images
        self.uses_lens = self.view.uses_lens
        self.in_chans = in_chans
        self.mean, self.std = self.encoder.mean, self.encoder.std
        self.feature_info = self.encoder.feature_info
        self.decoder = Decoder(self.encoder, decoder_depths)
        self.places = nn.ModuleList(
            Linear(self.view.coordinates, channels, bias=False)
            for channels in (self.feature_info.channels() if places else ())
        )
        self.apply(init_by_width)
        if rays is None:
            rays = task == "distance"
        self.rays = rays and self.uses_lens and skip_width > 0
        head_chans = in_chans + (RAYS if self.rays else 0)
        self._make_head(num_classes, self.feature_info.channels(0), head_chans, skip_width)
        self.pretrained_cfg = self.encoder.pretrained_cfg | dict(
            num_classes=self.num_classes,
            input_size=(in_chans, *(self.image_size or (128, 128))),
            first_conv="encoder.patch_embed.proj",
            classifier=f"{task}_head.proj",
        )

    @property
    def refines_with_images(self) -> bool:  # type: ignore[override]
        """True for the view "polar" with a skip_width above 0."""
        return isinstance(self.encoder, DarSwin) and self.head.skip_width > 0

    def _prepare(self, lens: Any, size: Pair) -> UnetPrepared:
        encoder = self.encoder._prepare(lens, size)
        return UnetPrepared(
            encoder,
            encoder.positions[:-1],
            self.view.image_points(lens, size),
            self.view.view_points(lens, size),
            ray_channels(*self.view.rays(lens, size)) if self.rays else None,
            size,
        )

    def _run(self, images: Tensor, prepared: UnetPrepared) -> Tensor:
        seen = self.view.to_view(self._floating(images), prepared.image_points)
        return self._decode(self.encoder.maps(seen, prepared.encoder), seen, prepared)

    def _sample(self, images: Tensor, prepared: UnetPrepared) -> Tensor:
        if isinstance(self.encoder, DarSwin):
            return self.encoder._sample(images, prepared.encoder)
        return self.view.to_view(self._floating(images), prepared.image_points)

    def _points(self, prepared: UnetPrepared) -> Any:
        grid = prepared.encoder.points
        return prepared.image_points if grid is None else grid

    def _run_sampled(
        self, sampled: Tensor, prepared: UnetPrepared, images: Tensor | None
    ) -> Tensor:
        seen: Tensor | None = sampled
        if isinstance(self.encoder, DarSwin):
            seen = None if images is None else self._floating(images)
        maps = self.encoder.maps(sampled, prepared.encoder._replace(points=None))
        return self._decode(maps, seen, prepared)

    def _checked_sampled(self, sampled: Tensor, prepared: UnetPrepared) -> Tensor:
        return self.encoder._checked_sampled(sampled, prepared.encoder)

    def _decode(self, maps: list[Tensor], seen: Tensor | None, prepared: UnetPrepared) -> Tensor:
        """The maps of the encoder and the view → the result."""
        maps[-1] = self.encoder.norm(maps[-1])
        if self.places:
            maps = self._with_places(maps, prepared.view_points)
        head = self.head
        x = head.carried(self.decoder(maps, prepared.positions))
        x = self.view.to_pixels(x, prepared.view_points, prepared.size)
        logits = head.refine(x, None if seen is None else with_rays(seen, prepared.rays))
        return head.finish(self.view.to_images(logits, prepared.view_points))

    def _with_places(self, maps: Sequence[Tensor], view_points: Any) -> list[Tensor]:
        """The encoder's maps, plus a linear function of the positions of their tokens."""
        weight = next(self.places.parameters())
        places = self.view.token_places(self.feature_info.get("map_size"), view_points, weight)
        steps = zip(maps, self.places, places, strict=True)
        return [x + layer(place.to(weight)).to(x.dtype) for x, layer, place in steps]
