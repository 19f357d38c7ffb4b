"""polar_to_image: a polar map as an image. Public function, fake, autograd."""

from typing import Literal

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops.checks import (
    DTYPES,
    check_layout,
    check_pair,
    check_rising,
    check_shape,
    check_tensor,
)


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

    A linear layer behind it may as well come first, on the map: fewer channels are brought back.

    Raises:
        TypeError: a tensor of another dtype, or an argument of another type.
        ValueError: a shape, device or range that does not fit, or radii that do not rise.
        NotImplementedError: forward-mode derivatives, those of torch.func, and second ones.
    """
    half: tuple[torch.dtype, ...] = (torch.bfloat16,)
    if isinstance(x, Tensor) and _library.has_kernels(x):
        half = (torch.bfloat16, torch.float16)
    elif isinstance(x, Tensor):
        x = _library.without_float16(x)
    check_tensor("x", x, dtypes=(*DTYPES, *half))
    check_shape("x", x, "(B, R, A, D)", (None,) * 4)
    rings, sectors = x.shape[1:3]
    if rings == 0 or sectors == 0:
        raise ValueError(f"x must have rings and sectors, got {tuple(x.shape)}")
    real = torch.float64 if x.dtype == torch.float64 else torch.float32
    height, width = check_pair("size", size, lowest=0)
    if (center is None) == (points is None) or (points is not None and affine is not None):
        raise ValueError("polar_to_image takes center, and affine if need be, or else points")
    if isinstance(r_max, (int, float)):
        r_max = radii.new_full((1,), float(r_max)) if isinstance(radii, Tensor) else None
    _check_lens("radii", radii, x, real, "(B or 1, R) = ({} or 1, {})", rings)
    for name, tensor, form, *shape in (
        ("center", center, "(B or 1, 2) = ({} or 1, {})", 2),
        ("affine", affine, "(B or 1, 2, 2) = ({} or 1, {}, {})", 2, 2),
        ("points", points, "(B or 1, H, W, 2) = ({} or 1, {}, {}, {})", height, width, 2),
        ("r_max", r_max, "(B or 1,) = ({} or 1,)"),
    ):
        if tensor is not None:
            _check_lens(name, tensor, x, real, form, *shape)
    check_rising("radii", radii)
    check_layout(layout)
    return _library.run(
        reference.polar_to_image, reference.polar_to_image,
        x, radii, center, affine, points, r_max, (height, width), layout == "tokens",
        kernel=_kernel_takes(x, height * width),
    )  # fmt: skip


def _kernel_takes(x: Tensor, pixels: int) -> bool:
    """Whether the kernel for GPUs is there and computes it: not float64, nor 2³¹ pixels or tokens
    of an image."""
    if not _library.has_kernels(x) or x.dtype == torch.float64:
        return False
    return max(pixels, x.shape[1] * x.shape[2]) < 2**31 - 2**16


def _check_lens(
    name: str, tensor: Tensor, x: Tensor, dtype: torch.dtype, form: str, *shape: int
) -> None:
    """TypeError or ValueError unless a tensor of the lens is (B or 1, *shape), beside x."""
    check_tensor(name, tensor, like=x, dtypes=(dtype,))
    check_shape(name, tensor, form, (len(x), *shape), (1, *shape))


@torch.library.register_fake("darswin::polar_to_image")
def _fake(x, radii, center, affine, points, r_max, size, tokens):
    (batch, _, _, channels), (height, width) = x.shape, size
    return x.new_empty(
        (batch, height, width, channels) if tokens else (batch, channels, height, width)
    )


@torch.library.register_fake("darswin::polar_to_image_backward")
def _fake_backward(
    x, radii, center, affine, points, r_max, size, tokens, grad_out, x_grad, lens_grad
):
    lens = (radii, center, affine, points)
    gradients = [radii.new_empty(t.shape if lens_grad and t is not None else (0,)) for t in lens]
    return x.new_empty(x.shape if x_grad else (0,)), *gradients


def _setup_context(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:6])
    ctx.settings = inputs[6:]


def _backward(ctx, grad_out):
    _library.refuse_other_derivatives("polar_to_image's backward", (grad_out,))
    wanted = ctx.needs_input_grad
    gradients = torch.ops.darswin.polar_to_image_backward(
        *ctx.saved_tensors, *ctx.settings, grad_out, wanted[0], any(wanted[1:5])
    )
    kept = [g if want else None for g, want in zip(gradients, wanted, strict=False)]
    return *kept, None, None, None


torch.library.register_autograd("darswin::polar_to_image", _backward, setup_context=_setup_context)
_library.no_second_derivative("darswin::polar_to_image")
