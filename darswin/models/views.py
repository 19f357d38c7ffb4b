"""The views in which networks see images: the image itself, a perspective view, a square, or polar
maps. A view also resamples the results of a network back to the pixels of the images."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from darswin.layers.polar import PixelGrid, PolarGridSpec, check_count, check_images
from darswin.lens import Lens
from darswin.lens.concentric import read_square, square_points, square_rays, square_view
from darswin.lens.pixels import perspective_view, pixel_rays, reprojection, sample_at
from darswin.lens.spacing import SPACINGS, Spacing, check_fixed_theta_max
from darswin.models.base import Model
from darswin.models.stages import Pair
from darswin.ops import polar_to_image
from darswin.ops.checks import as_int, per_channel
from darswin.utils.angles import degrees_hint

ViewName = Literal["none", "perspective", "square"]


class PlainView:
    """The images themselves, all of one size (H, W)."""

    uses_lens = False
    coordinates = 2  # the number of coordinates in `token_places`

    def __init__(self, size: Pair):
        self.size = size

    def image_points(self, lens: Any, size: Pair) -> Tensor | None:
        """The points of images of (H, W) that the pixels of the view show, (N, H', W', 2) px.

        None means that the view is the images.
        """
        return None

    def view_points(self, lens: Any, size: Pair) -> Any:
        """The points of the view that the pixels of images of (H, W) show."""
        return None

    def rays(self, lens: Any, size: Pair) -> tuple[Tensor, Tensor]:
        """The rays of the pixels of the view, as `pixel_rays` returns them, if it uses the lens."""
        raise NotImplementedError

    def to_view(self, images: Tensor, image_points: Tensor | None) -> Tensor:
        """Images (B, C, H, W) in floating point → the view, (B, C, H', W')."""
        if image_points is None:
            return images
        check_count(image_points.shape[0], images)
        return sample_at(images, image_points)

    def token_places(self, sizes: Sequence[Pair], view_points: Any, like: Tensor) -> list[Tensor]:
        """The positions of the tokens of each map: (1, H', W', 2), x and y in [-1, 1]."""
        sides = ([_centers(side, like.device) for side in size] for size in sizes)
        return [torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[None] for y, x in sides]

    def to_pixels(self, x: Tensor, view_points: Any, size: Pair) -> Tensor:
        """A map (B, H', W', K) → the pixels of the view, (B, K, H, W)."""
        x = x.permute(0, 3, 1, 2)
        if x.shape[2:] == size:
            return x
        return F.interpolate(x, size, mode="bilinear", align_corners=False)

    def to_images(self, x: Tensor, view_points: Any) -> Tensor:
        """The pixels of the view, (B, K, H', W') → the pixels of the images, (B, K, H, W)."""
        return x


def _centers(count: int, device: torch.device) -> Tensor:
    """The centres of `count` equal parts of [-1, 1]."""
    return (2 * torch.arange(count, device=device) + 1) / count - 1


class PerspectiveView(PlainView):
    """A perspective view of each image, with the field of view of the lens, but `max_fov` at most.

    Pixels of the images that are outside the view get 0.
    """

    uses_lens = True

    def __init__(self, size: Pair, max_fov: float = math.radians(175)):
        super().__init__(size)
        if not 0 < max_fov < math.pi:
            hint = degrees_hint(max_fov)
            raise ValueError(f"max_fov must be in (0, π), got {max_fov}{hint}")
        self.max_fov = float(max_fov)

    def image_points(self, lens: Lens, size: Pair) -> Tensor:
        view = perspective_view(lens, self.size, self.max_fov)
        return reprojection(lens, size, view, self.size)

    def view_points(self, lens: Lens, size: Pair) -> Tensor:
        view = perspective_view(lens, self.size, self.max_fov)
        return reprojection(view, self.size, lens, size)

    def rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        return pixel_rays(perspective_view(lens, self.size, self.max_fov), self.size)

    def to_images(self, x: Tensor, view_points: Tensor) -> Tensor:
        return sample_at(x, view_points)


class SquareView(PlainView):
    """The image disc as a square, by the concentric map of Shirley and Chiu (JGT 1997).

    Equal steps of `spacing` become equal distances in the square. Pixels that no ray reaches get 0.
    The edge of the square is θ_max of each lens, or the fixed angle `theta_max` (rad).
    """

    uses_lens = True

    def __init__(self, size: Pair, spacing: Spacing = "theta", theta_max: float | None = None):
        super().__init__(size)
        if spacing not in SPACINGS:
            raise ValueError(f"spacing must be one of {SPACINGS}, got {spacing!r}")
        if size[0] != size[1]:
            raise ValueError(f"image_size must be square, got {size}")
        if theta_max is not None:
            check_fixed_theta_max(theta_max, spacing)
        self.spacing, self.theta_max = spacing, theta_max

    def image_points(self, lens: Lens, size: Pair) -> Tensor:
        return square_view(lens, size, self.size[0], self.spacing, self.theta_max)

    def view_points(self, lens: Lens, size: Pair) -> Tensor:
        return square_points(lens, size, self.spacing, self.theta_max)

    def rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        return square_rays(lens, self.size[0], self.spacing, self.theta_max)

    def to_images(self, x: Tensor, view_points: Tensor) -> Tensor:
        return read_square(x, view_points)


class PolarView(PlainView):
    """The polar maps of DarSwin, whose encoder samples the images itself.

    `split` is the number of rings of the decoder's last map for each ring of the grid, and `sizes`
    are the sizes (R, A) of the encoder's maps.
    """

    uses_lens = True
    coordinates = 3  # the viewing direction of a token

    def __init__(self, spec: PolarGridSpec, split: int, sizes: Sequence[Pair]):
        self.spec, self.split = spec, split
        self.specs = [replace(spec, rings=rings, sectors=sectors) for rings, sectors in sizes]

    def view_points(self, lens: Lens, size: Pair) -> tuple[PixelGrid, list[Tensor]]:
        """The grid of `to_pixels`, and the viewing directions of the tokens of each map."""
        grid = self.spec.pixel_grid(lens, size, self.split)
        return grid, [spec.token_rays(lens) for spec in self.specs]

    def rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        return pixel_rays(lens, size)

    def token_places(self, sizes: Sequence[Pair], view_points: Any, like: Tensor) -> list[Tensor]:
        return view_points[1]

    def to_pixels(self, x: Tensor, view_points: Any, size: Pair) -> Tensor:
        """A map (B, R, A, K) → the pixels of the images, (B, K, H, W); 0 beyond θ_max."""
        dtype = torch.float64 if x.dtype == torch.float64 else torch.float32
        *lens, plan = view_points[0]
        radii, r_max, center, affine, points = (
            None if tensor is None else tensor.to(x.device, dtype) for tensor in lens
        )
        if plan is not None and (plan.device, plan.dtype) != (x.device, dtype):
            plan = None
        assert radii is not None
        pixels = polar_to_image(
            x, radii, center, size,
            affine=affine, points=points, r_max=r_max, plan=plan, layout="tokens",
        )  # fmt: skip
        return pixels.permute(0, 3, 1, 2)


_VIEWS: dict[str, tuple[type[PlainView], Sequence[str]]] = {
    "none": (PlainView, ()),
    "perspective": (PerspectiveView, ("max_fov",)),
    "square": (SquareView, ("spacing", "theta_max")),
}


def make_view(view: str, size: int | Pair, options: dict[str, Any]) -> PlainView:
    """The view with this name, of (H, W) or of a square; its option is taken out of `options`."""
    if view not in _VIEWS:
        raise ValueError(f"view must be one of {tuple(_VIEWS)}, got {view!r}")
    kind, names = _VIEWS[view]
    height, width = (size, size) if isinstance(size, int) else size
    return kind((height, width), **{name: options.pop(name) for name in names if name in options})


class LensAdapter(Model):
    """Wraps any square-image network so that it works with any lens.

    The image disc is resampled to a square by the concentric map, and the network runs on the
    square. Results with 4 dimensions, (B, K, S', S') for any S', are resampled to the pixels of the
    images, (B, K, H, W), and pixels that no ray reaches get 0. Other results, such as logits of
    classes, are returned as they are. Lists, tuples and dicts of results may be nested.

    The network sees equal steps of θ at equal distances from the centre, whatever the lens is. It
    may come from timm, from segmentation_models_pytorch or from you, trained or not. The adapter is
    called `adapter(images, lens)`. It gives images in floating point to the network as they are.

    Args:
        network: a module that takes images (B, C, S, S).
        size: S, in pixels.
        spacing: the spacing from the centre of the square to its edge; see `darswin.lens.spacing`.
        theta_max: θ at the edge of the square, rad. None means θ_max of each lens. The size of a
            thing in the square then depends on the lens, and the network is not told. If sizes
            matter, as for distances, give the widest θ_max of your lenses. The square is 0 beyond
            θ_max of a lens.
        mean, std: the normalization of uint8 images that the network expects, `(pixel/255 - mean) /
            std`, one number or one for each channel. None refuses uint8 images.
        output: "pixels" resamples results with 4 dimensions as described; "view" returns all
            results as the network made them, in the square.

    Raises:
        ValueError: the size is below 1, the spacing or the output is unknown, theta_max is not in
            (0, π) or has another spacing than "theta", or mean and std do not fit together.
        TypeError: in forward, images of uint8 without mean and std.

    Source: the concentric map of Shirley and Chiu, JGT 1997.
    """

    def __init__(
        self,
        network: nn.Module,
        size: int,
        spacing: Spacing = "theta",
        theta_max: float | None = None,
        *,
        mean: float | Sequence[float] | None = None,
        std: float | Sequence[float] | None = None,
        output: Literal["pixels", "view"] = "pixels",
    ):
        super().__init__()
        if (as_int(size) or 0) < 1:
            raise ValueError(f"size must be an int of at least 1, got {size!r}")
        if output not in ("pixels", "view"):
            raise ValueError(f"output must be 'pixels' or 'view', got {output!r}")
        self.network, self.output = network, output
        self.view = SquareView((int(size), int(size)), spacing, theta_max)
        if (mean is None) != (std is None):
            raise ValueError(f"mean and std must be given together, got {mean} and {std}")
        if mean is None or std is None:
            self._looks = 0  # the network may expect any values
        else:
            channels = max(len(tuple(v)) if isinstance(v, Iterable) else 1 for v in (mean, std))
            per_channel("mean", mean, channels), per_channel("std", std, channels)
        self.mean, self.std = mean, std

    def _prepare(self, lens: Any, size: Pair) -> tuple[Tensor, Tensor | None]:
        back = self.view.view_points(lens, size) if self.output == "pixels" else None
        return self.view.image_points(lens, size), back

    def normalize(self, images: Tensor) -> Tensor:
        if self.mean is None:
            raise ValueError("normalize needs an adapter with mean and std")
        return super().normalize(images)

    def _with_shape(self, images: Tensor) -> Tensor:
        taken = (torch.uint8,) if self.mean is not None else ()
        if isinstance(images, Tensor) and not (images.is_floating_point() or images.dtype in taken):
            hint = "" if taken else "; with mean and std, an adapter takes uint8 too"
            raise TypeError(f"images must be in floating point, got {images.dtype}{hint}")
        return check_images(images)

    def _check_device(self, name: str, images: Tensor) -> None:
        """No check: the network may move its images itself."""

    def _sample(self, images: Tensor, prepared: tuple[Tensor, Any]) -> Tensor:
        return self.view.to_view(self._floating(images), prepared[0])

    def _points(self, prepared: tuple[Tensor, Any]) -> Tensor:
        return prepared[0]

    def _run_sampled(self, sampled: Tensor, prepared: Any, images: Tensor | None) -> Any:
        return self._run(sampled, (None, prepared[1]))

    def _run(self, images: Tensor, prepared: tuple[Any, Tensor | None]) -> Any:
        image_points, view_points = prepared
        results = self.network(self.view.to_view(self._floating(images), image_points))
        if view_points is None:
            return results

        def to_images(out: Any) -> Any:
            has_pixels = isinstance(out, Tensor) and out.dim() == 4
            return self.view.to_images(out, view_points) if has_pixels else out

        return pytree.tree_map(to_images, results)

    def extra_repr(self) -> str:
        edge = "" if self.view.theta_max is None else f", theta_max={self.view.theta_max:g}"
        size, spacing = self.view.size[0], self.view.spacing
        return f"size={size}, spacing={spacing!r}{edge}, output={self.output!r}"
