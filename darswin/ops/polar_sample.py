"""polar_sample: an image on a polar grid, with jitter. Public function, fake, autograd."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops.checks import (
    DTYPES,
    as_int,
    channels_first,
    check_jitter,
    check_layout,
    check_pair,
    check_shape,
    check_tensor,
    per_channel,
)


def polar_sample(
    image: Tensor,
    radii: Tensor,
    azimuths: Tensor,
    center: Tensor,
    *,
    affine: Tensor | None = None,
    offsets: Tensor | None = None,
    patch: tuple[int, int],
    jitter: float = 0.0,
    seed: int | Tensor = 0,
    layout: Literal["tokens", "image"] = "tokens",
    mean: float | Sequence[float] | None = None,
    std: float | Sequence[float] | None = None,
) -> Tensor:
    """Samples an image bilinearly on a polar grid, zeros outside.

    Point (i, j) of image b stands at `(x, y) = center + affine @ (r cos a, r sin a) +
    offsets[b, :, i, j]` with `r = radii[b, i]` and `a = azimuths[j]`. A lens that is round needs
    neither affine nor offsets, and pays nothing for them.

    Convention:
        Pixel centres are integers, x to the right in [0, W-1] and y down in [0, H-1]; azimuth 0
        points right, π/2 down. Points at NaN or infinity sample nothing; pixels that are NaN or
        infinite count with their weights, as in `F.grid_sample`.

    Args:
        image: (B, C, H, W), any strides: float32, float64, bfloat16, or uint8 camera frames, which
            may also be (B, H, W, 3).
        radii: (B or 1, R·S_r) px. Like azimuths, center, affine and offsets float64 if the image
            is, else float32.
        azimuths: (A·S_φ,) rad. They get no gradient.
        center: (B or 1, 2) px, x then y.
        affine: (B or 1, 2, 2), of rows x and y: aspect ratio and skew. None is the identity.
        offsets: (B or 1, 2, R·S_r, A·S_φ) px, x then y: what is left of a lens that is not round,
            such as its tangential distortion. None is zero.
        patch: (S_r, S_φ), the samples of a patch along radius and azimuth.
        jitter: in [0, 1]. Moves each point by `u·jitter` cells along its row of radii (linear
            between neighbours, extrapolated at both ends, never below 0) and by
            `v·jitter·2π/(A·S_φ)` in azimuth, before the matrix; its offset stays that of the
            unmoved point. u and v, in [-½, ½), are the upper and the lower half of one 32-bit word
            of Philox4x32-10: for point p = i·A·S_φ + j of image b word p mod 4 of key `seed`,
            counter (⌊p/4⌋, b).
        seed: int or 0-dim int64 tensor on the CPU. Without jitter it is not used.
        layout: "tokens" or "image".
        mean, std: of uint8 images only, which count as `(pixel/255 - mean) / std`: one number, or
            one a channel. None means 0 and 1. Outside the image is zero after this.

    Returns:
        "tokens": (B, R, A, S_r·S_φ·C), inner order (S_r, S_φ, C).
        "image": (B, C, R·S_r, A·S_φ), what `F.grid_sample` gives on such a grid.
        bfloat16 where the image is, or under bfloat16 autocast; float64 where the image is; else
        float32. bfloat16 is computed in float32 and rounded once.

    Gradients go to image (unless uint8), radii, center, affine and offsets; results and gradients
    do not depend on the number of threads. There are no others than those of backward(); in eager
    mode, asking for others is an error.

    A large fresh output costs its memory's first touch, about as much time as sampling. Where the
    linear layer of a patch embedding comes next, `polar_embed` never writes the samples at all.

    Raises:
        TypeError: a tensor of another dtype, or an argument of another type.
        ValueError: a shape, device or range that does not fit.
        NotImplementedError: forward-mode derivatives, those of torch.func, and second ones.

    Source: DarSwin, ICCV 2023, sec. 4.3.
    """
    sampling = sampling_arguments(
        image, radii, azimuths, center, affine, offsets, patch, jitter, seed, mean, std
    )
    check_layout(layout)
    arguments = (*sampling, layout == "tokens", _library.output_bfloat16(sampling[0]))
    return _library.run(torch.ops.darswin.polar_sample, reference.polar_sample, arguments)


def sampling_arguments(
    image, radii, azimuths, center, affine, offsets, patch, jitter, seed, mean, std
) -> tuple:
    """What `polar_sample` and `polar_embed` share, checked, as the operators take it."""
    if isinstance(image, Tensor):
        image = _library.without_float16(image)
    check_tensor("image", image, dtypes=(*DTYPES, torch.bfloat16, torch.uint8))
    check_shape("image", image, "(B, C, H, W)", (None,) * 4)
    image = channels_first(image)
    geometry = None if image.dtype in DTYPES else (torch.float32,)
    tensors = dict(radii=radii, azimuths=azimuths, center=center, affine=affine, offsets=offsets)
    for name, value in tensors.items():
        if value is not None or name not in ("affine", "offsets"):
            check_tensor(name, value, like=image, dtypes=geometry)
    batch, channels = image.shape[:2]
    check_shape("radii", radii, "(B or 1, R·S_r) = ({} or 1, any)", (batch, None), (1, None))
    check_shape("azimuths", azimuths, "(A·S_φ,)", (None,))
    check_shape("center", center, "(B or 1, 2) = ({} or 1, 2)", (batch, 2), (1, 2))
    if affine is not None:
        form = "(B or 1, 2, 2) = ({} or 1, 2, 2)"
        check_shape("affine", affine, form, (batch, 2, 2), (1, 2, 2))
    if offsets is not None:
        points = (2, radii.shape[1], azimuths.shape[0])
        form = "(B or 1, 2, R·S_r, A·S_φ) = ({} or 1, {}, {}, {})"
        check_shape("offsets", offsets, form, (batch, *points), (1, *points))
    patch = check_pair("patch", patch, lowest=1)
    if radii.shape[1] % patch[0] or azimuths.shape[0] % patch[1]:
        raise ValueError(
            f"patch = (S_r, S_φ) must divide (R·S_r, A·S_φ) = "
            f"({radii.shape[1]}, {azimuths.shape[0]}), got {patch}"
        )
    jitter, key = _jitter_tensors(jitter, seed)
    if image.dtype == torch.uint8:
        mean = per_channel("mean", 0.0 if mean is None else mean, channels)
        std = per_channel("std", 1.0 if std is None else std, channels)
    elif mean is None and std is None:
        mean = std = ()
    else:
        raise ValueError(f"mean and std go with uint8 images, got an image of {image.dtype}")
    return image, radii, azimuths, center, affine, offsets, patch, jitter, key, mean, std


def _jitter_tensors(jitter: float, seed: int | Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Jitter and seed as the operators take them: tensors, so that a graph which is compiled does
    not keep their values. None and None without jitter."""
    jitter = check_jitter(jitter)
    if jitter == 0:
        return None, None
    return torch.tensor(jitter, dtype=torch.float64, device="cpu"), _seed_tensor(seed)


def _seed_tensor(seed: int | Tensor) -> Tensor:
    if isinstance(seed, Tensor):
        if seed.dtype != torch.int64 or seed.dim() != 0:
            raise ValueError(
                f"seed must be an int or a 0-dim int64 tensor, got {seed.dtype} of shape "
                f"{tuple(seed.shape)}"
            )
        return seed
    key = as_int(seed)
    if key is None:
        raise TypeError(f"seed must be an int or a 0-dim int64 tensor, got {type(seed).__name__}")
    if not -(2**63) <= key < 2**63:
        raise ValueError(f"seed must fit 64 bits, got {seed}")
    return torch.tensor(key, dtype=torch.int64, device="cpu")


@torch.library.register_fake("darswin::polar_sample")
def _fake(image, radii, azimuths, center, affine, offsets, patch, *settings):
    *_, tokens, bfloat16 = settings
    batch, channels = image.shape[:2]
    rows, columns = radii.shape[1], azimuths.shape[0]
    if tokens:
        shape = (batch, rows // patch[0], columns // patch[1], patch[0] * patch[1] * channels)
    else:
        shape = (batch, channels, rows, columns)
    return radii.new_empty(shape, dtype=torch.bfloat16 if bfloat16 else None)


@torch.library.register_fake("darswin::polar_sample_backward")
def _fake_backward(grad_out, image, radii, azimuths, center, affine, offsets, *settings):
    return sampling_gradients(image, radii, center, affine, offsets, *settings[-3:])


def sampling_gradients(
    image, radii, center, affine, offsets, image_grad, lens_grad, offsets_grad
) -> tuple[Tensor, ...]:
    """The gradients of the sampling as the backward operators give them: empty if not wanted."""
    return tuple(
        value.new_empty(value.shape) if wanted and value is not None else like.new_empty((0,))
        for value, like, wanted in (
            (image, image, image_grad),
            (radii, radii, lens_grad),
            (center, radii, lens_grad),
            (affine, radii, lens_grad),
            (offsets, radii, offsets_grad),
        )
    )


def sampling_wants(needs_input_grad: Sequence[bool]) -> tuple[bool, bool, bool]:
    """Whether backward needs the gradients of the image, of the lens and of the offsets."""
    image, radii, _, center, affine, offsets = needs_input_grad[:6]
    return image, radii or center or affine, offsets


def _setup_context(ctx, inputs, output):
    *sampling, patch, jitter, seed, mean, std, tokens, bfloat16 = inputs
    ctx.save_for_backward(*sampling, jitter, seed)
    ctx.settings = patch, (mean, std, tokens, bfloat16)


def _backward(ctx, grad_out):
    _library.refuse_other_derivatives("polar_sample's backward", (grad_out,))
    *sampling, jitter, seed = ctx.saved_tensors
    patch, rest = ctx.settings
    image, radii, center, affine, offsets = torch.ops.darswin.polar_sample_backward(
        grad_out, *sampling, patch, jitter, seed, *rest, *sampling_wants(ctx.needs_input_grad)
    )
    return wanted_gradients(ctx, image, radii, None, center, affine, offsets, *(None,) * 7)


def wanted_gradients(ctx, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
    """The gradients of inputs that need one, None for the others."""
    return tuple(
        gradient if wanted else None
        for gradient, wanted in zip(gradients, ctx.needs_input_grad, strict=True)
    )


torch.library.register_autograd("darswin::polar_sample", _backward, setup_context=_setup_context)
_library.no_second_derivative("darswin::polar_sample")
