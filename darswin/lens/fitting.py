"""One lens model in terms of another: least squares on where rays land."""

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from darswin.lens.base import MODELS, Lens
from darswin.lens.curves import Tabulated, as_curves
from darswin.lens.polynomial import PolynomialLens

# How finely rays are compared.
RINGS, SPOKES = 200, 16


class Fit(NamedTuple):
    """A fitted lens, and how far at most (px) it is from the one it was fitted to, (N,)."""

    lens: Lens
    error: Tensor


def fit(model: str | type[Lens], lens: Lens, *, terms: int | None = None) -> Fit:
    """The lens of another model that comes closest to a lens, for all rays up to its θ_max.

    Principal point, affine and image size stay. Tangential and thin-prism terms are fitted where
    the model has them, else left out, which the error tells.

    Args:
        model: a lens class, or its name in `darswin.lens.MODELS`.
        lens: N lenses.
        terms: of the model's polynomial. None means the usual number: 2 of `Mei`, 3 of
            `BrownConrady`, 4 of the others (their `terms`).

    Returns:
        (lens, error): N lenses in the dtype of `lens`, and for each the largest distance in px, on
        a grid of rays.

    Raises:
        ValueError: an unknown model, or one that cannot reach θ_max.
    """
    model = _model(model)
    if issubclass(model, Tabulated):
        curves = as_curves(lens if lens.is_radial else lens.replace(tangential=None, prism=None))
        return Fit(curves, largest_distance(curves, lens))
    terms = model.terms if terms is None else terms
    exact = lens.detach().to(torch.float64)
    parts = [_fit_one(model, exact[k], terms) for k in range(len(lens))]
    names = parts[0].parameters + parts[0].optional
    tensors = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in names
        if getattr(parts[0], name) is not None
    }
    fitted = model(**tensors, **{name: getattr(exact, name) for name in exact.common})
    return Fit(fitted.to(lens.theta_max.dtype), largest_distance(fitted, exact).to(lens.theta_max))


def largest_distance(lens: Lens, other: Lens) -> Tensor:
    """(N,) px: how far apart two lenses with the same principal point let a ray land, at most."""
    theta = other.theta_max[:, None, None] * _fractions(other, 1024)[:, None]
    direction = _directions(other, 72)
    apart = lens._flat(theta, direction) - other._flat(theta, direction)
    return other.through_affine(apart).norm(dim=-1).flatten(1).amax(1)


def _model(model: str | type[Lens]) -> type[Lens]:
    if isinstance(model, str):
        if model not in MODELS:
            raise ValueError(f"model must be one of {sorted(MODELS)}, got {model!r}")
        return MODELS[model]
    if not isinstance(model, type) or not issubclass(model, Lens):
        raise TypeError(f"model must be a lens class or its name, got {model!r}")
    return model


def _fractions(like: Lens, count: int) -> Tensor:
    return torch.arange(1, count + 1, dtype=like.theta_max.dtype) / count


def _directions(like: Lens, count: int) -> Tensor:
    """(1, 1, count, 2): cos φ and sin φ all around."""
    azimuth = torch.arange(count, dtype=like.theta_max.dtype) * (2 * math.pi / count)
    return torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)[None, None]


def _fit_one(model: type[Lens], lens: Lens, terms: int) -> Lens:
    theta = lens.theta_max[:, None, None] * _fractions(lens, RINGS)[:, None]
    # A radial lens is the same along all azimuths.
    aside = not lens.is_radial and "tangential" in model.optional
    direction = _directions(lens, SPOKES if aside else 1)
    goal = lens._flat(theta, direction) if aside else lens.project(theta)[..., None] * direction
    if issubclass(model, PolynomialLens):
        coefficients = _coefficients(model, lens, terms)
        return model._from_tensors({"coefficients": coefficients, "theta_max": lens.theta_max})
    best = None
    for start in _starts(model, lens, terms, aside):
        found, cost = _least_squares(model, start, lens.theta_max, theta, direction, goal)
        if best is None or cost < best[1]:
            best = found, cost
    if best is None or not math.isfinite(best[1]):
        degrees = math.degrees(lens.theta_max.item())
        raise ValueError(f"no {model.__name__} lens was found that reaches {degrees:.2f}°")
    return model._from_tensors(best[0] | {"theta_max": lens.theta_max})


def _starts(model: type[Lens], lens: Lens, terms: int, aside: bool) -> Iterator[dict[str, Tensor]]:
    """Parameters to start from, with the shapes that all shall have."""
    slope = lens.project(1e-4 * lens.theta_max) / (1e-4 * lens.theta_max)
    free = [name for name in model.parameters if name in model.starts]
    for values in itertools.product(*(model.starts[name] for name in free)):
        start = {n: slope.new_tensor([v]) for n, v in zip(free, values, strict=True)}
        if "radial" in model.optional:
            start["radial"] = slope.new_zeros(1, terms)
        if aside:
            start |= {"tangential": slope.new_zeros(1, 2), "prism": slope.new_zeros(1, 4)}
        # The focal length with which the curve has the right slope at 0.
        unit = start | {"focal": slope.new_ones(1), "theta_max": lens.theta_max}
        start["focal"] = slope * 1e-4 / model._from_tensors(unit).project(1e-4)
        yield start


def _coefficients(model: type[PolynomialLens], lens: Lens, terms: int) -> Tensor:
    theta = lens.theta_max[0] * _fractions(lens, RINGS)
    radius = lens.project(theta[None])[0]
    slope = torch.func.jvp(lens.project, (theta[None],), (torch.ones_like(theta)[None],))[1][0]
    return model.closest(theta, radius, slope, terms)


def _least_squares(
    model: type[Lens],
    start: dict[str, Tensor],
    theta_max: Tensor,
    theta: Tensor,
    direction: Tensor,
    goal: Tensor,
) -> tuple[dict[str, Tensor], float]:
    """Levenberg and Marquardt's method, within bounds."""
    names = list(start)
    shapes = [start[name].shape for name in names]
    sizes = [shape.numel() for shape in shapes]
    bounds = [model.bounds.get(name, (-math.inf, math.inf)) for name in names]
    low, high = (
        torch.cat([theta.new_full((s,), b[end]) for b, s in zip(bounds, sizes, strict=True)])
        for end in (0, 1)
    )

    def parameters(vector: Tensor) -> dict[str, Tensor]:
        pieces = vector.split(sizes)
        return {n: p.reshape(s) for n, p, s in zip(names, pieces, shapes, strict=True)}

    def miss(vector: Tensor) -> Tensor:
        lens = model._from_tensors(parameters(vector) | {"theta_max": theta_max})
        return (lens._flat(theta, direction) - goal).flatten()

    def cost_of(vector: Tensor) -> float:
        lens = model._from_tensors(parameters(vector) | {"theta_max": theta_max})
        rises = bool((lens.project(theta).flatten().diff() > 0).all())
        value = (lens._flat(theta, direction) - goal).square().mean().item()
        return value if rises and value >= 0 else math.inf

    vector = torch.cat([start[name].flatten() for name in names]).clamp(low, high)
    cost, damping = cost_of(vector), 1e-3
    if not math.isfinite(cost):
        return start, math.inf
    axes = torch.eye(len(vector), dtype=vector.dtype)
    for _ in range(200):
        columns = [torch.func.jvp(miss, (vector,), (axis,)) for axis in axes]
        error, slopes = columns[0][0], torch.stack([column[1] for column in columns], 1)
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
    return parameters(vector), cost
