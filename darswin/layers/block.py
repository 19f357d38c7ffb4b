"""Transformer blocks and what joins tokens between stages.

A polar map is (B, R, A, D) from the embedding to the head; the maps of Swin and DAT are
(B, H, W, D), rows and columns.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.layers.recompute import recomputed


class DropPath(nn.Module):
    """Stochastic depth: in training, drops a branch for whole images with probability p."""

    def __init__(self, p: float = 0.0):
        super().__init__()
        if not 0 <= p < 1:
            raise ValueError(f"drop path must be in [0, 1), got {p}")
        self.p = p

    def forward(self, x: Tensor) -> Tensor:
        """x, any shape → the same with each image's branch kept, and scaled, or zero."""
        if self.p == 0 or not self.training:
            return x
        keep = 1 - self.p
        mask = torch.bernoulli(x.new_full((x.shape[0], *(1,) * (x.dim() - 1)), keep))
        return x * (mask / keep)

    def extra_repr(self) -> str:
        return f"p={self.p}"


class Mlp(nn.Module):
    """Linear, GELU, Linear."""

    grad_checkpointing = False  # see `Encoder.set_grad_checkpointing`

    def __init__(self, dim: int, hidden: int):
        super().__init__()
        self.fc1 = Linear(dim, hidden)
        self.fc2 = Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D)."""
        hidden = self.fc1(x)
        x = F.gelu(hidden)
        with recomputed(x, F.gelu, hidden, when=self.grad_checkpointing):
            return self.fc2(x)


class Block(nn.Module):
    """Pre-norm transformer block: attention, then an MLP, each behind a residual.

    Args:
        dim: D. attn: maps (B, R, A, D), and positions, to the same shape.
        mlp_ratio: hidden width of the MLP over D. drop_path: probability.
    """

    grad_checkpointing = False  # see `Encoder.set_grad_checkpointing`

    def __init__(
        self, dim: int, attn: nn.Module, *, mlp_ratio: float = 4.0, drop_path: float = 0.0
    ):
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attn = attn
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = Mlp(dim, int(dim * mlp_ratio))
        self.drop_path = DropPath(drop_path)

    def forward(self, x: Tensor, *positions: Tensor, **table: Tensor) -> Tensor:
        """(B, R, A, D) → the same shape. `positions`, or the `table`, are the attention's."""
        y = self.norm1(x)
        with recomputed(y, self.norm1, x, when=self.grad_checkpointing):
            y = self.attn(y, *positions, **table)
        x = x + self.drop_path(y)
        y = self.norm2(x)
        with recomputed(y, self.norm2, x, when=self.grad_checkpointing):
            y = self.mlp(y)
        return x + self.drop_path(y)


class PatchMerging(nn.Module):
    """Joins m_r × m_φ neighbouring tokens into one of twice the width.

    Args:
        dim: D. merge: (m_r, m_φ): (1, 4) in DarSwin-A, (2, 2) in DarSwin-RA.

    Source: DarSwin, ICCV 2023, sec. 4.4.
    """

    def __init__(self, dim: int, merge: tuple[int, int]):
        super().__init__()
        self.merge = tuple(merge)
        joined = dim * merge[0] * merge[1]
        self.norm = nn.LayerNorm(joined)
        self.reduction = Linear(joined, 2 * dim, bias=False)

    def join(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R/m_r, A/m_φ, m_r·m_φ·D)."""
        batch, rings, sectors, dim = x.shape
        mr, ma = self.merge
        if rings % mr or sectors % ma:
            raise ValueError(f"merge {self.merge} must divide (R, A) = {(rings, sectors)}")
        # Inner order (φ, r, D): neighbours along the radius come first.
        x = x.reshape(batch, rings // mr, mr, sectors // ma, ma, dim).permute(0, 1, 3, 4, 2, 5)
        return x.flatten(3)

    def forward(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R/m_r, A/m_φ, 2·D)."""
        return self.reduction(self.norm(self.join(x)))

    def extra_repr(self) -> str:
        return f"merge={self.merge}"
