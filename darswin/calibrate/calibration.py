"""Calibration: a lens, and how sure it is, from the corners of boards in pictures."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from darswin.calibrate import radial
from darswin.calibrate.inputs import (
    LEAST_CORNERS,
    LEAST_PICTURES,
    CalibrationError,
    checked,
    usable_pictures,
)
from darswin.calibrate.refine import (
    MEDIAN,
    Free,
    Normal,
    State,
    Views,
    losses,
    refine,
    weights_of,
)
from darswin.lens import MODELS, Lens, to_dict
from darswin.lens.base import unknown_model
from darswin.lens.files.load import reach
from darswin.lens.fitting import slopes_of
from darswin.utils.parameters import check, naming

# What "auto" tries.
CANDIDATES = (
    "KannalaBrandt", "Perspective", "Equidistant", "Equisolid", "Stereographic", "FieldOfView",
    "EnhancedUnified", "OCam", "BrownConrady", "Mei", "Fisheye624",
)  # fmt: skip
# The terms off the curve that are found for a model.
ASIDE = {"BrownConrady": {"tangential": 2}, "Mei": {"tangential": 2},
         "Fisheye624": {"tangential": 2, "prism": 4}}  # fmt: skip
HOPELESS = 4.0  # times the standard deviation of a corner from another model
OFF = 6.0  # standard deviations: a corner this far off does not fit
SHARPEST = 0.05  # px: no detector finds corners better than this
# For doubts.
UNSURE, UNKNOWN = 0.01, 0.2  # the radius's standard deviation, as a part of it
FEW, BLURRED, PARALLEL = 8, 1.0, 12.0  # pictures; px; degrees
WRONG = 0.02  # of the picture's side: a corner's standard deviation
ONE_DISTANCE = 1.05  # the distance of the farthest board, by that of the nearest
COVERED = 0.8  # of theta_max
SHOWN = 10  # corners


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration:
    """A lens found from P pictures of a board with K corners, and how sure it is.

    Attributes:
        lens: the lens, a batch of one in float64. Its theta_max is the largest of its
            `side_angles`, at most the angle up to which r rises.
        rotations, translations: (P, 3, 3) and (P, 3): a point (x, y) of the board is at
            rotation @ (x, y, 0) + translation in the camera's frame, in the board's unit. NaN for
            pictures that show too few corners.
        residuals: (P, K, 2) px: the pixels of the lens minus the corners; NaN where not seen.
        weights: (P, K) in [0, 1]: how much each corner counts.
        theta: (P, K) rad: the angle of each corner; NaN where not seen.
        used: (P,) bool: the pictures that count.
        names: those of the pictures.
        sigma: px: the standard deviation of a corner along one axis, from the median.
        error: px: the root mean square distance of corners from the lens, without those off it.
        left_out: px: the same from a lens that is found without their picture, to first order; NaN
            for fewer than 4 pictures.
        supported: rad: the largest angle with corners around it.
        parameters: the names of the n numbers that were found for the lens.
        covariance: (n, n), theirs.
        models: for "auto", the best first: (model, left_out, error, ""), or (model, NaN, NaN, the
            reason why there is none).
        doubts: what looks wrong, in sentences. Corners are counted from 1.
    """

    lens: Lens
    rotations: Tensor
    translations: Tensor
    residuals: Tensor
    weights: Tensor
    theta: Tensor
    used: Tensor
    names: list[str]
    sigma: float
    error: float
    left_out: float
    supported: float
    parameters: list[str]
    covariance: Tensor
    models: list[tuple[str, float, float, str]]
    doubts: list[str]
    _free: Free = field(repr=False)
    _vector: Tensor = field(repr=False)
    _joint: Tensor = field(repr=False)

    def uncertainty(self, pixels: Any) -> Tensor:
        """(...,) px: the standard deviation of the pixel of a far point, along its worst direction.

        Pixels are (..., 2). As mrcal defines it, the point stays fixed with respect to the boards:
        its ray moves with the mean rotation of the poses. NaN where no ray lands.
        """
        pixels = torch.as_tensor(pixels, dtype=torch.float64)
        lens = self.lens.with_theta_max(None)
        rays, count = lens.unproject_points(pixels.reshape(-1, 2)), len(self._vector)

        def places(numbers: Tensor) -> Tensor:
            turned = torch.linalg.cross(*torch.broadcast_tensors(numbers[:, None, count:], rays))
            return self._free.at(numbers[:, :count], lens.theta_max).project_points(rays + turned)

        slopes = slopes_of(places, torch.cat((self._vector, torch.zeros(3).to(rays))))
        (a, b), (_, d) = ((slopes @ self._joint @ slopes.mT)[:, k].unbind(1) for k in (0, 1))
        spread = (a + d) / 2 + torch.hypot(b, (a - d) / 2)
        return spread.sqrt().reshape(pixels.shape[:-1])

    def uncertainty_of_theta(self, theta: Any) -> Tensor:
        """(...,) px: the standard deviation of the radius r(θ), for θ (...,) rad."""
        theta = torch.as_tensor(theta, dtype=torch.float64)
        slopes = slopes_of(
            lambda vectors: self._free.at(vectors, self.lens.theta_limit).project(
                theta.view(1, -1)
            ),
            self._vector,
        )
        return ((slopes @ self.covariance) * slopes).sum(-1).sqrt().reshape(theta.shape)

    def to_dict(self) -> dict[str, Any]:
        """All of it as a JSON object; NaN becomes None."""
        named = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        public = {name: _plain(value) for name, value in named.items() if name[0] != "_"}
        return public | {"lens": to_dict(self.lens)}


def _plain(value: Any) -> Any:
    value = value.tolist() if isinstance(value, Tensor) else value
    if isinstance(value, list | tuple):
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
        terms: the number of polynomial terms, or of the steps of a table. None means the model's
            default.
        names: those of the pictures, for messages. None means "picture 1", ….
        square_pixels: False also finds the ratio of a pixel's sides.
        progress: a function that is called with lines of text.

    Raises:
        CalibrationError: no lens can be found from these corners. ValueError: a wrong shape or an
            unknown model. TypeError: an argument of another kind.
    """
    say = progress or (lambda line: None)
    whole, points = checked(corners, board, size)
    count = len(whole.seen)
    names = [f"picture {k + 1}" for k in range(count)] if names is None else [*names]
    check("names", names, len(names) == count, f"{count} names, one for each picture")
    kinds = [_kind(name) for name in (CANDIDATES if model == "auto" else [model])]
    if terms is not None:
        check("terms", terms, isinstance(terms, int) and 1 <= terms <= 64, "1 to 64, or None")
    usable = usable_pictures(whole, size, names)
    views = whole._replace(corners=whole.corners[usable], seen=whole.seen[usable])
    say(f"Finding a start from {len(views.seen)} pictures")
    start = radial.start(views.corners, views.seen, views.board[:, :2], size)
    found: list[_Found] = []
    failed: list[tuple[str, float, float, str]] = []
    for kind in kinds:
        say(f"Refining the lens: {kind.__name__}")
        try:
            least = min((one.sigma for one in found), default=math.inf)
            found.append(_find(kind, terms, views, start, size, square_pixels, least))
        except (CalibrationError, torch.linalg.LinAlgError) as error:
            reason = (
                error if isinstance(error, CalibrationError) else "Its equations have no solution."
            )
            failed.append((kind.__name__, math.nan, math.nan, str(reason)))
    if not found:
        raise CalibrationError(failed[0][3])
    # A corner that fits any model counts for all: no model may leave out the rim.
    counts = torch.stack([one.fits for one in found]).any(0)
    for one in found:
        one.judge(views, counts)
    found.sort(key=lambda one: one.left_out)
    table = [(one.free.model.__name__, one.left_out, one.error, "") for one in found] + failed
    best, miss = found[0], found[0].miss
    middle, unit = points.mean(0), (points - points.mean(0)).norm(dim=1).max()
    spot = torch.cat((middle, middle.new_zeros(1)))
    place = views.points(best.state)
    theta = torch.atan2(place[..., :2].norm(dim=-1), place[..., 2])

    def all_pictures(value: Tensor, rest: float = math.nan) -> Tensor:
        return value.new_full((count, *value.shape[1:]), rest).index_put((usable,), value)

    lens, seen = best.state.lens, views.seen
    supported = theta[best.fits].quantile(0.99).item()
    lens = lens.with_theta_max(reach(lens))
    calibration = Calibration(
        lens=lens,
        rotations=all_pictures(best.state.rotations),
        translations=all_pictures(unit * best.state.translations - best.state.rotations @ spot),
        residuals=all_pictures(torch.where(seen[..., None], miss, torch.nan)),
        weights=all_pictures(weights_of(miss, best.scale) * (seen & best.used[:, None]), 0.0),
        theta=all_pictures(torch.where(seen, theta, torch.nan)),
        used=all_pictures(best.used, False),
        names=names,
        sigma=best.sigma,
        error=best.error,
        left_out=best.left_out,
        supported=supported,
        parameters=best.free.names,
        covariance=best.joint[:-3, :-3],
        models=table if model == "auto" else [],
        doubts=[],
        _free=best.free,
        _vector=best.state.vector,
        _joint=best.joint,
    )
    calibration.doubts.extend(_doubts(calibration, whole, best, place))
    return calibration


def _kind(model: Any) -> type[Lens]:
    if isinstance(model, str):
        if model not in MODELS:
            raise naming(ValueError(f"`model`: {unknown_model(model)}"), "model")
        return MODELS[model]
    if not (isinstance(model, type) and issubclass(model, Lens)):
        raise TypeError(f"model must be a lens class or its name, got {model!r}")
    return model


class _Found:
    """A lens of one model with the poses, and what is known of them."""

    error = left_out = math.nan
    joint: Tensor

    def __init__(self, free: Free, state: State, scale: float, views: Views, used: Tensor):
        self.free, self.state, self.scale, self.used = free, state, scale, used
        self.miss = views.miss(state)
        counts = views.seen & used[:, None]
        distance = self.miss.norm(dim=-1)
        numbers = 2 * int(counts.sum())
        spare = max(numbers - len(state.vector) - 6 * int(used.sum()), 1)
        self.sigma = distance[counts].median().item() / MEDIAN * math.sqrt(numbers / spare)
        self.fits = counts & (distance <= OFF * max(self.sigma, SHARPEST))

    def judge(self, views: Views, counts: Tensor) -> None:
        """Computes the covariance and the errors, over the corners that count, (P, K)."""
        used, (vector, lens, rotations, translations) = counts.any(1), self.state
        views = Views(views.corners[used], views.seen[used], views.board)
        state = State(vector, lens, rotations[used], translations[used])
        miss, counts = self.miss[used], counts[used]
        slopes = views.slopes(self.free, state)
        normal = Normal(slopes, miss, counts.to(miss), self.free, vector).damped(0.0)
        self.joint = self.sigma**2 * normal.covariance()
        self.error = miss[counts].square().sum(-1).mean().sqrt().item()
        if len(miss) > LEAST_PICTURES:
            moved = miss + (slopes @ normal.steps(left_out=True)[:, None, :, None])[..., 0]
            self.left_out = moved[counts].square().sum(-1).mean().sqrt().item()


def _state(lens: Lens, square_pixels: bool, poses: tuple[Tensor, Tensor]) -> tuple[Free, State]:
    """The free numbers of a lens, and the state with these poses."""
    free = Free(lens, square_pixels)
    whole = free.lens(free.start)
    if whole is None:
        raise CalibrationError(f"No {free.model.__name__} lens is close to the start.")
    return free, State(free.start, whole, *poses)


def _find(
    model: type[Lens], terms: int | None, views: Views, start: radial.Start,
    size: tuple[int, int], square_pixels: bool, least: float,
) -> _Found:  # fmt: skip
    """The lens of a model and the poses, from all pictures that agree; or a rough answer, if it is
    much worse than the `least` standard deviation of a corner so far."""
    rays, used, board = start.rays(views.corners), start.fits, views.board[:, :2]
    theta = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])
    top = theta[views.seen & used[:, None]].max().item()
    poses = radial.poses(rays, views.seen.to(rays), board)
    free, state = _state(start.lens(model, terms, top, size), square_pixels, poses)
    agreeing = views._replace(seen=views.seen & used[:, None])
    state, scale = refine(agreeing, free, state, rough=True)
    if model.__name__ in ASIDE:  # far from the best lens, these terms could cut off the rim
        zeros = {name: rays.new_zeros(1, n) for name, n in ASIDE[model.__name__].items()}
        free, state = _state(state.lens.replace(**zeros), square_pixels, state[2:])
        state, scale = refine(agreeing, free, state, rough=True)
    found = _Found(free, state, scale, views, used)
    if found.sigma > HOPELESS * max(least, SHARPEST):
        return found
    for _ in range(4):
        counts = views.seen & used[:, None]
        state, scale = refine(views._replace(seen=counts), free, state)
        # Each pose anew from its rays: some may be mirrored, some pictures may fit after all.
        rays = state.lens.unproject_points(views.corners)
        there = (views.seen & ~rays.isnan().any(-1)).to(rays)
        again = State(*state[:2], *radial.poses(rays.nan_to_num(), there, board))
        again, _ = refine(views, free, again, lens_moves=False)
        loss, other = (losses(views.miss(x), scale).sum(1) for x in (state, again))
        better = other < loss - 0.1
        state = state._replace(
            rotations=torch.where(better[:, None, None], again.rotations, state.rotations),
            translations=torch.where(better[:, None], again.translations, state.translations),
        )
        distance = views.miss(state).norm(dim=-1)
        typical = torch.where(views.seen, distance, torch.nan).nanmedian(1).values
        sigma = max(distance[counts].median().item() / MEDIAN, SHARPEST)
        before, used = used, typical <= OFF * sigma
        if used.sum() < LEAST_PICTURES:
            raise CalibrationError(
                f"Only {int(used.sum())} pictures agree on a {model.__name__} lens: are the board "
                "and the order of its corners right?"
            )
        if torch.equal(before, used) and not better[used].any():
            break
    return _Found(free, state, scale, views, used)


def _doubts(found: Calibration, views: Views, best: _Found, place: Tensor) -> list[str]:
    """What looks wrong; CalibrationError if the pictures do not determine the lens."""
    said, used = [], best.used
    if found.sigma > WRONG * best.state.lens.image_size.mean():
        raise CalibrationError(
            f"Half of the corners are {MEDIAN * found.sigma:.3g} px or more off the best lens: are "
            "the board and the order of its corners right?"
        )
    theta = torch.linspace(0.3, 1, 8, dtype=torch.float64) * found.supported
    spread = (found.uncertainty_of_theta(theta) / found.lens.project(theta)).max().item()
    spread *= max(1.0, SHARPEST / max(found.sigma, 1e-12))
    if not spread <= UNSURE:
        tilt = torch.acos(best.state.rotations[used, 2, 2].abs().clamp(max=1)).max().rad2deg()
        why = "take more pictures, with tilted boards that fill more of the picture"
        if tilt < PARALLEL:
            why = "all boards are nearly parallel to the sensor: tilt them by 20 to 45°"
        if not spread <= UNKNOWN:
            raise CalibrationError(f"The pictures do not determine the lens: {why}.")
        said.append(f"the radius is unsure by {100 * spread:.2g} %: {why}")
    distance = found.residuals.norm(dim=-1)
    off = (distance > OFF * max(found.sigma, SHARPEST)) & found.used[:, None]
    worst = sorted(((distance[k, i].item(), k, i) for k, i in off.nonzero().tolist()), reverse=True)
    for d, k, i in worst[:SHOWN]:
        said.append(f"corner {i + 1} of {found.names[k]} is {d:.3g} px off")
    if len(worst) > SHOWN:
        said.append(
            f"{len(worst) - SHOWN} more corners are off, in {int(off.any(1).sum())} pictures"
        )
    for k in (~found.used).nonzero()[:, 0].tolist():
        what = f"does not fit: half of its corners are {distance[k].nanmedian():.3g} px off"
        if found.rotations[k].isnan().any():
            count = int(views.seen[k].sum())
            what = f"shows {count} corners; {LEAST_CORNERS}, not on one line, are needed"
        said.append(f"{found.names[k]} {what}")
    if used.sum() < FEW:
        said.append(f"{int(used.sum())} pictures are few: take 10 to 20")
    if found.sigma > BLURRED:
        said.append(
            f"corners are {found.sigma:.2g} px off: the pictures are blurred, the board is bent, "
            "or another model fits better"
        )
    far = best.state.translations[used].norm(dim=1)
    if far.max() < ONE_DISTANCE * far.min():
        said.append("all boards are at one distance: take some nearer and some farther")
    normals = best.state.rotations[:, :, 2]
    behind = found.used.nonzero()[(normals * place.mean(1)).sum(1)[used] < 0, 0].tolist()
    if behind:
        which = ", ".join(found.names[k] for k in behind[:SHOWN])
        said.append(f"the board is mirrored, or seen from behind, in {len(behind)}: {which}")
    end = found.lens.theta_max.item()
    if found.supported < COVERED * end:
        said.append(
            f"corners reach {math.degrees(found.supported):.0f}° from the axis, but the sensor "
            f"{math.degrees(end):.0f}°: in between, the lens is a guess"
        )
    return said
