"""polar_embed: polar sampling and the linear layer behind it. Public function, fake, autograd."""

from collections.abc import Sequence

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops._sampling import GRADIENTS, Sampling, checked_sampling
from darswin.ops.checks import check_tensor


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
    image, size = sampling.image, sampling.token_size()
    double = image.dtype == torch.float64
    dtypes = (torch.float64,) if double else (torch.float32, torch.bfloat16)
    form = "(D, S_r·S_φ·C) = (any, {})"
    check_tensor("weight", weight, dtypes, form, (None, size), like=image)
    if bias is not None:
        check_tensor("bias", bias, dtypes, "(D,) = ({},)", (weight.shape[0],), like=image)
    return _library.run(
        torch.ops.darswin.polar_embed.default, reference.polar_embed, Sampling.kernel_takes,
        sampling, weight, bias,
    )  # fmt: skip


@torch.library.register_fake("darswin::polar_embed")
def _fake(*arguments):
    *fields, weight, _bias = arguments
    sampling = Sampling(*fields)
    return sampling.new_output((*sampling.map_size(), weight.shape[0]))


_FIELDS = len(Sampling._fields)  # weight and bias come after them


def _fake_backward(*arguments):
    weight, *_, weight_grad = arguments[_FIELDS:]
    of_sampling = _library.empty_gradients(arguments, GRADIENTS, arguments[-4:-1])
    shapes = (weight.shape, weight.shape[:1]) if weight_grad else ((0,), (0,))
    return *of_sampling, *(arguments[1].new_empty(shape) for shape in shapes)


_library.register_gradients("polar_embed", GRADIENTS | {_FIELDS: 3, _FIELDS + 1: 3}, _fake_backward)
