"""Attention in the windows of a map, with a position bias of offsets or angles between tokens."""

from collections.abc import Callable
from functools import partial
from typing import Any

from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.layers.position_bias import (
    AngularRelativeBias,
    FourierBias,
    PositionBias,
    RelativeTable,
    ring_angles,
)
from darswin.ops import window_attention
from darswin.ops.checks import check_pair
from darswin.views import PolarGrid

__all__ = ["PolarWindowAttention", "WindowAttention"]


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
        self.qkv = Linear(dim, 3 * dim)
        self.proj = Linear(dim, dim)
        self.position_bias = position_bias(self.window, num_heads)

    def forward(self, x: Tensor, table: Tensor) -> Tensor:
        """(B, R, A, D) and the result of `position_bias` → the same shape as x."""
        qkv = self.queries_keys_values(x)
        return self.proj(window_attention(qkv, table, **self.windows()))

    def queries_keys_values(self, x: Tensor) -> Tensor:
        """(B, R, A, D) → (B, R, A, 3, heads, d)."""
        batch, rings, sectors, dim = x.shape
        if (rings, sectors) != self.map_size:
            raise ValueError(f"the map must be (R, A) = {self.map_size}, got {(rings, sectors)}")
        # Sizes in words: with -1, a map of no images would be ambiguous.
        return self.qkv(x).reshape(batch, rings, sectors, 3, self.num_heads, dim // self.num_heads)

    def windows(self) -> dict[str, Any]:
        """The options of the operator `window_attention`."""
        return dict(window=self.window, shift=self.shift, periodic=self.periodic)

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

    It is called `layer(x, layer.position_bias(angles))` with x (B, R, A, D) and the angles
    (B or 1, R+1) of the ring borders, from `darswin.layers.position_bias.ring_angles`.

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
        window: tuple[int, int],
        shift: tuple[int, int] = (0, 0),
        periodic: tuple[bool, bool] = (False, True),
        position_bias: PositionBias = "angular_relative",
        harmonics: int = 16,
        periodic_bias: bool = False,
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
            dim, num_heads, map_size=map_size, window=window, shift=shift, periodic=periodic,
            position_bias=bias,
        )  # fmt: skip
        self.kind = position_bias

    def angles(self, grid: PolarGrid) -> Tensor:
        """The angles from which the position bias is computed, (B or 1, R+1) rad."""
        return ring_angles(grid.last, grid, self.map_size[0], self.kind)
