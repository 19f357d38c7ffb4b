"""Tabulated lenses: radii at angles. Lenses of several models become one batch of them."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

from darswin.lens.base import Lens
from darswin.lens.parameter import Number, Parameter
from darswin.lens.solve import inverse
from darswin.ops.checks import readable
from darswin.ops.reference import ranks


class Tabulated(Lens):
    """r at given angles, interpolated by cubics that rise. The lens ends at the last angle.

    Args:
        angles: (K,) or (N, K) rad, rising from 0 to π at most; K ≥ 2.
        radii: the same shape, px, rising from 0.
        slopes: the same shape, px/rad: dr/dθ at the angles. The error for a smooth curve is then of
            the fourth power of the steps. None computes them from the table (PCHIP).

    `Lens` describes the other arguments.

    Source: Fritsch and Carlson, SINUM 1980; Fritsch and Butland, SISSC 1984.
    """

    angles = Parameter(shape=(None,), angle=True)
    radii = Parameter(shape=(None,), in_pixels=True)
    slopes = Parameter(shape=(None,), optional=True, in_pixels=True)
    max_numbers = 65536

    def _validate(self) -> None:
        if self.angles.shape != self.radii.shape or self.angles.shape[1] < 2:
            raise ValueError(
                "angles and radii must have the same shape, with at least 2 per lens, got "
                f"{tuple(self.angles.shape)} and {tuple(self.radii.shape)}"
            )
        for name in ("angles", "radii"):
            value = getattr(self, name).detach()
            rises = (value[:, 0] == 0) & (value.diff(dim=1) > 0).all(1) & value.isfinite().all(1)
            self._require(name, rises, "finite and rising from 0")
        ends = self.angles[:, -1] <= math.pi * (1 + 2 * torch.finfo(self.angles.dtype).eps)
        self._require("angles", ends, "at most π rad")
        if self.slopes is None:
            return
        if self.slopes.shape != self.angles.shape:
            shape, own = tuple(self.angles.shape), tuple(self.slopes.shape)
            raise ValueError(f"slopes must have the shape of angles and radii, {shape}, got {own}")
        steepest = _steepest(self.angles, self.radii)
        rise = (self.slopes >= 0) & (self.slopes <= steepest)
        self._require("slopes", rise.all(1), "from 0 to 3 times the table's, so that r rises")

    @property
    def theta_limit(self) -> Tensor:
        return self.angles[:, -1].detach()

    def _slopes(self) -> Tensor:
        """(N, K): dr/dθ at the angles, such that the cubics rise."""
        if self.slopes is not None:
            return self.slopes
        width, rise = self.angles.diff(dim=1), self.radii.diff(dim=1)
        secant = rise / width
        if secant.shape[1] == 1:
            return secant.expand(-1, 2)
        # Inside: a weighted harmonic mean of two secants. At the ends: a parabola through 3 points.
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
        """Start, width, first radius, rise and end slopes of the interval that contains each x. The
        slopes are in px per width."""
        x = torch.broadcast_tensors(x, self._row(self.theta_max, x.dim()))[0]
        shape, flat = x.shape, self._by_lens(x.detach())
        index = (ranks(table.detach(), flat) - 1).clamp(0, self.angles.shape[1] - 2)

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

    def _angle_at(self, radius: Tensor) -> Tensor:
        start, width, low, rise, first, last = self._pieces(radius, self.radii)
        t = inverse(
            lambda t: _cubic(t, rise, first, last),
            lambda t: _cubic_slope(t, rise, first, last),
            radius - low,
            torch.ones_like(low),
        )
        return start + t * width


def _steepest(angles: Tensor, radii: Tensor) -> Tensor:
    """(N, K): the largest slopes with which cubics rise: 3 times the smaller adjacent secant."""
    secant = radii.detach().diff(dim=1) / angles.detach().diff(dim=1)
    return 3 * torch.minimum(torch.cat((secant[:, :1], secant), 1),
                             torch.cat((secant, secant[:, -1:]), 1))  # fmt: skip


def _cubic(t: Tensor, rise: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """The cubic on [0, 1] from 0 to `rise` with the slopes `first` and `last` at its ends."""
    bend = first + last - 2 * rise
    return t * (first + t * (3 * rise - 2 * first - last + t * bend))


def _cubic_slope(t: Tensor, rise: Tensor, first: Tensor, last: Tensor) -> Tensor:
    bend = first + last - 2 * rise
    return first + t * (2 * (3 * rise - 2 * first - last) + 3 * t * bend)


def as_curves(lens: Lens, count: int = 512) -> Tabulated:
    """The lenses as tables of `count` angles with slopes; differentiable in their parameters.

    In float64, 512 angles reproduce every model up to 0.99 of its `theta_limit` to 1e-7 of `r_max`;
    in float32, to rounding. Two things are lost: the kinks of a `Tabulated` lens without slopes
    (about 1e-4 of `r_max`), and the small r(0) of an `OCamInverse` lens with fitted coefficients.

    Raises:
        ValueError: a lens with tangential or thin-prism terms, or with an r(0) of more than
            1/1000 of `r_max` or 1 px. Tables cannot represent these.
    """
    if not lens.is_radial:
        raise ValueError(
            "a lens with tangential or thin-prism terms is no curve; "
            "lens.replace(tangential=None, prism=None) removes them"
        )
    angles = lens.theta_max[:, None] * _fractions(lens, count)
    radii, slopes = lens.project(angles), lens._slope(angles)
    _check_start(radii)
    radii = torch.cat((torch.zeros_like(radii[:, :1]), radii[:, 1:]), 1)
    slopes = torch.minimum(slopes.clamp(min=0), _steepest(angles, radii))
    common = {name: getattr(lens, name) for name in lens.common}
    return Tabulated._from_tensors({"angles": angles, "radii": radii, "slopes": slopes} | common)


def _check_start(radii: Tensor) -> None:
    """Raises ValueError unless radii (N, K) begin near 0 and rise."""
    first, second, last = (radii.detach()[:, k] for k in (0, 1, -1))
    most = 1e-3 * last.clamp(max=1000)
    off = (first.abs() > most) | ~(second > 0)
    if readable(radii) and bool(off.any()):
        raise ValueError(
            f"a lens is a curve only if r(0) is 0 to within {most[off][0].item():.2g} px and r "
            f"rises from there; got r(0) = {first[off][0].item():.4g} px"
        )


@torch.no_grad()
def _fractions(lens: Lens, count: int) -> Tensor:
    """(N, count): fractions of θ_max from 0 to 1, closer together where the slope of r changes."""
    like = lens.theta_max
    fractions = torch.linspace(0, 1, 2 * count, dtype=like.dtype, device=like.device)[None]
    fractions = fractions.expand(lens.count, -1)
    # Each round uses the slopes at the last round's points, which resolve a pole better.
    for points in (2 * count, 2 * count, count):
        slope = lens._slope(like[:, None] * fractions)
        bends = slope.clamp(min=torch.finfo(like.dtype).tiny).log().diff(dim=1).abs()
        bends = torch.nn.functional.pad(bends.cumsum(1), (1, 0))
        place = (fractions + bends / bends[:, -1:].clamp(min=1)).contiguous()
        even = place[:, -1:] * torch.linspace(0, 1, points, dtype=like.dtype, device=like.device)
        after = torch.searchsorted(place, even).clamp(1, place.shape[1] - 1)
        before, next_ = (place.gather(1, k) for k in (after - 1, after))
        low, high = (fractions.gather(1, k) for k in (after - 1, after))
        fractions = low + (high - low) * ((even - before) / (next_ - before)).clamp(0, 1)
    fractions[:, 0], fractions[:, -1] = 0, 1
    return fractions


def cat(lenses: Sequence[Lens]) -> Lens:
    """Joins lenses to one batch. Lenses of several models become `Tabulated` lenses of 512 angles,
    which in float64 reproduce them to 1e-7 of `r_max`.

    Raises:
        ValueError: no lens; a principal point or an image size for only some lenses; or several
            models of which one has no curve.
    """
    lenses = list(lenses)
    if not lenses:
        raise ValueError("cat needs at least one lens")
    for name in ("center", "image_size"):
        if len({getattr(lens, name) is None for lens in lenses}) > 1:
            raise ValueError(f"cat needs a {name} for all lenses or for none")
    if len({form_of(lens) for lens in lenses}) > 1:
        lenses = [as_curves(lens) for lens in lenses]
    if len({lens.affine is None for lens in lenses}) > 1:
        lenses = [lens.replace(affine=lens._affine()) for lens in lenses]
    names = lenses[0]._tensors()
    return lenses[0]._from_tensors({n: torch.cat([getattr(x, n) for x in lenses]) for n in names})


def form_of(lens: Lens) -> tuple:
    """A key: lenses with equal forms are joined without becoming curves."""
    shapes = {n: v.shape[1:] for n, v in lens._tensors().items() if n not in lens.common}
    return type(lens), tuple(shapes.items())


# A DataLoader batches lenses of any class.
default_collate_fn_map[Lens] = lambda batch, *, collate_fn_map=None: cat(batch)
