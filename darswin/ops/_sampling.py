"""The arguments of polar_sample, and their checks."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from darswin.ops import _library
from darswin.ops.checks import (
    DTYPES,
    as_int,
    channels_first,
    check_has_batch,
    check_jitter,
    check_pair,
    check_tensor,
    per_channel,
)

# Index of each field of `Sampling` that has a gradient → its group: image, lens or offsets.
GRADIENTS = {0: 0, 1: 1, 3: 1, 4: 1, 5: 2}


class Sampling(NamedTuple):
    """The arguments of a sampling in the form and order of the operators' schemas."""

    image: Tensor
    radii: Tensor
    azimuths: Tensor
    center: Tensor
    affine: Tensor | None
    offsets: Tensor | None
    # Tensors, so that compiled graphs do not keep their values. None without jitter.
    jitter: Tensor | None
    seed: Tensor | None
    samples: tuple[int, int]
    # One number per channel for uint8 images, empty for other dtypes.
    mean: Sequence[float]
    std: Sequence[float]
    bfloat16: bool  # True if the output is bfloat16

    # Methods, not properties: Dynamo of torch 2.10 cannot trace a NamedTuple's properties.
    def token_size(self) -> int:
        """Number of values in a token: S_r·S_φ·C."""
        return self.samples[0] * self.samples[1] * self.image.shape[1]

    def map_size(self) -> tuple[int, int, int]:
        """(B, R, A) of the tokens."""
        rings = self.radii.shape[1] // self.samples[0]
        return self.image.shape[0], rings, self.azimuths.shape[0] // self.samples[1]

    def kernel_takes(self, *others: object) -> bool:
        """True if the GPU kernels support it. They do not support float64, uint8 images of more
        than 16 channels, or about 2³¹ samples or pixels per image."""
        image = self.image
        frames = image.dtype == torch.uint8 and image.shape[1] > 16
        counts = self.radii.shape[1] * self.azimuths.shape[0], image.shape[2] * image.shape[3]
        return image.dtype != torch.float64 and not frames and max(counts) < 2**31 - 2**16

    def new_output(self, shape: tuple[int, ...]) -> Tensor:
        """An empty tensor of the output's dtype."""
        return self.radii.new_empty(shape, dtype=torch.bfloat16 if self.bfloat16 else None)


def checked_sampling(
    image: Tensor,
    radii: Tensor,
    azimuths: Tensor,
    center: Tensor,
    affine: Tensor | None,
    offsets: Tensor | None,
    jitter: float,
    seed: int | Tensor,
    samples: tuple[int, int],
    mean: float | Sequence[float],
    std: float | Sequence[float],
    channels_last: bool | None,
) -> Sampling:
    """Checks the arguments of the public functions. Raises TypeError or ValueError."""
    image = _library.without_float16(image)
    pixels = (*DTYPES, torch.bfloat16, torch.uint8)
    if isinstance(image, Tensor):
        check_has_batch("image", image, channels_last)
    check_tensor("image", image, pixels, "(B, C, H, W)", (None,) * 4)
    image = channels_first("image", image, channels_last)
    batch = image.shape[0]
    real = (torch.float64 if image.dtype == torch.float64 else torch.float32,)
    form = "(B or 1, R·S_r) = ({} or 1, any)"
    check_tensor("radii", radii, real, form, (batch, None), (1, None), like=image)
    check_tensor("azimuths", azimuths, real, "(A·S_φ,)", (None,), like=image)
    if azimuths.requires_grad and torch.is_grad_enabled() and not _library.reference_in_use():
        raise NotImplementedError(
            "azimuths require a gradient, which only the reference computes: run within "
            "darswin.ops.use_reference(), or turn the grid with affine or move its points with "
            "offsets, which have gradients"
        )
    form = "(B or 1, 2) = ({} or 1, 2)"
    check_tensor("center", center, real, form, (batch, 2), (1, 2), like=image)
    if affine is not None:
        form = "(B or 1, 2, 2) = ({} or 1, 2, 2)"
        check_tensor("affine", affine, real, form, (batch, 2, 2), (1, 2, 2), like=image)
    if offsets is not None:
        points = (2, radii.shape[1], azimuths.shape[0])
        form = "(B or 1, 2, R·S_r, A·S_φ) = ({} or 1, {}, {}, {})"
        check_tensor("offsets", offsets, real, form, (batch, *points), (1, *points), like=image)
    samples = check_pair("samples", samples, lowest=1)
    if radii.shape[1] % samples[0] or azimuths.shape[0] % samples[1]:
        raise ValueError(
            f"samples = (S_r, S_φ) must divide (R·S_r, A·S_φ) = "
            f"({radii.shape[1]}, {azimuths.shape[0]}), got {samples}"
        )
    return Sampling(
        image, radii, azimuths, center, affine, offsets, *_jitter_tensors(jitter, seed),
        samples, *_statistics(image, mean, std), _library.output_bfloat16(image),
    )  # fmt: skip


def unchecked_sampling(*given: Any) -> Sampling | None:
    """The arguments of `checked_sampling` for `_library.attempt`: the operator itself checks the
    tensors. None in the rare cases that only `checked_sampling` can check."""
    image, radii, azimuths, center, affine, offsets, *others = given
    jitter, seed, samples, mean, std, channels_last = others
    if not (
        _library.may_attempt()
        and _library.plain(image, radii, azimuths, center)
        and (affine is None or _library.plain(affine))
        and (offsets is None or _library.plain(offsets))
        and image.dim() == 4
        and not (azimuths.requires_grad and torch.is_grad_enabled())
    ):
        return None
    dtype = image.dtype
    if channels_last is not None or dtype == torch.uint8:
        image = channels_first("image", image, channels_last)
    return Sampling(
        image, radii, azimuths, center, affine, offsets, *_jitter_tensors(jitter, seed),
        check_pair("samples", samples, lowest=1), *_statistics(image, mean, std),
        dtype == torch.bfloat16,
    )  # fmt: skip


def _statistics(
    image: Tensor, mean: float | Sequence[float], std: float | Sequence[float]
) -> tuple[Sequence[float], Sequence[float]]:
    """mean and std with one number per channel; empty if the image is not uint8."""
    if image.dtype != torch.uint8:
        return (), ()
    channels = image.shape[1]
    return per_channel("mean", mean, channels), per_channel("std", std, channels)


def _jitter_tensors(jitter: float, seed: int | Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Jitter and seed as tensors for the operators; None and None without jitter."""
    jitter = check_jitter(jitter)
    if jitter == 0:
        return None, None
    amount = torch.tensor(jitter, dtype=torch.float64, device="cpu")
    if isinstance(seed, Tensor):
        if seed.dtype != torch.int64 or seed.dim() != 0:
            raise ValueError(
                f"seed must be an int or a 0-dim int64 tensor, got {seed.dtype} of shape "
                f"{tuple(seed.shape)}"
            )
        return amount, seed
    key = as_int(seed)
    if key is None:
        raise TypeError(f"seed must be an int or a 0-dim int64 tensor, got {type(seed).__name__}")
    if not -(2**63) <= key < 2**63:
        raise ValueError(f"seed must fit 64 bits, got {seed}")
    return amount, torch.tensor(key, dtype=torch.int64, device="cpu")
