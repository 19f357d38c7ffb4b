"""What all models share, classifiers and dense ones: what they say of themselves, and settings."""

from typing import Any

from torch import nn

from darswin.layers.attention import WindowAttention
from darswin.layers.block import Block, Mlp
from darswin.layers.linear import MATMUL_BACKENDS, Linear, MatmulBackend
from darswin.lens import Lens
from darswin.models.features import FeatureInfo
from darswin.models.stages import Pair


class Model(nn.Module):
    """Base of all models, called `model(images, lens)`; the methods are those of timm's models.

    Attributes:
        in_chans: C of the images. num_classes: of the result.
        feature_info: what the encoder's stages are.
        pretrained_cfg: timm's description of a model: "architecture" (of `create_model`),
            "num_classes", "input_size" (C, H, W), "fixed_input_size", "mean" and "std" (of pixels
            in [0, 1]), "interpolation", "crop_pct", "first_conv" (the layer that takes the pixels),
            "classifier". A loaded model's says what its card does, and has "label_names" and
            "file".
    """

    image_size: Pair | None = None  # (H, W) that all images must have; None: any size
    square_images = False  # whether images must be square
    in_chans: int
    num_classes: int
    matmul_backend: MatmulBackend = "torch"  # see `set_matmul_backend`

    def __init__(self) -> None:
        super().__init__()
        self.feature_info = FeatureInfo()
        self.pretrained_cfg: dict[str, Any] = {}

    def prepare(self, lens: Lens | None, size: Pair) -> Any:
        """What the lenses alone decide about images of (H, W), for any number of calls of `run`.

        Args:
            lens: N lenses, or None for a model that ignores them. size: (H, W) of the images.

        Raises:
            TypeError: no lens, for a model that needs one.
            ValueError: a lens of images of another size.
        """
        raise NotImplementedError

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
