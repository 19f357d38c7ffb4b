"""Fits one lens model to another by least squares on the pixels where rays land."""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from darswin.lens.base import MODELS, Lens, unknown_model
from darswin.lens.curves import Tabulated, as_curves, cat
from darswin.lens.polynomial import PolynomialLens
from darswin.lens.solve import direction_of

# The grid of rays that are compared.
RINGS, SPOKES = 200, 16
ROUNDS = 200


class Fit(NamedTuple):
    """A fitted lens, and its largest distance from the original lens, (N,) px."""

    lens: Lens
    error: Tensor


def fit(model: str | type[Lens], lens: Lens, *, terms: int | None = None) -> Fit:
    """Finds the lens of another model that is closest to a lens, for all rays up to its θ_max.

    Principal point, affine and image size stay the same. Tangential and thin-prism terms are fitted
    if the model has them; if not, the error includes their effect.

    Args:
        model: a lens class, or its name in `darswin.lens.MODELS`.
        lens: N lenses.
        terms: the number of polynomial terms. None means the model's default: 2 for `Mei`, 3 for
            `BrownConrady`, 4 for the others.

    Returns:
        (lens, error): N lenses in the dtype of `lens`, and the largest distance of each, px, on a
        grid of rays.

    Raises:
        ValueError: an unknown model, or a model that cannot reach θ_max.
    """
    if isinstance(model, str):
        if model not in MODELS:
            raise ValueError(unknown_model(model))
        model = MODELS[model]
    if not isinstance(model, type) or not issubclass(model, Lens):
        raise TypeError(f"model must be a lens class or its name, got {model!r}")
    if issubclass(model, Tabulated):
        curves = as_curves(lens if lens.is_radial else lens.replace(tangential=None, prism=None))
        return Fit(curves, largest_distance(curves, lens))
    terms = model.terms if terms is None else terms
    exact = lens.detach().to(torch.float64)
    found = cat([fit_one(model, exact[k], terms) for k in range(len(lens))])._tensors()
    fitted = model(**found | {name: getattr(exact, name) for name in exact.common})
    return Fit(fitted.to(lens.theta_max.dtype), largest_distance(fitted, exact).to(lens.theta_max))


def largest_distance(lens: Lens, other: Lens) -> Tensor:
    """(N,) px: the largest distance between the pixels of a ray in two lenses with one center."""
    theta, direction = _rays(other, 1024, 72)
    one, two = (each.through_affine(each._flat(theta, direction)) for each in (lens, other))
    return (one - two).norm(dim=-1).flatten(1).amax(1)


def _rays(lens: Lens, rings: int, spokes: int) -> tuple[Tensor, Tensor]:
    """θ (N, rings, 1), above 0 up to θ_max, and (cos φ, sin φ), (1, 1, spokes, 2), over a turn."""
    dtype = lens.theta_max.dtype
    theta = lens.theta_max[:, None] * (torch.arange(1, rings + 1, dtype=dtype) / rings)
    azimuth = torch.arange(spokes, dtype=dtype) * (2 * math.pi / spokes)
    return theta[..., None], direction_of(azimuth)[None, None]


def fit_one(model: type[Lens], lens: Lens, terms: int, rounds: int = ROUNDS) -> Lens:
    """`fit` of one lens in float64, without the parameters that all lenses have but theta_max, in
    at most `rounds` steps from each start."""
    # A radial lens needs one azimuth only.
    aside = not lens.is_radial and "tangential" in model.optional
    theta, direction = _rays(lens, RINGS, SPOKES if aside else 1)
    if issubclass(model, PolynomialLens):
        line = theta[:, :, 0]
        radius, slope = lens.project(line), Lens._slope(lens, line)
        coefficients = model.closest(line[0], radius[0], slope[0], terms)
        return model._from_tensors({"coefficients": coefficients, "theta_max": lens.theta_max})
    goal = lens._flat(theta, direction) if aside else lens.project(theta)[..., None] * direction
    found = (
        _least_squares(model, start, lens.theta_max, theta, direction, goal, rounds)
        for start in _starts(model, lens, terms, aside)
    )
    best, cost = min(found, key=lambda pair: pair[1])
    if not math.isfinite(cost):
        degrees = math.degrees(lens.theta_max.item())
        raise ValueError(f"no {model.__name__} lens was found that reaches {degrees:.2f}°")
    return best


def _starts(model: type[Lens], lens: Lens, terms: int, aside: bool) -> Iterator[dict[str, Tensor]]:
    """Initial parameters, in the shapes of the fitted ones."""
    slope = lens.project(1e-4 * lens.theta_max) / (1e-4 * lens.theta_max)
    starts = {name: p.starts for name, p in model.declared.items() if p.starts}
    for values in itertools.product(*starts.values()):
        start = {name: slope.new_tensor([v]) for name, v in zip(starts, values, strict=True)}
        if "radial" in model.optional:
            start["radial"] = slope.new_zeros(1, terms)
        if aside:
            start |= {"tangential": slope.new_zeros(1, 2), "prism": slope.new_zeros(1, 4)}
        # This focal length gives the curve the right slope at 0.
        unit = start | {"focal": slope.new_ones(1), "theta_max": lens.theta_max}
        start["focal"] = slope * 1e-4 / model._from_tensors(unit).project(1e-4)
        yield start


class Packing:
    """Parameters of one lens as one vector: names and shapes are those of tensors (1, ...). `low`
    and `high` bound its numbers in a fit."""

    def __init__(self, model: type[Lens], tensors: Mapping[str, Tensor]):
        self.shapes = {name: tensor.shape for name, tensor in tensors.items()}
        declared = {name: model.declared[name] for name in tensors}
        bounds = {name: p.bounds or (p.low, p.high) for name, p in declared.items()}
        self.low, self.high = (
            self.vector({n: t.new_full(t.shape, bounds[n][end]) for n, t in tensors.items()})
            for end in (0, 1)
        )

    def vector(self, tensors: Mapping[str, Tensor]) -> Tensor:
        """The numbers of the tensors, one after the other."""
        return torch.cat([tensors[name].flatten() for name in self.shapes])

    def tensors(self, vectors: Tensor) -> dict[str, Tensor]:
        """The inverse of `vector`, for vectors (B, n) of B lenses."""
        pieces = vectors.split([shape.numel() for shape in self.shapes.values()], dim=1)
        named = zip(self.shapes.items(), pieces, strict=True)
        return {name: piece.reshape(-1, *shape[1:]) for (name, shape), piece in named}


def slopes_of(function: Callable[[Tensor], Tensor], vector: Tensor) -> Tensor:
    """(..., n): the derivatives of a function by the numbers of a vector (n,). The function takes
    vectors (n, n), one for each derivative, and gives (n, ...)."""
    count = len(vector)
    with forward_ad.dual_level():  # torch.func.jacfwd takes much longer
        axes = torch.eye(count, dtype=vector.dtype)
        values = function(forward_ad.make_dual(vector.repeat(count, 1), axes))
        return forward_ad.unpack_dual(values).tangent.movedim(0, -1)


def _least_squares(
    model: type[Lens],
    start: dict[str, Tensor],
    theta_max: Tensor,
    theta: Tensor,
    direction: Tensor,
    goal: Tensor,
    rounds: int,
) -> tuple[Lens, float]:
    """The closest lens within bounds by the Levenberg–Marquardt method, and its mean squared
    distance, which is infinite if no lens was found."""
    packing = Packing(model, start)
    low, high = packing.low, packing.high

    def lenses_of(vectors: Tensor) -> Lens:
        limits = {"theta_max": theta_max.expand(len(vectors))}
        return model._from_tensors(packing.tensors(vectors) | limits)

    def points(vectors: Tensor) -> Tensor:
        return lenses_of(vectors)._flat(theta, direction)

    def cost_of(vector: Tensor) -> float:
        lens = lenses_of(vector[None])
        rises = bool((lens.project(theta).flatten().diff() > 0).all())
        value = (lens._flat(theta, direction) - goal).square().mean().item()
        return value if rises and value >= 0 else math.inf

    vector = packing.vector(start).clamp(low, high)
    cost, damping = cost_of(vector), 1e-3
    if not math.isfinite(cost):
        return lenses_of(vector[None]), math.inf
    axes = torch.eye(len(vector), dtype=vector.dtype)
    for _ in range(rounds):
        error = (points(vector[None]) - goal).flatten()
        slopes = slopes_of(points, vector).flatten(0, -2)
        scale = slopes.norm(dim=0).clamp(min=1e-30)
        before = cost
        while damping < 1e12:
            rows = torch.cat((slopes / scale, math.sqrt(damping) * axes))
            aim = torch.cat((error, error.new_zeros(len(vector))))
            step = torch.linalg.lstsq(rows, aim[:, None]).solution[:, 0] / scale
            trial = (vector - step).clamp(low, high)
            trial_cost = cost_of(trial)
            if trial_cost < cost:
                vector, cost, damping = trial, trial_cost, max(damping / 10, 1e-15)
                break
            damping *= 10
        if cost > 0.9999 * before or cost < 1e-26:
            break
    return lenses_of(vector[None]), cost
