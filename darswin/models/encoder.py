"""What the models share: lens and images → maps of stages, features and logits."""

from collections.abc import Sequence
from itertools import chain
from typing import Any, Literal, NamedTuple

from torch import Tensor, nn

from darswin.layers.embed import ImageInput, PatchProjection
from darswin.layers.grid import PolarGrid
from darswin.layers.linear import Linear
from darswin.layers.sampling import check_count, check_images
from darswin.lens import Lens
from darswin.lens.pixels import sample_at
from darswin.models.base import Model, init_weights
from darswin.models.features import FeatureInfo, feature_info, take_indices
from darswin.models.stages import Pair, StagePlan, check_depths, make_stages, plan_stages
from darswin.ops.checks import per_channel


class Prepared(NamedTuple):
    """What the lenses alone decide about images of one size: `Encoder.prepare` computes it.

    Args:
        points: where the images are read: on a polar grid, or at pixels (N, H, W, 2); None means
            as they are.
        positions: for each stage, the tensors that its position biases are computed from.
    """

    points: PolarGrid | Tensor | None
    positions: Sequence[Sequence[Tensor | None]]


class Encoder(Model):
    """Base of the classifiers.

    A model sets `in_chans`, makes `patch_embed` and `stages`, then calls `_finish`; it defines
    `embed` and, if its lens matters, `prepare`. Maps are channels last: (B, R, A, D) where they are
    polar, else (B, H, W, D).

    Attributes:
        num_features, head_hidden_size: D of the last map, and of what the head takes.
        plans: the sizes of the stages.
        feature_info, pretrained_cfg: as `Model`.
    """

    num_features: int
    patch_embed: nn.Module
    plans: Sequence[StagePlan]
    stages: nn.ModuleList
    norm: nn.Module
    head: nn.Module

    def _finish(
        self,
        num_classes: int,
        plans: Sequence[StagePlan],
        embed_dim: int,
        *,
        patch: Pair,
        mean: float | Sequence[float],
        std: float | Sequence[float],
    ) -> None:
        """Makes what ends a model, initialises it, and says what it is."""
        self.plans = plans
        self.feature_info = feature_info(plans, embed_dim, patch)
        self.num_features = self.feature_info.channels(-1)
        self.norm = nn.LayerNorm(self.num_features)
        self.reset_classifier(num_classes)
        self.apply(init_weights)
        self.pretrained_cfg = dict(
            num_classes=num_classes,
            input_size=(self.in_chans, *(self.image_size or (64, 64))),  # else the paper's
            fixed_input_size=self.image_size is not None,
            interpolation="box",  # as `darswin predict`
            crop_pct=1.0,
            mean=tuple(per_channel("mean", mean, self.in_chans)),
            std=tuple(per_channel("std", std, self.in_chans)),
            first_conv="patch_embed.proj",
            classifier="head",
        )

    @property
    def head_hidden_size(self) -> int:
        """D of what the head takes."""
        return self.num_features

    def get_classifier(self) -> nn.Module:
        """The head; an identity where there is none."""
        return self.head

    def reset_classifier(self, num_classes: int) -> None:
        """A new head for `num_classes` classes; 0 leaves it out.

        It has the dtype, the device and the backend (see `set_matmul_backend`) of the model.
        """
        self.num_classes = num_classes
        if num_classes:
            like = next(chain(self.norm.parameters(), self.parameters()))
            head = Linear(self.num_features, num_classes, device=like.device, dtype=like.dtype)
            head.matmul_backend = self.matmul_backend
            init_weights(head)
            self.head = head.train(self.training)
        else:
            self.head = nn.Identity()

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        """As `Model`: where the images are read, and what the position biases need."""
        return Prepared(None, [()] * len(self.stages))

    def embed(self, images: Tensor, points: Any) -> Tensor:
        """Images (B, C, H, W) and the `points` of `prepare` → the first map."""
        raise NotImplementedError

    def run(
        self, images: Tensor, prepared: Prepared, *, stop_after: int | None = None
    ) -> list[Tensor]:
        """The map that each stage ends with: `prepare` and `run` are a model without its head.

        Args:
            images: (B, C, H, W); of uint8 also (B, H, W, C).
            prepared: of `prepare`, for the size of these images and B lenses or one.
            stop_after: the last stage that runs; None means all do.

        Raises:
            TypeError, ValueError: images of another kind, or as many lenses as do not fit them.
        """
        x = self.embed(check_images(images, channels=self.in_chans), prepared.points)
        maps = []
        for stage, positions in zip(self.stages, prepared.positions, strict=True):
            x = stage(x, *positions)
            maps.append(x)
            if len(maps) - 1 == stop_after:
                break
        return maps

    def _maps(
        self, images: Tensor, lens: Lens | None, stop_after: int | None = None
    ) -> list[Tensor]:
        height, width = check_images(images, channels=self.in_chans).shape[2:]
        return self.run(images, self.prepare(lens, (height, width)), stop_after=stop_after)

    def forward_features(self, images: Tensor, lens: Lens | None = None) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → the last map, (B, R', A', D'), normed."""
        return self.norm(self._maps(images, lens)[-1])

    def forward_intermediates(
        self,
        images: Tensor,
        lens: Lens | None = None,
        *,
        indices: int | Sequence[int] | None = None,
        norm: bool = False,
        stop_early: bool = False,
        output_fmt: Literal["NHWC", "NCHW"] = "NHWC",
        intermediates_only: bool = False,
    ) -> list[Tensor] | tuple[Tensor, list[Tensor]]:
        """The maps of some stages, in their order, and the last map.

        Args:
            indices: which stages; an int means the last so many, None all.
            norm: the last stage's map is normed; the norm fits no other.
            stop_early: no stage runs after the last of `indices`.
            output_fmt: of the maps: "NHWC" as (B, R, A, D), "NCHW" as (B, D, R, A).
            intermediates_only: leaves out the first result.

        Returns:
            (features, maps); the features are `forward_features`, or, where stages were left out,
            the last map that was made.

        Raises:
            ValueError: stages that there are not, another format.
        """
        last = len(self.stages) - 1
        taken = take_indices(len(self.stages), indices)
        if output_fmt not in ("NHWC", "NCHW"):
            raise ValueError(f"output_fmt must be 'NHWC' or 'NCHW', got {output_fmt!r}")
        maps = self._maps(images, lens, max(taken) if stop_early else last)
        final = maps[-1]
        if len(maps) - 1 == last and (norm or not intermediates_only):
            final = self.norm(final)
            if norm:
                maps[-1] = final
        intermediates = [maps[i] for i in sorted(set(taken))]
        if output_fmt == "NCHW":
            intermediates = [x.permute(0, 3, 1, 2).contiguous() for x in intermediates]
        return intermediates if intermediates_only else (final, intermediates)

    def prune_intermediate_layers(
        self,
        indices: int | Sequence[int] = 1,
        *,
        prune_norm: bool = False,
        prune_head: bool = True,
    ) -> list[int]:
        """Removes, in place, what comes after the last of some stages.

        Args:
            indices: as `forward_intermediates`.
            prune_norm: removes the norm too; prune_head: and the head. Both go in any case where a
                stage does, since they do not fit what is left.

        Returns:
            The numbers of those stages.
        """
        taken = take_indices(len(self.stages), indices)
        end = max(taken) + 1
        shorter = end < len(self.stages)
        self.plans, self.stages = self.plans[:end], self.stages[:end]
        self.feature_info = FeatureInfo(self.feature_info[:end])
        self.num_features = self.feature_info.channels(-1)
        if prune_norm or shorter:
            self.norm = nn.Identity()
        if prune_head or shorter:
            self.reset_classifier(0)
        return taken

    def forward_head(self, features: Tensor, pre_logits: bool = False) -> Tensor:
        """Features (B, R', A', D') → logits (B, num_classes), or their mean (B, D')."""
        pooled = features.mean((1, 2))
        return pooled if pre_logits else self.head(pooled)

    def forward(self, images: Tensor, lens: Lens | None = None) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → logits (B, num_classes)."""
        return self.forward_head(self.forward_features(images, lens))


class ImageEncoder(Encoder):
    """Base of the models that cut images of one size into square patches.

    Args:
        attention, downsample: as `make_stages`. Others: as `Swin`.
    """

    image_size: Pair = (64, 64)

    def __init__(
        self,
        num_classes: int,
        in_chans: int,
        embed_dim: int,
        depths: Sequence[int],
        num_heads: Sequence[int],
        *,
        image_size: int | Pair,
        patch_size: int,
        window: Pair,
        mean: float | Sequence[float],
        std: float | Sequence[float],
        **stages,
    ):
        super().__init__()
        check_depths(depths, num_heads)
        height, width = (image_size,) * 2 if isinstance(image_size, int) else image_size
        self.image_size, self.square_images = (height, width), height == width
        if any(side < 1 or side % patch_size for side in (height, width)):
            raise ValueError(
                f"patch_size must divide image_size = {self.image_size}, got {patch_size}"
            )
        plans = plan_stages(height // patch_size, width // patch_size, len(depths), "RA", window)
        self.in_chans = in_chans
        self.image_input = ImageInput(self.image_size, in_chans, mean, std)
        self.patch_embed = PatchProjection(in_chans, embed_dim, patch_size)
        self.stages = make_stages(plans, embed_dim, depths, num_heads, **stages)
        patch = (patch_size, patch_size)
        self._finish(num_classes, plans, embed_dim, patch=patch, mean=mean, std=std)

    def embed(self, images: Tensor, points: Tensor | None) -> Tensor:
        """Images (B, C, H, W), read at the pixels `points` (N, H, W, 2) if any → the first map."""
        images = self.image_input(images, next(self.patch_embed.parameters()).dtype)
        if points is not None:
            check_count(len(points), images)
            images = sample_at(images, points)
        return self.patch_embed(images.permute(0, 2, 3, 1))
