"""polar_embed: polar sampling and the linear layer behind it. Public function, fake, autograd."""

from collections.abc import Sequence

import torch
from torch import Tensor

from darswin.ops import _devices, _library, reference
from darswin.ops._sampling import (
    TENSORS,
    Sampling,
    checked_sampling,
    input_gradients,
    wanted_groups,
)
from darswin.ops.checks import check_shape, check_tensor


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
    samples: tuple[int, int],
    jitter: float = 0.0,
    seed: int | Tensor = 0,
    mean: float | Sequence[float] = 0.0,
    std: float | Sequence[float] = 1.0,
    channels_last: bool | None = None,
) -> Tensor:
    """Samples the patches of a polar grid and maps each to a token: `F.linear(polar_sample(...))`.

    The samples are never written to memory; backward recomputes them.

    Args:
        image, radii, azimuths, center, affine, offsets, samples: as `polar_sample`.
        jitter, seed, mean, std, channels_last: as `polar_sample`.
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
    sampling = checked_sampling(
        image, radii, azimuths, center, affine, offsets, jitter, seed, samples, mean, std,
        channels_last,
    )  # fmt: skip
    image = sampling.image
    double = image.dtype == torch.float64
    dtypes = (torch.float64,) if double else (torch.float32, torch.bfloat16)
    check_tensor("weight", weight, like=image, dtypes=dtypes)
    form = "(D, S_r·S_φ·C) = (any, {})"
    check_shape("weight", weight, form, (None, sampling.token_size()))
    if bias is not None:
        check_tensor("bias", bias, like=image, dtypes=dtypes)
        check_shape("bias", bias, "(D,) = ({},)", (weight.shape[0],))
    return _library.run(
        reference.polar_embed, _devices.polar_embed, sampling, weight, bias,
        kernel=sampling.kernel_takes(),
    )  # fmt: skip


@torch.library.register_fake("darswin::polar_embed")
def _fake(*arguments):
    *fields, weight, _bias = arguments
    sampling = Sampling(*fields)
    return sampling.new_output((*sampling.map_size(), weight.shape[0]))


@torch.library.register_fake("darswin::polar_embed_backward")
def _fake_backward(*arguments):
    *fields, weight, _grad_out, image_grad, lens_grad, offsets_grad, weight_grad = arguments
    sampling = Sampling(*fields)
    return (
        *sampling.new_gradients(image_grad, lens_grad, offsets_grad),
        sampling.radii.new_empty(weight.shape if weight_grad else (0,)),
        sampling.radii.new_empty(weight.shape[:1] if weight_grad else (0,)),
    )


def _setup_context(ctx, inputs, output):
    *settings, weight, bias = inputs[TENSORS:]
    ctx.save_for_backward(*inputs[:TENSORS], weight)
    ctx.settings = settings
    ctx.bias_dtype = weight.dtype if bias is None else bias.dtype


def _backward(ctx, grad_out):
    _library.refuse_other_derivatives("polar_embed's backward", (grad_out,))
    *tensors, weight = ctx.saved_tensors
    needs = ctx.needs_input_grad
    *gradients, grad_weight, grad_bias = torch.ops.darswin.polar_embed_backward(
        *tensors, *ctx.settings, weight, grad_out, *wanted_groups(needs), needs[-2] or needs[-1]
    )
    layer = grad_weight.to(weight.dtype), grad_bias.to(ctx.bias_dtype)
    return input_gradients(needs, *gradients, *layer)


torch.library.register_autograd("darswin::polar_embed", _backward, setup_context=_setup_context)
_library.no_second_derivative("darswin::polar_embed")
