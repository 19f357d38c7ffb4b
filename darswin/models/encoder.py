"""What the models share: lens and images → maps of stages, features and logits."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor, nn

from darswin.layers.attention import WindowAttention
from darswin.layers.block import Block, Mlp
from darswin.layers.embed import ImageInput, PatchProjection
from darswin.layers.grid import PolarGrid
from darswin.layers.linear import MATMUL_BACKENDS, Linear, MatmulBackend
from darswin.layers.sampling import check_count, check_images
from darswin.lens import Lens
from darswin.lens.reprojection import sample_at
from darswin.models.stages import Pair, check_depths, make_stages, plan_stages


class Prepared(NamedTuple):
    """What the lenses alone decide about images of one size: `Encoder.prepare` computes it.

    Args:
        points: where the images are read: on a polar grid, or at pixels (N, H, W, 2); None means
            as they are.
        positions: for each stage, the tensors that its position biases are computed from.
    """

    points: PolarGrid | Tensor | None
    positions: Sequence[Sequence[Tensor | None]]


class Encoder(nn.Module):
    """Base of all models, called `model(images, lens)`; the methods are those of timm's models.

    A model sets `num_features`, makes `patch_embed` and `stages`, then calls `_finish`; it defines
    `embed` and, if its lens matters, `prepare`. Maps are channels last: (B, R, A, D) where they are
    polar, else (B, H, W, D).
    """

    image_size: Pair | None = None  # (H, W) that all images must have; None: any size
    square_images = False  # whether images must be square
    in_chans: int
    num_features: int
    patch_embed: nn.Module
    stages: nn.ModuleList
    head: nn.Module
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
        if num_classes:
            like = self.norm.weight
            head = Linear(self.num_features, num_classes, device=like.device, dtype=like.dtype)
            head.matmul_backend = self.matmul_backend
            _init_weights(head)
            self.head = head.train(self.training)
        else:
            self.head = nn.Identity()

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
        of the work, are recomputed in backward. The gradients are the same, bit for bit.
        """
        for module in self.modules():
            if isinstance(module, (Block, Mlp, WindowAttention)):
                module.grad_checkpointing = enable

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        """What the lenses alone decide about images of (H, W), for any number of calls of `run`.

        Args:
            lens: N lenses, or None for a model that ignores them. size: (H, W) of the images.

        Raises:
            TypeError: no lens, for a model that needs one.
            ValueError: a lens of images of another size.
        """
        return Prepared(None, [()] * len(self.stages))

    def embed(self, images: Tensor, points: Any) -> Tensor:
        """Images (B, C, H, W) and the `points` of `prepare` → the first map."""
        raise NotImplementedError

    def run(self, images: Tensor, prepared: Prepared) -> list[Tensor]:
        """The map that each stage ends with: `prepare` and `run` are a model without its head.

        Args:
            images: (B, C, H, W), or uint8 (B, H, W, 3).
            prepared: of `prepare`, for the size of these images and B lenses or one.

        Raises:
            TypeError, ValueError: images of another kind, or as many lenses as do not fit them.
        """
        x = self.embed(check_images(images), prepared.points)
        maps = []
        for stage, positions in zip(self.stages, prepared.positions, strict=True):
            x = stage(x, *positions)
            maps.append(x)
        return maps

    def _maps(self, images: Tensor, lens: Lens | None) -> list[Tensor]:
        height, width = check_images(images).shape[2:]
        return self.run(images, self.prepare(lens, (height, width)))

    def forward_features(self, images: Tensor, lens: Lens | None = None) -> Tensor:
        """Images (B, C, H, W) and their lenses (B or 1) → the last map, (B, R', A', D'), normed."""
        return self.norm(self._maps(images, lens)[-1])

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
        maps = self._maps(images, lens)
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
        self.num_features = embed_dim * 2 ** (len(depths) - 1)
        self.in_chans = in_chans
        self.image_input = ImageInput(self.image_size, in_chans, mean, std)
        self.patch_embed = PatchProjection(in_chans, embed_dim, patch_size)
        self.stages = make_stages(plans, embed_dim, depths, num_heads, **stages)
        self._finish(num_classes)

    def embed(self, images: Tensor, points: Tensor | None) -> Tensor:
        """Images (B, C, H, W), read at the pixels `points` (N, H, W, 2) if any → the first map."""
        images = self.image_input(images, next(self.patch_embed.parameters()).dtype)
        if points is not None:
            check_count(len(points), images)
            images = sample_at(images, points)
        return self.patch_embed(images.permute(0, 2, 3, 1))


def _init_weights(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
