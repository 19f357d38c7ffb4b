"""What the authors' released DarSwin-A does otherwise than the paper: `DarSwin(compat="official")`.

Rings and samples equal in tan θ with both borders sampled, azimuth 0 pointing down and running
against the clock, radii scaled as align_corners=True does, the field of view of image 0 for the
whole batch, tan θ_max as the angle of the bias, a seam in the azimuth, and other shifts.
"""

import dataclasses
import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from darswin.grid import PolarGrid, Spacing, polar_grid
from darswin.lens import Lens, Number

if TYPE_CHECKING:
    from darswin.models.darswin import StagePlan


class OfficialPolynomial(Lens):
    """The released code's polynomial lens, an angle as a function of the radius.

    θ(x) = x (d₁ + d₂ x + d₃ x² + d₄ x³) with x = r / radius in [0, 1], inverted on a table of 50
    points, straight between them. θ(1) is θ_max, in units of its own: it need not be an angle.

    Args:
        coefficients: (4,) or (N, 4): d₁ … d₄, such that θ rises.
        radius: px, of the image circle: half the image's side.
    """

    parameters = ("coefficients", "radius")
    coefficients: Tensor
    radius: Tensor

    def __init__(self, coefficients: Number, radius: Number, center: Number | None = None):
        theta_max = torch.as_tensor(coefficients).sum(-1)
        super().__init__(theta_max, center, coefficients=coefficients, radius=radius)

    def _validate(self) -> None:
        self._require("radius", self.radius > 0, "greater than 0")
        self._require(
            "coefficients", (self._table()[1].diff(dim=1) > 0).all(1), "such that θ rises"
        )

    def _angle(self, x: Tensor) -> Tensor:
        columns = self.coefficients.reshape(*self.coefficients.shape, *(1,) * (x.dim() - 1))
        return sum(column * x**power for power, column in enumerate(columns.unbind(1), start=1))

    def _table(self) -> tuple[Tensor, Tensor]:
        """x (50,) and its θ (N, 50)."""
        x = torch.linspace(0, 1, 50, dtype=self.theta_max.dtype, device=self.theta_max.device)
        return x, self._angle(x[None])

    def project(self, theta: Number) -> Tensor:
        theta, radius = self._aligned(theta, "radius")
        x, angles = self._table()
        flat = theta.expand(torch.broadcast_shapes(theta.shape, radius.shape)).flatten(1)
        above = torch.searchsorted(angles.contiguous(), flat.contiguous(), right=True)
        above = above.clamp(1, len(x) - 1)
        low, high = angles.gather(1, above - 1), angles.gather(1, above)
        fraction = (flat - low) / (high - low)
        rho = x[above - 1] + fraction * (x[above] - x[above - 1])
        return rho.reshape(radius.shape[:1] + theta.shape[1:]) * radius

    def unproject(self, radius: Number) -> Tensor:
        radius, full = self._aligned(radius, "radius")
        return self._angle(radius / full)


def grid(
    lens: Lens,
    image_size: tuple[int, int],
    *,
    sample_spacing: Spacing,
    spacing: Spacing,
    **options,
) -> PolarGrid:
    """`polar_grid` as the released code makes it; ValueError unless images are square."""
    height, width = image_size
    if height != width:
        raise ValueError(f"compat='official' needs square images, got (H, W) = {image_size}")
    if isinstance(lens, OfficialPolynomial):
        spacing, sample_spacing = "theta", "radius"
    lens = lens.replace(theta_max=lens.theta_max[:1].expand(len(lens)))
    made = polar_grid(lens, image_size, spacing=spacing, sample_spacing=sample_spacing, **options)
    scale = (height - 1) / 2 / (height // 2)
    return made._replace(radii=made.radii * scale, azimuths=math.pi / 2 - made.azimuths)


def radial_positions(lens: Lens, rings: int) -> Tensor:
    """(1, rings+1): equal steps up to tan θ_max of image 0, taken for an angle."""
    last = lens.theta_max[:1]
    if not isinstance(lens, OfficialPolynomial):
        last = torch.tan(last)
    return last[:, None] * torch.linspace(0, 1, rings + 1, device=last.device)


def plan(stage: "StagePlan", window: tuple[int, int]) -> "StagePlan":
    """The stage with the released code's shift of its odd blocks."""
    shift = (window[0], window[1] // 4)
    if stage.map_size[1] < 4:
        shift = shift[::-1]
    # Rolling by whole windows of one token, or once around, moves nothing.
    effective = tuple(
        s % size if w > 1 else 0
        for s, size, w in zip(shift, stage.map_size, stage.window, strict=True)
    )
    return dataclasses.replace(stage, shift=effective)
