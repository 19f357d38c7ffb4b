"""The search for a lens, and for the best model, from the corners of boards in pictures."""

import contextlib
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from darswin.calibrate import radial
from darswin.calibrate.boards import misfit
from darswin.calibrate.calibrated import CalibratedLens
from darswin.calibrate.doubts import WRONG, doubts, misshapen
from darswin.calibrate.inputs import LEAST_PICTURES, CalibrationError, checked, usable_pictures
from darswin.calibrate.refine import (
    AGAIN,
    BEND,
    FINE,
    FLAT,
    MEDIAN,
    OFF,
    PIXELS,
    ROUGH,
    SHARPEST,
    STRETCH,
    Free,
    Normal,
    State,
    Views,
    losses,
    refine,
    weights_of,
)  # fmt: skip
from darswin.calibrate.steady import FEW, Steadiness, growth, unsure
from darswin.lens import MODELS, Lens
from darswin.lens.base import unknown_model
from darswin.lens.files.load import reach
from darswin.utils.parameters import check, naming
from darswin.utils.words import counted

# What "auto" tries.
CANDIDATES = (
    "KannalaBrandt", "Perspective", "Equidistant", "Equisolid", "Stereographic", "FieldOfView",
    "EnhancedUnified", "Polynomial", "OCam", "BrownConrady", "Mei", "Fisheye624",
)  # fmt: skip
# The terms off the curve that are found for a model.
ASIDE = {"BrownConrady": {"tangential": 2}, "Mei": {"tangential": 2},
         "Fisheye624": {"tangential": 2, "prism": 4}}  # fmt: skip
FOLDS = 5  # parts of the pictures, of which each is left out once
FINALISTS, CLOSE = 3, 1.25  # models that are fitted to parts; their left_out, by the best
HOPELESS = 4.0  # times the standard deviation of a corner from another model
TIMES = 3  # that PIXELS, BEND and STRETCH are tried, as each changes what is sure of the others


def calibrate(
    corners: Any,
    board: Any,
    size: tuple[int, int],
    model: str | type[Lens] = "auto",
    *,
    terms: int | None = None,
    names: Sequence[str] | None = None,
    square_pixels: bool | None = None,
    accept: Callable[[Lens], bool] | None = None,
    progress: Callable[[str], None] | None = None,
) -> CalibratedLens:
    """Finds the lens of a camera from the corners of a board in its pictures.

    It needs no guess, for fields of view up to 250°. Corners and pictures that do not fit the
    others count little, and `doubts` names them. A board that is bent, or longer along one of its
    sides, is found as well, if that is significant and predicts left-out pictures better.

    Args:
        corners: (P, K, 2) px, NaN where a corner was not seen; pixel centres are integers.
        board: a `Board`, or its points (K, 2), in any unit of length.
        size: (H, W) of the pictures.
        model: a lens class, its name in `darswin.lens.MODELS`, or "auto": of many models, the
            simplest that predicts left-out pictures as well as the best, within its standard error.
        terms: the number of polynomial terms, or of the steps of a table. None means the model's
            default.
        names: those of the pictures, for messages. None means "picture 1", ….
        square_pixels: False also finds the ratio of a pixel's sides, and True keeps it at 1. None
            finds it if it is significant and predicts left-out pictures better.
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
    views = whole.of(usable)
    say(f"Finding a start from {len(views.seen)} pictures")
    start = radial.start(views.corners, views.seen, views.board[:, :2], size)

    def with_more(one: _Found) -> _Found:
        """The same with what is sure of pixels and board, if its lens is accepted."""
        for _ in range(TIMES):
            other = one.with_more(views, square_pixels)
            if other is one or (accept and accept(one.state.lens) > accept(other.state.lens)):
                break
            one = other
        return one

    found: list[_Found] = []
    failed: list[tuple[str, float, float, str]] = []
    for kind in kinds:
        say(f"Refining the lens: {kind.__name__}")
        usual = min([WRONG * max(size) / HOPELESS, *(one.sigma for one in found)])
        # Terms of a model may imitate what is of the pixels or the board, so each starts with that.
        more = list(PIXELS) * (square_pixels is False)
        more = min(found, key=lambda one: one.sigma).free.more if found else more
        try:
            found.append(_find(kind, terms, views, start, size, more, usual, with_more))
        except CalibrationError as error:
            failed.append((kind.__name__, math.nan, math.nan, str(error)))
        except torch.linalg.LinAlgError:
            failed.append((kind.__name__, math.nan, math.nan, "Its equations have no solution."))
    if not found:
        raise misfit(board, failed[0][3])
    # A corner that fits any model counts for all: no model may leave out the rim or pictures.
    most = max(one.used.sum() for one in found)
    sigma = min(one.sigma for one in found if one.used.sum() == most)
    counts = torch.stack([one.fits(sigma) for one in found]).any(0)
    for one in found:
        one.judge(views, counts)
    found.sort(key=lambda one: one.left_out)
    taken = [one for one in found if accept is None or accept(one.state.lens)] or found
    close = [one for one in taken if not one.left_out > CLOSE * taken[0].left_out][:FINALISTS]
    for one in close:
        say(f"Leaving out pictures: {one.free.model.__name__}")
        one.leave_out(views, counts)
    best = _simplest(close)
    found.sort(key=lambda one: (one is not best, one.left_out))
    table = [(one.free.model.__name__, one.left_out, one.error, "") for one in found] + failed
    miss = best.miss
    middle, unit = points.mean(0), (points - points.mean(0)).norm(dim=1).max()
    spot = torch.cat((middle, middle.new_zeros(1)))
    place = views.points(best.state)
    theta = torch.atan2(place[..., :2].norm(dim=-1), place[..., 2])

    def all_pictures(value: Tensor, rest: float = math.nan) -> Tensor:
        return value.new_full((count, *value.shape[1:]), rest).index_put((usable,), value)

    lens, seen = best.state.lens, views.seen
    supported = theta[best.fits(best.sigma)].quantile(0.99).item()
    if best.sigma > WRONG * sum(size) / 2:
        off = f"{MEDIAN * best.sigma:.3g} px or more off the best lens."
        raise misfit(board, f"Half of the corners are {off}")
    steady = best.steadiness(views, counts, supported)
    lens = lens.with_theta_max(reach(lens))
    result = CalibratedLens(
        lens=lens, names=names, parameters=best.free.names, covariance=best.joint[:-3, :-3],
        rotations=all_pictures(best.state.rotations),
        translations=all_pictures(unit * best.state.translations - best.state.rotations @ spot),
        board=unit * views.shaped(best.state.shape) + spot,
        corners=torch.where(whole.seen[..., None], whole.corners, torch.nan),
        residuals=all_pictures(torch.where(seen[..., None], miss, torch.nan)),
        weights=all_pictures(weights_of(miss, best.scale) * (seen & best.used[:, None]), 0.0),
        theta=all_pictures(torch.where(seen, theta, torch.nan)),
        used=all_pictures(best.used, False),
        sigma=best.sigma, error=best.error, left_out=best.left_out,
        supported=supported, unsure=max(steady.noise, steady.scatter),
        models=table if model == "auto" else [], doubts=[],
        _free=best.free, _vector=best.state.vector, _joint=best.joint,
    )  # fmt: skip
    result.doubts.extend(doubts(result, whole.seen, spot, steady))
    result.doubts.extend(misshapen(result, best.state.shape, best.confounded))
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
    squares = torch.tensor([math.nan])  # the sum of the squared misses in each picture left out
    confounded = False  # the board's stretch may be that of the pixels
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
        """Computes the covariance and the errors, over the corners that count, (P, K): to first
        order, `squares` and `left_out` are of a lens without the pictures of each place."""
        place, miss, counts, slopes, normal = self._normal(views, counts, self.free)
        self.joint = self.sigma**2 * normal.covariance()
        self.error = miss[counts].square().sum(-1).mean().sqrt().item()
        if place.max() >= LEAST_PICTURES:
            steps = normal.steps(place)
            moved = miss + (slopes @ steps[:, None, :, None])[..., 0]
            self.squares = (counts * moved.square().sum(-1)).sum(1)
            self.left_out = (self.squares.sum() / counts.sum()).sqrt().item()

    def steadiness(self, views: Views, counts: Tensor, top: float) -> Steadiness:
        """Whether the pictures agree, over the corners that count, (P, K), up to an angle, rad."""
        mine, n = views.of(counts.any(1)), len(self.state.vector)
        place, miss, counts, slopes, normal = self._normal(views, counts, self.free)
        without = miss.new_zeros(int(place.max()) + 1, n)
        if len(without) >= FEW:
            without[place] = normal.steps(place)[:, :n]
        lens, noise = self.state.lens, self.joint[:n, :n]
        spread = unsure(self.free, self.state.vector, lens, top, noise, without)
        grown = growth(mine, lens, slopes, miss, counts, self.sigma)
        return Steadiness(len(without), *spread, *grown)

    def leave_out(self, views: Views, counts: Tensor) -> None:
        """The same by fits to parts of the pictures; NaN for too few."""
        pictures = counts.any(1).nonzero()[:, 0]
        self.squares = counts.new_zeros(len(counts), dtype=torch.float64)
        place = views.of(pictures).group
        # The order of the pictures does not change the parts.
        spots = views.corners[pictures].sum((1, 2))
        rank = spots.new_zeros(int(place.max()) + 1).index_add(0, place, spots).argsort().argsort()
        parts = [pictures[rank[place] % FOLDS == k] for k in range(min(FOLDS, len(rank)))]
        for part in parts if len(parts) > LEAST_PICTURES else [pictures]:
            rest = pictures[~torch.isin(pictures, part)]
            self.squares[part] = math.nan
            if len(rest) < LEAST_PICTURES:
                continue
            with contextlib.suppress(torch.linalg.LinAlgError):
                mine = views._replace(seen=self.counts).of(rest)
                without, _ = refine(mine, self.free, self.state.of(rest), stages=[AGAIN])
                poses = self.state.of(part)
                state = without._replace(rotations=poses.rotations, translations=poses.translations)
                mine = views.of(part)
                state, _ = refine(mine, self.free, state, lens_moves=False, stages=[AGAIN])
                miss = mine.miss(state).square().sum(-1)
                self.squares[part] = torch.where(counts[part], miss, 0.0).sum(1)
        self.left_out = (self.squares.sum() / counts.sum()).sqrt().item()

    def with_more(self, views: Views, square_pixels: bool | None) -> "_Found":
        """The same with those of PIXELS, BEND and STRETCH that are significant, and without others,
        as far as that predicts left-out pictures better, to first order."""
        more, confounded = self._significant(views, square_pixels)
        # A stretch that was taken for that of the board looks sure when it is looked at again.
        confounded = (self.confounded or confounded) and STRETCH[0] in more
        if {*more} == {*self.free.more}:
            self.confounded = confounded
            return self
        free, state = _state(self.state.lens, more, *self.state[2:])
        state, scale = refine(views._replace(seen=self.counts), free, state, stages=[FINE])
        other = _Found(free, state, scale, views, self.used)
        other.confounded = confounded
        for one in (self, other):
            one.judge(views, self.fits(self.sigma))
        fewer = len(more) < len(self.free.more)
        return other if fewer or other.left_out < self.left_out else self

    def _significant(self, views: Views, square_pixels: bool | None) -> tuple[list[str], bool]:
        """The names of the numbers of the pixels and of the board's shape that are no chance, to
        first order; and whether boards that never turn in the picture cannot tell its stretch from
        that of the pixels."""
        held = list(PIXELS) * (square_pixels is False)
        open_ = [*[PIXELS] * (square_pixels is None), BEND, STRETCH]
        extra = {name for group in open_ for name in group}
        free, confounded = Free(self.state.lens, (*held, *extra), self.state.shape), False
        vector = free.start
        _, miss, counts, slopes, _ = self._normal(views, self.fits(self.sigma), free)
        low, high = free.low, free.high
        while open_:
            stay = torch.tensor([n in extra.difference(*open_) for n in free.names])
            free.low, free.high = (torch.where(stay, vector, end) for end in (low, high))
            normal = Normal(slopes, miss, counts.to(miss), free, vector).damped(0.0)
            step = normal.steps()[0, : len(vector)]
            covariance, sure = normal.covariance(), {}
            for group in open_:
                at = [free.names.index(name) for name in group]
                value = (vector + step)[at] - float(group == PIXELS)  # a ratio of 1 is none
                squared = value @ torch.linalg.solve(covariance[at][:, at], value)
                sure[group] = squared.sqrt().item() / max(self.sigma, SHARPEST)
            chance = [group for group in open_ if not sure[group] > OFF]
            if not chance:
                break
            both = PIXELS in chance and STRETCH in chance
            confounded |= both
            open_.remove(PIXELS if both else min(chance, key=lambda group: sure[group]))
        return [*held, *(name for group in open_ for name in group)], confounded

    def _normal(
        self, views: Views, counts: Tensor, free: Free
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Normal]:
        """Places, misses, counts, slopes and equations of the pictures with corners that count."""
        used = counts.any(1)
        vector = self.state.vector if free is self.free else free.start
        slopes = views.of(used).slopes(free, self.state.of(used)._replace(vector=vector))
        miss, counts = self.miss[used], counts[used]
        normal = Normal(slopes, miss, counts.to(miss), free, vector).damped(0.0)
        return views.of(used).group, miss, counts, slopes, normal


def _simplest(found: list[_Found]) -> _Found:
    """The one with the fewest numbers that misses left-out pictures by no more than the best does,
    within the standard error of the difference."""
    best = min(found, key=lambda one: one.left_out)
    for one in sorted(found, key=lambda one: len(one.state.vector)):
        more = one.squares - best.squares
        if more.sum() <= math.sqrt(len(more)) * more.std():
            return one
    return best


def _state(
    lens: Lens, more: Sequence[str], rotations: Tensor, translations: Tensor, shape: Tensor
) -> tuple[Free, State]:
    """The free numbers of a lens, and the state with these poses and the board's shape, (3,)."""
    free = Free(lens, more, shape)
    whole = free.lens(free.start)
    if whole is None:
        raise CalibrationError(f"No {free.model.__name__} lens is close to the start.")
    return free, State(free.start, whole, rotations, translations, free.shape(free.start))


def _find(
    model: type[Lens], terms: int | None, views: Views, start: radial.Start,
    size: tuple[int, int], more: Sequence[str], usual: float, with_more: Callable[[_Found], _Found],
) -> _Found:  # fmt: skip
    """The lens of a model and the poses, from all pictures that agree. It stays rough where corners
    are much farther off than the `usual` standard deviation, px."""
    rays, used, board = start.rays(views.corners), start.fits, views.board[:, :2]
    theta = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])
    top = theta[views.seen & used[:, None]].max().item()
    poses = radial.poses(rays, views.seen.to(rays), board)
    free, state = _state(start.lens(model, terms, top, size), more, *poses, FLAT)
    agreeing = views._replace(seen=views.seen & used[:, None])
    state, scale = refine(agreeing, free, state, stages=[ROUGH])
    # Far from the best lens, these terms could cut off the rim, and they imitate oblong pixels.
    if model.__name__ in ASIDE:
        zeros = {name: rays.new_zeros(1, n) for name, n in ASIDE[model.__name__].items()}
        plain = with_more(_Found(free, state, scale, views, used))
        lens = plain.state.lens.replace(**zeros)
        free, state = _state(lens, plain.free.more, *plain.state[2:])
        state, scale = refine(agreeing, free, state, stages=[ROUGH])
    found = _Found(free, state, scale, views, used)
    if found.sigma > HOPELESS * max(usual, SHARPEST):
        return found
    for _ in range(4):
        counts = views.seen & used[:, None]
        state, scale = refine(views._replace(seen=counts), free, state)
        # Each pose anew from its rays: some may be mirrored, some pictures may fit after all.
        rays = state.lens.unproject_points(views.corners)
        there = (views.seen & ~rays.isnan().any(-1)).to(rays)
        again = State(*state[:2], *radial.poses(rays.nan_to_num(), there, board), state.shape)
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
                f"Only {counted(int(used.sum()), 'picture')} fit one {model.__name__} lens."
            )
        if torch.equal(before, used) and not better[used].any():
            break
    return with_more(_Found(free, state, scale, views, used))
