"""A lens from ordinary pictures: from curves that are straight, and often orthogonal, in the world.

The rays of a straight line lie in a plane. This determines the curve of a lens up to a factor of
tan θ, because the map (x, y, z) → (x, y, s z) of rays keeps planes. What people build has three
orthogonal directions, which determine the factor; so does the field of view of the image circle.

Source: Devernay and Faugeras, MVA 2001; Coughlan and Yuille, ICCV 1999.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from darswin.calibrate import boards, edges
from darswin.calibrate.circle import image_circle
from darswin.calibrate.inputs import CalibrationError
from darswin.calibrate.planes import RHO, STRAIGHT, TOLERANCE, USUAL, WEIGHT, Lines, Planes
from darswin.lens import OCam, fit, to_dict
from darswin.lens.base import MODELS, Lens, unknown_model
from darswin.lens.files.load import reach
from darswin.utils.parameters import check
from darswin.utils.words import counted, in_px

MOST = 120  # curves of a picture that are used
FEWEST = 10  # curves of all pictures that an estimate needs
STEP = 4  # points of an edge that are averaged
FRAME = 0.03  # of the radius: lines along a side that are nearer to it are of a black frame
BENDS = np.linspace(-2, 0.3, 47)  # a₁ that are tried
DEPTHS = np.geomspace(0.2, 4, 24)  # h₀ that are tried
LOWS = 2  # depths that are looked into, for each ratio
UNSURE = 0.05  # of the rim's angle: with a wider interval, the scale is not set
OPEN = 0.25  # the same, of the angle at any radius
OFF = 2.0  # px: a form that misses the lines by more gives a warning
COVERED = 0.8  # of the radius: lines that end before give a warning
AGREE = 0.5  # of the edges: fewer in orthogonal directions give a warning
REAL = 0.005  # of any angle: by how much real cameras differ from every model
RATIOS = -0.05, 0.0, 0.05  # q, the logarithm of the ratio of a pixel's sides, that are tried
CLOSE = 1.5  # times the least cost: shapes that are looked into
SECOND = 3  # lines that the second direction of a picture needs
SEVERAL = 5  # lines: fewer in every picture's second direction give a warning
SIGMAS = 3.0  # standard deviations on each side of an interval
ROUNDS = 3  # of the search for an interval, if it finds a better lens
SCALES = 0.03, 0.08, 0.15, 0.3, 0.6  # of the logarithm of h₀, from the best
NARROWEST = math.radians(3)  # at the rim
MORE = "give more pictures, or the field of view of the image circle if it is visible"
DIFFERENT = f"the pictures do not set the scale, and allow very different lenses: {MORE}"
FORMS = "Spherical", "KannalaBrandt", "Division"  # that "auto" tries
_cost = attrgetter("cost")


@dataclass(frozen=True)
class Estimate:
    """A lens from pictures without a board.

    Attributes:
        lens: one lens in float64.
        rim: rad, its θ at `radius`, px: at the image circle, or at the nearest side without one.
        interval: rad: the least and the largest θ at the rim that the lines allow.
        spread: how far θ may be off, anywhere up to the rim, as a part of θ.
        curves: the number of curves that are straight with this lens.
        covered: the part of the radius, in [0, 1], on which they lie.
        verdict: what supports the lens, in one sentence; doubts: sentences on what does not.
    """

    lens: Lens
    rim: float
    radius: float
    interval: tuple[float, float]
    spread: float
    curves: int
    covered: float
    verdict: str
    doubts: tuple[str, ...]

    @property
    def is_sure(self) -> bool:
        """False if the pictures allow very different lenses."""
        return DIFFERENT not in self.doubts

    def to_dict(self) -> dict[str, Any]:
        """All of it as a JSON object; the lens is described as by `darswin.lens.to_dict`."""
        return vars(self) | {"lens": to_dict(self.lens)}


def estimate(
    pictures: Sequence[np.ndarray], model: str = "auto", *,
    center: tuple[float, float] | None = None, fov: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Estimate:  # fmt: skip
    """Finds the lens of a camera from pictures with straight edges.

    Args:
        pictures: (H, W) or (H, W, 3), uint8, all of one size and one camera.
        model: a name in `darswin.lens.MODELS`; "Division", the `OCam` lens with [a₀, 0, a₂]; or
            "auto": of it, Spherical and KannalaBrandt, the closest to what the lines show.
        center: (x, y) px, if it is known. Otherwise it is near the middle of the image circle, or
            of the picture.
        fov: rad, the field of view of the visible image circle, if it is known.
        progress: a function that is called with lines of text.

    Raises:
        CalibrationError: too few lines, or lines that do not determine the lens or its scale.
        ValueError: an unknown model, or pictures of several sizes, or below 16 px.
    """
    if model not in (*MODELS, "Division", "auto"):
        raise ValueError(unknown_model(model))
    if fov is not None:
        check("fov", fov, 0 < fov < 2 * math.pi, "above 0 and below 2π")
    sizes = {picture.shape[:2] for picture in pictures}
    if len(sizes) != 1:
        found = ", ".join(map(in_px, sorted(sizes))) or "no pictures"
        raise ValueError(f"pictures must be of one camera and one size, got {found}")
    if min(min(sizes)) < (least := boards.LEAST_SIDE):
        raise ValueError(f"pictures must have at least {least} × {least} px")
    circle = image_circle(pictures)
    if fov is not None and circle is None:
        raise CalibrationError("no image circle is visible, so its field of view says nothing")
    found_curves = []
    for number, picture in enumerate(pictures, 1):
        found_curves.append(edges.curves(picture))
        if progress is not None:
            found = counted(len(found_curves[-1]), "curve")
            progress(f"picture {number} of {len(pictures)}: {found}")
    return from_curves(found_curves, sizes.pop(), model, center=center, fov=fov, circle=circle)


def from_curves(
    curves: Sequence[Sequence[np.ndarray]], size: tuple[int, int], model: str = "auto", *,
    center: tuple[float, float] | None = None, fov: float | None = None,
    circle: tuple[float, float, float] | None = None,
) -> Estimate:  # fmt: skip
    """`estimate` from the curves of each picture, (n, 2) px; circle: (x, y, radius), px."""
    height, width = size
    x, y = center or (circle[:2] if circle else ((width - 1) / 2, (height - 1) / 2))
    radius = circle[2] if circle else min(x, y, width - 1 - x, height - 1 - y) + 0.5
    pieces, picture = [], []
    for number, of_picture in enumerate(curves):
        for curve in of_picture[:MOST]:
            points = curve[: len(curve) // STEP * STEP].reshape(-1, STEP, 2).mean(1)
            # The edges of the image circle, and of a black frame, are not of the world.
            at_rim = circle and (np.hypot(*(points - circle[:2]).T) > 0.98 * radius).mean() > 0.1
            from_sides = np.hstack((points, (width - 1, height - 1) - points))
            if len(points) > 3 and not at_rim and from_sides.max(0).min() > FRAME * radius:
                pieces.append(points / radius)
                picture.append(number)
    about = 1e-4 if center else 0.003 if circle else 0.01
    known = np.array((x / radius, y / radius, about)), fov and fov / 2
    _check(len(pieces))
    scale = min(radius / TOLERANCE[0], 1 / TOLERANCE[1])
    best, apart = _allowed(_search(Lines(pieces, np.array(picture), scale, *known)))
    along = [[(best.along[of] == k).sum() for k in range(3)] for of in best.lines.of.values()]
    second = np.sort(along)[:, 1]
    if fov is None and second.max() < SECOND:
        raise CalibrationError(
            "straight lines alone do not tell the focal length, and no picture has several lines "
            f"in two orthogonal directions: {MORE}"
        )
    raw, last = best.lens(size, radius), best.rho.max()
    theta = raw.unproject(min(radius * last, raw.r_max.item()))
    tried = {name: _closest(name, raw, theta) for name in (model, *FORMS) if name != "auto"}
    fits = {name: fitted for name, fitted in tried.items() if fitted is not None}
    closest = min(fits, key=lambda name: fits[name][1], default=model)
    form = closest if model == "auto" else model
    if form not in fits:
        raise CalibrationError(
            f"no {model} lens is close to what the lines show: give more pictures, or another model"
        )
    lens, error = fits[form]
    angles = _curve(lens, radius)
    # Where no lines are, other forms show what they leave open.
    others = [_curve(fits[name][0], radius) - angles for name in FORMS[:2] if name in fits]
    misfit = np.abs([angles - best.curve, *others]).max(0)
    if (rim := float(angles[-1])) < NARROWEST:
        raise CalibrationError("the lines do not determine a lens: give more pictures")
    lens = lens.with_theta_max(rim if circle else reach(lens))
    sigmas = np.linalg.norm((apart, misfit, REAL * angles), axis=0)
    sigma, spread = float(sigmas[-1]), float((sigmas / angles).max())
    low, high = max(rim - sigma, 0.0), min(rim + sigma, math.pi)
    covered = len(np.unique(np.minimum(20 * best.rho, 19).astype(int))) / 20
    oriented = (second >= SECOND).sum()
    unsure = sigma > UNSURE * rim or spread > OPEN
    sets = "hardly set" if unsure else "set"
    where = f"{oriented} of {counted(len(curves), 'picture')}"
    source = f"orthogonal directions in {where} {sets} the scale"
    verdict = (
        f"{len(best.normal)} straight curves over {covered:.0%} of the radius support this lens, "
        f"and {'the given field of view sets the scale' if fov else source}: "
        "{:.1f}° at the rim, between {:.1f}° and {:.1f}°".format(*np.degrees((rim, low, high)))
        + f", and within {spread:.1%} at smaller radii"
    )
    ratio, oblong = math.exp(best.v[6]), raw.affine is not None
    than = f", {closest} up to {fits[closest][1]:.1f} px" * (form != closest)
    few, disagree = (not fov and second.max() < SEVERAL), (not fov and best.agree < AGREE)
    doubts = {
        DIFFERENT: unsure,
        f"{form} is up to {error:.1f} px from what the lines show{than}": error > OFF,
        f"pixels are not square: {ratio:.3f} along x is 1 along y, as the lens has it": oblong,
        f"only {second.max()} lines of a picture have a second direction": few,
        f"only {best.agree:.0%} of the lines agree with orthogonal directions": disagree,
        f"no line is beyond {last:.0%} of the radius, where the lens is a guess": last < COVERED,
    }
    said = tuple(doubt for doubt, holds in doubts.items() if holds)
    count = len(best.normal)
    return Estimate(lens, rim, radius, (low, high), spread, count, covered, verdict, said)


def _closest(name: str, raw: OCam, theta: Tensor) -> tuple[Lens, float] | None:
    """The lens of a model that is closest up to θ, without a θ_max, and px by which it is off."""
    kind, terms = ("OCam", 2) if name == "Division" else (name, min(MODELS[name].terms, 2))
    for part in (1.0, 0.95, 0.9, 0.85, 0.8):  # some models do not reach the corners of pictures
        with suppress(ValueError):
            lens, error = fit(kind, raw.with_theta_max(part * theta), terms=terms)
            return lens.with_theta_max(None), error.item()
    return None


def _curve(lens: Lens, radius: float) -> np.ndarray:
    """(20,) rad: θ at `RHO` times a radius in px."""
    radii = torch.from_numpy(radius * RHO).clamp(max=lens.r_max.item())
    return lens.unproject(radii[None])[0].numpy()


def _check(count: int) -> None:
    if count < FEWEST:
        raise CalibrationError(
            f"only {counted(count, 'curve')} may be straight, but an estimate needs {FEWEST}: "
            "give more pictures, or some of rooms, houses or streets"
        )


def _search(lines: Lines) -> Planes:
    """The lens that fits best."""
    # First the shape alone, like that of stereographic or of equidistant lenses.
    usual = [(0, a, c * a**2 / -5, c * a**3 * 2 / 35) for a in BENDS for c in (0, 1)]
    lines = lines.some(lines.counts > 0, 1.0)
    tried = [Planes(lines, np.array((*shape, *lines.center[:2], 0))) for shape in usual]
    near = min(tried, key=lambda t: (lines.counts * np.minimum(t.straightness, 1)).sum())
    ratios = (Planes(lines, np.r_[near.v[:6], q]).orient({}) for q in RATIOS)
    shapes = [start.refined(free=range(6)) for start in ratios]
    shapes = [shape for shape in shapes if shape.cost < CLOSE * min(map(_cost, shapes))]
    straight = np.min([shape.straightness for shape in shapes], 0) < STRAIGHT**2
    _check(straight.sum())
    lines, fits = lines.some(straight), []
    for shape in shapes:
        starts = []
        for depth in DEPTHS:
            starts.append(Planes(lines, np.array((math.log(depth), *shape.v[1:]))).orient())
            if lines.unusual(starts[-1].v)[2] > 3 * WEIGHT / USUAL:
                break
        around = [starts[max(k - 2, 0) : k + 3] for k in range(len(starts))]
        lows = [s for s, near in zip(starts, around, strict=True) if s is min(near, key=_cost)]
        fits += sorted(lows, key=_cost)[:LOWS]
    if (known := lines.rim) is not None:
        fits = [min(fits, key=lambda start: abs(start.rim - known))]
    for _ in range(3):
        fits = [fit.refined(5) for fit in fits]
        fits = [min(fit, Planes(lines, fit.v).orient(), key=_cost) for fit in fits]
    return min((fit.refined() for fit in fits), key=_cost)


def _allowed(best: Planes) -> tuple[Planes, np.ndarray]:
    """The best lens, and (20,) rad: how far θ may be off at `RHO` times the radius.

    This is the profile of the cost: for each scale, all else is found again, also which lines are
    orthogonal. The errors along a curve are alike, so a curve counts as one observation.
    """
    lines = best.lines
    for _ in range(ROUNDS):
        rows = best.rows[: len(lines.points) + len(lines.counts)]
        noise = rows @ rows / len(lines.counts) + 1e-9
        lines = lines.some(lines.counts > 0, float(np.sqrt(noise)))
        best = Planes(lines, best.v, best.normal).orient(best.axes).refined()
        trials, ends = [best], [best.curve]
        for sign in (-1, 1):
            near, before = best, 0.0
            for step in SCALES:
                v = np.r_[best.v[0] + sign * step, near.v[1:]]
                tried = Planes(lines, v, near.normal).orient(near.axes), Planes(lines, v).orient()
                trial = min(tried, key=_cost).refined(8, range(1, 7))
                rise = np.sqrt(max(trial.cost - best.cost, 0.0) / noise)
                if min(before, rise) <= SIGMAS:
                    part = 1 if max(before, rise) <= SIGMAS else (SIGMAS - before) / (rise - before)
                    ends.append(near.curve + part * (trial.curve - near.curve))
                near, before = trial, rise
                trials.append(trial)
        if min(map(_cost, trials)) > best.cost - 0.1 * noise:
            break
        best = min(trials, key=_cost)
    # At one scale, the other numbers of the lens are as uncertain as their linear problem says.
    slopes, steps = best.slopes()[1][:, 1:], 1e-5 * np.eye(7)[1:]
    change = np.stack([best.moved(step).curve - best.curve for step in steps], 1) / 1e-5
    rest = noise * ((change @ np.linalg.pinv(slopes.T @ slopes)) * change).sum(1)
    return best, np.hypot(np.abs(ends - best.curve).max(0), SIGMAS * np.sqrt(rest))
