"""Swin, the paper's baseline: on images as they are, and on views of them through their lenses."""

from darswin.layers.attention import WindowAttention
from darswin.models.encoder import ImageEncoder
from darswin.models.registry import Presets, register_model
from darswin.models.stages import StagePlan

_PRESETS: Presets = dict(nano=dict(image_size=32))


@register_model("swin", presets=_PRESETS, image_size=64)
@register_model("swin_undis", presets=_PRESETS, image_size=64, view="perspective")
class Swin(ImageEncoder):
    """The Swin Transformer. It is called as DarSwin is; "swin_undis" looks at perspective views.

    Args: as `ImageEncoder`.

    Source: Swin Transformer, ICCV 2021; at 64 px with patches of 2 and windows of 4 as in DarSwin,
        ICCV 2023, sec. 5.1.
    """

    def attention(self, dim: int, heads: int, plan: StagePlan, block: int) -> WindowAttention:
        """As `Encoder`."""
        return WindowAttention(
            dim,
            heads,
            map_size=plan.map_size,
            window=plan.window,
            shift=plan.shift_of(block),
        )
