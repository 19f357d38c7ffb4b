"""Lenses as curves: a table of radii at angles. Lenses of several models are one batch as these."""

from collections.abc import Sequence

import torch
from torch import Tensor

from darswin.inverse import inverse
from darswin.lens.base import FRAME, Lens, Number


class Tabulated(Lens):
    """r at some angles, and between them the cubic that rises with the table (PCHIP).

    Args:
        angles: (K,) or (N, K) rad, rising from 0; K ≥ 2. radii: the same shape, px, rising from 0.
            Others: as `Lens`; the lens ends where its table does.

    Source: Fritsch and Butland, SISSC 1984.
    """

    parameters = ("angles", "radii")
    lengths = ("radii",)
    angles: Tensor
    radii: Tensor

    def __init__(
        self,
        angles: Number,
        radii: Number,
        theta_max: Number | None = None,
        center: Number | None = None,
        **frame: Number | None,
    ):
        super().__init__(theta_max, center, angles=angles, radii=radii, **frame)

    def _validate(self) -> None:
        if self.angles.shape != self.radii.shape or self.angles.shape[1] < 2:
            raise ValueError(
                "angles and radii must have the same shape, at least 2 a lens, got "
                f"{tuple(self.angles.shape)} and {tuple(self.radii.shape)}"
            )
        for name in ("angles", "radii"):
            value = getattr(self, name).detach()
            rises = (value[:, 0] == 0) & (value.diff(dim=1) > 0).all(1) & value.isfinite().all(1)
            self._require(name, rises, "finite and rising from 0")

    @property
    def theta_limit(self) -> Tensor:
        return self.angles[:, -1].detach()

    def _slopes(self) -> Tensor:
        """(N, K): dr/dθ at the angles, such that the cubics rise."""
        width, rise = self.angles.diff(dim=1), self.radii.diff(dim=1)
        secant = rise / width
        if secant.shape[1] == 1:
            return secant.expand(-1, 2)
        # Inside a weighted harmonic mean; at both ends the parabola through three points.
        before, after = width[:, :-1], width[:, 1:]
        w1, w2 = 2 * after + before, after + 2 * before
        inside = (w1 + w2) / (w1 / secant[:, :-1] + w2 / secant[:, 1:])

        def end(h0: Tensor, h1: Tensor, s0: Tensor, s1: Tensor) -> Tensor:
            parabola = ((2 * h0 + h1) * s0 - h0 * s1) / (h0 + h1)
            return torch.clamp(parabola, s0 / 10, 3 * s0)

        first = end(width[:, :1], width[:, 1:2], secant[:, :1], secant[:, 1:2])
        last = end(width[:, -1:], width[:, -2:-1], secant[:, -1:], secant[:, -2:-1])
        return torch.cat((first, inside, last), 1)

    def _pieces(self, x: Tensor, table: Tensor) -> tuple[Tensor, ...]:
        """Of the piece of the table that each x is in: θ where it starts, its width; r where it
        starts, its rise, and its slopes at both ends, in units of the width."""
        rows = max(len(self), x.shape[0])
        flat = x.detach().expand(rows, *x.shape[1:]).reshape(rows, -1)
        table = table.detach().expand(rows, -1).contiguous()
        if len(self) == 1:
            flat, shape = flat.reshape(1, -1), x.shape
            table = table[:1].contiguous()
        else:
            shape = (rows, *x.shape[1:])
        index = torch.searchsorted(table, flat.contiguous(), right=True) - 1
        index = index.clamp(0, self.angles.shape[1] - 2)

        def at(values: Tensor, place: Tensor) -> Tensor:
            return values.gather(1, place).reshape(shape)

        slopes = self._slopes()
        start, width = at(self.angles, index), at(self.angles.diff(dim=1), index)
        low, rise = at(self.radii, index), at(self.radii.diff(dim=1), index)
        return start, width, low, rise, at(slopes, index) * width, at(slopes, index + 1) * width

    def project(self, theta: Number) -> Tensor:
        (theta,) = self._aligned(theta)
        start, width, low, rise, first, last = self._pieces(theta, self.angles)
        return low + _cubic((theta - start) / width, rise, first, last)

    def unproject(self, radius: Number) -> Tensor:
        (radius,) = self._aligned(radius)
        start, width, low, rise, first, last = self._pieces(radius, self.radii)
        end = torch.ones_like(low)
        t = inverse(
            lambda t: _cubic(t, rise, first, last),
            lambda t: _cubic_slope(t, rise, first, last),
            radius - low,
            end,
        )
        r_max = self._row(self.radii[:, -1].detach(), radius.dim())
        lands = (radius >= 0) & (radius <= r_max * (1 + 4 * torch.finfo(radius.dtype).eps))
        return torch.where(lands, start + t * width, torch.nan)


def _cubic(t: Tensor, rise: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """The cubic on [0, 1] from 0 to `rise`, with these slopes at its ends."""
    bend = first + last - 2 * rise
    return t * (first + t * (3 * rise - 2 * first - last + t * bend))


def _cubic_slope(t: Tensor, rise: Tensor, first: Tensor, last: Tensor) -> Tensor:
    bend = first + last - 2 * rise
    return first + t * (2 * (3 * rise - 2 * first - last) + 3 * t * bend)


def as_curves(lens: Lens, count: int = 512) -> Tabulated:
    """The lenses as tables of `count` angles, to about 1e-5 px; differentiable in their parameters.

    Raises:
        ValueError: a lens with tangential or thin-prism terms, which no curve has.
    """
    if not lens.is_radial:
        raise ValueError(
            "a lens with tangential or thin-prism terms is no curve; "
            "lens.replace(tangential=None, prism=None) leaves them out"
        )
    steps = torch.linspace(0, 1, count, dtype=lens.theta_max.dtype, device=lens.theta_max.device)
    angles = lens.theta_max[:, None] * steps
    radii = lens.project(angles)
    radii = torch.cat((torch.zeros_like(radii[:, :1]), radii[:, 1:]), 1)
    tensors = {name: getattr(lens, name) for name in ("theta_max", *FRAME)}
    return Tabulated._from_tensors(dict(angles=angles, radii=radii) | tensors)


def stack(lenses: Sequence[Lens]) -> Lens:
    """One batch of all the lenses of a sequence; of several models as curves (`as_curves`).

    Raises:
        ValueError: no lens, principal points or image sizes for only some, or several models of
            which one has tangential or thin-prism terms.
    """
    lenses = list(lenses)
    if not lenses:
        raise ValueError("stack needs at least one lens")
    for name in ("center", "image_size"):
        if len({getattr(lens, name) is None for lens in lenses}) > 1:
            raise ValueError(f"stack needs a {name} for all lenses or for none")
    if len({_form(lens) for lens in lenses}) > 1:
        lenses = [as_curves(lens) for lens in lenses]
    if len({lens.affine is None for lens in lenses}) > 1:
        eye = torch.eye(2, dtype=lenses[0].theta_max.dtype, device=lenses[0].theta_max.device)
        lenses = [
            lens if lens.affine is not None else lens.replace(affine=eye.expand(len(lens), 2, 2))
            for lens in lenses
        ]
    tensors = {}
    for name in lenses[0]._names():
        values = [getattr(lens, name) for lens in lenses]
        tensors[name] = None if values[0] is None else torch.cat(values)
    return lenses[0]._from_tensors(tensors)


def _form(lens: Lens) -> tuple:
    """Lenses that agree in this are one batch as they are."""
    parameters = [getattr(lens, name) for name in (*lens.parameters, *lens.optional)]
    return type(lens), tuple(None if p is None else p.shape[1:] for p in parameters)
