"""Swin, the paper's baseline, on the images themselves or on views through their lenses."""

from collections.abc import Sequence

from torch import nn

from darswin.layers.attention import WindowAttention
from darswin.layers.embed import PatchEmbed
from darswin.models.base import view_of_model
from darswin.models.encoder import Encoder
from darswin.models.registry import Presets, register_model
from darswin.models.stages import StageSizes, stage_sizes
from darswin.ops.checks import side_or_pair
from darswin.views import View
from darswin.views.base import Pair, PerChannel, size_of

_PRESETS: Presets = dict(nano=dict(image_size=32))


@register_model("swin", presets=_PRESETS, image_size=64)
class Swin(Encoder):
    """The Swin Transformer, on images of a single size.

    Args:
        num_classes, in_chans, embed_dim, depths, num_heads, mlp_ratio, drop_path_rate: the
            arguments of `Encoder`.
        image_size: (H, W) in pixels, or the side of a square.
        patch_size: the side of a patch, in pixels.
        window: (rows, columns) on maps that are large enough.
        view: what the network sees of the images through their lenses: a `View`, which has its own
            size, mean and std; or the name of one, `list_views()`, of (H, W) and with its own
            defaults. "none" takes the images as they are and ignores the lens.
        mean, std: normalization of uint8 images, `(pixel/255 - mean) / std`, by default with 0 and
            1; images in floating point are not normalized.

    Raises:
        ValueError: an unknown option, a view of several pictures, or sizes that do not divide; in
            forward, images of another size.
        TypeError: in forward, the lens is missing and the view uses it.

    Source: Swin Transformer, ICCV 2021; at 64 px with patches of 2 and windows of 4 as in DarSwin,
        ICCV 2023, sec. 5.1.
    """

    image_size: Pair

    def __init__(
        self,
        num_classes: int = 1000,
        in_chans: int = 3,
        embed_dim: int = 96,
        depths: Sequence[int] = (2, 2, 18, 2),
        num_heads: Sequence[int] = (3, 6, 12, 24),
        *,
        mlp_ratio: float = 4.0,
        drop_path_rate: float = 0.2,
        image_size: int | Pair = 64,
        patch_size: int = 2,
        window: Pair = (4, 4),
        view: str | View = "none",
        mean: PerChannel | None = None,
        std: PerChannel | None = None,
    ):
        super().__init__(
            num_classes, in_chans, embed_dim, depths, num_heads, mlp_ratio, drop_path_rate
        )
        self.image_size = side_or_pair("image_size", image_size)
        self.view = view_of_model(view, self.image_size, in_chans, mean, std)
        height, width = seen = size_of(self.view) or self.image_size
        if not self.view.uses_lens and seen != self.image_size:
            raise ValueError(f"the view must have image_size = {self.image_size}, got {seen}")
        if patch_size < 1 or height % patch_size or width % patch_size:
            raise ValueError(f"patch_size must divide the view's (H, W) = {seen}, got {patch_size}")
        rows, columns = height // patch_size, width // patch_size
        self.patch_embed = PatchEmbed(in_chans, embed_dim, patch_size)
        sizes = stage_sizes(rows, columns, len(depths), "RA", window)
        self._finish(sizes, (patch_size, patch_size))

    def attention(self, dim: int, heads: int, sizes: StageSizes, block: int) -> nn.Module:
        return WindowAttention(dim, heads, **sizes.windows(block))
