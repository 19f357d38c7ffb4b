"""Swin, the paper's baseline: on images as they are, and on views of them through their lenses."""

from typing import Any

from torch import Tensor, nn

from darswin.layers.embed import PatchProjection
from darswin.layers.transformer import WindowAttention
from darswin.lens import Lens
from darswin.models.encoder import Encoder, Prepared
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair, StagePlan, plan_stages
from darswin.models.views import ViewName, make_view

_PRESETS: Presets = dict(nano=dict(image_size=32))


@register_model("swin", presets=_PRESETS, image_size=64)
@register_model("swin_undis", presets=_PRESETS, image_size=64, view="perspective")
class Swin(Encoder):
    """The Swin Transformer, on images of one size. It is called as DarSwin is.

    Args:
        arguments, options: as `Encoder`.
        image_size: (H, W), or the side of a square. patch_size: its side, in pixels.
        window: (rows, columns) where the map is large enough.
        view: "none" takes the images as they are and ignores the lens; "perspective", with the
            option `max_fov`, and "square", with `spacing`, are views of that size through the lens:
            see `darswin.models.views`.

    Raises:
        ValueError: sizes that do not divide, a wrong option; in forward, images of another size.
        TypeError: in forward, no lens where there is a view.

    Source: Swin Transformer, ICCV 2021; at 64 px with patches of 2 and windows of 4 as in DarSwin,
        ICCV 2023, sec. 5.1.
    """

    image_size: Pair

    def __init__(
        self,
        *arguments: Any,
        image_size: int | Pair = 64,
        patch_size: int = 2,
        window: Pair = (4, 4),
        view: ViewName = "none",
        **options: Any,
    ):
        height, width = (image_size,) * 2 if isinstance(image_size, int) else image_size
        made = make_view(view, (height, width), options)
        super().__init__(*arguments, **options)
        self.view, self.image_size, self.square_images = made, (height, width), height == width
        if any(side < 1 or side % patch_size for side in (height, width)):
            raise ValueError(
                f"patch_size must divide image_size = {self.image_size}, got {patch_size}"
            )
        rows, columns = height // patch_size, width // patch_size
        self.patch_embed = PatchProjection(self.in_chans, self.embed_dim, patch_size)
        plans = plan_stages(rows, columns, len(self.depths), "RA", window)
        self._finish(plans, (patch_size, patch_size))

    def attention(self, dim: int, heads: int, plan: StagePlan, block: int) -> nn.Module:
        """As `Encoder`."""
        return WindowAttention(dim, heads, **plan.windows(block))

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        """As `Encoder`: the pixels of the images that the view shows."""
        way = self.view.prepare(lens, size, both=False)
        return super().prepare(lens, size)._replace(points=way.there)

    def embed(self, images: Tensor, points: Tensor | None) -> Tensor:
        """Images (B, C, H, W), read at the pixels `points` (N, H, W, 2) if any → the first map."""
        seen = self.view.to_view(self._floating(images), points)
        return self.patch_embed(seen.permute(0, 2, 3, 1))
