"""The position biases of window attention: of angles, a Fourier series, or a table."""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from darswin.views import PolarGrid

PositionBias = Literal["angular_relative", "angular", "polar"]

COEFFICIENTS = ("a_theta", "b_theta", "a_phi", "b_phi")


class RelativeBias(nn.Module):
    """The bias B_θ + B_φ, computed from the angles between tokens.

    The coefficients a_θ, b_θ, a_φ and b_φ have `rows` rows each, and a column for each head.
    Subclasses define the bias along one axis.
    """

    def __init__(
        self, window: tuple[int, int], heads: int, sectors: int, rows: tuple[int, int, int, int]
    ):
        super().__init__()
        self.window, self.sector_angle, self.heads = window, 2 * math.pi / sectors, heads
        self.a_theta, self.b_theta, self.a_phi, self.b_phi = (
            nn.Parameter(nn.init.trunc_normal_(torch.empty(count, heads), std=0.02))
            for count in rows
        )

    def _axis(self, angle: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Angles (N, K) of Δ = -(K-1)/2 … (K-1)/2 → the bias along one axis, (N, K, heads)."""
        raise NotImplementedError

    def forward(self, ring_angles: Tensor) -> Tensor:
        """Angles → (N, heads, 2·M_r-1, 2·M_φ-1), the `bias` of `window_attention`.

        Args:
            ring_angles: the angles that 0, 1, 2 … rings span, (N, M_r or more) rad.
        """
        return self.table(ring_angles, **joined_coefficients([self]))

    def table(
        self, ring_angles: Tensor, a_theta: Tensor, b_theta: Tensor, a_phi: Tensor, b_phi: Tensor
    ) -> Tensor:
        """The result of `forward` for these coefficients, (rows, heads) each."""
        outward = ring_angles[:, : self.window[0]].to(a_theta)
        theta = torch.cat((-outward[:, 1:].flip(1), outward), 1)
        reach = self.window[1]
        steps = torch.arange(1 - reach, reach, dtype=outward.dtype, device=outward.device)
        phi = self.sector_angle * steps
        along_r = self._axis(theta, a_theta, b_theta).transpose(1, 2)
        along_phi = self._axis(phi[None], a_phi, b_phi).transpose(1, 2)
        return along_r[..., None] + along_phi[..., None, :]


def joined_coefficients(biases: Sequence[RelativeBias]) -> dict[str, Tensor]:
    """The coefficients of several biases, concatenated along the heads."""
    return {name: torch.cat([getattr(bias, name) for bias in biases], 1) for name in COEFFICIENTS}


class AngularRelativeBias(RelativeBias):
    """B = a_Δ sin α + b_Δ cos α, where α is the angle between two tokens with the offset Δ.

    The rows of the coefficients are in the order Δ = 0, 1, …, -2, -1. `periodic` makes the bias
    periodic in φ, if the window spans the ring: there are M_φ rows then, for Δφ modulo M_φ, instead
    of 2·M_φ-1 rows.

    Source: DarSwin, ICCV 2023, eq. 9 to 11.
    """

    def __init__(self, window: tuple[int, int], heads: int, sectors: int, periodic: bool = False):
        theta, phi = (2 * reach - 1 for reach in window)
        if periodic and window[1] == sectors:
            phi = sectors
        super().__init__(window, heads, sectors, (theta, theta, phi, phi))

    def _axis(self, angle: Tensor, a: Tensor, b: Tensor) -> Tensor:
        reach, angle = angle.shape[1] // 2, angle[..., None]
        # Rows Δ = -reach … reach. Indexing would give the same, but its gradient is slow.
        a, b = (torch.cat((rows[len(rows) - reach :], rows[: reach + 1])) for rows in (a, b))
        return a * torch.sin(angle) + b * torch.cos(angle)


class FourierBias(RelativeBias):
    """B = b_0 + (1/P) Σ_{p=1..P} (a_p sin pα + b_p cos pα), a series with P harmonics.

    α is the angle between two tokens ("angular"). For "polar", α along the radius is the distance
    of the tokens in the image, scaled so that the image circle has the radius π. `ring_angles`
    computes either of them.

    Source: DarSwin, ICCV 2023, table 3, after Ning et al., IJCAI 2020.
    """

    def __init__(self, window: tuple[int, int], heads: int, sectors: int, harmonics: int = 16):
        if harmonics < 1:
            raise ValueError(f"harmonics must be at least 1, got {harmonics}")
        super().__init__(window, heads, sectors, (harmonics, harmonics + 1) * 2)

    def _axis(self, angle: Tensor, a: Tensor, b: Tensor) -> Tensor:
        harmonics = a.shape[0]
        waves = angle[..., None] * torch.arange(1, harmonics + 1, device=angle.device)
        return b[0] + (torch.sin(waves) @ a + torch.cos(waves) @ b[1:]) / harmonics


class RelativeTable(nn.Module):
    """A learned bias for each offset between two tokens, independent of angles, as in Swin."""

    def __init__(self, window: tuple[int, int], heads: int):
        super().__init__()
        table = torch.empty(heads, 2 * window[0] - 1, 2 * window[1] - 1)
        self.table = nn.Parameter(nn.init.trunc_normal_(table, std=0.02))

    def forward(self) -> Tensor:
        """The `bias` of `window_attention`, (1, heads, 2·M_r-1, 2·M_φ-1)."""
        return self.table[None]


def ring_angles(last: Tensor, grid: PolarGrid, rings: int, kind: PositionBias) -> Tensor:
    """The θ of the ring borders of a map with `rings` rings, (N, rings+1) rad, up to `last` (N,),
    in equal steps: for spacings other than "theta" they are nominal. For "polar" it is their radius
    in the image instead, scaled so that the last one is π."""
    if kind == "polar":
        step = (grid.borders.shape[1] - 1) // rings
        borders = grid.borders[:, ::step]
        return borders * (math.pi / borders[:, -1:])
    return last[:, None] * torch.linspace(0, 1, rings + 1, device=last.device)
