"""What splits tokens on the way up from the last map: the inverse of `PatchMerging`, with skips."""

import torch
from torch import Tensor, nn

from darswin.layers.linear import Linear


class PatchExpand(nn.Module):
    """Splits each token into m_r × m_φ neighbours: a linear layer, then a LayerNorm.

    On a polar map the split follows the ring around: no token is at its end.

    Args:
        dim: D. out_dim: D' of the new tokens. split: (m_r, m_φ), of rows and columns on others.

    Source: Swin-Unet, ECCV 2022 workshops, sec. 3.4.
    """

    def __init__(self, dim: int, out_dim: int, split: tuple[int, int]):
        super().__init__()
        self.out_dim, self.split = out_dim, tuple(split)
        self.expansion = Linear(dim, out_dim * split[0] * split[1], bias=False)
        self.norm = nn.LayerNorm(out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R·m_r, A·m_φ, D')."""
        batch, rings, sectors, _ = x.shape
        mr, ma = self.split
        # Inner order (φ, r, D), as `PatchMerging` has it.
        x = self.norm(self.expansion(x).reshape(batch, rings, sectors, ma, mr, self.out_dim))
        x = x.permute(0, 1, 4, 2, 3, 5)
        return x.reshape(batch, rings * mr, sectors * ma, self.out_dim)

    def extra_repr(self) -> str:
        return f"split={self.split}"


class SkipJoin(nn.Module):
    """Splits the tokens of a map, and joins them with the encoder's map of that resolution.

    Args:
        dim: D of the encoder's map; the other has 2·D. split: as `PatchExpand`.

    Source: Swin-Unet, ECCV 2022 workshops, sec. 3.5.
    """

    def __init__(self, dim: int, split: tuple[int, int]):
        super().__init__()
        self.expand = PatchExpand(2 * dim, dim, split)
        self.fuse = Linear(2 * dim, dim)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """(B, R, A, 2·D) and (B, R·m_r, A·m_φ, D) → the shape of the latter."""
        return self.fuse(torch.cat((self.expand(x), skip), -1))
