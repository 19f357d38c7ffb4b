"""Patch embedding: images → the first map, of polar patches (DarSwin) or squares (Swin, DAT)."""

from typing import Any

import torch
from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.layers.polar import PolarGrid, PolarGridSpec, PolarSample
from darswin.ops import polar_sample


def check_dtype(images: Tensor, dtype: torch.dtype) -> None:
    """TypeError unless the images are uint8, have the model's dtype, or autocast converts them."""
    if images.dtype in (torch.uint8, dtype):
        return
    autocast = torch.is_autocast_enabled(images.device.type)
    if not autocast or torch.float64 in (images.dtype, dtype):
        raise TypeError(
            f"images must be uint8 or {dtype}, the dtype of the weights, got {images.dtype}"
        )


class PatchProjection(nn.Module):
    """Joins p × p neighbours of a map into one token, by a p × p convolution and a LayerNorm."""

    def __init__(self, dim: int, out_dim: int, patch: int, *, bias: bool = True):
        super().__init__()
        self.proj = nn.Conv2d(dim, out_dim, patch, patch, bias=bias)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, H, W, D) → (B, H/p, W/p, D')."""
        check_dtype(x, self.proj.weight.dtype)
        return self.norm(self.proj(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1))


class PolarPatchEmbed(nn.Module):
    """Samples each patch of a polar grid, and maps the samples to a token."""

    def __init__(
        self, spec: PolarGridSpec, *, in_chans: int = 3, embed_dim: int = 96, **options: Any
    ):
        super().__init__()
        self.sample = PolarSample(**vars(spec), **options)
        self.proj = Linear(spec.samples[0] * spec.samples[1] * in_chans, embed_dim)
        self.norm = nn.LayerNorm(embed_dim)

    def forward(self, images: Tensor, grid: PolarGrid | None) -> Tensor:
        """Images (B, C, H, W), uint8 or of the weights' dtype → (B, R, A, D).

        Without a grid, the images are samples (B, R, A, S_r·S_φ·C) of any floating-point dtype.
        """
        samples = patch_samples(self.sample, images, grid, self.proj.weight.dtype)
        return self.norm(self.proj(samples))


def patch_samples(
    sample: PolarSample, images: Tensor, grid: PolarGrid | None, dtype: torch.dtype
) -> Tensor:
    """The samples (B, R, A, S_r·S_φ·C) for a product with weights of `dtype`; images and grid as in
    `PolarPatchEmbed.forward`."""
    if grid is None:
        return images.to(dtype)
    check_dtype(images, dtype)
    samples = polar_sample(**sample.arguments(images, grid))
    # Samples of uint8 images are float32. Autocast gives bfloat16, and the product takes it.
    return samples.to(dtype) if samples.dtype == torch.float32 else samples
