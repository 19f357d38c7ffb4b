"""Calibration: a lens, and how sure it is, from the corners of boards in pictures."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from darswin.calibrate import radial
from darswin.calibrate.refine import (
    RAYLEIGH,
    Free,
    Refined,
    Views,
    equations,
    refine,
    weights_of,
)
from darswin.lens import MODELS, Lens, OCam, Tabulated, to_dict
from darswin.lens.base import unknown_model
from darswin.lens.fitting import fit_one
from darswin.lens.ideal import FocalLens
from darswin.utils.parameters import check, naming

CANDIDATES = ("Perspective", "Equidistant", "FieldOfView", "EnhancedUnified", "DoubleSphere",
              "KannalaBrandt", "OCam", "BrownConrady", "Mei", "Fisheye624")  # fmt: skip
LEAST_CORNERS, LEAST_PICTURES = 8, 3
OFF = 6.0  # standard deviations: a corner this far off does not fit
SHARPEST = 0.05  # px: no detector finds corners better than this
UNSURE, UNKNOWN = 0.01, 0.2  # of the radius: its standard deviation
FEW, BLURRED, PARALLEL = 8, 1.0, 12.0  # pictures; px; degrees
ONE_DISTANCE = 1.05  # the farthest board's distance, by the nearest's
COVERED = 0.8  # of the widest angle on the sensor
TABLE = 12  # the steps of a table


class CalibrationError(ValueError):
    """Corners from which no lens can be found; the message is one sentence for the user."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A lens found from P pictures of a board with K corners, and how sure it is.

    Attributes:
        lens: the lens, a batch of one in float64. Its theta_max is the largest angle that lands on
            the sensor and up to which r rises.
        rotations, translations: (P, 3, 3) and (P, 3): a point (x, y) of the board is at
            rotation @ (x, y, 0) + translation in the camera's frame, in the board's unit.
        residuals: (P, K, 2) px: the lens's pixels minus the corners; NaN where none was seen.
        weights: (P, K) in [0, 1]: how much each corner counts.
        theta: (P, K) rad: the angle of each corner; NaN where none was seen.
        sigma: px: the standard deviation of a corner along one axis, by the median.
        used: (P,) bool: the pictures that count.
        names: of the pictures.
        parameters: the names of the lens's n free numbers.
        covariance: (n, n), theirs.
        supported: rad: the largest angle with corners around it.
        left_out: px: the root mean square distance of corners from a calibration without their
            picture, to first order; NaN for fewer than 4 pictures.
        models: for "auto": (model, left_out, root mean square distance, "") of each model, or
            (model, NaN, NaN, the reason why it was not found); the best is first.
        doubts: sentences on what looks wrong.
    """

    lens: Lens
    rotations: Tensor
    translations: Tensor
    residuals: Tensor
    weights: Tensor
    theta: Tensor
    sigma: float
    used: Tensor
    names: list[str]
    parameters: list[str]
    covariance: Tensor
    supported: float
    left_out: float
    models: list[tuple[str, float, float, str]] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    _free: Free = field(repr=False, default=None)  # type: ignore[assignment]
    _vector: Tensor = field(repr=False, default=None)  # type: ignore[assignment]
    _joint: Tensor = field(repr=False, default=None)  # type: ignore[assignment]

    @property
    def error(self) -> float:
        """px: the root mean square distance of the corners of the used pictures, by weight."""
        squared = self.residuals.nan_to_num().square().sum(-1)
        return math.sqrt((self.weights * squared).sum().item() / self.weights.sum().item())

    def uncertainty(self, pixels: Tensor | Sequence[Any]) -> Tensor:
        """(...,) px: the standard deviation of the pixel of a far point, along its worst direction.

        Pixels are (..., 2). The point is fixed with respect to the boards, as mrcal defines it: its
        ray moves with the mean rotation of the poses. NaN where no ray lands.
        """
        pixels = torch.as_tensor(pixels, dtype=torch.float64)
        whole = self.lens.with_theta_max(None)
        rays = whole.unproject_points(pixels.reshape(-1, 2))
        count = len(self._vector)

        def place(vector: Tensor, turn: Tensor) -> Tensor:
            moved = rays + torch.linalg.cross(turn.expand_as(rays), rays)
            return self._free.pixels(vector, moved, whole.theta_max)

        slopes = torch.func.jacfwd(lambda both: place(both[:count], both[count:]))(
            torch.cat((self._vector, torch.zeros(3).to(rays)))
        )
        variance = slopes @ self._joint @ slopes.mT  # (M, 2, 2)
        half = variance.diagonal(dim1=1, dim2=2).sum(-1) / 2
        apart = torch.hypot(variance[:, 0, 1], (variance[:, 0, 0] - variance[:, 1, 1]) / 2)
        return (half + apart).sqrt().reshape(pixels.shape[:-1])

    def uncertainty_of_theta(self, theta: Tensor | Sequence[float] | float) -> Tensor:
        """(...,) px: the standard deviation of the radius r(θ), for θ (...,) rad."""
        theta = torch.as_tensor(theta, dtype=torch.float64)
        return _radius_spread(self._free, self._vector, self.covariance, theta)

    def to_dict(self) -> dict[str, Any]:
        """All of it as a JSON object, with None in place of NaN."""
        pictures = [
            {
                "name": name, "used": bool(used), "rotation": _plain(rotation),
                "translation": _plain(translation), "residuals": _plain(residuals),
                "weights": _plain(weights), "theta": _plain(theta),
            }
            for name, used, rotation, translation, residuals, weights, theta in zip(
                self.names, self.used, self.rotations, self.translations, self.residuals,
                self.weights, self.theta, strict=True,
            )
        ]  # fmt: skip
        models = [
            {"model": model, "left_out": _plain(left_out), "error": _plain(error), "reason": reason}
            for model, left_out, error, reason in self.models
        ]
        return {
            "lens": to_dict(self.lens), "error": self.error, "left_out": _plain(self.left_out),
            "sigma": self.sigma, "supported": self.supported, "parameters": self.parameters,
            "covariance": _plain(self.covariance), "models": models, "doubts": self.doubts,
            "pictures": pictures,
        }  # fmt: skip


def _plain(value: Any) -> Any:
    """Numbers as JSON knows them."""
    if isinstance(value, Tensor):
        value = value.tolist()
    if isinstance(value, list):
        return [_plain(x) for x in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def calibrate(
    corners: Any,
    board: Any,
    size: tuple[int, int],
    model: str | type[Lens] = "KannalaBrandt",
    *,
    terms: int | None = None,
    names: Sequence[str] | None = None,
    square_pixels: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Calibration:
    """Finds the lens of a camera from the corners of a board in its pictures.

    It needs no guess, for fields of view up to 250°. Corners and pictures that do not fit the
    others count little, and `doubts` names them.

    Args:
        corners: (P, K, 2) px, NaN where a corner was not seen; pixel centres are integers.
        board: a `Board`, or its points (K, 2), in any unit of length.
        size: (H, W) of the pictures.
        model: a lens class, its name in `darswin.lens.MODELS`, or "auto": the model that predicts
            left-out pictures best.
        terms: the number of polynomial terms, or of a table's steps. None means the model's
            default.
        names: of the pictures, for messages. None means "picture 1", ….
        square_pixels: False also finds the ratio of a pixel's sides.
        progress: a function that is called with lines of text.

    Raises:
        CalibrationError: no lens can be found from these corners. ValueError: wrong shapes or an
            unknown model. TypeError: an argument is of another kind.
    """
    say = progress or (lambda _: None)
    views, points = _checked(corners, board, size)
    count = len(views.seen)
    names = [f"picture {k + 1}" for k in range(count)] if names is None else [*names]
    check("names", names, len(names) == count, f"{count} names, one for each picture")
    if isinstance(model, str) and model != "auto" and model not in MODELS:
        raise naming(ValueError(f"`model`: {unknown_model(model)}"), "model")
    if not isinstance(model, str) and not (isinstance(model, type) and issubclass(model, Lens)):
        raise TypeError(f"model must be a lens class or its name, got {model!r}")
    if terms is not None:
        check("terms", terms, isinstance(terms, int) and 1 <= terms <= 64, "1 to 64, or None")
    usable = _usable(views, size, names)
    say(f"Finding a start from {int(usable.sum())} pictures")
    start = radial.start(views.corners, views.seen & usable[:, None], views.board[:, :2], size)
    wanted = CANDIDATES if model == "auto" else (model,)
    found: list[_Found] = []
    failed: list[tuple[str, float, float, str]] = []
    for one in wanted:
        kind = MODELS[one] if isinstance(one, str) else one
        say(f"Refining a {kind.__name__} lens")
        try:
            found.append(_find(kind, terms, views, usable, start, size, square_pixels))
        except CalibrationError as error:
            if model != "auto":
                raise
            failed.append((kind.__name__, math.nan, math.nan, str(error)))
    if not found:
        raise CalibrationError(failed[0][3])
    # A corner that fits any model counts for all: a poor model must not leave out the rim.
    counts = torch.stack([one.fits for one in found]).any(0)
    for one in found:
        one.judge(views, counts)
    found.sort(key=lambda one: one.left_out)
    table = [(type(x.lens).__name__, x.left_out, x.error, "") for x in found] + failed
    return _described(
        found[0], views, usable, names, points, size, table if model == "auto" else []
    )


class _Found:
    """A lens of one model with the poses, and what is known of them."""

    left_out = error = math.nan

    def __init__(self, free: Free, refined: Refined, views: Views, used: Tensor):
        self.free, self.refined, self.used = free, refined, used
        self.lens = refined.lens
        self.miss = views.miss(self.lens, refined.rotations, refined.translations)
        distance = self.miss.norm(dim=-1)
        counts = views.seen & used[:, None]
        self.sigma = _sigma(distance[counts], len(refined.vector) + 6 * int(used.sum()))
        self.fits = counts & (distance <= OFF * max(self.sigma, SHARPEST))

    def judge(self, views: Views, counts: Tensor) -> None:
        """Computes the errors over the corners that count, (P, K), and the covariance."""
        vector, poses = self.refined.vector, self.refined[2:4]
        normal = equations(views, self.free, vector, self.lens, *poses, counts.to(vector))
        held = self.free.held(vector, normal.lens_side.sum(0))
        reduced = normal.reduced(0.0, held)
        self.joint = self.sigma**2 * reduced.covariance(self.used)
        moved = torch.cat(reduced.without(), 1)[:, None, None]
        off = self.miss + (normal.slopes * moved).sum(-1)
        self.error = self.miss[counts].square().sum(-1).mean().sqrt().item()
        if self.used.sum() > LEAST_PICTURES:
            self.left_out = off[counts].square().sum(-1).mean().sqrt().item()


def _sigma(distances: Tensor, unknowns: int) -> float:
    """px: the standard deviation of corners along one axis, from the median of their distances."""
    numbers = 2 * len(distances)
    return distances.median().item() / RAYLEIGH * math.sqrt(numbers / max(numbers - unknowns, 1))


def _find(
    model: type[Lens], terms: int | None, views: Views, usable: Tensor, start: radial.Start,
    size: tuple[int, int], square_pixels: bool,
) -> _Found:  # fmt: skip
    rays, board = start.rays(views.corners), views.board[:, :2]
    used = usable & start.fits
    theta = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])
    top = theta[views.seen & used[:, None]].max().item()
    lens = _start_lens(model, terms, start, top, size)
    free = Free(lens, square_pixels)
    vector = free.start
    rotations, translations = radial.poses(rays, views.seen.to(rays), board)
    for _ in range(4):
        part = Views(views.corners, views.seen & used[:, None], views.board)
        refined = refine(part, free, vector, rotations, translations)
        if refined is None:
            raise CalibrationError(f"No {model.__name__} lens fits the start: try another model.")
        # Each pose anew from its rays: some may be mirrored, some pictures may fit after all.
        rays = refined.lens.unproject_points(views.corners)
        there = views.seen & ~rays.isnan().any(-1)
        again = radial.poses(rays.nan_to_num(), there.to(rays), board)
        again = refine(views, free, refined.vector, *again, lens_moves=False)
        loss, other = (
            views.miss(refined.lens, *x).square().sum(-1).div(refined.scale**2).log1p().sum(1)
            for x in (refined[2:4], again[2:4])
        )
        better = other < loss - 0.1
        rotations = torch.where(better[:, None, None], again.rotations, refined.rotations)
        translations = torch.where(better[:, None], again.translations, refined.translations)
        distance = views.miss(refined.lens, rotations, translations).norm(dim=-1)
        sigma = _sigma(distance[views.seen & used[:, None]], 0)
        typical = torch.where(views.seen, distance, torch.nan).nanmedian(1).values
        fit_now = usable & (typical <= OFF * max(sigma, SHARPEST))
        vector, done = refined.vector, torch.equal(fit_now, used) and not better[used].any()
        refined = refined._replace(rotations=rotations, translations=translations)
        if done:
            break
        used = fit_now
        if used.sum() < LEAST_PICTURES:
            raise CalibrationError(
                f"Only {int(used.sum())} pictures agree on a {model.__name__} lens: are the board "
                "and the order of its corners right?"
            )
    return _Found(free, refined, views, used)


def _start_lens(
    model: type[Lens], terms: int | None, start: radial.Start, top: float, size: tuple[int, int]
) -> Lens:
    """The lens of a model that is close to the start up to the angle `top`, rad."""
    end = model._end if issubclass(model, FocalLens) else math.pi
    if top > end + 0.1:
        raise CalibrationError(
            f"The corners reach {math.degrees(top):.0f}° from the axis, but a {model.__name__} "
            f"lens ends at {math.degrees(end):.0f}°: choose another model."
        )
    image = {"center": start.center[None], "image_size": start.center.new_tensor([size])}
    curve = OCam(-start.depth[None], **image)
    limit = curve.theta_limit.item()
    if issubclass(model, Tabulated):
        steps = terms or TABLE
        angles = torch.linspace(0, min(1.03 * top + 0.02, limit, math.pi), steps + 1)
        return Tabulated(angles.to(start.center), curve.project(angles.to(start.center)), **image)
    terms = model.terms if terms is None else terms
    reaches = min(top, limit, 0.97 * end)
    for share in (1.0, 0.9, 0.8, 0.6, 0.4):
        try:
            found = fit_one(model, curve.with_theta_max(share * reaches), terms, rounds=20)
        except ValueError:
            continue
        tensors = {name: value for name, value in found._tensors().items() if name != "theta_max"}
        return model(**tensors, **image)
    raise CalibrationError(f"No {model.__name__} lens is close to the start: try another model.")


def _described(
    found: _Found, views: Views, usable: Tensor, names: list[str], points: Tensor,
    size: tuple[int, int], table: list[tuple[str, float, float, str]],
) -> Calibration:  # fmt: skip
    """The calibration in the units of the user, with doubts."""
    lens, refined, seen = found.lens, found.refined, views.seen
    places = views.board @ refined.rotations.mT + refined.translations[:, None]
    theta = torch.atan2(places[..., :2].norm(dim=-1), places[..., 2])
    supported = theta[found.fits].quantile(0.99).item()
    middle = torch.cat((points.mean(0), points.new_zeros(1)))
    unit = (points - points.mean(0)).norm(dim=1).max()
    return Calibration(
        lens=lens.with_theta_max(_widest(lens, size)),
        rotations=refined.rotations,
        translations=unit * refined.translations - refined.rotations @ middle,
        residuals=torch.where(seen[..., None], found.miss, torch.nan),
        weights=weights_of(found.miss, seen & found.used[:, None], refined.scale),
        theta=torch.where(seen, theta, torch.nan),
        sigma=found.sigma,
        used=found.used,
        names=names,
        parameters=found.free.names,
        covariance=found.joint[:-3, :-3],
        supported=supported,
        left_out=found.left_out,
        models=table,
        doubts=_doubts(found, views, usable, names, places, supported),
        _free=found.free,
        _vector=refined.vector,
        _joint=found.joint,
    )


def _widest(lens: Lens, size: tuple[int, int]) -> float | None:
    """rad: the largest angle on the sensor; None if the lens ends within it."""
    height, width = size
    ends = torch.tensor([[x, y] for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    theta, _ = lens.with_theta_max(None).unproject_pixels(ends.to(lens.theta_max))
    return None if theta.isnan().any() else theta.max().item()


def _doubts(
    found: _Found, views: Views, usable: Tensor, names: list[str], places: Tensor, supported: float
) -> list[str]:
    said = []
    distance, seen = found.miss.norm(dim=-1), views.seen
    for k, name in enumerate(names):
        if not usable[k]:
            count = int(seen[k].sum())
            said.append(
                f"{name} shows {count} corners that can be used, {LEAST_CORNERS} are needed"
            )
        elif not found.used[k]:
            typical = distance[k][seen[k]].median().item()
            said.append(
                f"{name} does not fit: half of its corners are {typical:.3g} px off or more"
            )
        else:
            off = (seen[k] & ~found.fits[k]).nonzero()[:, 0].tolist()
            off.sort(key=lambda i: -distance[k, i].item())
            said += [f"corner {i + 1} of {name} is {distance[k, i]:.3g} px off" for i in off[:5]]
            if len(off) > 5:
                said.append(f"{len(off) - 5} more corners of {name} are off")
    used = found.used
    if used.sum() < FEW:
        said.append(f"{int(used.sum())} pictures are few: {FEW} or more make a sure calibration")
    if found.sigma > BLURRED:
        said.append(
            f"corners are {found.sigma:.2g} px off: the pictures are blurred, the board is bent, "
            "or another model fits better"
        )
    rotations = found.refined.rotations[used]
    spread = _relative_spread(found, supported)
    if spread > UNSURE:
        tilts = torch.rad2deg(torch.acos(rotations[:, 2, 2].abs().clamp(max=1)))
        why = (
            f"all boards are nearly parallel to the sensor (at most {tilts.max():.0f}° tilted): "
            "tilt the board by 20 to 45° in several pictures"
            if tilts.max() < PARALLEL
            else "take more pictures, with tilted boards that fill more of the picture"
        )
        if spread > UNKNOWN:
            raise CalibrationError(f"The pictures do not determine the lens: {why}.")
        said.append(f"the focal length is unsure by {100 * spread:.2g} %: {why}")
    middles = found.refined.translations[used].norm(dim=1)
    if (middles.max() / middles.min()) < ONE_DISTANCE:
        said.append("all boards are at nearly one distance: take some nearer and some farther")
    facing = (rotations[:, :, 2] * places[used].mean(1)).sum(-1)
    back = (facing < 0).nonzero()[:, 0].tolist()
    if back:
        which = [names[k] for k in used.nonzero()[:, 0][back].tolist()]
        said.append(f"{', '.join(which[:5])}: the board is seen mirrored, as if from behind")
    reach = found.lens.side_angles().max().item()
    if supported < COVERED * reach:
        said.append(
            f"corners reach {math.degrees(supported):.0f}° from the axis, the sensor "
            f"{math.degrees(reach):.0f}°: in between, the lens is a guess"
        )
    return said


def _relative_spread(found: _Found, supported: float) -> float:
    """The largest standard deviation of the radius, as a part of it, for corners that are at best
    `SHARPEST`."""
    theta = torch.linspace(0.3, 1, 8, dtype=torch.float64) * supported
    spread = _radius_spread(found.free, found.refined.vector, found.joint[:-3, :-3], theta)
    spread = spread * max(1.0, SHARPEST / max(found.sigma, 1e-12))
    return (spread / found.lens.project(theta)).max().item()


def _radius_spread(free: Free, vector: Tensor, covariance: Tensor, theta: Tensor) -> Tensor:
    def radius(numbers: Tensor) -> Tensor:
        return free.model._from_tensors(free.tensors(numbers) | {"theta_max": end}).project(flat)

    lens, flat = free.lens(vector), theta.reshape(1, -1)
    assert lens is not None
    end = lens.theta_limit
    slopes = torch.func.jacfwd(radius)(vector)[0]  # (M, n)
    return ((slopes @ covariance) * slopes).sum(-1).clamp(min=0).sqrt().reshape(theta.shape)


def _checked(corners: Any, board: Any, size: tuple[int, int]) -> tuple[Views, Tensor]:
    points = _numbers("board", board.points if hasattr(board, "points") else board)
    check("board", tuple(points.shape), points.dim() == 2 and points.shape[1] == 2,
          "a Board, or its points of shape (K, 2)")  # fmt: skip
    check("board", "others", bool(points.isfinite().all()), "finite points")
    count, found = len(points), _numbers("corners", corners)
    check("corners", tuple(found.shape), found.dim() == 3 and found.shape[1:] == (count, 2),
          f"of shape (P, {count}, 2), for a board of {count} points")  # fmt: skip
    check("corners", "infinity", not bool(found.isinf().any()), "finite, or NaN where not seen")
    check("size", size, isinstance(size, Sequence) and len(size) == 2
          and all(isinstance(side, int) and side > 0 for side in size), "(H, W), px")  # fmt: skip
    seen = ~found.isnan().any(-1)
    radius = (points - points.mean(0)).norm(dim=1).max().item() if count else 0.0
    flat = (points - points.mean(0)) / (radius or 1.0)
    if count < LEAST_CORNERS or torch.linalg.svdvals(flat)[-1] < 1e-3:
        raise CalibrationError(
            f"A board needs {LEAST_CORNERS} points or more that are not on one line, got {count}."
        )
    board = torch.nn.functional.pad(flat, (0, 1))
    return Views(torch.where(seen[..., None], found, 0.0), seen, board), points


def _numbers(name: str, value: Any) -> Tensor:
    try:
        return torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise naming(TypeError(f"`{name}` must be numbers, got {value!r:.200}"), name) from error


def _usable(views: Views, size: tuple[int, int], names: list[str]) -> Tensor:
    """(P,) bool: the pictures with enough corners, not all on one line."""
    height, width = size
    sides = views.corners.new_tensor([width, height])
    outside = ((views.corners < -1) | (views.corners > sides)).any(-1) & views.seen
    for k in outside.any(1).nonzero()[:1, 0].tolist():
        x, y = views.corners[k][outside[k]][0].tolist()
        raise CalibrationError(
            f"{names[k]} has a corner at ({x:.4g}, {y:.4g}), outside of {width}×{height} (W×H) "
            "px: pictures of several sizes cannot be mixed."
        )
    flat = torch.where(views.seen[..., None], views.board[:, :2], 0)
    middle = flat.sum(1) / views.seen.sum(1, keepdim=True).clamp(min=1)
    flat = torch.where(views.seen[..., None], flat - middle[:, None], 0)
    usable = (views.seen.sum(1) >= LEAST_CORNERS) & (torch.linalg.svdvals(flat)[:, -1] > 0.1)
    if usable.sum() < LEAST_PICTURES:
        raise CalibrationError(
            f"At least {LEAST_PICTURES} pictures with {LEAST_CORNERS} corners each are needed, "
            f"got {int(usable.sum())}: take 10 to 20 pictures of the board."
        )
    return usable
