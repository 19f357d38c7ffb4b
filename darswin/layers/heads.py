"""The heads of the dense models: from the decoder's map to logits or distances for each pixel."""

import math

import torch
from torch import Tensor, nn

from darswin.layers.linear import Linear

# exp(±8): from a three-thousandth of the typical distance to three thousand times as far.
LARGEST_EXPONENT = 8.0


class PixelHead(nn.Module):
    """Logits of each pixel: of the decoder's map, refined by what the image shows there.

    The map is projected to K channels before it is brought to the pixels, which is the same as
    after it, to rounding, and cheaper: `project`, then the way back, then `refine`, then `finish`.

    Args:
        dim: D of the map. channels: K. in_chans: C of the images.
        skip_width: channels of the skip from the image; 0 leaves it out.
    """

    def __init__(self, dim: int, channels: int, in_chans: int, skip_width: int):
        super().__init__()
        self.skip_width = skip_width
        self.proj = Linear(dim, channels)
        if skip_width:
            self.stem = nn.Conv2d(in_chans, skip_width, 3, padding=1)
            self.mix = nn.Conv2d(skip_width + channels, skip_width, 3, padding=1)
            self.out = nn.Conv2d(skip_width, channels, 1, bias=False)
            nn.init.trunc_normal_(self.out.weight, std=0.02)
        self.act = nn.ReLU()

    def project(self, x: Tensor) -> Tensor:
        """The decoder's map (B, R, A, D) → (B, R, A, K)."""
        return self.proj(x)

    def refine(self, coarse: Tensor, images: Tensor) -> Tensor:
        """The projected map at the pixels, (B, K, H, W), and the images (B, C, H, W) → logits."""
        if not self.skip_width:
            return coarse
        # Convolutions of few channels take half the time with channels last, as `coarse` comes.
        skip = self.act(self.stem(images.contiguous(memory_format=torch.channels_last)))
        skip = self.act(self.mix(torch.cat((skip, coarse.to(skip.dtype)), 1)))
        return coarse + self.out(skip).to(coarse.dtype)

    def finish(self, logits: Tensor) -> Tensor:
        """The logits (B, K, H, W) → the model's result."""
        return logits

    def extra_repr(self) -> str:
        return f"skip_width={self.skip_width}"


class SegmentationHead(PixelHead):
    """`PixelHead` of classes."""


class DistanceHead(PixelHead):
    """`PixelHead` of distances along the ray, in metres: `typical_distance` times e^x.

    x is bounded, smoothly, so that the distance is above 0 and finite.

    Args:
        dim, in_chans, skip_width: as `PixelHead`.
        typical_distance: m, what x = 0 means.

    Raises:
        ValueError: a typical_distance that is not above 0 or not finite.
    """

    def __init__(self, dim: int, in_chans: int, skip_width: int, typical_distance: float = 10.0):
        super().__init__(dim, 1, in_chans, skip_width)
        if not 0 < typical_distance < math.inf:
            raise ValueError(f"typical_distance must be above 0 m, got {typical_distance}")
        self.typical_distance = float(typical_distance)

    def finish(self, logits: Tensor) -> Tensor:
        """x (B, 1, H, W) → distances (B, 1, H, W), m, in float32 at least."""
        x = logits.to(torch.promote_types(logits.dtype, torch.float32))
        x = LARGEST_EXPONENT * torch.tanh(x / LARGEST_EXPONENT)
        return self.typical_distance * torch.exp(x)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, typical_distance={self.typical_distance}"
