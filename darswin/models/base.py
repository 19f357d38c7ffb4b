"""The base of all models: one way through them, and what they tell about themselves."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from darswin.layers.linear import MATMUL_BACKENDS, Linear, MatmulBackend
from darswin.layers.polar import check_images
from darswin.layers.transformer import Block, Mlp, WindowAttention
from darswin.lens import Lens
from darswin.models.stages import Pair, StagePlan
from darswin.ops.reference import normalized


class FeatureInfo(list[dict[str, Any]]):
    """A dict for each stage, and timm's accessors.

    Keys:
        num_chs: D of the stage's map.
        reduction: how many px a token spans along its longer side. They are px of the image; of the
            view where the model makes one; in DarSwin samples of the polar grid, as a token there
            spans as many px of the image as its lens and its ring say.
        module: the stage's name in the model.
        map_size: (R, A) where the map is polar, else (H, W).
    """

    def get(self, key: str, idx: int | Sequence[int] | None = None) -> Any:
        """The value of a key: of one stage, of several, or, without `idx`, of all."""
        if isinstance(idx, int):
            return self[idx][key]
        return [self[k][key] for k in (range(len(self)) if idx is None else idx)]

    def channels(self, idx: int | Sequence[int] | None = None) -> Any:
        """D of the stages' maps."""
        return self.get("num_chs", idx)

    def reduction(self, idx: int | Sequence[int] | None = None) -> Any:
        """Pixels that a token spans; `FeatureInfo` says which pixels."""
        return self.get("reduction", idx)

    def module_name(self, idx: int | Sequence[int] | None = None) -> Any:
        """The stages' names."""
        return self.get("module", idx)


class Model(nn.Module):
    """Base of all models, called `model(images, lens)`; the methods are those of timm's models.

    A call checks its images, computes `prepare(lens, size)`, and runs the network on both; a user
    whose lens stays the same calls `prepare` once, and then `run(images, prepared)`, which gives
    the same. A model defines `prepare` and `_run`.

    Attributes:
        in_chans: C of the images. num_classes: of the result.
        image_size: (H, W) that all images must have; None means any size.
        square_images: whether images must be square.
        feature_info: sizes of the encoder's stages.
        pretrained_cfg: timm's description of a model: "architecture" (of `create_model`),
            "num_classes", "input_size" (C, H, W), "fixed_input_size", "mean" and "std" (of pixels
            in [0, 1]), "interpolation", "crop_pct", "first_conv" (the layer that takes the pixels),
            "classifier". A loaded model's agrees with its card, and has "label_names" and "file".
    """

    image_size: Pair | None = None
    square_images = False
    in_chans: int
    num_classes: int
    mean: Sequence[float]
    std: Sequence[float]
    matmul_backend: MatmulBackend = "torch"  # see `set_matmul_backend`

    def __init__(self) -> None:
        super().__init__()
        self.feature_info = FeatureInfo()
        self.pretrained_cfg: dict[str, Any] = {}

    def prepare(self, lens: Lens | None, size: Pair) -> Any:
        """All that the lenses alone decide about images of (H, W), for any number of calls of
        `run`.

        Args:
            lens: N lenses, or None for a model that ignores them. size: (H, W) of the images.

        Raises:
            TypeError: no lens, for a model that needs one.
            ValueError: a lens of images of another size.
        """
        raise NotImplementedError

    def _run(self, images: Tensor, prepared: Any) -> Any:
        """Images that were checked, and what `prepare` gave → the result."""
        raise NotImplementedError

    def forward(self, images: Tensor, lens: Lens | None = None) -> Any:
        """Images (B, C, H, W) and their lenses (B or 1) → the result."""
        return self._run(*self._checked_and_prepared(images, lens))

    def run(self, images: Tensor, prepared: Any) -> Any:
        """As `forward`, with what `prepare` gave for the size of these images and B lenses or one.

        Args:
            images: (B, C, H, W); of uint8 also (B, H, W, C).

        Raises:
            TypeError, ValueError: images of another kind, or as many lenses as do not fit them.
        """
        return self._run(self._checked(images), prepared)

    def _checked_and_prepared(self, images: Tensor, lens: Lens | None) -> tuple[Tensor, Any]:
        images = self._checked(images)
        height, width = images.shape[2:]
        return images, self.prepare(lens, (height, width))

    def _checked(self, images: Tensor) -> Tensor:
        """The images as (B, C, H, W), of the channels and the size that the model takes."""
        images = check_images(images, channels=self.in_chans)
        if images.shape[1] != self.in_chans:
            raise ValueError(f"images must have {self.in_chans} channels, got {images.shape[1]}")
        if self.image_size is not None and images.shape[2:] != self.image_size:
            raise ValueError(
                f"images must have the model's image_size, (H, W) = {self.image_size}, "
                f"got {tuple(images.shape[2:])}"
            )
        return images

    def _floating(self, images: Tensor) -> Tensor:
        """The images normalized, where they are uint8, in the dtype of the first layer."""
        if images.dtype != torch.uint8:
            return images
        dtype = next(self.parameters()).dtype
        exact = torch.promote_types(dtype, torch.float32)
        return normalized(images, self.mean, self.std, exact).to(dtype)

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
        for module in self.modules():
            if isinstance(module, (Linear, Model)):
                module.matmul_backend = matmul_backend

    def set_grad_checkpointing(self, enable: bool = True) -> None:
        """Says whether training saves memory: norms, GELUs and attention in windows, a few percent
        of the work, are recomputed in backward. The gradients are the same, bit for bit.
        """
        for module in self.modules():
            if isinstance(module, (Block, Mlp, WindowAttention)):
                module.grad_checkpointing = enable


def init_weights(module: nn.Module) -> None:
    """As the Swin Transformer's linear layers start; other layers stay as they are."""
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def feature_info(plans: Sequence[StagePlan], embed_dim: int, patch: Pair) -> FeatureInfo:
    """The sizes of stages whose width doubles at each; a token of the first spans `patch`."""
    infos = FeatureInfo()
    for plan in plans:
        merged = zip(patch, plans[0].map_size, plan.map_size, strict=True)
        infos.append(
            dict(
                num_chs=embed_dim * 2**plan.index,
                reduction=max(span * before // after for span, before, after in merged),
                module=f"stages.{plan.index}",
                map_size=plan.map_size,
            )
        )
    return infos


def take_indices(count: int, indices: int | Sequence[int] | None) -> list[int]:
    """The stages that `indices` names, of `count`: the last so many for an int, all for None."""
    if isinstance(indices, int):
        chosen: Sequence[int] = range(count)[-indices:] if 0 < indices <= count else ()
    else:
        chosen = range(count) if indices is None else indices
    if not chosen or not all(-count <= i < count for i in chosen):
        raise ValueError(f"indices must name some of {count} stages, got {indices}")
    return [i % count for i in chosen]
