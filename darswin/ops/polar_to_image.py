"""polar_to_image resamples a polar map to an image. Public function, fakes and autograd."""

from typing import Literal

import torch
from torch import Tensor
from torch.overrides import handle_torch_function, has_torch_function_unary

from darswin.ops import _library, reference
from darswin.ops.checks import DTYPES, check_layout, check_pair, check_rising, check_tensor

_TO_IMAGE = _library.operator("polar_to_image")
_PLAN = _library.operator("_polar_to_image_plan")


def polar_to_image(
    x: Tensor,
    radii: Tensor,
    center: Tensor | None,
    size: tuple[int, int],
    *,
    affine: Tensor | None = None,
    points: Tensor | None = None,
    r_max: Tensor | float | None = None,
    plan: Tensor | None = None,
    layout: Literal["tokens", "image"] = "image",
) -> Tensor:
    """Resamples a polar map to the pixels of an image, the reverse of `polar_sample`.

    Each pixel is interpolated bilinearly between the two rings and the two sectors around it.
    Azimuth is periodic. Inside the centre of ring 0, the inner neighbour is the sector across the
    pole, half a turn away. From the centre of the last ring to `r_max`, only the last ring counts.
    Pixels beyond `r_max` are zero. Radii and azimuths of the pixels are computed on the fly, so
    there is no sampling grid in memory.

    Convention:
        Pixel centres are integers, x to the right in [0, W-1] and y down in [0, H-1]; azimuth 0
        points right, π/2 down. Sector a has its middle at 2π(a + ½)/A, as in `PolarView`.

    Args:
        x: (B, R, A, D), float32, float64 or bfloat16.
        radii: (B or 1, R) px, of the rings' centres: finite, at least 0, rising. All tensors from
            here on are float64 if x is float64, else float32.
        center: (B or 1, 2) px, x then y; None if `points` are given.
        size: (H, W) of the image.
        affine: (B or 1, 2, 2), rows x and y: aspect ratio and skew, as in `polar_sample`.
        points: (B or 1, H, W, 2) px, for a lens that is not circular: the place (r cos φ, r sin φ)
            of each pixel's ray on the plane of radius and azimuth. It replaces center and affine.
            Pixels whose place is NaN or infinite are zero.
        r_max: px, the radius at which the image ends: a number, or (B or 1,). None means no limit.
        plan: the result of `polar_to_image_plan` for the same lens and sizes. It saves time and
            leaves the result as it is. The result has no meaning if the plan is of another lens.
        layout: "image" or "tokens".

    Returns:
        "image": (B, D, H, W). "tokens": (B, H, W, D). The dtype is that of x; 16-bit results are
        computed in float32 and rounded once.

    backward() gives gradients for x, radii, center, affine and points. Results and gradients do not
    depend on the number of threads. At the centre itself, radius and azimuth have no gradient.

    Raises:
        TypeError: a tensor has an unsupported dtype, or an argument has the wrong type.
        ValueError: a shape, device or range does not fit, or the radii do not rise.
        NotImplementedError: forward-mode, torch.func or second derivatives are requested.
    """
    if has_torch_function_unary(x):
        return handle_torch_function(
            polar_to_image, (x,), x, radii, center, size, affine=affine, points=points,
            r_max=r_max, plan=plan, layout=layout,
        )  # fmt: skip
    size = check_pair("size", size, lowest=0)
    check_layout(layout)
    r_max, tokens = _as_tensor(r_max, radii), layout == "tokens"
    return _library.call(
        _TO_IMAGE, _check, reference.polar_to_image,
        (x, radii, center, affine, points, r_max, size, tokens, plan),
    )  # fmt: skip


def polar_to_image_plan(
    x: Tensor,
    radii: Tensor,
    center: Tensor | None,
    size: tuple[int, int],
    *,
    affine: Tensor | None = None,
    points: Tensor | None = None,
    r_max: Tensor | float | None = None,
) -> Tensor | None:
    """The positions of an image's pixels in a polar map, for `polar_to_image(..., plan=)`.

    With few channels, finding these positions takes a large part of the time of `polar_to_image`.
    If your lens stays the same, make a plan once and give it to each call. It takes 12 bytes per
    pixel, or 24 for float64. It has no gradient, and the gradients of the lens do not depend on it.

    Args:
        x: a map with the dtype, the rings and the sectors of the later maps. Its values are
            ignored, and D may be 0.

    The other arguments and the errors are those of `polar_to_image`.

    Returns:
        (B or 1, H, 3, W), or None where `polar_to_image` uses no plan: on devices other than the
        CPU, within `use_reference`, and while a graph is compiled, exported or traced.
    """
    if torch.compiler.is_compiling() or torch.jit.is_tracing() or _library.transformed():
        return None
    size = check_pair("size", size, lowest=0)
    with torch.no_grad():
        return _library.call(
            _PLAN, _check, lambda *arguments: None,
            (x, radii, center, affine, points, _as_tensor(r_max, radii), size),
        )  # fmt: skip


def _as_tensor(r_max: Tensor | float | None, radii: Tensor) -> Tensor | None:
    if not isinstance(r_max, (int, float)):
        return r_max
    return radii.new_full((1,), float(r_max)) if isinstance(radii, Tensor) else None


def _check(x, radii, center, affine, points, r_max, size, tokens=False, plan=None) -> None:
    """Raises TypeError or ValueError unless the arguments of an operator fit."""
    height, width = size
    check_tensor("x", x, (*DTYPES, torch.bfloat16), "(B, R, A, D)", (None,) * 4)
    rings, sectors = x.shape[1:3]
    if rings == 0 or sectors == 0:
        raise ValueError(f"x must have rings and sectors, got {tuple(x.shape)}")
    real = torch.float64 if x.dtype == torch.float64 else torch.float32
    if (center is None) == (points is None) or (points is not None and affine is not None):
        raise ValueError("polar_to_image needs either center (with an optional affine) or points")
    for name, tensor, form, *shape in (
        ("radii", radii, "(B or 1, R) = ({} or 1, {})", rings),
        ("center", center, "(B or 1, 2) = ({} or 1, {})", 2),
        ("affine", affine, "(B or 1, 2, 2) = ({} or 1, {}, {})", 2, 2),
        ("points", points, "(B or 1, H, W, 2) = ({} or 1, {}, {}, {})", height, width, 2),
        ("r_max", r_max, "(B or 1,) = ({} or 1,)"),
        ("plan", plan, "(B or 1, H, 3, W) = ({} or 1, {}, {}, {})", height, 3, width),
    ):
        if tensor is not None or name == "radii":
            check_tensor(name, tensor, (real,), form, (x.shape[0], *shape), (1, *shape), like=x)
    check_rising("radii", radii)


@_library.register_fake("polar_to_image")
def _fake(x, radii, center, affine, points, r_max, size, tokens, plan):
    _check(x, radii, center, affine, points, r_max, size, tokens, plan)
    (batch, _, _, channels), (height, width) = x.shape, size
    return x.new_empty(
        (batch, height, width, channels) if tokens else (batch, channels, height, width)
    )


@_library.register_fake("_polar_to_image_plan")
def _fake_plan(x, radii, center, affine, points, r_max, size):
    _check(x, radii, center, affine, points, r_max, size)
    lens = (radii, center, affine, points, r_max)
    shared = all(t is None or t.shape[0] == 1 for t in lens)
    return radii.new_empty((1 if shared else x.shape[0], size[0], 3, size[1]))


GRADIENTS = {0: 0, 1: 1, 2: 1, 3: 1, 4: 1}  # group 0: x; group 1: the lens
_library.register_gradients("polar_to_image", GRADIENTS)
