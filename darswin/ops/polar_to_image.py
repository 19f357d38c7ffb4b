"""polar_to_image: a polar map as an image. Public function, fakes, autograd."""

from typing import Literal

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops.checks import DTYPES, check_layout, check_pair, check_rising, check_tensor

_TO_IMAGE = torch.ops.darswin.polar_to_image.default


def polar_to_image(
    x: Tensor,
    radii: Tensor,
    center: Tensor | None,
    size: tuple[int, int],
    *,
    affine: Tensor | None = None,
    points: Tensor | None = None,
    r_max: Tensor | float | None = None,
    layout: Literal["tokens", "image"] = "image",
) -> Tensor:
    """Brings a polar map back to pixels: what `polar_sample` does to an image, the other way.

    The value of a pixel is bilinear between the two rings and the two sectors around it. Azimuth
    is periodic. Inside the centre of ring 0 the neighbour is the sector half a turn away, across
    the pole; from the last ring's centre to `r_max` the last ring counts alone; beyond is zero.
    The pixels' radii and azimuths are computed from their places: there is no mesh.

    Convention:
        Pixel centres are integers, x to the right in [0, W-1] and y down in [0, H-1]; azimuth 0
        points right, π/2 down. Sector a has its middle at 2π(a + ½)/A, as in `polar_grid`.

    Args:
        x: (B, R, A, D), float32, float64 or bfloat16. float16 is taken like bfloat16 where
            `darswin.ops.triton` has kernels, elsewhere as float32 under autocast.
        radii: (B or 1, R) px, of the rings' centres: finite, at least 0, rising. Like all tensors
            that follow float64 if x is, else float32.
        center: (B or 1, 2) px, x then y; None where there are `points`.
        size: (H, W) of the image.
        affine: (B or 1, 2, 2), of rows x and y: aspect ratio and skew, as `polar_sample` takes it.
        points: (B or 1, H, W, 2) px, for a lens that is not circular: where each pixel's ray lies
            on the plane of radius and azimuth, as (r cos φ, r sin φ). It takes the place of center
            and affine. Pixels at NaN or infinity are zero.
        r_max: px, where the image ends: a number, or (B or 1,); None means nowhere.
        layout: "image" or "tokens".

    Returns:
        "image": (B, D, H, W). "tokens": (B, H, W, D). Of the type of x; 16 bits are computed in
        float32 and rounded once.

    Gradients go to x, radii, center, affine and points; results and gradients do not depend on the
    number of threads. At the centre itself radius and azimuth have none.

    Raises:
        TypeError: a tensor of another dtype, or an argument of another type.
        ValueError: a shape, device or range that does not fit, or radii that do not rise.
        NotImplementedError: forward-mode derivatives, those of torch.func, and second ones.
    """
    height, width = check_pair("size", size, lowest=0)
    check_layout(layout)
    tokens = layout == "tokens"
    if isinstance(r_max, (int, float)):
        r_max = radii.new_full((1,), float(r_max)) if isinstance(radii, Tensor) else None
    if _library.may_attempt() and _library.plain(
        x, radii, *(t for t in (center, affine, points, r_max) if t is not None)
    ):
        given = (x, radii, center, affine, points, r_max, (height, width), tokens)
        out = _library.attempt(_TO_IMAGE, given)
        if out is not None:
            return out
    narrow = _library.narrow_types(x)
    x = x if torch.float16 in narrow else _library.without_float16(x)
    check_tensor("x", x, (*DTYPES, *narrow), "(B, R, A, D)", (None,) * 4)
    rings, sectors = x.shape[1:3]
    if rings == 0 or sectors == 0:
        raise ValueError(f"x must have rings and sectors, got {tuple(x.shape)}")
    real = torch.float64 if x.dtype == torch.float64 else torch.float32
    if (center is None) == (points is None) or (points is not None and affine is not None):
        raise ValueError("polar_to_image takes center, and affine if need be, or else points")
    for name, tensor, form, *shape in (
        ("radii", radii, "(B or 1, R) = ({} or 1, {})", rings),
        ("center", center, "(B or 1, 2) = ({} or 1, {})", 2),
        ("affine", affine, "(B or 1, 2, 2) = ({} or 1, {}, {})", 2, 2),
        ("points", points, "(B or 1, H, W, 2) = ({} or 1, {}, {}, {})", height, width, 2),
        ("r_max", r_max, "(B or 1,) = ({} or 1,)"),
    ):
        if tensor is not None or name == "radii":
            check_tensor(name, tensor, (real,), form, (x.shape[0], *shape), (1, *shape), like=x)
    check_rising("radii", radii)
    return _library.run(
        _TO_IMAGE, reference.polar_to_image, _kernel_takes,
        x, radii, center, affine, points, r_max, (height, width), tokens,
    )  # fmt: skip


def _kernel_takes(x, radii, center, affine, points, r_max, size, tokens) -> bool:
    """True if the kernel for GPUs computes it: not float64, nor 2³¹ pixels or tokens an image."""
    most = max(size[0] * size[1], x.shape[1] * x.shape[2])
    return x.dtype != torch.float64 and most < 2**31 - 2**16


@torch.library.register_fake("darswin::polar_to_image")
def _fake(x, radii, center, affine, points, r_max, size, tokens):
    (batch, _, _, channels), (height, width) = x.shape, size
    return x.new_empty(
        (batch, height, width, channels) if tokens else (batch, channels, height, width)
    )


GRADIENTS = {0: 0, 1: 1, 2: 1, 3: 1, 4: 1}  # of x, and of the lens
_library.register_gradients("polar_to_image", GRADIENTS)
