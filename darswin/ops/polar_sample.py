"""polar_sample, an image on a polar grid, and polar_embed, its patches as tokens by a linear layer.
Public functions, fakes, autograd."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops._sampling import GRADIENTS, Sampling, checked_sampling, unchecked_sampling
from darswin.ops.checks import check_layout, check_tensor

_SAMPLE = torch.ops.darswin.polar_sample.default
_EMBED = torch.ops.darswin.polar_embed.default


def polar_sample(
    image: Tensor,
    radii: Tensor,
    azimuths: Tensor,
    center: Tensor,
    *,
    affine: Tensor | None = None,
    offsets: Tensor | None = None,
    samples: tuple[int, int],
    jitter: float = 0.0,
    seed: int | Tensor = 0,
    layout: Literal["tokens", "image"] = "tokens",
    mean: float | Sequence[float] = 0.0,
    std: float | Sequence[float] = 1.0,
    channels_last: bool | None = None,
) -> Tensor:
    """Samples an image bilinearly on a polar grid, zeros outside.

    Point (i, j) of image b stands at `(x, y) = center + affine @ (r cos a, r sin a) +
    offsets[b, :, i, j]` with `r = radii[b, i]` and `a = azimuths[j]`. A circular lens needs
    neither affine nor offsets. `polar_embed` takes the linear layer of a patch embedding along.

    Convention:
        Pixel centres are integers, x to the right in [0, W-1] and y down in [0, H-1]; azimuth 0
        points right, π/2 down. Points at NaN or infinity sample nothing; pixels that are NaN or
        infinite count with their weights, as in `F.grid_sample`.

    Args:
        image: (B, C, H, W) or (B, H, W, C), as channels_last says, of any strides: float32,
            float64, bfloat16, or uint8 camera frames.
        radii: (B or 1, R·S_r) px. Like azimuths, center, affine and offsets float64 if the image
            is, else float32.
        azimuths: (A·S_φ,) rad. They have a gradient only within `use_reference()`; use affine to
            turn the grid, or offsets to move its points, where a gradient is wanted.
        center: (B or 1, 2) px, x then y.
        affine: (B or 1, 2, 2), of rows x and y: aspect ratio and skew. None is the identity.
        offsets: (B or 1, 2, R·S_r, A·S_φ) px, x then y: what else moves the points of a
            general lens, such as its tangential distortion. None is zero.
        samples: (S_r, S_φ), the samples of a patch along radius and azimuth.
        jitter: in [0, 1]. Moves each point by `u·jitter` cells along its row of radii (linear
            between neighbours, extrapolated at both ends, never below 0) and by
            `v·jitter·2π/(A·S_φ)` in azimuth, before the matrix; its offset stays that of the
            unmoved point. u and v, in [-½, ½), are the upper and the lower half of one 32-bit word
            of Philox4x32-10: for point p = i·A·S_φ + j of image b word p mod 4 of key `seed`,
            counter (⌊p/4⌋, b).
        seed: int or 0-dim int64 tensor on the CPU. Without jitter it is not used.
        layout: "tokens" or "image".
        mean, std: one number, or one a channel. Pixels of type uint8 count as
            `(pixel/255 - mean) / std`, zero outside the image; those of other types count as they
            are, whatever mean and std say.
        channels_last: True for an image (B, H, W, C), False for (B, C, H, W). With None an image in
            floating point is (B, C, H, W), and the channels of a uint8 image are its second or its
            last axis, the one that has the size 1, 3 or 4.

    Returns:
        "tokens": (B, R, A, S_r·S_φ·C), inner order (S_r, S_φ, C).
        "image": (B, C, R·S_r, A·S_φ), what `F.grid_sample` gives on such a grid.
        bfloat16 where the image is, or under bfloat16 autocast; float64 where the image is; else
        float32. bfloat16 is computed in float32 and rounded once.

    Gradients go to image (unless uint8), radii, center, affine and offsets, by backward() alone;
    results and gradients do not depend on the number of threads.

    Raises:
        TypeError: a tensor of another dtype, or an argument of another type.
        ValueError: a shape, device or range that does not fit; without channels_last, a uint8 image
            of which both axes can be that of the channels, or neither.
        NotImplementedError: forward-mode derivatives, those of torch.func, second ones, and
            azimuths that require a gradient.

    Source: DarSwin, ICCV 2023, sec. 4.3.
    """
    given = (
        image, radii, azimuths, center, affine, offsets, jitter, seed, samples, mean, std,
        channels_last,
    )  # fmt: skip
    check_layout(layout)
    sampling, tokens = unchecked_sampling(*given), layout == "tokens"
    if sampling is not None:
        out = _library.attempt(_SAMPLE, (*sampling, tokens))
        if out is not None:
            return out
    return _library.run(
        _SAMPLE, reference.polar_sample, Sampling.kernel_takes, checked_sampling(*given), tokens
    )


@torch.library.register_fake("darswin::polar_sample")
def _fake(*arguments):
    *fields, tokens = arguments
    sampling = Sampling(*fields)
    if tokens:
        return sampling.new_output((*sampling.map_size(), sampling.token_size()))
    rows, columns = sampling.radii.shape[1], sampling.azimuths.shape[0]
    return sampling.new_output((*sampling.image.shape[:2], rows, columns))


_library.register_gradients("polar_sample", GRADIENTS)


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
    given = (
        image, radii, azimuths, center, affine, offsets, jitter, seed, samples, mean, std,
        channels_last,
    )  # fmt: skip
    sampling = unchecked_sampling(*given)
    if sampling is not None and _library.plain(weight) and (bias is None or _library.plain(bias)):
        out = _library.attempt(_EMBED, (*sampling, weight, bias))
        if out is not None:
            return out
    sampling = checked_sampling(*given)
    image, size = sampling.image, sampling.token_size()
    double = image.dtype == torch.float64
    dtypes = (torch.float64,) if double else (torch.float32, torch.bfloat16)
    form = "(D, S_r·S_φ·C) = (any, {})"
    check_tensor("weight", weight, dtypes, form, (None, size), like=image)
    if bias is not None:
        check_tensor("bias", bias, dtypes, "(D,) = ({},)", (weight.shape[0],), like=image)
    return _library.run(
        _EMBED, reference.polar_embed, Sampling.kernel_takes, sampling, weight, bias
    )


@torch.library.register_fake("darswin::polar_embed")
def _fake_embed(*arguments):
    *fields, weight, _bias = arguments
    sampling = Sampling(*fields)
    return sampling.new_output((*sampling.map_size(), weight.shape[0]))


_FIELDS = len(Sampling._fields)  # weight and bias come after them


def _fake_embed_backward(*arguments):
    weight, *_, weight_grad = arguments[_FIELDS:]
    of_sampling = _library.empty_gradients(arguments, GRADIENTS, arguments[-4:-1])
    shapes = (weight.shape, weight.shape[:1]) if weight_grad else ((0,), (0,))
    return *of_sampling, *(arguments[1].new_empty(shape) for shape in shapes)


_library.register_gradients(
    "polar_embed", GRADIENTS | {_FIELDS: 3, _FIELDS + 1: 3}, _fake_embed_backward
)
