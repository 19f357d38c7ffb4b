"""What the dense models share: lens and images → a label or a distance for each pixel."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

from torch import Tensor, nn

from darswin.layers.embed import ImageInput
from darswin.layers.heads import DistanceHead, PixelHead, SegmentationHead
from darswin.layers.linear import Linear
from darswin.layers.sampling import check_images
from darswin.lens import Lens
from darswin.models.base import Model, init_weights
from darswin.models.darswin import DarSwin
from darswin.models.decoder import Decoder
from darswin.models.encoder import Prepared
from darswin.models.stages import Pair
from darswin.models.swin import Swin

DenseTask = Literal["segmentation", "distance"]


class DensePrepared(NamedTuple):
    """What the lenses alone decide about images of one size: `DenseModel.prepare` computes it.

    Args:
        encoder: what `Encoder.prepare` gives.
        positions: for each stage of the decoder, what its position biases are computed from.
        way: how the model looks at the images and brings its maps back to their pixels.
    """

    encoder: Prepared
    positions: Sequence[Sequence[Tensor | None]]
    way: Any


class DenseModel(Model):
    """Base of the models that say something of each pixel, called `model(images, lens)`.

    The result has the images' height and width: for "segmentation" logits (B, num_classes, H, W),
    for "distance" metres along the ray, (B, 1, H, W), above 0. What it is at pixels that no ray of
    the lens reaches has no meaning.

    A model makes `encoder` and `decoder`, then calls `_finish`; it defines `way`, `to_pixels` and,
    if it does not look at the images themselves, `look` and `back`; and `token_places`.

    The encoder is a classifier without its head, and takes the weights of one of the same options:

        classifier.reset_classifier(0)
        model.encoder.load_state_dict(classifier.state_dict())

    Attributes:
        task: "segmentation" or "distance".
        encoder, decoder: of maps. segmentation_head or distance_head: from maps to pixels.
        num_classes: K of the logits; 1 for distances.
        feature_info, pretrained_cfg: as `Model`, of the encoder.
    """

    task: DenseTask
    encoder: DarSwin | Swin
    decoder: Decoder
    image_input: ImageInput

    def _finish(
        self,
        encoder: DarSwin | Swin,
        num_classes: int,
        *,
        task: DenseTask,
        decoder_depths: int | Sequence[int],
        num_heads: Sequence[int],
        coordinates: int,
        mlp_ratio: float,
        drop_path_rate: float,
        skip_width: int,
        typical_distance: float,
        mean: float | Sequence[float],
        std: float | Sequence[float],
    ) -> None:
        """Makes what follows the encoder, initialises it, and says what the model is.

        `coordinates` are those of a place of `token_places`; 0 leaves the places out.
        """
        if task not in get_args(DenseTask):
            raise ValueError(f"task must be one of {get_args(DenseTask)}, got {task!r}")
        if skip_width < 0:
            raise ValueError(f"skip_width must be at least 0, got {skip_width}")
        dim = encoder.feature_info.channels(0)
        self.task, self.encoder, self.in_chans = task, encoder, encoder.in_chans
        self.feature_info = encoder.feature_info
        self._head_options = dict(in_chans=encoder.in_chans, skip_width=skip_width)
        self._typical_distance = typical_distance
        self.image_input = ImageInput(self.image_size, encoder.in_chans, mean, std)
        self.decoder = Decoder(
            encoder.plans,
            dim,
            decoder_depths,
            num_heads,
            attention=encoder.attention,
            mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate,
        ).apply(init_weights)
        told = self.feature_info if coordinates else ()
        self.places = nn.ModuleList(
            Linear(coordinates, info["num_chs"], bias=False) for info in told
        ).apply(init_weights)
        self.reset_classifier(num_classes)
        head = f"{task}_head"
        self.pretrained_cfg = encoder.pretrained_cfg | dict(
            num_classes=self.num_classes,
            input_size=(encoder.in_chans, *(self.image_size or (128, 128))),
            first_conv="encoder.patch_embed.proj",
            classifier=f"{head}.proj",
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
        like = next(self.decoder.parameters())
        dim = self.feature_info.channels(0)
        head: PixelHead
        if self.task == "distance":
            self.num_classes = 1
            head = DistanceHead(dim, typical_distance=self._typical_distance, **self._head_options)
        elif num_classes < 1:
            raise ValueError(f"num_classes must be at least 1, got {num_classes}")
        else:
            self.num_classes = num_classes
            head = SegmentationHead(dim, num_classes, **self._head_options)
        init_weights(head.proj)
        head.proj.matmul_backend = self.matmul_backend
        self.add_module(f"{self.task}_head", head.to(like).train(self.training))

    # -- what a model defines -----------------------------------------------------------------

    def way(self, lens: Lens | None, size: Pair) -> Any:
        """How images of (H, W) are looked at and their maps brought back, of `prepare`."""
        return None

    def look(self, images: Tensor, way: Any) -> Tensor:
        """The images (B, C, H, W), in floating point → what the network takes in."""
        return images

    def token_places(self, way: Any) -> Sequence[Tensor]:
        """Where the tokens of each of the encoder's maps are, (N or 1, R, A, coordinates)."""
        raise NotImplementedError

    def to_pixels(self, x: Tensor, way: Any, size: Pair) -> Tensor:
        """The projected map (B, R, A, K) → (B, K, H, W), of what `look` gave."""
        raise NotImplementedError

    def back(self, logits: Tensor, way: Any) -> Tensor:
        """Logits of what `look` gave → those of the images' pixels."""
        return logits

    # -- what all do --------------------------------------------------------------------------

    def prepare(self, lens: Lens | None, size: Pair) -> DensePrepared:
        """As `Model`: what the encoder and the decoder take, and the way to the pixels."""
        encoder = self.encoder.prepare(lens, size)
        return DensePrepared(encoder, encoder.positions[:-1], self.way(lens, size))

    def run(self, images: Tensor, prepared: DensePrepared) -> Tensor:
        """As `forward`: `prepare` and `run` are the model.

        Args:
            images: (B, C, H, W); of uint8 also (B, H, W, C).
            prepared: of `prepare`, for the size of these images and B lenses or one.

        Raises:
            TypeError, ValueError: images of another kind, or as many lenses as do not fit them.
        """
        dtype = next(self.encoder.patch_embed.parameters()).dtype
        seen = self.look(
            self.image_input(check_images(images, channels=self.in_chans), dtype), prepared.way
        )
        maps = self.encoder.run(seen, prepared.encoder)
        maps[-1] = self.encoder.norm(maps[-1])
        if self.places:
            maps = self._told(maps, self.token_places(prepared.way))
        x = self.head.project(self.decoder(maps, prepared.positions))
        height, width = seen.shape[2:]
        logits = self.head.refine(self.to_pixels(x, prepared.way, (height, width)), seen)
        return self.head.finish(self.back(logits, prepared.way))

    def _told(self, maps: Sequence[Tensor], places: Sequence[Tensor]) -> list[Tensor]:
        """The encoder's maps, whose tokens are told where they are."""
        dtype = next(self.places.parameters()).dtype
        steps = zip(maps, self.places, places, strict=True)
        return [x + layer(place.to(x.device, dtype)).to(x.dtype) for x, layer, place in steps]

    def forward(self, images: Tensor, lens: Lens | None = None) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → (B, num_classes, H, W)."""
        height, width = check_images(images, channels=self.in_chans).shape[2:]
        return self.run(images, self.prepare(lens, (height, width)))
