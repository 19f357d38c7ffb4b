"""An encoder as a backbone: the maps of some of its stages, as timm's `features_only` has it."""

from collections.abc import Sequence
from typing import Literal

from torch import Tensor

from darswin.layers.sampling import check_images
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.models.encoder import Encoder, Prepared
from darswin.models.features import FeatureInfo, take_indices
from darswin.models.stages import Pair


class FeatureMaps(Model):
    """The maps of some stages of an encoder, which loses what they do not need.

    `create_model(name, features_only=True, out_indices=…)` makes it. It is called
    `model(images, lens)` and gives a list of maps (B, R, A, D), those of the stages in their order,
    not normed.

    Args:
        encoder: it is pruned in place: of later stages, the norm and the head.
        out_indices: of the stages, from 0; they may count from the end. An int means the last so
            many, None all.
        output_fmt: of the maps: "NHWC" as (B, R, A, D), "NCHW" as (B, D, R, A).

    Attributes:
        encoder: what is left of it, with the names of its weights.
        feature_info: what the stages of `out_indices` are.
        output_fmt: as given.

    Raises:
        ValueError: stages that there are not, another format.
    """

    def __init__(
        self,
        encoder: Encoder,
        out_indices: int | Sequence[int] | None = None,
        output_fmt: Literal["NHWC", "NCHW"] = "NHWC",
    ):
        super().__init__()
        if output_fmt not in ("NHWC", "NCHW"):
            raise ValueError(f"output_fmt must be 'NHWC' or 'NCHW', got {output_fmt!r}")
        taken = sorted(set(take_indices(len(encoder.stages), out_indices)))
        encoder.prune_intermediate_layers(taken, prune_norm=True)
        self.encoder, self.out_indices, self.output_fmt = encoder, tuple(taken), output_fmt
        self.image_size, self.square_images = encoder.image_size, encoder.square_images
        self.in_chans, self.num_classes = encoder.in_chans, 0
        self.feature_info = FeatureInfo(
            dict(encoder.feature_info[i], module=f"encoder.{encoder.feature_info[i]['module']}")
            for i in taken
        )
        self.pretrained_cfg = encoder.pretrained_cfg | dict(
            num_classes=0, first_conv=f"encoder.{encoder.pretrained_cfg['first_conv']}"
        )

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        """As the encoder."""
        return self.encoder.prepare(lens, size)

    def run(self, images: Tensor, prepared: Prepared) -> list[Tensor]:
        """As `forward`, with what `prepare` gave for images of this size."""
        maps = self.encoder.run(images, prepared)
        maps = [maps[i] for i in self.out_indices]
        if self.output_fmt == "NCHW":
            maps = [x.permute(0, 3, 1, 2).contiguous() for x in maps]
        return maps

    def forward(self, images: Tensor, lens: Lens | None = None) -> list[Tensor]:
        """Images (B, C, H, W) and their lenses (B or 1) → the maps."""
        height, width = check_images(images, channels=self.in_chans).shape[2:]
        return self.run(images, self.prepare(lens, (height, width)))
