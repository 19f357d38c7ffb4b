"""What the authors' released DarSwin-A does otherwise than the paper: `DarSwin(compat="official")`.

Rings and samples equal in tan θ with both borders sampled, azimuth 0 pointing down and running
counterclockwise, radii scaled as align_corners=True does, the field of view of image 0 for the
whole batch, tan θ_max as the angle of the bias, a seam in the azimuth, and other shifts.
"""

import dataclasses
import math

import torch
from torch import Tensor

from darswin.layers.grid import PolarGrid
from darswin.lens import Lens, Number, Spherical
from darswin.lens.parameter import Parameter
from darswin.lens.spacing import check_tan
from darswin.models.stages import Pair, StagePlan


class OfficialPolynomial(Lens, register=False):
    """The released code's polynomial lens, an angle as a function of the radius.

    θ(x) = x (d₁ + d₂ x + d₃ x² + d₄ x³) with x = r / radius in [0, 1], inverted on a table of 50
    points, straight between them. θ(1) is θ_max, in units of its own: it need not be an angle.

    Args:
        coefficients: (4,) or (N, 4): d₁ … d₄, such that θ rises.
        radius: px, of the image circle: half the image's side.
    """

    coefficients = Parameter(shape=(4,))
    radius = Parameter(low=0, open=True, in_pixels=True)

    def _validate(self) -> None:
        self._require(
            "coefficients", (self._table()[1].diff(dim=1) > 0).all(1), "such that θ rises"
        )

    @property
    def theta_limit(self) -> Tensor:
        return self.coefficients.detach().sum(1)

    def _angle(self, x: Tensor) -> Tensor:
        columns = self.coefficients.reshape(*self.coefficients.shape, *(1,) * (x.dim() - 1))
        terms = (column * x**power for power, column in enumerate(columns.unbind(1), start=1))
        return sum(terms, torch.zeros_like(x))

    def _table(self) -> tuple[Tensor, Tensor]:
        """x (50,) and its θ (N, 50)."""
        like = self.coefficients
        x = torch.linspace(0, 1, 50, dtype=like.dtype, device=like.device)
        return x, self._angle(x[None])

    def project(self, theta: Number) -> Tensor:
        theta, radius = self._aligned(theta, "radius")
        x, angles = self._table()
        angle, radius = torch.broadcast_tensors(theta, radius)
        flat = angle.reshape(len(self), -1)
        above = torch.searchsorted(angles.contiguous(), flat.contiguous(), right=True)
        above = above.clamp(1, len(x) - 1)
        low, high = angles.gather(1, above - 1), angles.gather(1, above)
        fraction = (flat - low) / (high - low)
        rho = x[above - 1] + fraction * (x[above] - x[above - 1])
        return rho.reshape(angle.shape) * radius

    def _angle_at(self, radius: Tensor) -> Tensor:
        radius, full = self._aligned(radius, "radius")
        return self._angle(radius / full)


def grid(
    lens: Lens,
    image_size: tuple[int, int],
    *,
    rings: int,
    sectors: int,
    samples: tuple[int, int],
    **_settings: str,
) -> PolarGrid:
    """The grid of the released code, in place of `polar_grid`; ValueError unless images are square.

    It is a grid of the transposed image: azimuth 0 points down there. Near 90° the rounding of
    float32 tangents moves samples by 1e-4 px, so the released steps are followed one by one, and
    the samples still depend that much on the maths library (MKL's differs between CPUs).
    """
    height, width = image_size
    if height != width:
        raise ValueError(f"compat='official' needs square images, got (H, W) = {image_size}")
    if lens.affine is not None or not lens.is_radial:
        raise ValueError("compat='official' needs radial lenses, with no affine, got " + repr(lens))
    like = lens.theta_max
    lens = lens.replace(theta_max=like[:1].expand(len(lens)))
    along_r, along_phi = (_inclusive(count - 1, like) for count in samples)
    ends = _last_angle(lens)[:, None] * _inclusive(rings, like)
    if isinstance(lens, OfficialPolynomial):
        borders = lens.project(ends)
        radii = _between(borders[:, :-1], borders[:, 1:], along_r)
    else:
        check_tan(lens)
        borders = _radius(lens, ends)
        inner, outer = borders[:, :-1], borders[:, :-1] + borders.diff(dim=1)
        tangents = _between(_tangent(lens, inner), _tangent(lens, outer), along_r)
        radii = _radius(lens, tangents)
    step = (torch.tensor(2 * math.pi, dtype=like.dtype) / sectors).item()
    # Half a step less than once around: the end itself must not come in by rounding.
    start = torch.arange(0, (sectors - 0.5) * step, step, dtype=like.dtype, device=like.device)
    azimuths = _between(start, step + start, along_phi)
    scale = (height - 1) / 2 / (height // 2)
    center = lens.center_in(image_size).flip(1)
    return PolarGrid(radii * scale, azimuths, center, borders * scale)


def _inclusive(count: int, like: Tensor) -> Tensor:
    """0 … 1 in `count` equal steps."""
    return torch.arange(count + 1, dtype=like.dtype, device=like.device) / count


def _between(inner: Tensor, outer: Tensor, steps: Tensor) -> Tensor:
    """Borders (..., R) and fractions (S,) → (..., R·S)."""
    return (inner[..., None] + steps * (outer - inner)[..., None]).flatten(-2)


def _radius(lens: Lens, tangent: Tensor) -> Tensor:
    """r at tan θ."""
    return lens.project(torch.atan(tangent))


def _tangent(lens: Lens, radius: Tensor) -> Tensor:
    """tan θ at r, in the released steps where the released code has the lens."""
    if not isinstance(lens, Spherical):
        return torch.tan(lens.unproject(radius))
    xi, rho = lens.xi[:, None], radius / lens.focal[:, None]
    sine = xi * radius / lens.focal[:, None] / torch.sqrt(1 + rho * rho)
    return torch.tan(torch.asin(sine) + torch.atan(rho))


def _last_angle(lens: Lens) -> Tensor:
    """(N,): what the released code splits into rings and takes for θ_max in the bias."""
    if isinstance(lens, OfficialPolynomial):
        return lens.theta_max
    return torch.tan(lens.theta_max)


def ring_angles(lens: Lens, rings: int) -> Tensor:
    """(1, rings+1): equal steps up to tan θ_max of image 0, taken for an angle."""
    return _last_angle(lens[:1])[:, None] * _inclusive(rings, lens.theta_max)


def plan(stage: StagePlan, window: Pair) -> StagePlan:
    """The stage with the released code's shift of its odd blocks."""
    shift = (window[0], window[1] // 4)
    if stage.map_size[1] < 4:
        shift = shift[::-1]
    # Rolling by whole windows of one token, or once around, moves nothing.
    along_r, along_phi = (
        s % size if w > 1 else 0
        for s, size, w in zip(shift, stage.map_size, stage.window, strict=True)
    )
    return dataclasses.replace(stage, shift=(along_r, along_phi))
