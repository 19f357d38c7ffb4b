"""Transformer layers: the MLP, blocks, stages, and the merging of tokens.

A polar map has the shape (B, R, A, D) from the embedding to the head. The maps of Swin and DAT have
the shape (B, H, W, D).
"""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.checkpointing import checkpointed
from darswin.layers.linear import Linear
from darswin.layers.position_bias import RelativeBias, joined_coefficients
from darswin.ops.linear import mlp
from darswin.views import PolarGrid


class DropPath(nn.Module):
    """Stochastic depth: in training, drops the branch of an image with probability p."""

    def __init__(self, p: float = 0.0):
        super().__init__()
        if not 0 <= p < 1:
            raise ValueError(f"drop path must be in [0, 1), got {p}")
        self.p = p

    def forward(self, x: Tensor) -> Tensor:
        """x (B, ...) → the branch of each image, either scaled by 1/(1-p) or zero."""
        if self.p == 0 or not self.training:
            return x
        keep = 1 - self.p
        mask = torch.bernoulli(x.new_full((x.shape[0], *(1,) * (x.dim() - 1)), keep))
        return x * (mask / keep)

    def extra_repr(self) -> str:
        return f"p={self.p}"


class Mlp(nn.Module):
    """Linear, GELU, Linear."""

    def __init__(self, dim: int, hidden: int):
        super().__init__()
        self.fc1 = Linear(dim, hidden)
        self.fc2 = Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D)."""
        fc1, fc2 = self.fc1, self.fc2
        # In inference, nothing need be kept, and a layer may have been replaced.
        if torch.is_grad_enabled() and all(
            isinstance(f, Linear) and f.is_itself() for f in (fc1, fc2)
        ):
            return mlp(x, fc1.weight, fc1.bias, fc2.weight, fc2.bias)
        return fc2(F.gelu(fc1(x)))


class Block(nn.Module):
    """A pre-norm transformer block: attention and an MLP, each with a residual connection.

    Args:
        dim: D, the width of the tokens.
        attn: the attention, called `attn(x, table)`. Its `position_bias` makes the table.
        mlp_ratio: the hidden width of the MLP, divided by D.
        drop_path: the probability that training drops a branch.
    """

    grad_checkpointing = False  # see `Model.set_grad_checkpointing`

    def __init__(
        self, dim: int, attn: nn.Module, *, mlp_ratio: float = 4.0, drop_path: float = 0.0
    ):
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attn = attn
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = Mlp(dim, int(dim * mlp_ratio))
        self.drop_path = DropPath(drop_path)

    def forward(self, x: Tensor, table: Tensor) -> Tensor:
        """(B, R, A, D) and the position bias of the attention → the same shape."""
        # In a compiled graph, the compiler decides which values are kept.
        if (
            self.grad_checkpointing
            and torch.is_grad_enabled()
            and not torch.compiler.is_compiling()
        ):
            return checkpointed(self, x, table)
        x = x + self.drop_path(self.attn(self.norm1(x), table))
        return x + self.drop_path(self.mlp(self.norm2(x)))


class PatchMerging(nn.Module):
    """Joins m_r × m_φ neighbouring tokens into one token of twice the width."""

    def __init__(self, dim: int, merge: tuple[int, int]):
        super().__init__()
        self.merge = tuple(merge)
        joined = dim * merge[0] * merge[1]
        self.norm = nn.LayerNorm(joined)
        self.reduction = Linear(joined, 2 * dim, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R/m_r, A/m_φ, 2·D)."""
        return self.reduction(self.norm(self.joined(x)))

    def joined(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → the neighbours side by side, (B, R/m_r, A/m_φ, m_r·m_φ·D)."""
        batch, rings, sectors, dim = x.shape
        mr, ma = self.merge
        if rings % mr or sectors % ma:
            raise ValueError(f"merge {self.merge} must divide (R, A) = {(rings, sectors)}")
        # Inner order (φ, r, D): neighbours along the radius are next to each other.
        x = x.reshape(batch, rings // mr, mr, sectors // ma, ma, dim).permute(0, 1, 3, 4, 2, 5)
        return x.flatten(3)

    def extra_repr(self) -> str:
        return f"merge={self.merge}"


class Stage(nn.Module):
    """A stage: the merging of tokens, then blocks whose position biases are all of one kind."""

    def __init__(self, downsample: nn.Module, blocks: Iterable[Block]):
        super().__init__()
        self.downsample = downsample
        self.blocks = nn.ModuleList(blocks)

    def tables(self, grid: PolarGrid | None) -> Sequence[Tensor]:
        """The position biases of all blocks, (B or 1, heads, 2·M_r-1, 2·M_φ-1) each.

        Args:
            grid: that of a polar view, of which the biases of angles depend.
        """
        attentions: list[Any] = [block.attn for block in self.blocks]
        biases = [attn.position_bias for attn in attentions]
        relative = [bias for bias in biases if isinstance(bias, RelativeBias)]
        if not relative:
            return [bias() for bias in biases]
        # One computation for all blocks, because each step handles only a few numbers.
        table = relative[0].table(attentions[0].angles(grid), **joined_coefficients(relative))
        return table.split([bias.heads for bias in relative], 1)

    def forward(self, x: Tensor, tables: Sequence[Tensor]) -> Tensor:
        """The map of the previous stage, and the position bias of each block → the map of this."""
        x = self.downsample(x)
        for block, table in zip(self.blocks, tables, strict=True):
            x = block(x, table)
        return x
