"""Patch embedding: what a view shows → the first map, of polar patches (DarSwin) or squares."""

from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.ops._library import autocast_dtype


class PatchProjection(nn.Module):
    """Joins p × p neighbours of a map into one token, by a p × p convolution and a LayerNorm."""

    def __init__(self, dim: int, out_dim: int, patch: int, *, bias: bool = True):
        super().__init__()
        self.proj = nn.Conv2d(dim, out_dim, patch, patch, bias=bias)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, H, W, D) → (B, H/p, W/p, D')."""
        return self.norm(self.proj(x.permute(0, 3, 1, 2)).permute(0, 2, 3, 1))


class PatchEmbed(PatchProjection):
    """Maps each p × p patch of an image to a token."""

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) → (B, H/p, W/p, D)."""
        return super().forward(x.permute(0, 2, 3, 1))


class PolarPatchEmbed(nn.Module):
    """Maps the samples of each patch of a polar grid to a token."""

    def __init__(self, values: int, embed_dim: int):
        super().__init__()
        self.proj = Linear(values, embed_dim)
        self.norm = nn.LayerNorm(embed_dim)

    def forward(self, x: Tensor) -> Tensor:
        """Samples (B, R, A, S_r·S_φ·C) of any floating-point dtype → (B, R, A, D)."""
        if autocast_dtype(x) is None:  # which would convert them itself
            x = x.to(self.proj.weight.dtype)
        return self.norm(self.proj(x))
