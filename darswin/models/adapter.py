"""Any network on square images, behind any lens."""

from typing import Any, NamedTuple

from torch import Tensor, nn
from torch.utils import _pytree as pytree

from darswin.layers.sampling import check_count, check_images, check_lens
from darswin.lens import Lens
from darswin.lens.concentric import read_square, square_places, square_view
from darswin.lens.pixels import sample_at
from darswin.lens.spacing import SPACINGS, Spacing
from darswin.models.stages import Pair
from darswin.ops.checks import as_int


class SquareView(NamedTuple):
    """A lens's disc as a square, and back: `there` (N, S, S, 2) px in the image, and `places`
    (N, H, W, 2) in the square, which is [-1, 1]²."""

    there: Tensor
    places: Tensor


def prepare_square(lens: Lens | None, image_size: Pair, size: int, spacing: Spacing) -> SquareView:
    """The square of `size` px that shows what the lens sees in images of (H, W).

    Raises:
        TypeError: no lens. ValueError: a lens of images of another size, or spacing "tan" with one
            of θ_max ≥ 90°.
    """
    lens = check_lens(lens, image_size)
    return SquareView(
        square_view(lens, image_size, size, spacing), square_places(lens, image_size, spacing)
    )


class LensAdapter(nn.Module):
    """Any network on square images, made to work through any lens.

    The image disc becomes a square by the concentric map, the network runs on the square, and what
    it gives with 4 dimensions, (B, K, S', S') of any S', is brought back to the pixels of the
    images, (B, K, H, W): one resampling each way. Pixels that no ray reaches are 0. What else it
    gives, such as a class, passes through; lists, tuples and dicts are looked into.

    The network sees equal steps of θ at equal distances from the middle whatever the lens, and may
    be one of timm, segmentation_models_pytorch or your own, trained or not. It is called
    `adapter(images, lens)`.

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
        if spacing not in SPACINGS:
            raise ValueError(f"spacing must be one of {SPACINGS}, got {spacing!r}")
        self.network, self.size, self.spacing = network, int(size), spacing

    def prepare(self, lens: Lens, size: Pair) -> SquareView:
        """What the lenses alone decide about images of (H, W), for any number of calls of `run`.

        Raises:
            TypeError: no lens. ValueError: a lens of images of another size, or spacing "tan" with
                one of θ_max ≥ 90°.
        """
        return prepare_square(lens, size, self.size, self.spacing)

    def run(self, images: Tensor, prepared: SquareView) -> Any:
        """As `forward`, with what `prepare` gave for the size of these images.

        Raises:
            TypeError: images that are not in floating point.
            ValueError: as many lenses as do not fit the images.
        """
        images = _check_floating(images)
        check_count(len(prepared.there), images)

        def bring_back(out: Any) -> Any:
            dense = isinstance(out, Tensor) and out.dim() == 4
            return read_square(out, prepared.places) if dense else out

        return pytree.tree_map(bring_back, self.network(sample_at(images, prepared.there)))

    def forward(self, images: Tensor, lens: Lens) -> Any:
        """Images (B, C, H, W) and their lenses (B or 1) → what the network gives, at the pixels."""
        height, width = _check_floating(images).shape[2:]
        return self.run(images, self.prepare(lens, (height, width)))

    def extra_repr(self) -> str:
        return f"size={self.size}, spacing={self.spacing!r}"


def _check_floating(images: Tensor) -> Tensor:
    """The images (B, C, H, W) in floating point, else TypeError or ValueError."""
    if isinstance(images, Tensor) and not images.is_floating_point():
        raise TypeError(f"images must be in floating point, got {images.dtype}")
    return check_images(images)
