"""Images → the first map of tokens: polar patches of DarSwin, square ones of Swin and DAT."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from darswin.layers.grid import PolarGrid
from darswin.layers.linear import Linear
from darswin.layers.sampling import PolarSample
from darswin.ops import polar_embed
from darswin.ops.checks import per_channel
from darswin.ops.reference import normalized


def check_dtype(images: Tensor, dtype: torch.dtype) -> None:
    """TypeError unless the images are uint8 or of a model's dtype, or autocast makes them so."""
    if images.dtype in (torch.uint8, dtype):
        return
    autocast = torch.is_autocast_enabled(images.device.type)
    if not autocast or torch.float64 in (images.dtype, dtype):
        raise TypeError(
            f"images must be uint8, or {dtype} as the model's weights are, got {images.dtype}"
        )


class ImageInput(nn.Module):
    """The images of a model, as (B, C, H, W) in floating point.

    Args:
        image_size: (H, W) that they must have; None means any. in_chans: C.
        mean, std: of uint8 images, which count as `(pixel/255 - mean) / std`; others ignore them.

    Raises:
        ValueError: images of another size or number of channels.
    """

    def __init__(
        self,
        image_size: tuple[int, int] | None,
        in_chans: int = 3,
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
    ):
        super().__init__()
        self.image_size, self.in_chans = image_size, in_chans
        self.mean, self.std = per_channel("mean", mean, in_chans), per_channel("std", std, in_chans)

    def forward(self, images: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """(B, C, H, W) → the same, in `dtype` where they are uint8."""
        check_channels(images, self.in_chans)
        if self.image_size is not None and images.shape[2:] != self.image_size:
            raise ValueError(
                f"images must have the model's image_size, (H, W) = {self.image_size}, "
                f"got {tuple(images.shape[2:])}"
            )
        if images.dtype != torch.uint8:
            return images
        exact = torch.promote_types(dtype, torch.float32)
        return normalized(images, self.mean, self.std, exact).to(dtype)

    def extra_repr(self) -> str:
        return f"image_size={self.image_size}, mean={self.mean}, std={self.std}"


def check_channels(images: Tensor, in_chans: int) -> None:
    """ValueError unless the images (B, C, H, W) have `in_chans` channels."""
    if images.shape[1] != in_chans:
        raise ValueError(f"images must have {in_chans} channels, got {images.shape[1]}")


class PatchProjection(nn.Module):
    """Joins p × p neighbours of a map into one: a convolution as wide as its step, a LayerNorm.

    Args:
        dim: D of the map, out_dim: D'. patch: p, which divides the map. bias: of the convolution.

    Source: Swin Transformer, ICCV 2021, sec. 3.1; DAT, CVPR 2022, sec. 3.3.
    """

    def __init__(self, dim: int, out_dim: int, patch: int, *, bias: bool = True):
        super().__init__()
        self.proj = nn.Conv2d(dim, out_dim, patch, patch, bias=bias)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, H, W, D) → (B, H/p, W/p, D')."""
        check_dtype(x, self.proj.weight.dtype)
        return self.norm(self.proj(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1))


class PolarPatchEmbed(nn.Module):
    """Image and lens → polar map: samples of each patch, a linear layer, a LayerNorm.

    Args:
        in_chans: C. embed_dim: D. Others: as `PolarSample`.

    Source: DarSwin, ICCV 2023, sec. 4.3.
    """

    def __init__(
        self,
        rings: int,
        sectors: int,
        samples: tuple[int, int],
        *,
        in_chans: int = 3,
        embed_dim: int = 96,
        **grid_options,
    ):
        super().__init__()
        self.in_chans = in_chans
        self.sample = PolarSample(rings, sectors, samples, **grid_options)
        self.proj = Linear(samples[0] * samples[1] * in_chans, embed_dim)
        self.norm = nn.LayerNorm(embed_dim)

    def forward(self, images: Tensor, grid: PolarGrid) -> Tensor:
        """(B, C, H, W), uint8 or of the weights' dtype → (B, R, A, D)."""
        check_channels(images, self.in_chans)
        weight, bias = self.proj.weight, self.proj.bias
        check_dtype(images, weight.dtype)
        if images.dtype == torch.uint8 and weight.dtype == torch.float64:
            mean, std = (
                per_channel(name, getattr(self.sample, name), self.in_chans)
                for name in ("mean", "std")
            )
            images = normalized(images, mean, std, weight.dtype)  # the operator would use float32
        tokens = polar_embed(**self.sample.arguments(images, grid), weight=weight, bias=bias)
        if weight.dtype == torch.bfloat16:
            tokens = tokens.bfloat16()  # of uint8 images they are float32
        return self.norm(tokens)
