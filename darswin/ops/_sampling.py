"""The arguments of polar_sample, and their checks."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from darswin.ops import _library
from darswin.ops.checks import (
    DTYPES,
    as_int,
    check_has_batch,
    check_jitter,
    check_tensor,
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

    def new_output(self, shape: tuple[int, ...]) -> Tensor:
        """An empty tensor of the output's dtype."""
        return self.radii.new_empty(shape, dtype=torch.bfloat16 if self.bfloat16 else None)


def check_sampling(
    image: Tensor,
    radii: Tensor,
    azimuths: Tensor,
    center: Tensor,
    affine: Tensor | None,
    offsets: Tensor | None,
    jitter: Tensor | None,
    seed: Tensor | None,
    samples: Sequence[int],
    *others: object,
) -> None:
    """Raises TypeError or ValueError unless the arguments of an operator fit."""
    check_image(image)
    batch = image.shape[0]
    real = (torch.float64 if image.dtype == torch.float64 else torch.float32,)
    form = "(B or 1, R·S_r) = ({} or 1, any)"
    check_tensor("radii", radii, real, form, (batch, None), (1, None), like=image)
    check_tensor("azimuths", azimuths, real, "(A·S_φ,)", (None,), like=image)
    form = "(B or 1, 2) = ({} or 1, 2)"
    check_tensor("center", center, real, form, (batch, 2), (1, 2), like=image)
    if affine is not None:
        form = "(B or 1, 2, 2) = ({} or 1, 2, 2)"
        check_tensor("affine", affine, real, form, (batch, 2, 2), (1, 2, 2), like=image)
    if offsets is not None:
        points = (2, radii.shape[1], azimuths.shape[0])
        form = "(B or 1, 2, R·S_r, A·S_φ) = ({} or 1, {}, {}, {})"
        check_tensor("offsets", offsets, real, form, (batch, *points), (1, *points), like=image)
    if radii.shape[1] % samples[0] or azimuths.shape[0] % samples[1]:
        raise ValueError(
            f"samples = (S_r, S_φ) must divide (R·S_r, A·S_φ) = "
            f"({radii.shape[1]}, {azimuths.shape[0]}), got {tuple(samples)}"
        )


def check_image(image: Tensor, channels_last: bool | None = None) -> None:
    if isinstance(image, Tensor):
        check_has_batch("image", image, channels_last)
    pixels = (*DTYPES, torch.bfloat16, torch.uint8)
    check_tensor("image", image, pixels, "(B, C, H, W)", (None,) * 4)


def refuse_gradient_of_azimuths() -> None:
    if not _library.reference_in_use():
        raise NotImplementedError(
            "azimuths require a gradient, which only the reference computes: run within "
            "darswin.ops.use_reference(), or turn the grid with affine or move its points with "
            "offsets, which have gradients"
        )


def jitter_tensors(jitter: float, seed: int | Tensor) -> tuple[Tensor | None, Tensor | None]:
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
