"""polar_embed: polar sampling and the linear layer behind it. Public function, fake, autograd."""

from collections.abc import Sequence

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops.checks import check_shape, check_tensor
from darswin.ops.polar_sample import (
    sampling_arguments,
    sampling_gradients,
    sampling_wants,
    wanted_gradients,
)


def polar_embed(
    image: Tensor,
    radii: Tensor,
    azimuths: Tensor,
    center: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    *,
    affine: Tensor | None = None,
    offsets: Tensor | None = None,
    patch: tuple[int, int],
    jitter: float = 0.0,
    seed: int | Tensor = 0,
    mean: float | Sequence[float] | None = None,
    std: float | Sequence[float] | None = None,
) -> Tensor:
    """Samples the patches of a polar grid and maps each to a token: `F.linear(polar_sample(...))`.

    The samples are never written to memory; backward makes them again.

    Args:
        image, radii, azimuths, center, affine, offsets, patch, jitter, seed, mean, std: as
            `polar_sample`.
        weight: (D, S_r·S_φ·C), float64 if the image is, else float32 or bfloat16.
        bias: (D,) or None, as weight.

    Returns:
        (B, R, A, D). bfloat16 where the image is, or under bfloat16 autocast; float64 where the
        image is; else float32. bfloat16 is computed in float32 and rounded once.

    Gradients go to weight, bias, image (unless uint8), radii, center, affine and offsets; results
    and gradients do not depend on the number of threads.

    Raises:
        TypeError, ValueError: as `polar_sample`, and for a weight or bias that does not fit.
        NotImplementedError: as `polar_sample`.

    Source: DarSwin, ICCV 2023, sec. 4.3.
    """
    sampling = sampling_arguments(
        image, radii, azimuths, center, affine, offsets, patch, jitter, seed, mean, std
    )
    image, patch = sampling[0], sampling[6]
    double = image.dtype == torch.float64
    dtypes = (torch.float64,) if double else (torch.float32, torch.bfloat16)
    check_tensor("weight", weight, like=image, dtypes=dtypes)
    samples = patch[0] * patch[1] * image.shape[1]
    check_shape("weight", weight, "(D, S_r·S_φ·C) = (any, {})", (None, samples))
    if bias is not None:
        check_tensor("bias", bias, like=image, dtypes=dtypes)
        check_shape("bias", bias, "(D,) = ({},)", (weight.shape[0],))
    arguments = (*sampling[:6], weight, bias, *sampling[6:], _library.output_bfloat16(image))
    return _library.run(torch.ops.darswin.polar_embed, reference.polar_embed, arguments)


@torch.library.register_fake("darswin::polar_embed")
def _fake(image, radii, azimuths, center, affine, offsets, weight, bias, patch, *settings):
    shape = (
        image.shape[0], radii.shape[1] // patch[0], azimuths.shape[0] // patch[1], weight.shape[0],
    )  # fmt: skip
    bfloat16 = settings[-1]
    return radii.new_empty(shape, dtype=torch.bfloat16 if bfloat16 else None)


@torch.library.register_fake("darswin::polar_embed_backward")
def _fake_backward(grad_out, image, radii, azimuths, center, affine, offsets, weight, *settings):
    *_, image_grad, lens_grad, offsets_grad, weight_grad = settings
    wants = (image_grad, lens_grad, offsets_grad)
    return (
        *sampling_gradients(image, radii, center, affine, offsets, *wants),
        radii.new_empty(weight.shape if weight_grad else (0,)),
        radii.new_empty(weight.shape[:1] if weight_grad else (0,)),
    )


def _setup_context(ctx, inputs, output):
    *sampling, weight, bias, patch, jitter, seed, mean, std, bfloat16 = inputs
    ctx.save_for_backward(*sampling, weight, jitter, seed)
    ctx.settings = patch, (mean, std, bfloat16)
    ctx.bias_dtype = weight.dtype if bias is None else bias.dtype


def _backward(ctx, grad_out):
    _library.refuse_other_derivatives("polar_embed's backward", (grad_out,))
    *sampling, weight, jitter, seed = ctx.saved_tensors
    patch, rest = ctx.settings
    wants_weight, wants_bias = ctx.needs_input_grad[6:8]
    image, radii, center, affine, offsets, grad_weight, grad_bias = (
        torch.ops.darswin.polar_embed_backward(
            grad_out, *sampling, weight, patch, jitter, seed, *rest,
            *sampling_wants(ctx.needs_input_grad), wants_weight or wants_bias,
        )
    )  # fmt: skip
    grads = (image, radii, None, center, affine, offsets)
    grads += (grad_weight.to(weight.dtype), grad_bias.to(ctx.bias_dtype))
    return wanted_gradients(ctx, *grads, *(None,) * 6)


torch.library.register_autograd("darswin::polar_embed", _backward, setup_context=_setup_context)
_library.no_second_derivative("darswin::polar_embed")
