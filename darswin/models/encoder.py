"""The base class of the classifiers: images and lenses → maps, features and logits."""

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Literal

from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.layers.transformer import Block, PatchMerging, Stage
from darswin.lens import Lens
from darswin.models.base import Model, init_weights
from darswin.models.features import FeatureInfo, feature_info, take_indices
from darswin.models.prepared import Prepared
from darswin.models.stages import StageSizes
from darswin.views.base import Pair

Format = Literal["NHWC", "NCHW"]


class Encoder(Model[Tensor]):
    """The base class of the classifiers.

    A subclass makes `view` and `patch_embed`, calls `_finish`, and defines `attention`. Maps are
    channels last: polar maps have the shape (B, R, A, D), other maps (B, H, W, D).

    Args:
        num_classes: the number of classes; 0 leaves out the head.
        in_chans: C, the number of channels of the images.
        embed_dim: D, the width of the first stage; it doubles with every stage.
        depths: the number of blocks of each stage.
        num_heads: the number of attention heads of each stage.
        mlp_ratio: the hidden width of the MLPs, divided by D.
        drop_path_rate: the drop path rate of the last block; it rises linearly from 0.

    Attributes:
        num_features, head_hidden_size: the width D of the last map.
        sizes: the sizes of the stages.
    """

    in_chans: int
    num_features: int
    patch_embed: nn.Module
    sizes: Sequence[StageSizes]
    stages: nn.ModuleList  # type: ignore[assignment]
    head: nn.Module

    def __init__(
        self,
        num_classes: int = 1000,
        in_chans: int = 3,
        embed_dim: int = 96,
        depths: Sequence[int] = (2, 2, 18, 2),
        num_heads: Sequence[int] = (3, 6, 12, 24),
        mlp_ratio: float = 4.0,
        drop_path_rate: float = 0.2,
    ):
        super().__init__()
        if len(depths) != len(num_heads) or not depths:
            raise ValueError(f"depths and num_heads must pair up, got {depths} and {num_heads}")
        for name, value, least in (
            ("num_classes", num_classes, 0),
            ("in_chans", in_chans, 1),
            ("embed_dim", embed_dim, 1),
            ("embed_dim · mlp_ratio", embed_dim * mlp_ratio, 1),
            ("depths", min(depths), 0),
            ("num_heads", min(num_heads), 1),
        ):
            if not value >= least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        self.num_classes, self.in_chans, self.embed_dim = num_classes, in_chans, embed_dim
        self.depths, self.num_heads = depths, num_heads
        self.mlp_ratio, self.drop_path_rate = mlp_ratio, drop_path_rate

    def _finish(self, sizes: Sequence[StageSizes], patch: Pair) -> None:
        """Makes the stages, the norm and the head; initialises all layers; describes the model."""
        self.sizes = sizes
        self.feature_info = feature_info(sizes, self.embed_dim, patch)
        self.num_features = self.feature_info.channels(-1)
        self.stages = self.make_stages(self.depths, self.downsample)
        self.norm: nn.Module = nn.LayerNorm(self.num_features)
        self.reset_classifier(self.num_classes)
        self.apply(init_weights)
        self.pretrained_cfg = dict(
            num_classes=self.num_classes,
            input_size=(self.in_chans, *(self.image_size or (64, 64))),  # 64 as in the paper
            fixed_input_size=self.image_size is not None,
            interpolation="box",  # as in `darswin predict`
            crop_pct=1.0,
            mean=self.mean,
            std=self.std,
            first_conv="patch_embed.proj",
            classifier="head",
        )

    def make_stages(
        self, depths: Sequence[int], downsample: Callable[[int, Pair], nn.Module]
    ) -> nn.ModuleList:
        """Stages of the first `len(depths)` sizes, with these numbers of blocks.

        The width doubles with every stage, and stochastic depth rises linearly with every block.
        """
        stages = nn.ModuleList()
        before, last = 0, max(sum(depths) - 1, 1)
        for sizes, depth in zip(self.sizes, depths, strict=False):
            dim, heads = self.embed_dim * 2**sizes.index, self.num_heads[sizes.index]
            merging = downsample(dim // 2, sizes.merge) if sizes.merge else nn.Identity()
            blocks = [
                Block(
                    dim,
                    self.attention(dim, heads, sizes, block),
                    mlp_ratio=self.mlp_ratio,
                    drop_path=self.drop_path_rate * (before + block) / last,
                )
                for block in range(depth)
            ]
            stages.append(Stage(merging, blocks))
            before += depth
        return stages

    def attention(self, dim: int, heads: int, sizes: StageSizes, block: int) -> nn.Module:
        """A new attention layer for a block of a stage, in the encoder or in a Unet's decoder."""
        raise NotImplementedError

    def downsample(self, dim: int, merge: Pair) -> nn.Module:
        """A new layer that merges tokens, the first layer of every stage after the first stage."""
        return PatchMerging(dim, merge)

    @property
    def head_hidden_size(self) -> int:
        """The number of features that the head reads, timm's name for `num_features`."""
        return self.num_features

    def get_classifier(self) -> nn.Module:
        """The head, or an identity layer if the model has no head."""
        return self.head

    def reset_classifier(self, num_classes: int) -> None:
        """Replaces the head by a new one for `num_classes` classes, or by none for 0.

        The new head has the dtype and the device of the model.
        """
        self.num_classes = num_classes
        if num_classes:
            like = next(chain(self.norm.parameters(), self.parameters()))
            head = Linear(self.num_features, num_classes, device=like.device, dtype=like.dtype)
            init_weights(head)
            self.head = head.train(self.training)
        else:
            self.head = nn.Identity()

    def maps(
        self, x: Tensor, tables: Sequence[Sequence[Tensor]], count: int | None = None
    ) -> list[Tensor]:
        """The maps after each of the first `count` stages, or after all.

        Args:
            x: what the view sees.
            tables: the position biases of the stages, `Prepared.tables`.
        """
        x = self.patch_embed(x)
        maps = []
        for stage, of_stage in zip(list(self.stages)[:count], tables, strict=False):
            x = stage(x, of_stage)
            maps.append(x)
        return maps

    def forward_network(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> Tensor:
        return self.forward_head(self.norm(self.maps(x, prepared.tables)[-1]))

    def forward_features(self, images: Tensor, lens: Lens | None = None) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → the last map after the norm."""
        x, prepared, _ = self._seen(images, lens)
        return self.norm(self.maps(x, prepared.tables)[-1])

    def forward_head(self, features: Tensor, pre_logits: bool = False) -> Tensor:
        """Features (B, R, A, D) → logits (B, num_classes), or the mean feature (B, D)."""
        pooled = features.mean((1, 2))
        return pooled if pre_logits else self.head(pooled)

    def forward_intermediates(
        self,
        images: Tensor,
        lens: Lens | None = None,
        *,
        indices: int | Sequence[int] | None = None,
        norm: bool = False,
        stop_early: bool = False,
        output_fmt: Format = "NHWC",
        intermediates_only: bool = False,
    ) -> list[Tensor] | tuple[Tensor, list[Tensor]]:
        """The maps of the chosen stages, in the order of the stages, and the last map.

        Args:
            indices: numbers of stages, from 0, or from -1 backwards; an int N means the last N
                stages, and None means all.
            norm: applies the final norm to the last stage's map; it does not fit other maps.
            stop_early: skips the stages after the last one of `indices`.
            output_fmt: shape of the maps: "NHWC" is (B, R, A, D), "NCHW" is (B, D, R, A).
            intermediates_only: returns the maps alone.

        Returns:
            (features, maps). The features are those of `forward_features`, or the last computed map
            if stages were skipped.

        Raises:
            ValueError: a stage does not exist, or the format is unknown.
        """
        taken = take_indices(len(self.stages), indices)
        _check_format(output_fmt)
        x, prepared, _ = self._seen(images, lens)
        maps = self.maps(x, prepared.tables, count=max(taken) + 1 if stop_early else None)
        final = maps[-1]
        if len(maps) == len(self.stages) and (norm or not intermediates_only):
            final = self.norm(final)
            if norm:
                maps[-1] = final
        intermediates = _chosen(maps, sorted(set(taken)), output_fmt)
        return intermediates if intermediates_only else (final, intermediates)

    def prune_intermediate_layers(
        self, indices: int | Sequence[int] = 1, *, prune_norm: bool = False, prune_head: bool = True
    ) -> list[int]:
        """Removes the stages after the last one of `indices`, in place.

        If a stage is removed, the norm and the head go too, because they do not fit another stage.

        Args:
            indices: as in `forward_intermediates`.
            prune_norm: always removes the norm.
            prune_head: always removes the head.

        Returns:
            The numbers of the chosen stages.
        """
        taken = take_indices(len(self.stages), indices)
        end = max(taken) + 1
        shorter = end < len(self.stages)
        self.sizes, self.stages = self.sizes[:end], self.stages[:end]
        self.feature_info = FeatureInfo(self.feature_info[:end])
        self.num_features = self.feature_info.channels(-1)
        if prune_norm or shorter:
            self.norm = nn.Identity()
        if prune_head or shorter:
            self.reset_classifier(0)
        return taken


class FeatureMaps(Model[list[Tensor]]):
    """A backbone: the maps of the chosen stages of an encoder.

    `create_model(name, features_only=True, out_indices=…)` makes one, as in timm. A call
    `model(images, lens)` returns a list of maps (B, R, A, D) in the order of the stages. The final
    norm is not applied.

    Args:
        encoder: the encoder; it is pruned in place, as by `prune_intermediate_layers`.
        out_indices: the stages, as `indices` in `Encoder.forward_intermediates`.
        output_fmt: "NHWC" or "NCHW", as in `Encoder.forward_intermediates`.

    Raises:
        ValueError: a stage does not exist, or the format is unknown.
    """

    def __init__(
        self,
        encoder: Encoder,
        out_indices: int | Sequence[int] | None = None,
        output_fmt: Format = "NHWC",
    ):
        super().__init__()
        _check_format(output_fmt)
        taken = sorted(set(take_indices(len(encoder.stages), out_indices)))
        encoder.prune_intermediate_layers(taken, prune_norm=True)
        self.encoder, self.out_indices, self.output_fmt = encoder, tuple(taken), output_fmt
        self.view, self.image_size = encoder.view, encoder.image_size
        self.in_chans, self.num_classes = encoder.in_chans, 0
        self.feature_info = FeatureInfo(
            dict(encoder.feature_info[i], module=f"encoder.{encoder.feature_info[i]['module']}")
            for i in taken
        )
        self.pretrained_cfg = encoder.pretrained_cfg | dict(
            num_classes=0, first_conv=f"encoder.{encoder.pretrained_cfg['first_conv']}"
        )

    @property
    def stages(self) -> nn.ModuleList:  # type: ignore[override]
        """The stages of the encoder."""
        return self.encoder.stages

    def forward_network(self, x: Tensor, prepared: Prepared, images: Tensor | None) -> list[Tensor]:
        maps = self.encoder.maps(x, prepared.tables)
        return _chosen(maps, self.out_indices, self.output_fmt)


def _check_format(output_fmt: str) -> None:
    if output_fmt not in ("NHWC", "NCHW"):
        raise ValueError(f"output_fmt must be 'NHWC' or 'NCHW', got {output_fmt!r}")


def _chosen(maps: Sequence[Tensor], indices: Sequence[int], output_fmt: Format) -> list[Tensor]:
    chosen = [maps[i] for i in indices]
    if output_fmt == "NCHW":
        return [x.permute(0, 3, 1, 2).contiguous() for x in chosen]
    return chosen
