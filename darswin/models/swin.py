"""Swin on images as they are, and on images that were undistorted: the paper's baselines."""

import math
from collections.abc import Sequence

from torch import Tensor

from darswin.layers.attention import WindowAttention
from darswin.layers.sampling import check_lens
from darswin.lens import Lens
from darswin.lens.pixels import perspective_view, reprojection
from darswin.models.encoder import ImageEncoder, Prepared
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair, StagePlan

_PRESETS: Presets = dict(nano=dict(image_size=32))


@register_model("swin", presets=_PRESETS)
class Swin(ImageEncoder):
    """The Swin Transformer. It is called as DarSwin is, and ignores the lens.

    Args:
        num_classes: 0 leaves out the head. in_chans: C of the images.
        embed_dim, depths, num_heads: of the stages; width doubles at each.
        image_size: (H, W), or the side of a square. patch_size: its side, in pixels.
        window: (rows, columns) where the map is large enough.
        mlp_ratio: hidden width of the MLPs over D. drop_path_rate: of the last block; linear.
        mean, std: of uint8 images, which count as `(pixel/255 - mean) / std`; others ignore them.

    Raises:
        ValueError: sizes that do not divide; in forward, images of another size.

    Source: Swin Transformer, ICCV 2021; at 64 px with patches of 2 and windows of 4 as in DarSwin,
        ICCV 2023, sec. 5.1.
    """

    def __init__(
        self,
        num_classes: int = 1000,
        in_chans: int = 3,
        embed_dim: int = 96,
        depths: Sequence[int] = (2, 2, 18, 2),
        num_heads: Sequence[int] = (3, 6, 12, 24),
        *,
        image_size: int | Pair = 64,
        patch_size: int = 2,
        window: Pair = (4, 4),
        mlp_ratio: float = 4.0,
        drop_path_rate: float = 0.2,
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
    ):
        super().__init__(
            num_classes,
            in_chans,
            embed_dim,
            depths,
            num_heads,
            image_size=image_size,
            patch_size=patch_size,
            window=window,
            mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate,
            mean=mean,
            std=std,
            attention=self.attention,
        )

    def attention(self, dim: int, heads: int, plan: StagePlan, block: int) -> WindowAttention:
        """The attention of a block of a stage, which a decoder's blocks have too."""
        return WindowAttention(
            dim,
            heads,
            map_size=plan.map_size,
            window=plan.window,
            shift=plan.shift_of(block),
        )


@register_model("swin_undis", presets=_PRESETS)
class SwinUndis(Swin):
    """Swin on the perspective view of each image, which its lens gives: "Swin (undis)".

    The view has the lens's field of view, θ_max at half the image's shorter side. A perspective
    lens ends below 180° and shrinks the middle long before: of a lens wider than `max_fov` the
    network sees the middle `max_fov` only.

    Args:
        max_fov: the widest field of view of a view, rad, in (0, π).
        options: as `Swin`.

    Raises:
        ValueError: as `Swin`, or a max_fov out of its range.
        TypeError: in forward, no lens.

    Source: DarSwin, ICCV 2023, sec. 5.1.
    """

    def __init__(self, *arguments, max_fov: float = math.radians(175), **options):
        super().__init__(*arguments, **options)
        self.max_fov = check_max_fov(max_fov)

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        """The pixels where the lenses show each pixel of their views; else as `Encoder`."""
        _, points = undistortion(check_lens(lens, size), size, self.image_size, self.max_fov)
        return super().prepare(lens, size)._replace(points=points)


def undistortion(lens: Lens, size: Pair, view_size: Pair, max_fov: float) -> tuple[Lens, Tensor]:
    """The perspective views of N lenses, see `SwinUndis`, and where in the images of (H, W) each
    pixel of them lies, (N, H', W', 2)."""
    view = perspective_view(lens, view_size, max_fov)
    return view, reprojection(lens, size, view, view_size)


def check_max_fov(max_fov: float) -> float:
    """The widest field of view of a perspective view, rad; ValueError unless it is in (0, π)."""
    if not 0 < max_fov < math.pi:
        raise ValueError(f"max_fov must be in (0, π), got {max_fov}")
    return float(max_fov)
