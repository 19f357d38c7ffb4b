"""Swin, the paper's baseline, on the images themselves or on views through their lenses."""

from typing import Any

from torch import Tensor, nn

from darswin.layers.embed import PatchProjection
from darswin.layers.transformer import WindowAttention
from darswin.models.encoder import Encoder, Prepared
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair, StagePlan, plan_stages
from darswin.models.views import ViewName, make_view

_PRESETS: Presets = dict(nano=dict(image_size=32))


@register_model("swin", presets=_PRESETS, image_size=64)
@register_model("swin_undis", presets=_PRESETS, image_size=64, view="perspective")
class Swin(Encoder):
    """The Swin Transformer, on images of a single size.

    Args:
        arguments, options: the arguments of `Encoder`.
        image_size: (H, W) in pixels, or the side of a square.
        patch_size: the side of a patch, in pixels.
        window: (rows, columns) on maps that are large enough.
        view: "none" takes the images as they are and ignores the lens. "perspective" (with the
            option `max_fov`) and "square" (with `spacing` and `theta_max`) resample the images to a
            view of this size through the lens; see `PerspectiveView` and `SquareView`.

    Raises:
        ValueError: an unknown option, or sizes that do not divide; in forward, images of another
            size.
        TypeError: in forward, the lens is missing and the view uses it.

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
        made = make_view(view, image_size, options)
        super().__init__(*arguments, **options)
        self.view, self.image_size, self.uses_lens = made, made.size, made.uses_lens
        height, width = made.size
        self.square_images = height == width
        if patch_size < 1 or any(side < 1 or side % patch_size for side in (height, width)):
            raise ValueError(
                f"patch_size must divide image_size = {self.image_size}, got {patch_size}"
            )
        rows, columns = height // patch_size, width // patch_size
        self.patch_embed = PatchProjection(self.in_chans, self.embed_dim, patch_size)
        plans = plan_stages(rows, columns, len(self.depths), "RA", window)
        self._finish(plans, (patch_size, patch_size))

    def attention(self, dim: int, heads: int, plan: StagePlan, block: int) -> nn.Module:
        return WindowAttention(dim, heads, **plan.windows(block))

    def _prepare(self, lens: Any, size: Pair) -> Prepared:
        return super()._prepare(lens, size)._replace(points=self.view.image_points(lens, size))

    def embed(self, images: Tensor, points: Tensor | None) -> Tensor:
        return self.patch_embed(self._to_view(images, points).permute(0, 2, 3, 1))

    def _sample(self, images: Tensor, prepared: Prepared) -> Tensor:
        return self._to_view(images, prepared.points)

    def _to_view(self, images: Tensor, points: Tensor | None) -> Tensor:
        return self.view.to_view(self._floating(images), points)
