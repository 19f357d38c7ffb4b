"""Transformer layers: window attention, the MLP, blocks, stages, and the merging of tokens.

A polar map has the shape (B, R, A, D) from the embedding to the head. The maps of Swin and DAT have
the shape (B, H, W, D).
"""

import contextlib
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.layers.position_bias import (
    AngularRelativeBias,
    FourierBias,
    PositionBias,
    RelativeBias,
    RelativeTable,
    joined_coefficients,
)
from darswin.ops import window_attention
from darswin.ops.checks import check_pair

__all__ = ["PolarWindowAttention", "WindowAttention"]

# A module, or the function that `darswin.optimize` puts in its place.
Layer = Callable[[Tensor], Tensor]
_NOTHING = contextlib.nullcontext()


def recomputed(
    value: Tensor, function: Callable[..., Any], *inputs: Tensor, when: bool
) -> contextlib.AbstractContextManager:
    """A context in which autograd recomputes `value` in backward, instead of keeping it in memory.

    `value` is the last result of `function(*inputs)`, which gives the same bits again. Autograd
    keeps the inputs in any case, for the gradient of the function.
    """
    # In a compiled graph, the compiler decides which values are kept.
    if not when or torch.compiler.is_compiling() or not torch.is_grad_enabled():
        return _NOTHING
    # torch's selective checkpointing saves the same memory, but its Python mode intercepts every
    # operator: a training step takes 10 to 50 % longer.
    place, size, dtype = value.data_ptr(), value.numel(), value.dtype
    inputs = tuple(t.detach() for t in inputs)

    def pack(saved: Tensor) -> Tensor | torch.Size:
        same = saved.data_ptr() == place and saved.numel() == size and saved.dtype == dtype
        return saved.shape if same and saved.is_contiguous() else saved

    def unpack(kept: Tensor | torch.Size) -> Tensor:
        if isinstance(kept, Tensor):
            return kept
        with torch.no_grad():
            again = function(*inputs)
        return (again[-1] if isinstance(again, tuple) else again).view(kept)

    return torch.autograd.graph.saved_tensors_hooks(pack, unpack)


class WindowAttention(nn.Module):
    """Multi-head attention in the windows of a map, as in Swin.

    Args:
        dim: D, the width of the tokens.
        num_heads: the number of heads, which must divide D.
        map_size: the size of the map, (R, A) or (H, W).
        window: the size of the windows, (M_r, M_φ), which must divide the map.
        shift: the shift of the windows, (s_r, s_φ).
        periodic: for each axis, True if the map wraps around along it.
        position_bias: a function that makes the position bias from the window and the heads.

    Raises:
        ValueError: sizes do not divide each other.

    Source: Swin Transformer, ICCV 2021, sec. 3.2.
    """

    grad_checkpointing = False  # see `Model.set_grad_checkpointing`

    def __init__(
        self,
        dim: int,
        num_heads: int,
        *,
        map_size: tuple[int, int],
        window: tuple[int, int],
        shift: tuple[int, int] = (0, 0),
        periodic: tuple[bool, bool] = (False, False),
        position_bias: Callable[[tuple[int, int], int], nn.Module] = RelativeTable,
    ):
        super().__init__()
        check_heads(dim, num_heads)
        self.dim, self.num_heads, self.periodic = dim, num_heads, periodic
        self.map_size = check_pair("map_size", map_size, lowest=1)
        self.window = check_pair("window", window, lowest=1)
        self.shift = check_pair("shift", shift, lowest=0)
        if map_size[0] % window[0] or map_size[1] % window[1]:
            raise ValueError(f"window must divide the map (R, A) = {map_size}, got {window}")
        self.qkv: Layer = Linear(dim, 3 * dim)
        self.proj: Layer = Linear(dim, dim)
        self.position_bias = position_bias(self.window, num_heads)

    def attend(self, qkv: Tensor, bias: Tensor) -> Tensor:
        """Queries, keys and values (B, R, A, 3, heads, d) and the bias → (B, R, A, D)."""
        return window_attention(
            qkv, bias, window=self.window, shift=self.shift, periodic=self.periodic
        )

    def forward(self, x: Tensor, *positions: Tensor, table: Tensor | None = None) -> Tensor:
        """(B, R, A, D) → the same shape.

        Args:
            positions: the inputs of the position bias.
            table: the position bias itself, if it is computed already.
        """
        batch, rings, sectors, dim = x.shape
        if (rings, sectors) != self.map_size:
            raise ValueError(f"the map must be (R, A) = {self.map_size}, got {(rings, sectors)}")
        qkv = self.qkv(x).reshape(batch, rings, sectors, 3, self.num_heads, dim // self.num_heads)
        bias = self.position_bias(*positions) if table is None else table
        out = self.attend(qkv, bias)
        with recomputed(out, self.attend, qkv, bias, when=self.grad_checkpointing):
            return self.proj(out)

    def extra_repr(self) -> str:
        return (
            f"map_size={self.map_size}, window={self.window}, shift={self.shift}, "
            f"periodic={self.periodic}"
        )


def check_heads(dim: int, num_heads: int) -> None:
    """ValueError unless the number of heads divides the width."""
    if num_heads < 1 or dim % num_heads:
        raise ValueError(f"num_heads must divide dim = {dim}, got {num_heads}")


class PolarWindowAttention(WindowAttention):
    """Multi-head attention in the windows of a polar map, with a position bias of angles.

    It is called `layer(x, ring_angles)` with x (B, R, A, D) and the angles (B or 1, R+1) from
    `darswin.layers.position_bias.ring_angles`.

    Args:
        dim, num_heads, map_size, window, shift, periodic: the arguments of `WindowAttention`.
        position_bias: "angular_relative", "angular" or "polar".
        harmonics: the number of harmonics of "angular" and "polar".
        periodic_bias: makes "angular_relative" periodic in φ, if the window spans the ring.

    Raises:
        ValueError: sizes do not divide each other, or the position bias is unknown.

    Source: DarSwin, ICCV 2023, sec. 4.4 and 4.5.
    """

    def __init__(
        self,
        dim: int,
        num_heads: int,
        *,
        map_size: tuple[int, int],
        periodic: tuple[bool, bool] = (False, True),
        position_bias: PositionBias = "angular_relative",
        harmonics: int = 16,
        periodic_bias: bool = False,
        **windows: Any,
    ):
        bias: Callable[[tuple[int, int], int], nn.Module]
        if position_bias == "angular_relative":
            bias = partial(AngularRelativeBias, sectors=map_size[1], periodic=periodic_bias)
        elif position_bias in ("angular", "polar"):
            bias = partial(FourierBias, sectors=map_size[1], harmonics=harmonics)
        else:
            raise ValueError(
                "position_bias must be 'angular_relative', 'angular' or 'polar', "
                f"got {position_bias!r}"
            )
        super().__init__(
            dim, num_heads, map_size=map_size, periodic=periodic, position_bias=bias, **windows
        )


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


class AddNorm(nn.LayerNorm):
    """A residual connection and the layer norm after it."""

    def forward(self, x: Tensor, branch: Tensor | None = None) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        """The residual x and a branch to add, or None → their sum, and the norm of the sum."""
        x = x if branch is None else x + branch
        return x, super().forward(x)


class Mlp(nn.Module):
    """Linear, GELU, Linear."""

    grad_checkpointing = False  # see `Model.set_grad_checkpointing`

    def __init__(self, dim: int, hidden: int):
        super().__init__()
        self.fc1: Layer = Linear(dim, hidden)
        self.activation: Layer | None = F.gelu  # None: `fc1` includes it
        self.fc2: Layer = Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D)."""
        hidden = self.fc1(x)
        if self.activation is None:
            return self.fc2(hidden)
        x = self.activation(hidden)
        with recomputed(x, self.activation, hidden, when=self.grad_checkpointing):
            return self.fc2(x)


class Block(nn.Module):
    """A pre-norm transformer block: attention and an MLP, each with a residual connection.

    The result of the MLP is not added to the residual here. The first norm of the next block adds
    it, because the sum and the norm are one operator in an optimized model.
    """

    grad_checkpointing = False  # see `Model.set_grad_checkpointing`

    def __init__(
        self, dim: int, attn: nn.Module, *, mlp_ratio: float = 4.0, drop_path: float = 0.0
    ):
        super().__init__()
        self.norm1: Callable[..., tuple[Tensor, Tensor]] = AddNorm(dim)
        self.attn = attn
        self.norm2: Callable[..., tuple[Tensor, Tensor]] = AddNorm(dim)
        self.mlp = Mlp(dim, int(dim * mlp_ratio))
        self.drop_path = DropPath(drop_path)

    def forward(
        self, x: Tensor, branch: Tensor | None, table: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """One block of a stage.

        Args:
            x: the residual, (B, R, A, D).
            branch: the branch of the previous block, which is added to the residual here.
            table: the position bias of the attention.

        Returns:
            The residual and the branch for the next block.
        """
        x, y = self.norm1(x, branch)
        with recomputed(y, self.norm1, x, when=self.grad_checkpointing):
            y = self.attn(y) if table is None else self.attn(y, table=table)
        x, y = self.norm2(x, self.drop_path(y) if self.training else y)
        with recomputed(y, self.norm2, x, when=self.grad_checkpointing):
            y = self.mlp(y)
        return x, self.drop_path(y) if self.training else y


class PatchMerging(nn.Module):
    """Joins m_r × m_φ neighbouring tokens into one token of twice the width."""

    def __init__(self, dim: int, merge: tuple[int, int]):
        super().__init__()
        self.merge = tuple(merge)
        joined = dim * merge[0] * merge[1]
        self.norm: Layer = nn.LayerNorm(joined)
        self.reduction: Layer = Linear(joined, 2 * dim, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R/m_r, A/m_φ, 2·D)."""
        batch, rings, sectors, dim = x.shape
        mr, ma = self.merge
        if rings % mr or sectors % ma:
            raise ValueError(f"merge {self.merge} must divide (R, A) = {(rings, sectors)}")
        # Inner order (φ, r, D): neighbours along the radius are next to each other.
        x = x.reshape(batch, rings // mr, mr, sectors // ma, ma, dim).permute(0, 1, 3, 4, 2, 5)
        return self.reduction(self.norm(x.flatten(3)))

    def extra_repr(self) -> str:
        return f"merge={self.merge}"


class Tables(tuple[Tensor | None, ...]):
    """The position biases of a stage's blocks, (B or 1, heads, 2·M_r-1, 2·M_φ-1) each, or None for
    a block without window attention."""


class Stage(nn.Module):
    """A stage: the merging of tokens, then blocks whose position biases are all of one kind."""

    # An optimized model sets these. `coefficients` are the joined coefficients of the position
    # biases. A map with more than `most_numbers` numbers is computed in parts, each of some images.
    # `add` works in place.
    coefficients: dict[str, Tensor] | None = None
    most_numbers: int | None = None
    add: Callable[[Tensor, Tensor], Tensor] = torch.add

    def __init__(self, downsample: nn.Module, blocks: Iterable[Block]):
        super().__init__()
        self.downsample = downsample
        self.blocks = nn.ModuleList(blocks)

    def tables(self, *positions: Any) -> Tables:
        """The position biases of all blocks. `forward` accepts them in place of the positions."""
        if positions and isinstance(positions[0], Tables):
            return positions[0]
        attentions = [block.attn for block in self.blocks]
        biases = [a.position_bias if isinstance(a, WindowAttention) else None for a in attentions]
        relative = [bias for bias in biases if isinstance(bias, RelativeBias)]
        if relative:
            # One computation for all blocks, because each step handles only a few numbers.
            coefficients = self.coefficients or joined_coefficients(relative)
            table = relative[0].table(*positions, **coefficients)
            return Tables(table.split([bias.heads for bias in relative], 1))
        return Tables(None if bias is None else bias(*positions) for bias in biases)

    def forward(self, x: Tensor, *positions: Any) -> Tensor:
        """The map of the previous stage → the map of this stage."""
        x, tables = self.downsample(x), self.tables(*positions)
        most = x.numel() if self.most_numbers is None else self.most_numbers
        if x.numel() <= most:
            return self._run(x, tables)
        count = min(-(-x.numel() // most), len(x))
        x = x.contiguous()
        parts = zip(x.tensor_split(count), *(_split(t, count) for t in tables), strict=True)
        for part, *of_part in parts:
            self._run(part, of_part)
        return x

    def _run(self, x: Tensor, tables: Iterable[Tensor | None]) -> Tensor:
        branch = None
        for block, table in zip(self.blocks, tables, strict=True):
            x, branch = block(x, branch, table)
        return x if branch is None else self.add(x, branch)


def _split(table: Tensor | None, count: int) -> Sequence[Tensor | None]:
    """The table for each part of the images. A table for all images serves every part."""
    return [table] * count if table is None or len(table) == 1 else table.tensor_split(count)
