"""polar_sample: an image on a polar grid, with jitter. Public function, fake, autograd."""

from typing import Literal

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops.checks import check_pair, check_sampling, check_shape, check_tensor


def polar_sample(
    image: Tensor,
    radii: Tensor,
    azimuths: Tensor,
    center: Tensor,
    *,
    patch: tuple[int, int],
    jitter: float = 0.0,
    seed: int | Tensor = 0,
    layout: Literal["tokens", "image"] = "tokens",
) -> Tensor:
    """Samples an image bilinearly on a polar grid, zeros outside.

    Point (i, j) of image b stands at `x = cx + r cos a`, `y = cy + r sin a` with `r = radii[b, i]`
    and `a = azimuths[j]`.

    Convention:
        Pixel centres are integers, x to the right in [0, W-1] and y down in [0, H-1]; azimuth 0
        points right, π/2 down. NaN and infinite radii sample nothing.

    Args:
        image: (B, C, H, W), float32 or float64, any strides. bfloat16 and float16 images are
            taken as float32 under autocast.
        radii: (B or 1, R·S_r) px.
        azimuths: (A·S_φ,) rad. They get no gradient.
        center: (B or 1, 2) px, x then y.
        patch: (S_r, S_φ), the samples of a patch along radius and azimuth.
        jitter: in [0, 1]. Moves each point by `u·jitter` cells along its row of radii (linear
            between neighbours, extrapolated at both ends, never below 0) and by
            `v·jitter·2π/(A·S_φ)` in azimuth. u, v in [-½, ½) come from Philox4x32-10, key `seed`,
            counter (i·A·S_φ + j, b).
        seed: int or 0-dim int64 tensor on the CPU. Without jitter it is not used.
        layout: "tokens" or "image".

    Returns:
        "tokens": (B, R, A, S_r·S_φ·C), inner order (S_r, S_φ, C).
        "image": (B, C, R·S_r, A·S_φ), what `F.grid_sample` gives on such a grid.

    Gradients go to image, radii and center; results and gradients do not depend on the number of
    threads.

    Raises:
        TypeError: a tensor of another dtype, or an argument of another type.
        ValueError: a shape, device or range that does not fit.

    Source: DarSwin, ICCV 2023, sec. 4.3.
    """
    if isinstance(image, Tensor):
        (image,) = _library.without_autocast(image)
    check_tensor("image", image)
    for name, value in (("radii", radii), ("azimuths", azimuths), ("center", center)):
        check_tensor(name, value, like=image)
    check_shape("image", image, "(B, C, H, W)", (None,) * 4)
    batch = image.shape[0]
    check_shape("radii", radii, f"(B or 1, R·S_r) = ({batch} or 1, any)", (batch, None), (1, None))
    check_shape("azimuths", azimuths, "(A·S_φ,)", (None,))
    check_shape("center", center, f"(B or 1, 2) = ({batch} or 1, 2)", (batch, 2), (1, 2))
    patch = check_pair("patch", patch, lowest=1)
    if radii.shape[1] % patch[0] or azimuths.shape[0] % patch[1]:
        raise ValueError(
            f"patch = (S_r, S_φ) must divide (R·S_r, A·S_φ) = "
            f"({radii.shape[1]}, {azimuths.shape[0]}), got {patch}"
        )
    check_sampling(jitter, layout)
    key = _seed_tensor(seed) if jitter > 0 else None
    arguments = (image, radii, azimuths, center, patch, float(jitter), key, layout == "tokens")
    if _library.compiled(image):
        return torch.ops.darswin.polar_sample(*arguments)
    return reference.polar_sample(*arguments)


def _seed_tensor(seed: int | Tensor) -> Tensor:
    if isinstance(seed, Tensor):
        if seed.dtype != torch.int64 or seed.dim() != 0:
            raise ValueError(
                f"seed must be an int or a 0-dim int64 tensor, got {seed.dtype} of shape "
                f"{tuple(seed.shape)}"
            )
        return seed
    if isinstance(seed, bool) or not isinstance(seed, (int, torch.SymInt)):
        raise TypeError(f"seed must be an int or a 0-dim int64 tensor, got {type(seed).__name__}")
    if not -(2**63) <= seed < 2**63:
        raise ValueError(f"seed must fit 64 bits, got {seed}")
    return torch.tensor(seed, dtype=torch.int64)


@torch.library.register_fake("darswin::polar_sample")
def _fake(image, radii, azimuths, center, patch, jitter, seed, tokens):
    batch, channels = image.shape[:2]
    rows, columns = radii.shape[1], azimuths.shape[0]
    if tokens:
        shape = (batch, rows // patch[0], columns // patch[1], patch[0] * patch[1] * channels)
    else:
        shape = (batch, channels, rows, columns)
    return image.new_empty(shape)


@torch.library.register_fake("darswin::polar_sample_backward")
def _fake_backward(
    grad_out, image, radii, azimuths, center, patch, jitter, seed, tokens, image_grad, lens_grad
):
    return (
        image.new_empty(image.shape if image_grad else (0,)),
        radii.new_empty(radii.shape if lens_grad else (0,)),
        center.new_empty(center.shape if lens_grad else (0,)),
    )


def _setup_context(ctx, inputs, output):
    image, radii, azimuths, center, patch, jitter, seed, tokens = inputs
    ctx.save_for_backward(image, radii, azimuths, center, seed)
    ctx.settings = (patch, jitter, tokens)


def _backward(ctx, grad_out):
    image, radii, azimuths, center, seed = ctx.saved_tensors
    patch, jitter, tokens = ctx.settings
    wants_image, wants_radii, _, wants_center = ctx.needs_input_grad[:4]
    grad_image, grad_radii, grad_center = torch.ops.darswin.polar_sample_backward(
        grad_out, image, radii, azimuths, center, patch, jitter, seed, tokens,
        wants_image, wants_radii or wants_center,
    )  # fmt: skip
    return (
        grad_image if wants_image else None,
        grad_radii if wants_radii else None,
        None,
        grad_center if wants_center else None,
        None, None, None, None,
    )  # fmt: skip


torch.library.register_autograd("darswin::polar_sample", _backward, setup_context=_setup_context)
_library.no_second_derivative("darswin::polar_sample")
