"""The views of images that networks take in: as they are, or through the lens as a perspective
image or a square; and the ways from what a network gives for a view back to the pixels."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from darswin.layers.polar import PixelGrid, PolarGridSpec, check_count, check_images, check_lens
from darswin.lens import Lens
from darswin.lens.concentric import read_square, square_places, square_view
from darswin.lens.pixels import perspective_view, reprojection, sample_at
from darswin.lens.spacing import SPACINGS, Spacing
from darswin.models.base import Model
from darswin.models.stages import Pair
from darswin.ops import polar_to_image
from darswin.ops.checks import as_int

ViewName = Literal["none", "perspective", "square"]


class Way(NamedTuple):
    """The way to a view and back, as the lenses decide it."""

    there: Tensor | None  # (N, H', W', 2) px of the images; None where they are the view
    back: Any  # what the view's `to_pixels` and `back` take


class PlainView:
    """Images as they are, of one size (H, W)."""

    coordinates = 2  # of a token's place

    def __init__(self, size: Pair):
        self.size = size

    def prepare(self, lens: Lens | None, size: Pair, *, both: bool = True) -> Way:
        """The way from images of (H, W) to the view, and, for `both`, the way back."""
        return Way(None, None)

    def to_view(self, images: Tensor, there: Tensor | None) -> Tensor:
        """Images (B, C, H, W) in floating point → the view of them."""
        if there is None:
            return images
        check_count(len(there), images)
        return sample_at(images, there)

    def token_places(self, sizes: Sequence[Pair], back: Any, like: Tensor) -> list[Tensor]:
        """Places of the tokens of maps in the view, x and y in [-1, 1]: (1, H', W', 2) each."""
        sides = ([_centers(side, like.device) for side in size] for size in sizes)
        return [torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[None] for y, x in sides]

    def to_pixels(self, x: Tensor, back: Any, size: Pair) -> Tensor:
        """A map (B, H', W', K) → (B, K, H, W), the pixels of the view."""
        x = x.permute(0, 3, 1, 2)
        if x.shape[2:] == size:
            return x
        return F.interpolate(x, size, mode="bilinear", align_corners=False)

    def back(self, x: Tensor, back: Any) -> Tensor:
        """(B, K, H', W') at the pixels of the view → at those of the images."""
        return x


def _centers(count: int, device: torch.device) -> Tensor:
    """The middles of equal parts of [-1, 1]."""
    return (2 * torch.arange(count, device=device) + 1) / count - 1


class PerspectiveView(PlainView):
    """The perspective view of each image, with the lens's field of view or, of a wider lens, its
    middle `max_fov`; pixels beyond it are 0."""

    def __init__(self, size: Pair, max_fov: float = math.radians(175)):
        super().__init__(size)
        if not 0 < max_fov < math.pi:
            raise ValueError(f"max_fov must be in (0, π), got {max_fov}")
        self.max_fov = float(max_fov)

    def prepare(self, lens: Lens | None, size: Pair, *, both: bool = True) -> Way:
        lens = check_lens(lens, size)
        view = perspective_view(lens, self.size, self.max_fov)
        there = reprojection(lens, size, view, self.size)
        return Way(there, reprojection(view, self.size, lens, size) if both else None)

    def back(self, x: Tensor, back: Tensor) -> Tensor:
        return sample_at(x, back)


class SquareView(PlainView):
    """The image disc as a square, by the concentric map of Shirley and Chiu (JGT 1997), equal steps
    of `spacing` being equal distances there; pixels that no ray reaches are 0."""

    def __init__(self, size: Pair, spacing: Spacing = "theta"):
        super().__init__(size)
        if spacing not in SPACINGS:
            raise ValueError(f"spacing must be one of {SPACINGS}, got {spacing!r}")
        if size[0] != size[1]:
            raise ValueError(f"image_size must be square, got {size}")
        self.spacing = spacing

    def prepare(self, lens: Lens | None, size: Pair, *, both: bool = True) -> Way:
        lens = check_lens(lens, size)
        there = square_view(lens, size, self.size[0], self.spacing)
        return Way(there, square_places(lens, size, self.spacing) if both else None)

    def back(self, x: Tensor, back: Tensor) -> Tensor:
        return read_square(x, back)


class PolarView(PlainView):
    """The polar maps of DarSwin, whose encoder reads the images itself."""

    coordinates = 3  # the direction in which a token looks

    def __init__(self, spec: PolarGridSpec, split: int, sizes: Sequence[Pair]):
        self.spec, self.split = spec, split  # of each ring, in the map that is brought back
        self.specs = [replace(spec, rings=rings, sectors=sectors) for rings, sectors in sizes]

    def prepare(self, lens: Lens | None, size: Pair, *, both: bool = True) -> Way:
        lens = check_lens(lens, size)
        grid = self.spec.pixel_grid(lens, size, self.split)
        return Way(None, (grid, [spec.token_rays(lens) for spec in self.specs]))

    def token_places(
        self, sizes: Sequence[Pair], back: tuple[PixelGrid, list[Tensor]], like: Tensor
    ) -> list[Tensor]:
        return back[1]

    def to_pixels(self, x: Tensor, back: tuple[PixelGrid, list[Tensor]], size: Pair) -> Tensor:
        """A map (B, R, A, K) → (B, K, H, W) of the images; 0 beyond θ_max."""
        dtype = torch.float64 if x.dtype == torch.float64 else torch.float32
        radii, r_max, center, affine, points = (
            None if tensor is None else tensor.to(x.device, dtype) for tensor in back[0]
        )
        assert radii is not None
        pixels = polar_to_image(
            x, radii, center, size, affine=affine, points=points, r_max=r_max, layout="tokens"
        )
        return pixels.permute(0, 3, 1, 2)


_VIEWS: dict[str, tuple[type[PlainView], Sequence[str]]] = {
    "none": (PlainView, ()),
    "perspective": (PerspectiveView, ("max_fov",)),
    "square": (SquareView, ("spacing",)),
}


def make_view(view: ViewName, size: Pair, options: dict[str, Any]) -> PlainView:
    """The view of that name, of (H, W); takes its option out of `options`."""
    if view not in _VIEWS:
        raise ValueError(f"view must be one of {tuple(_VIEWS)}, got {view!r}")
    kind, names = _VIEWS[view]
    return kind(size, **{name: options.pop(name) for name in names if name in options})


class LensAdapter(Model):
    """Any network on square images, made to work through any lens.

    The image disc becomes a square by the concentric map, the network runs on the square, and what
    it gives with 4 dimensions, (B, K, S', S') of any S', is brought back to the pixels of the
    images, (B, K, H, W): one resampling each way. Pixels that no ray reaches are 0. What else it
    gives, such as a class, passes through; lists, tuples and dicts are looked into.

    The network sees equal steps of θ at equal distances from the middle whatever the lens, and may
    be one of timm, segmentation_models_pytorch or your own, trained or not. It is called
    `adapter(images, lens)`, on images in floating point.

    Args:
        network: `network(square)`, (B, C, S, S). size: S, px.
        spacing: of θ from the middle of the square to its edge; see `darswin.lens.spacing`.

    Raises:
        ValueError: a size below 1, or an unknown spacing.

    Source: the concentric map of Shirley and Chiu, JGT 1997.
    """

    def __init__(self, network: nn.Module, size: int, spacing: Spacing = "theta"):
        super().__init__()
        if (as_int(size) or 0) < 1:
            raise ValueError(f"size must be an int of at least 1, got {size!r}")
        self.network, self.view = network, SquareView((int(size), int(size)), spacing)

    def prepare(self, lens: Lens | None, size: Pair) -> Way:
        """As `Model`: where the images show the square, and the square the images."""
        return self.view.prepare(lens, size)

    def _checked(self, images: Tensor) -> Tensor:
        if isinstance(images, Tensor) and not images.is_floating_point():
            raise TypeError(f"images must be in floating point, got {images.dtype}")
        return check_images(images)

    def _run(self, images: Tensor, prepared: Way) -> Any:
        def bring_back(out: Any) -> Any:
            dense = isinstance(out, Tensor) and out.dim() == 4
            return self.view.back(out, prepared.back) if dense else out

        square = self.view.to_view(images, prepared.there)
        return pytree.tree_map(bring_back, self.network(square))

    def extra_repr(self) -> str:
        return f"size={self.view.size[0]}, spacing={self.view.spacing!r}"
