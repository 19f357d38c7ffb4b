"""The search for a lens, and for the best model, from the corners of boards in pictures."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.calibrate import radial
from darswin.calibrate.calibrated import CalibratedLens
from darswin.calibrate.doubts import WRONG, doubts
from darswin.calibrate.inputs import (
    LEAST_PICTURES,
    CalibrationError,
    checked,
    usable_pictures,
)
from darswin.calibrate.refine import (
    MEDIAN,
    OFF,
    SHARPEST,
    Free,
    Normal,
    State,
    Views,
    losses,
    refine,
    weights_of,
)
from darswin.lens import MODELS, Lens
from darswin.lens.base import unknown_model
from darswin.lens.files.load import reach
from darswin.utils.parameters import check, naming

# What "auto" tries.
CANDIDATES = (
    "KannalaBrandt", "Perspective", "Equidistant", "Equisolid", "Stereographic", "FieldOfView",
    "EnhancedUnified", "Polynomial", "OCam", "BrownConrady", "Mei", "Fisheye624",
)  # fmt: skip
# The terms off the curve that are found for a model.
ASIDE = {"BrownConrady": {"tangential": 2}, "Mei": {"tangential": 2},
         "Fisheye624": {"tangential": 2, "prism": 4}}  # fmt: skip
HOPELESS = 4.0  # times the standard deviation of a corner from another model


def calibrate(
    corners: Any,
    board: Any,
    size: tuple[int, int],
    model: str | type[Lens] = "auto",
    *,
    terms: int | None = None,
    names: Sequence[str] | None = None,
    square_pixels: bool = True,
    accept: Callable[[Lens], bool] | None = None,
    progress: Callable[[str], None] | None = None,
) -> CalibratedLens:
    """Finds the lens of a camera from the corners of a board in its pictures.

    It needs no guess, for fields of view up to 250°. Corners and pictures that do not fit the
    others count little, and `doubts` names them.

    Args:
        corners: (P, K, 2) px, NaN where a corner was not seen; pixel centres are integers.
        board: a `Board`, or its points (K, 2), in any unit of length.
        size: (H, W) of the pictures.
        model: a lens class, its name in `darswin.lens.MODELS`, or "auto": of many models, the one
            that predicts left-out pictures best.
        terms: the number of polynomial terms, or of the steps of a table. None means the model's
            default.
        names: those of the pictures, for messages. None means "picture 1", ….
        square_pixels: False also finds the ratio of a pixel's sides.
        accept: a function of a lens: "auto" takes the best lens for which it is True, such as one
            that a file format holds. If there is none, it takes the best of all.
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
            usual = min([WRONG * max(size) / HOPELESS, *(one.sigma for one in found)])
            found.append(_find(kind, terms, views, start, size, square_pixels, usual))
        except (CalibrationError, torch.linalg.LinAlgError) as error:
            reason = (
                error if isinstance(error, CalibrationError) else "Its equations have no solution."
            )
            failed.append((kind.__name__, math.nan, math.nan, str(reason)))
    if not found:
        raise CalibrationError(failed[0][3])
    # A corner that fits any model counts for all: no model may leave out the rim or pictures.
    most = max(one.used.sum() for one in found)
    sigma = min(one.sigma for one in found if one.used.sum() == most)
    counts = torch.stack([one.fits(sigma) for one in found]).any(0)
    for one in found:
        one.judge(views, counts)
    found.sort(key=lambda one: one.left_out)
    table = [(one.free.model.__name__, one.left_out, one.error, "") for one in found] + failed
    best = next((one for one in found if accept is None or accept(one.state.lens)), found[0])
    miss = best.miss
    middle, unit = points.mean(0), (points - points.mean(0)).norm(dim=1).max()
    spot = torch.cat((middle, middle.new_zeros(1)))
    place = views.points(best.state)
    theta = torch.atan2(place[..., :2].norm(dim=-1), place[..., 2])

    def all_pictures(value: Tensor, rest: float = math.nan) -> Tensor:
        return value.new_full((count, *value.shape[1:]), rest).index_put((usable,), value)

    lens, seen = best.state.lens, views.seen
    supported = theta[best.fits(best.sigma)].quantile(0.99).item()
    lens = lens.with_theta_max(reach(lens))
    result = CalibratedLens(
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
    picture, board = best.stretch(views, counts)
    stretch = picture if square_pixels else 0.0, board  # else the lens has the ratio of its pixels
    result.doubts.extend(doubts(result, whole.seen, spot, stretch))
    return result


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
        self.counts, self.distance = views.seen & used[:, None], self.miss.norm(dim=-1)
        numbers, typical = 2 * int(self.counts.sum()), self.distance[self.counts].median().item()
        spare = max(numbers - len(state.vector) - 6 * int(used.sum()), 1)
        self.sigma = typical / MEDIAN * math.sqrt(numbers / spare)

    def fits(self, sigma: float) -> Tensor:
        """(P, K) bool: the corners that fit, if `sigma` px is their standard deviation."""
        return self.counts & (self.distance <= OFF * max(sigma, SHARPEST))

    def judge(self, views: Views, counts: Tensor) -> None:
        """Computes the covariance and the errors, over the corners that count, (P, K)."""
        miss, counts, slopes, normal = self._normal(views, counts, self.free)
        self.joint = self.sigma**2 * normal.covariance()
        self.error = miss[counts].square().sum(-1).mean().sqrt().item()
        if len(miss) > LEAST_PICTURES:
            moved = miss + (slopes @ normal.steps(left_out=True)[:, None, :, None])[..., 0]
            self.left_out = moved[counts].square().sum(-1).mean().sqrt().item()

    def stretch(self, views: Views, counts: Tensor) -> tuple[float, float]:
        """How much longer than in x things seem in y, as a part of their length: in the picture,
        and on the board; 0 if it may be chance. Boards that never turn in the picture cannot tell
        one from the other, and both are then the same."""
        free = Free(self.state.lens, square_pixels=False)
        miss, used, slopes, alone = self._normal(views, counts, free)
        last, least = len(free.start), OFF * max(self.sigma, SHARPEST)
        # One more number of all pictures moves the board's points along its y axis.
        along = self.state.rotations[counts.any(1), None, :, 1] * views.board[:, 1:2]
        slopes = torch.cat(
            (slopes[..., :last], slopes[..., -3:] @ along[..., None], slopes[..., last:]), -1
        )
        free.low, free.high = (
            F.pad(e, (0, 1), value=v) for e, v in ((free.low, -math.inf), (free.high, math.inf))
        )
        vector = F.pad(free.start, (0, 1), value=1.0)
        both = Normal(slopes, miss, used.to(miss), free, vector).damped(0.0)

        def sure(normal: Normal, place: int) -> float:
            found, variance = normal.steps()[0, place].item(), normal.covariance()[place, place]
            return found if abs(found) > least * math.sqrt(variance.item()) else 0.0

        picture, board = sure(both, last - 1), sure(both, last)
        if not (picture or board):
            picture = board = sure(alone, last - 1)
        return picture, board

    def _normal(
        self, views: Views, counts: Tensor, free: Free
    ) -> tuple[Tensor, Tensor, Tensor, Normal]:
        """Misses, counts, slopes and equations of the pictures with corners that count, (P, K)."""
        used, (_, lens, rotations, translations) = counts.any(1), self.state
        vector = self.state.vector if free is self.free else free.start
        views = Views(views.corners[used], views.seen[used], views.board)
        slopes = views.slopes(free, State(vector, lens, rotations[used], translations[used]))
        miss, counts = self.miss[used], counts[used]
        normal = Normal(slopes, miss, counts.to(miss), free, vector).damped(0.0)
        return miss, counts, slopes, normal


def _state(lens: Lens, square_pixels: bool, poses: tuple[Tensor, Tensor]) -> tuple[Free, State]:
    """The free numbers of a lens, and the state with these poses."""
    free = Free(lens, square_pixels)
    whole = free.lens(free.start)
    if whole is None:
        raise CalibrationError(f"No {free.model.__name__} lens is close to the start.")
    return free, State(free.start, whole, *poses)


def _find(
    model: type[Lens], terms: int | None, views: Views, start: radial.Start,
    size: tuple[int, int], square_pixels: bool, usual: float,
) -> _Found:  # fmt: skip
    """The lens of a model and the poses, from all pictures that agree. It stays rough where corners
    are much farther off than the `usual` standard deviation, px."""
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
    if found.sigma > HOPELESS * max(usual, SHARPEST):
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
