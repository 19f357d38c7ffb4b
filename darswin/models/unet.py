"""The Unet: a class or a distance for every pixel, from polar maps or views of the images."""

import inspect
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.layers.transformer import Stage
from darswin.lens import Lens
from darswin.models.base import init_by_width
from darswin.models.darswin import PRESETS, DarSwin
from darswin.models.encoder import Encoder
from darswin.models.pixel import RAYS, PixelModel, with_rays
from darswin.models.prepared import Prepared
from darswin.models.registry import Presets, register_model
from darswin.models.swin import Swin
from darswin.utils.tasks import PixelTask
from darswin.views.base import Pair
from darswin.views.pixels import resized

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

    def __init__(self, encoder: Encoder, depths: int | Sequence[int]):
        super().__init__()
        count, dim = len(encoder.sizes) - 1, encoder.embed_dim
        depths = [depths] * count if isinstance(depths, int) else list(depths)
        if len(depths) != count or min(depths, default=1) < 1:
            raise ValueError(
                "decoder_depths must be an int of at least 1, or one int for each stage but the "
                f"last, {count}, got {depths}"
            )
        self.joins = nn.ModuleList(
            SkipJoin(dim * 2 ** (sizes.index - 1), sizes.merge)
            for sizes in encoder.sizes
            if sizes.merge
        )
        self.stages = encoder.make_stages(depths, lambda _dim, _merge: nn.Identity())
        self.expand = PatchExpand(dim, dim, (EXPANSION, EXPANSION))

    def forward(self, maps: Sequence[Tensor], tables: Sequence[Sequence[Tensor]]) -> Tensor:
        """The encoder's maps, and the position biases of the stages → (B, 4·R, 4·A, D)."""
        x = maps[-1]
        steps = zip(self.joins, self.stages, maps[:-1], tables, strict=True)
        for join, stage, skip, of_stage in reversed(list(steps)):
            x = stage(join(x, skip), of_stage)
        return self.expand(x)


class Unet(PixelModel):
    """A class or a distance for every pixel: an encoder and a mirrored decoder.

    The result has the height and the width of the images. For "segmentation" it is logits (B,
    num_classes, H, W); for "distance" it is metres along the ray, (B, 1, H, W). Where the view
    shows nothing, distances are 0, for unknown, and logits have no meaning: there,
    `model.prepare(lens, size).view.shown` is False.

    The decoder's last map is 4 times finer along both axes than the encoder's first map. It is
    projected to `skip_width` channels and resampled to the pixels. A few convolutions, which also
    read the image, then add the details that the map is too coarse for, and predict. For "distance"
    they also read the viewing direction of each pixel.

    The network sees the images as its encoder does. `create_model` makes two kinds:

    - "darswin_unet" is DarSwin-Unet. DarSwin takes images of any size through any lens.
    - "swin_unet" is Swin-Unet. Swin takes the images as they are and ignores the lens, or takes a
      `view` of them. Pixels outside the view get 0.

    The encoder can start from the weights of a trained classifier:
    `classifier.reset_classifier(0)`, `model.encoder.load_state_dict(classifier.state_dict())`.

    Args:
        encoder: a classifier, whose head is removed.
        num_classes: the number of classes; "distance" ignores it.
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
        TypeError: the encoder is none; in forward, the lens is missing and the view uses it.

    Source: DarSwin-Unet, WACV 2025. Here the way back to the pixels is a differentiable
        interpolation instead of the nearest neighbour, and the skips start at the end of each
        stage, not at its beginning. Swin-Unet, ECCV 2022 workshops; it has two blocks per stage.
    """

    encoder: Encoder

    def __init__(
        self,
        encoder: Encoder,
        num_classes: int = 10,
        *,
        task: PixelTask = "segmentation",
        decoder_depths: int | Sequence[int] = 2,
        skip_width: int = 32,
        rays: bool | None = None,
        typical_distance: float = 10.0,
        places: bool = True,
    ):
        super().__init__(task, typical_distance)
        if not isinstance(encoder, Encoder):
            raise TypeError(
                f"encoder must be an Encoder, got {type(encoder).__name__}: create_model makes a "
                "Unet from options"
            )
        encoder.reset_classifier(0)
        self.encoder, self.view, self.image_size = encoder, encoder.view, encoder.image_size
        self.in_chans, self.feature_info = encoder.in_chans, encoder.feature_info
        self.decoder = Decoder(encoder, decoder_depths)
        rows, columns = encoder.sizes[0].map_size
        # Pixels of a view go back in its size, since the head refines them before.
        self.goes_back = self.view.in_pixels or (EXPANSION * rows, EXPANSION * columns)
        self.token_maps = self.feature_info.get("map_size") if places else ()
        self.places = nn.ModuleList(
            Linear(self.view.coordinates, channels, bias=False)
            for channels in (self.feature_info.channels() if places else ())
        )
        self.apply(init_by_width)
        if rays is None:
            rays = task == "distance"
        self.reads_rays = rays and self.view.uses_lens and skip_width > 0
        self.refines_with_images = not self.view.in_pixels and skip_width > 0
        head_chans = self.in_chans + (RAYS if self.reads_rays else 0)
        self._make_head(num_classes, self.feature_info.channels(0), head_chans, skip_width)
        self.pretrained_cfg = encoder.pretrained_cfg | dict(
            num_classes=self.num_classes,
            input_size=(self.in_chans, *(self.image_size or (128, 128))),
            first_conv="encoder.patch_embed.proj",
            classifier=f"{task}_head.proj",
        )

    @property
    def stages(self) -> list[Stage]:  # type: ignore[override]
        """The stages of the encoder and those of the decoder."""
        return [*self.encoder.stages, *self.decoder.stages]

    def forward_network(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Tensor:
        encoder, decoder, head = self.encoder, self.decoder, self.head
        maps = encoder.maps(x, prepared.tables)
        maps[-1] = encoder.norm(maps[-1])
        if self.places:
            maps = [x + place.to(x.dtype) for x, place in zip(maps, prepared.tokens, strict=True)]
        carried = head.carried(decoder(maps, prepared.tables[len(maps) :]))
        if self.view.in_pixels:
            carried = resized(carried.permute(0, 3, 1, 2), x.shape[2:])
            logits = head.refine(carried, with_rays(x, prepared.rays))
            return head.finish(self.view.back(logits, prepared.view), prepared.view.shown)
        carried = self.view.back(carried, prepared.view)
        if images is not None:
            images = with_rays(self.view.floating(images, self.dtype), prepared.rays)
        return head.finish(head.refine(carried, images), prepared.view.shown)

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        prepared = super().prepare(lens, size)
        layers: list[Any] = list(self.places)
        steps = zip(layers, prepared.tokens, strict=True)
        return prepared._replace(tokens=[layer(place.to(layer.weight)) for layer, place in steps])


@register_model("darswin_unet_a", kind=Unet, variant="A", presets=_POLAR)
@register_model("darswin_unet_ra", kind=Unet, variant="RA", presets=_POLAR)
def darswin_unet(view: Literal["polar"] = "polar", **options: Any) -> Unet:
    """A `Unet` with a DarSwin encoder, from the options of both."""
    if view != "polar":
        raise ValueError(f"view must be 'polar', got {view!r}: a swin_unet takes other views")
    return _unet(DarSwin, options)


@register_model("swin_unet", kind=Unet, image_size=128, presets=_PLAIN)
def swin_unet(**options: Any) -> Unet:
    """A `Unet` with a Swin encoder of patches of 4 × 4 pixels, from the options of both."""
    return _unet(Swin, dict(patch_size=4) | options)


def _unet(encoder: type[Encoder], options: dict[str, Any]) -> Unet:
    names = inspect.signature(encoder).parameters
    of_encoder = {name: value for name, value in options.items() if name in names}
    own = {name: value for name, value in options.items() if name not in names}
    num_classes = of_encoder.pop("num_classes", 10)
    return Unet(encoder(num_classes=0, **of_encoder), num_classes, **own)
