"""What the models share: maps of stages → features, intermediate maps and logits."""

from collections.abc import Sequence

from torch import Tensor, nn

from darswin.layers.attention import WindowAttention
from darswin.layers.block import Block, Mlp
from darswin.layers.embed import ImageInput, PatchProjection
from darswin.layers.linear import MATMUL_BACKENDS, Linear, MatmulBackend
from darswin.lens import Lens
from darswin.models.stages import Pair, check_depths, make_stages, plan_stages


class Encoder(nn.Module):
    """Base of all models, called `model(images, lens)`; the methods are those of timm's models.

    A model sets `num_features` and makes `stages`, then calls `_finish`; it defines `_stage_maps`.
    Maps are channels last: (B, R, A, D) where they are polar, else (B, H, W, D).
    """

    num_features: int
    stages: nn.ModuleList
    matmul_backend: MatmulBackend = "torch"  # see `set_matmul_backend`

    def _finish(self, num_classes: int) -> None:
        """Makes what ends a model, and initialises it."""
        self.norm = nn.LayerNorm(self.num_features)
        self.reset_classifier(num_classes)
        self.apply(_init_weights)

    def reset_classifier(self, num_classes: int) -> None:
        """A new head for `num_classes` classes; 0 leaves it out.

        It has the dtype, the device and the backend (see `set_matmul_backend`) of the model.
        """
        self.num_classes = num_classes
        self.head = nn.Identity()
        if num_classes:
            like = dict(device=self.norm.weight.device, dtype=self.norm.weight.dtype)
            self.head = Linear(self.num_features, num_classes, **like).train(self.training)
            self.head.matmul_backend = self.matmul_backend
        _init_weights(self.head)

    def no_weight_decay(self) -> set[str]:
        """Names of the parameters, besides biases and norms, that a recipe should not decay."""
        return {name for name, _ in self.named_parameters() if ".position_bias." in name}

    def set_matmul_backend(self, matmul_backend: MatmulBackend) -> None:
        """Chooses what computes the linear layers' products: "torch", "onednn" or "autotune"; see
        `Linear`.

        Raises:
            ValueError: an unknown choice.
        """
        if matmul_backend not in MATMUL_BACKENDS:
            raise ValueError(
                f"matmul_backend must be one of {MATMUL_BACKENDS}, got {matmul_backend!r}"
            )
        self.matmul_backend = matmul_backend
        for module in self.modules():
            if isinstance(module, Linear):
                module.matmul_backend = matmul_backend

    def set_grad_checkpointing(self, enable: bool = True) -> None:
        """Says whether training saves memory: norms, GELUs and attention in windows, a few percent
        of the work, are then computed again in backward. The gradients are the same, bit for bit.
        """
        for module in self.modules():
            if isinstance(module, (Block, Mlp, WindowAttention)):
                module.grad_checkpointing = enable

    def _stage_maps(self, images: Tensor, lens: Lens | None) -> list[Tensor]:
        """The map that each stage ends with."""
        raise NotImplementedError

    def forward_features(self, images: Tensor, lens: Lens | None = None) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → the last map, (B, R', A', D'), normed."""
        return self.norm(self._stage_maps(images, lens)[-1])

    def forward_intermediates(
        self,
        images: Tensor,
        lens: Lens | None = None,
        *,
        indices: int | Sequence[int] | None = None,
        intermediates_only: bool = False,
    ) -> list[Tensor] | tuple[Tensor, list[Tensor]]:
        """The maps of the stages, before the norm, and `forward_features`.

        Args:
            indices: which stages; an int means the last so many, None all.
            intermediates_only: leaves out the first result.

        Returns:
            (features, maps), each map (B, R, A, D) of its stage.
        """
        count = len(self.stages)
        chosen = range(count)[-indices:] if isinstance(indices, int) else indices or range(count)
        if (isinstance(indices, int) and not 0 < indices <= count) or any(
            not -count <= i < count for i in chosen
        ):
            raise ValueError(f"indices must name some of {count} stages, got {indices}")
        maps = self._stage_maps(images, lens)
        intermediates = [maps[i] for i in chosen]
        return intermediates if intermediates_only else (self.norm(maps[-1]), intermediates)

    def forward_head(self, features: Tensor, pre_logits: bool = False) -> Tensor:
        """Features (B, R', A', D') → logits (B, num_classes), or their mean (B, D')."""
        pooled = features.mean((1, 2))
        return pooled if pre_logits else self.head(pooled)

    def forward(self, images: Tensor, lens: Lens | None = None) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → logits (B, num_classes)."""
        return self.forward_head(self.forward_features(images, lens))


class ImageEncoder(Encoder):
    """Base of the models that see images of one size as they are, and need no lens.

    Args:
        attention, downsample: as `make_stages`. Others: as `Swin`.
    """

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
        size = (image_size, image_size) if isinstance(image_size, int) else tuple(image_size)
        if any(side < 1 or side % patch_size for side in size):
            raise ValueError(f"patch_size must divide image_size = {size}, got {patch_size}")
        plans = plan_stages(*(side // patch_size for side in size), len(depths), "RA", window)
        self.num_features = embed_dim * 2 ** (len(depths) - 1)
        self.in_chans = in_chans
        self.image_input = ImageInput(size, in_chans, mean, std)
        self.patch_embed = PatchProjection(in_chans, embed_dim, patch_size)
        self.stages = make_stages(plans, embed_dim, depths, num_heads, **stages)
        self._finish(num_classes)

    @property
    def image_size(self) -> Pair:
        """(H, W) that images must have."""
        return self.image_input.image_size

    def _view(self, images: Tensor, lens: Lens | None) -> Tensor:
        """What the network sees of the images."""
        return images

    def _stage_maps(self, images: Tensor, lens: Lens | None) -> list[Tensor]:
        dtype = next(self.patch_embed.parameters()).dtype
        x = self._view(self.image_input(images, dtype), lens)
        x = self.patch_embed(x.permute(0, 2, 3, 1))
        maps = []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        return maps


def _init_weights(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
