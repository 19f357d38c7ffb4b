"""Multi-head attention in the windows of a map."""

from collections.abc import Callable
from functools import partial

from torch import Tensor, nn

from darswin.layers.linear import Linear
from darswin.layers.position_bias import (
    AngularRelativeBias,
    FourierBias,
    PositionBias,
    RelativeTable,
)
from darswin.layers.recompute import recomputed
from darswin.ops import window_attention
from darswin.ops.checks import check_pair


class WindowAttention(nn.Module):
    """Multi-head attention in the windows of a map, as in Swin.

    Args:
        dim: D. num_heads: divides D. map_size: (R, A), or of a plain map (H, W).
        window: (M_r, M_φ), which divides the map. shift: (s_r, s_φ).
        periodic: whether the map wraps around along each axis.
        position_bias: makes the bias from the window and the heads.

    Raises:
        ValueError: sizes that do not divide.

    Source: Swin Transformer, ICCV 2021, sec. 3.2.
    """

    grad_checkpointing = False  # see `Encoder.set_grad_checkpointing`

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
        self.num_heads, self.periodic = num_heads, periodic
        self.map_size = check_pair("map_size", map_size, lowest=1)
        self.window = check_pair("window", window, lowest=1)
        self.shift = check_pair("shift", shift, lowest=0)
        if map_size[0] % window[0] or map_size[1] % window[1]:
            raise ValueError(f"window must divide the map (R, A) = {map_size}, got {window}")
        self.qkv = Linear(dim, 3 * dim)
        self.proj = Linear(dim, dim)
        self.position_bias = position_bias(self.window, num_heads)

    def forward(self, x: Tensor, *positions: Tensor, table: Tensor | None = None) -> Tensor:
        """(B, R, A, D) → the same shape. `positions` are what the bias is made from; a stage that
        has made it gives it as the `table`."""
        batch, rings, sectors, dim = x.shape
        if (rings, sectors) != self.map_size:
            raise ValueError(f"the map must be (R, A) = {self.map_size}, got {(rings, sectors)}")
        qkv = self.qkv(x).reshape(batch, rings, sectors, 3, self.num_heads, dim // self.num_heads)
        attend = partial(
            window_attention, window=self.window, shift=self.shift, periodic=self.periodic
        )
        bias = self.position_bias(*positions) if table is None else table
        out = attend(qkv, bias)
        with recomputed(out, attend, qkv, bias, when=self.grad_checkpointing):
            return self.proj(out)

    def extra_repr(self) -> str:
        return (
            f"map_size={self.map_size}, window={self.window}, shift={self.shift}, "
            f"periodic={self.periodic}"
        )


def check_heads(dim: int, num_heads: int) -> None:
    """ValueError unless the heads divide the width."""
    if dim % num_heads:
        raise ValueError(f"num_heads must divide dim = {dim}, got {num_heads}")


class PolarWindowAttention(WindowAttention):
    """Multi-head attention in the windows of a polar map, with a bias that knows the angles.

    It is called `layer(x, ring_angles)`: x (B, R, A, D), and (B or 1, R+1) of
    `darswin.layers.position_bias.ring_angles`.

    Args:
        dim, num_heads, map_size, window, shift, periodic: as `WindowAttention`.
        position_bias: "angular_relative", "angular" or "polar".
        harmonics: of the last two. periodic_bias: see `AngularRelativeBias`; it acts where the
            window spans the ring.

    Raises:
        ValueError: sizes that do not divide, or an unknown position bias.

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
        sectors = map_size[1]
        bias: Callable[[tuple[int, int], int], nn.Module]
        if position_bias == "angular_relative":
            whole = periodic_bias and window[1] == sectors
            bias = partial(AngularRelativeBias, sectors=sectors, periodic=whole)
        elif position_bias in ("angular", "polar"):
            bias = partial(FourierBias, sectors=sectors, harmonics=harmonics)
        else:
            raise ValueError(
                "position_bias must be 'angular_relative', 'angular' or 'polar', "
                f"got {position_bias!r}"
            )
        super().__init__(
            dim,
            num_heads,
            map_size=map_size,
            window=window,
            shift=shift,
            periodic=periodic,
            position_bias=bias,
        )
