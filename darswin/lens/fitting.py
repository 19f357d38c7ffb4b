"""Fits a lens model to a lens, or to rays, by least squares on the pixels where rays land."""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from darswin.lens.base import MODELS, Lens, unknown_model
from darswin.lens.curves import Tabulated, as_curves, cat
from darswin.lens.distorted import KannalaBrandt
from darswin.lens.image import _image_size
from darswin.lens.polynomial import OCam, OCamInverse, PolynomialLens
from darswin.lens.solve import direction_of, length_of
from darswin.utils.arrays import as_tensor

# The grid of rays that are compared.
RINGS, SPOKES = 200, 16
ROUNDS = 200
# Of a field of rays: the rays that are used, at least and about at most; the rounds of weighting;
# the scale of the Cauchy loss, in median distances; and parts of the picture: what is added to the
# scale, and the median distance of rays that no lens has.
FEWEST, ENOUGH, WEIGHTINGS, SCALE, FINE, WILD = 32, 2**13, 10, 2.5, 0.001, 0.1


class Fit(NamedTuple):
    """A fitted lens, and its distance from the original, (N,) px: the largest from a lens, and the
    median from a field of rays."""

    lens: Lens
    error: Tensor


def fit(
    model: str | type[Lens], lens: Lens | Any, *, terms: int | None = None, weights: Any = None,
    size: tuple[int, int] | None = None,
) -> Fit:  # fmt: skip
    """Finds the lens of a model that is closest to a lens, or to the rays of a picture's pixels.

    To a lens, for all rays up to its θ_max: principal point, affine and image size stay the same.
    Tangential and thin-prism terms are fitted if the model has them; if not, the error includes
    their effect.

    To a field of rays, such as a network gives it: the principal point is found too, for square
    pixels without tangential terms. Outliers count little (Cauchy's loss). θ_max is the largest
    angle at the pixels whose rays agree with the lens.

    Args:
        model: a lens class, or its name in `darswin.lens.MODELS`.
        lens: N lenses; or a field, (h, w, 3), an array or a tensor: the directions of the rays, of
            any length, with x to the right, y down and z forward; NaN or 0 where unknown.
        terms: the number of polynomial terms. None means the model's default: 2 for `Mei`, 3 for
            `BrownConrady`, 4 for the others.
        weights: (h, w), how much each ray of a field counts, 0 or more. None means equally.
        size: (H, W) px of the picture, if the field is a resized one. None means (h, w).

    Returns:
        (lens, error): N lenses in the dtype of `lens`, and the distance of each, px: the largest on
        a grid of rays, or the median of a field's rays.

    Raises:
        ValueError: an unknown model, a model that cannot reach θ_max, or a field with too few rays.
    """
    if isinstance(model, str):
        if model not in MODELS:
            raise ValueError(unknown_model(model))
        model = MODELS[model]
    if not isinstance(model, type) or not issubclass(model, Lens):
        raise TypeError(f"model must be a lens class or its name, got {model!r}")
    if not isinstance(lens, Lens):
        return _fit_field(model, lens, terms, weights, size)
    if weights is not None or size is not None:
        raise ValueError("weights and size belong to a field of rays, not to a lens")
    if issubclass(model, Tabulated):
        curves = as_curves(lens if lens.is_radial else lens.replace(tangential=None, prism=None))
        return Fit(curves, largest_distance(curves, lens))
    terms = model.terms if terms is None else terms
    exact = lens.detach().to(torch.float64)
    parameters = cat([fit_one(model, exact[k], terms) for k in range(len(lens))])._tensors()
    fitted = model(**parameters | {name: getattr(exact, name) for name in exact.common})
    return Fit(fitted.to(lens.theta_max.dtype), largest_distance(fitted, exact).to(lens.theta_max))


class _Samples(NamedTuple):
    """Rays, θ (K,) and (cos φ, sin φ), (K, 2), with their pixels (K, 2) and weights (K,)."""

    theta: Tensor
    direction: Tensor
    pixels: Tensor
    weight: Tensor

    def rays(self, lens: Lens) -> tuple[Tensor, Tensor]:
        """θ (1, K), at most θ_max so that an outlier has a pixel, and directions (1, K, 2)."""
        return torch.minimum(self.theta, lens.theta_max)[None], self.direction[None]

    def distance(self, lens: Lens) -> Tensor:
        """(K,) px: from the pixels to those of the lens."""
        return (lens.pixels(*self.rays(lens))[0] - self.pixels).norm(dim=-1)

    def median(self, values: Tensor) -> Tensor:
        values, order = values.sort()
        sums = self.weight[order].cumsum(0)
        return values[torch.searchsorted(sums, sums[-1:] / 2)]

    def trust(self, distance: Tensor) -> Tensor:
        """(K,): the part of each weight that the Cauchy loss leaves, for distances (K,) px."""
        scale = SCALE * self.median(distance) + FINE * self.pixels.amax()
        return 1 / (1 + (distance / scale).square())

    def curve(self) -> KannalaBrandt:
        """A flexible lens near the rays: its numbers and its principal point are linear."""
        weight = self.weight
        for terms in (*[1] * WEIGHTINGS, *[2] * WEIGHTINGS, *[5] * WEIGHTINGS):
            powers = self.theta[:, None] ** (2 * torch.arange(terms) + 1)
            rows = powers[:, None] * self.direction[..., None]
            rows = torch.cat((rows, torch.eye(2).to(rows).expand(len(rows), 2, 2)), -1)
            both = weight.sqrt()[:, None, None] * torch.cat((rows, self.pixels[..., None]), -1)
            *left, right = both.flatten(0, 1).split((terms + 2, 1), 1)
            solution = torch.linalg.lstsq(*left, right).solution[:, 0]
            weight = self.weight * self.trust((rows @ solution - self.pixels).norm(dim=-1))
        if solution[0] > 0:
            lens = KannalaBrandt(solution[0], solution[1:-2] / solution[0], center=solution[-2:])
            if self.median(self.distance(lens)) < WILD * self.pixels.amax():
                return lens
        raise ValueError("no lens has these rays: x must be to the right, y down and z forward")


def _fit_field(
    model: type[Lens], field: Any, terms: int | None, weights: Any, size: tuple[int, int] | None
) -> Fit:
    """`fit` to a field of rays."""
    field = as_tensor(field)
    rays = field.detach().to("cpu", torch.float64)
    if rays.dim() != 3 or rays.shape[2] != 3:
        raise ValueError(f"a field of rays must be (h, w, 3), got {tuple(rays.shape)}")
    sides = tuple(rays.shape[:2])
    weight = torch.ones(sides) if weights is None else as_tensor(weights).detach()
    if tuple(weight.shape) != sides or not bool(((weight >= 0) & weight.isfinite()).all()):
        raise ValueError(f"weights must be 0 or more and {sides}, got {tuple(weight.shape)}")
    known = rays.isfinite().all(-1) & rays.any(-1) & (weight.to(rays) > 0)
    if (count := int(known.sum())) < FEWEST or min(sides) < 2:
        said = f"{count} known in {sides[0]} × {sides[1]} pixels"
        raise ValueError(f"a field must have {FEWEST} known rays, in rows and columns, got {said}")
    picture = rays.new_tensor(sides if size is None else _image_size(size))
    scale = picture / rays.new_tensor(sides)
    places = torch.nonzero(known).to(rays)  # (y, x)
    pixels = ((places + 0.5) * scale - 0.5).flip(1)
    across, ahead = rays[known].split((2, 1), 1)
    aside = length_of(across)
    theta, weight = torch.atan2(aside, ahead[:, 0]), weight.to(rays)[known]
    samples = _Samples(theta, across / aside[:, None], pixels, weight)
    some = _Samples(*(part[:: math.ceil(count / ENOUGH)] for part in samples))
    lens: Lens = some.curve()
    # The picture may show more than the lens: rays that are far off do not say where it ends.
    near = samples.pixels[samples.trust(samples.distance(lens)) > 0.1]
    theta = lens.unproject_pixels(near)[0].nan_to_num(lens.theta_max.item())
    theta_max = torch.minimum(theta.max(), lens.theta_max)
    lens = lens.with_theta_max(theta_max)
    if issubclass(model, Tabulated):
        lens = as_curves(lens)
    else:
        start = fit_one(model, lens, model.terms if terms is None else terms)._tensors()
        start["center"], start["theta_max"] = lens.center, theta_max
        # Alone, the rays would give OCamInverse a radius at θ = 0.
        for _ in range(0 if issubclass(model, OCamInverse) else WEIGHTINGS):
            lens = model._from_tensors(start)
            weight = some.weight * some.trust(some.distance(lens))
            goal = some.pixels[None], weight.sqrt()[None, :, None]
            del start["theta_max"]
            lens, _ = _least_squares(model, start, theta_max, *some.rays(lens), *goal, 3)
            start = lens._tensors()
        lens = model(**start | {"theta_max": None})
        lens = lens.with_theta_max(torch.minimum(theta_max, lens.theta_max))
    dtype = field.dtype if field.dtype == torch.float64 else torch.float32
    lens = lens.replace(image_size=picture[None])
    return Fit(lens.to(dtype), samples.median(samples.distance(lens)).to(dtype))


def largest_distance(lens: Lens, other: Lens) -> Tensor:
    """(N,) px: the largest distance between the pixels of a ray in two lenses with one center."""
    theta, direction = _rays(other, 1024, 72)
    pixels, others = (each.through_affine(each._flat(theta, direction)) for each in (lens, other))
    return (pixels - others).norm(dim=-1).flatten(1).amax(1)


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
    fits = (
        _least_squares(model, start, lens.theta_max, theta, direction, goal, 1.0, rounds)
        for start in _starts(model, lens, terms, aside)
    )
    best, cost = min(fits, key=lambda pair: pair[1])
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
    # Twice backward. Forward, a product with a constant takes torch 40 times as long, because it
    # asks Python for the shape of the constant's derivative, which is 0.
    with torch.enable_grad():
        vectors = vector.repeat(len(vector), 1).requires_grad_()
        values = function(vectors)
        weights = torch.zeros_like(values, requires_grad=True)
        (back,) = torch.autograd.grad(values, vectors, weights, create_graph=True)
        (slopes,) = torch.autograd.grad(back, weights, torch.eye(len(vector)).to(vector))
    return slopes.movedim(0, -1)


def _least_squares(
    model: type[Lens],
    start: dict[str, Tensor],
    theta_max: Tensor,
    theta: Tensor,
    direction: Tensor,
    goal: Tensor,
    weight: Tensor | float,
    rounds: int,
) -> tuple[Lens, float]:
    """The closest lens within bounds by the Levenberg–Marquardt method, and its mean squared
    distance, times `weight`, which is infinite if no lens was found."""
    packing = Packing(model, start)
    low, high = packing.low, packing.high

    def lenses_of(vectors: Tensor) -> Lens:
        limits = {"theta_max": theta_max.expand(len(vectors))}
        return model._from_tensors(packing.tensors(vectors) | limits)

    def points(vectors: Tensor) -> Tensor:
        # A lens without a principal point has it at (0, 0), the middle of one pixel.
        return weight * lenses_of(vectors).pixels(theta, direction, (1, 1))

    goal, line = weight * goal, theta_max[:, None] * torch.linspace(0, 1, RINGS + 1).to(theta)
    held = [1] if issubclass(model, OCam) else []  # a kink at the centre

    def cost_of(vector: Tensor) -> float:
        rises = bool((lenses_of(vector[None]).project(line).flatten().diff() > 0).all())
        value = (points(vector[None]) - goal).square().mean().item()
        return value if rises and value >= 0 else math.inf

    vector = packing.vector(start).clamp(low, high)
    cost, damping = cost_of(vector), 1e-3
    if not math.isfinite(cost):
        return lenses_of(vector[None]), math.inf
    axes = torch.eye(len(vector), dtype=vector.dtype)
    for _ in range(rounds):
        error = (points(vector[None]) - goal).flatten()
        slopes = slopes_of(points, vector).flatten(0, -2)
        slopes[:, held] = 0
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
