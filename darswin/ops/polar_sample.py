"""polar_sample samples an image on a polar grid. Public function, fake and autograd."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops._sampling import (
    GRADIENTS,
    Sampling,
    check_image,
    check_sampling,
    jitter_tensors,
    refuse_gradient_of_azimuths,
)
from darswin.ops.checks import LAYOUTS, channels_first, check_layout, check_pair, per_channel

_SAMPLE = _library.operator("polar_sample")


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
    """Samples an image bilinearly on a polar grid, with zeros outside the image.

    Point (i, j) of image b lies at `(x, y) = center + affine @ (r cos a, r sin a) +
    offsets[b, :, i, j]` with `r = radii[b, i]` and `a = azimuths[j]`. A circular lens needs
    neither affine nor offsets.

    Convention:
        Pixel centres are integers, x to the right in [0, W-1] and y down in [0, H-1]; azimuth 0
        points right, π/2 down. Points at NaN or infinity give zeros. Pixels that are NaN or
        infinite enter the weighted sum, as in `F.grid_sample`.

    Args:
        image: (B, C, H, W) or (B, H, W, C), depending on channels_last, with any strides: float32,
            float64, bfloat16, or uint8 camera frames.
        radii: (B or 1, R·S_r) px. radii, azimuths, center, affine and offsets are float64 if the
            image is float64, else float32.
        azimuths: (A·S_φ,) rad. They have a gradient only within `use_reference()`. For a gradient,
            turn the grid with affine, or move its points with offsets.
        center: (B or 1, 2) px, x then y.
        affine: (B or 1, 2, 2), rows x and y: aspect ratio and skew. None is the identity.
        offsets: (B or 1, 2, R·S_r, A·S_φ) px, x then y: further shifts of the points of a general
            lens, such as its tangential distortion. None is zero.
        samples: (S_r, S_φ), the number of samples of a patch along radius and azimuth.
        jitter: in [0, 1]. Moves each point by `u·jitter` cells along its row of radii (linear
            between neighbours, extrapolated at both ends, never below 0) and by
            `v·jitter·2π/(A·S_φ)` in azimuth, before the matrix is applied. The point keeps the
            offset of its original place. u and v, in [-½, ½), are the upper and lower halves of a
            32-bit word of Philox4x32-10. Point p = i·A·S_φ + j of image b uses word p mod 4 for
            key `seed` and counter (⌊p/4⌋, b).
        seed: int or 0-dim int64 tensor on the CPU. It is not used without jitter.
        layout: "tokens" or "image".
        mean, std: one number, or one number per channel. A uint8 pixel is read as
            `(pixel/255 - mean) / std`, with zeros outside the image. For other dtypes mean and std
            are ignored.
        channels_last: True for an image (B, H, W, C), False for (B, C, H, W). With None, a
            floating-point image is (B, C, H, W), and the channel axis of a uint8 image is its
            second or last axis, depending on which has size 1, 3 or 4.

    Returns:
        "tokens": (B, R, A, S_r·S_φ·C), inner order (S_r, S_φ, C).
        "image": (B, C, R·S_r, A·S_φ), like the result of `F.grid_sample` on such a grid.
        The dtype is bfloat16 for a bfloat16 image or under bfloat16 autocast, float64 for a float64
        image, else float32. bfloat16 results are computed in float32 and rounded once.

    backward() gives gradients for image (unless uint8), radii, center, affine and offsets. Results
    and gradients do not depend on the number of threads.

    Raises:
        TypeError: a tensor has an unsupported dtype, or an argument has the wrong type.
        ValueError: a shape, device or range does not fit; or channels_last is None, and the channel
            axis of a uint8 image is ambiguous or missing.
        NotImplementedError: forward-mode, torch.func or second derivatives are requested, or the
            azimuths require a gradient.

    Source: DarSwin, ICCV 2023, sec. 4.3.
    """
    # What the operator does not see is checked here; `check_sampling` explains the rest.
    if not isinstance(image, Tensor) or image.dim() != 4:
        check_image(image, channels_last)  # raises
    if layout not in LAYOUTS:
        check_layout(layout)  # raises
    if isinstance(azimuths, Tensor) and azimuths.requires_grad and torch.is_grad_enabled():
        refuse_gradient_of_azimuths()
    dtype, frames = image.dtype, image.dtype == torch.uint8
    if channels_last is not None or frames:
        image = channels_first("image", image, channels_last)
    moves = type(jitter) is not float or jitter != 0
    autocast = None if dtype == torch.float64 else _library.autocast_dtype(image)
    sampling = Sampling(
        image, radii, azimuths, center, affine, offsets,
        *(jitter_tensors(jitter, seed) if moves else (None, None)),
        check_pair("samples", samples, lowest=1),
        per_channel("mean", mean, image.shape[1]) if frames else (),
        per_channel("std", std, image.shape[1]) if frames else (),
        torch.bfloat16 in (dtype, autocast),
    )  # fmt: skip
    return _library.call(_SAMPLE, check_sampling, _reference, (*sampling, layout == "tokens"))


def _reference(*arguments):
    *fields, tokens = arguments
    return reference.polar_sample(Sampling(*fields), tokens)


@_library.register_fake("polar_sample")
def _fake(*arguments):
    check_sampling(*arguments)
    *fields, tokens = arguments
    sampling = Sampling(*fields)
    if tokens:
        return sampling.new_output((*sampling.map_size(), sampling.token_size()))
    rows, columns = sampling.radii.shape[1], sampling.azimuths.shape[0]
    return sampling.new_output((*sampling.image.shape[:2], rows, columns))


_library.register_gradients("polar_sample", GRADIENTS)
