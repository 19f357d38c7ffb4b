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

from darswin.calibrate import boards, edges
from darswin.calibrate.circle import image_circle
from darswin.calibrate.inputs import CalibrationError
from darswin.calibrate.spread import RHO, allowed, angles, misfit
from darswin.lens import OCam, fit, to_dict
from darswin.lens.base import MODELS, Lens, unknown_model
from darswin.lens.files.load import reach
from darswin.utils.parameters import check

MOST, FEWEST, ENOUGH = 120, 10, 300  # curves: of a picture, of all, and to find the centre too
STEP = 4  # points of an edge that are averaged
FRAME = 0.03  # of the radius: lines along a side that are nearer to it are of a black frame
TOLERANCE = 0.3, 1 / 800  # px, at least, and of the radius: by which a line misses
STRAIGHT = 3.0  # times TOLERANCE: curves that miss by more are not lines
ORTHOGONAL = 4.0  # the weight of directions, compared with straightness
BENDS, DEPTHS = np.linspace(-2, 0.3, 47), np.geomspace(0.2, 4, 24)  # a₁ and h₀ that are tried
LONGEST, LIKELY, LOWS = 12, 5, 2  # curves, their directions and the depths that are looked into
UNSURE, OFF, COVERED, AGREE = 0.05, 2.0, 0.8, 0.5  # of the rim's angle; px; of radius; of edges
RATIOS = -0.05, 0.0, 0.05  # log of ratio
WEIGHT, USUAL = 4.0, 0.5  # of beliefs in a search; 
OBLONG = 0.003  # of the ratio of the sides of pixels, the standard deviation
SECOND = 3, 5  # lines of a picture that a second direction needs, and for no doubt
NARROWEST = math.radians(3)  # at the rim
DIFFERENT = "the pictures allow very different lenses: give more of them"
_cost = attrgetter("cost")


@dataclass(frozen=True)
class Estimate:
    """A lens from pictures without a board.

    Attributes:
        lens: one lens in float64.
        rim: rad, its θ at `radius`, px: at the image circle, or at the nearest side without one.
        interval: rad: the least and the largest θ at the rim, one standard deviation around it.
        spread: the largest standard deviation of θ up to the rim, as a part of θ.
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
    pictures: Sequence[np.ndarray], model: str = "Spherical", *,
    center: tuple[float, float] | None = None, fov: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Estimate:  # fmt: skip
    """Finds the lens of a camera from pictures with straight edges.

    Args:
        pictures: (H, W) or (H, W, 3), uint8, all of one size and one camera.
        model: a name in `darswin.lens.MODELS`; or "Division", the `OCam` lens with [a₀, 0, a₂].
        center: (x, y) px, if it is known. Otherwise it is near the middle of the image circle, or
            of the picture.
        fov: rad, the field of view of the visible image circle, if it is known.
        progress: a function that is called with lines of text.

    Raises:
        CalibrationError: too few lines, or lines that do not determine the lens.
        ValueError: an unknown model, or pictures of several sizes, or below 16 px.
    """
    if model not in MODELS and model != "Division":
        raise ValueError(unknown_model(model))
    if fov is not None:
        check("fov", fov, 0 < fov < 2 * math.pi, "above 0 and below 2π")
    sizes = {picture.shape[:2] for picture in pictures}
    if len(sizes) != 1:
        found = ", ".join(f"{w} × {h}" for h, w in sorted(sizes)) or "no pictures"
        raise ValueError(f"pictures must be of one camera and one size (W × H), got {found}")
    if min(min(sizes)) < (least := boards.LEAST_SIDE):
        raise ValueError(f"pictures must have at least {least} × {least} px")
    circle = image_circle(pictures)
    if fov is not None and circle is None:
        raise CalibrationError("no image circle is visible, so its field of view says nothing")
    found_curves = []
    for number, picture in enumerate(pictures, 1):
        found_curves.append(edges.curves(picture))
        if progress is not None:
            progress(f"picture {number} of {len(pictures)}: {len(found_curves[-1])} curves")
    return from_curves(found_curves, sizes.pop(), model, center=center, fov=fov, circle=circle)


def from_curves(
    curves: Sequence[Sequence[np.ndarray]], size: tuple[int, int], model: str = "Spherical", *,
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
    best, low, high = allowed(_search(_Lines(pieces, np.array(picture), scale, *known)))
    along = [[(best.along[of] == k).sum() for k in range(3)] for of in best.lines.of.values()]
    second = np.sort(along)[:, 1]
    if fov is None and second.max() < SECOND[0]:
        raise CalibrationError(
            "straight lines alone do not tell the focal length, and no picture has several lines "
            "in two orthogonal directions: give other pictures, or the image circle's field of view"
        )
    raw, last = best.lens(size, radius), best.rho.max()
    theta = raw.unproject(min(radius * last, raw.r_max.item()))
    kind, terms = ("OCam", 2) if model == "Division" else (model, min(MODELS[model].terms, 2))
    for part in (1.0, 0.95, 0.9, 0.85, 0.8):  # some models do not reach the corners of pictures
        with suppress(ValueError):
            shown = raw.with_theta_max(part * theta)
            lens, error = fit(kind, shown, terms=terms)
            break
    else:
        raise CalibrationError(
            f"no {model} lens is close to what the lines show: give more pictures, or another model"
        )
    lens = lens.with_theta_max(None)
    rim = lens.unproject(min(radius, lens.r_max.item())).item()
    if rim < NARROWEST:
        raise CalibrationError("the lines do not determine a lens: give more pictures")
    lens = lens.with_theta_max(rim if circle else reach(lens))
    sigmas = np.hypot(np.maximum(best.curve - low, high - best.curve), misfit(lens, shown, radius))
    sigma = float(sigmas[-1])
    low, high = max(rim - sigma, 0.0), min(rim + sigma, math.pi)
    spread = float((sigmas / angles(lens, radius)).max())
    covered = len(np.unique(np.minimum(20 * best.rho, 19).astype(int))) / 20
    oriented = (second >= SECOND[0]).sum()
    source = f"orthogonal directions in {oriented} of {len(curves)} pictures set the scale"
    verdict = (
        f"{len(best.normal)} straight curves over {covered:.0%} of the radius support this lens, "
        f"and {'the given field of view sets the scale' if fov else source}: "
        "{:.1f}° at the rim, between {:.1f}° and {:.1f}°".format(*np.degrees((rim, low, high)))
        + f", and known to {spread:.1%} at any radius below"
    )
    few, disagree = (not fov and second.max() < SECOND[1]), (not fov and best.agree < AGREE)
    doubts = {
        DIFFERENT: sigma > UNSURE * rim,
        f"{model} is up to {error.item():.1f} px from what the lines show": error.item() > OFF,
        f"only {second.max()} lines of a picture have a second direction": few,
        f"only {best.agree:.0%} of the lines agree with orthogonal directions": disagree,
        f"no line is beyond {last:.0%} of the radius, where the lens is a guess": last < COVERED,
    }
    said = tuple(doubt for doubt, holds in doubts.items() if holds)
    count = len(best.normal)
    return Estimate(lens, rim, radius, (low, high), spread, count, covered, verdict, said)


def _check(count: int) -> None:
    if count < FEWEST:
        raise CalibrationError(
            f"only {count} curves may be straight lines, but an estimate needs {FEWEST}: "
            "give more pictures, or some of rooms, houses or streets"
        )


class _Lines:
    """The curves of all pictures, in radii of the image, and what is known of the lens.

    A lens is v = (log h₀, a₁, a₂, a₃, x, y, q), with tan θ = ρ / (h₀ (1 + a₁ ρ² + a₂ ρ⁴ + a₃ ρ⁶))
    at the distance ρ from the centre (x, y), for pixels whose sides are as exp q to 1. scale: of a radius, in units of TOLERANCE; center:
    (x, y, standard deviation); rim: θ at ρ = 1; weight: of what is `unusual`.
    """

    def __init__(
        self, pieces: list[np.ndarray], picture: np.ndarray, scale: float, center: np.ndarray,
        rim: float | None, weight: float = WEIGHT,
    ):  # fmt: skip
        self.pieces, self.picture, self.scale, self.center = pieces, picture, scale, center
        self.rim, self.weight, self.points = rim, weight, np.concatenate(pieces)
        self.counts = np.array([len(piece) for piece in pieces])
        self.of = {p: np.nonzero(picture == p)[0] for p in np.unique(picture).tolist()}

    def some(self, keep: np.ndarray, weight: float = WEIGHT) -> "_Lines":
        kept = [piece for piece, k in zip(self.pieces, keep, strict=True) if k]
        return _Lines(kept, self.picture[keep], self.scale, self.center, self.rim, weight)

    def unusual(self, v: np.ndarray) -> np.ndarray:
        """How far a lens is from usual ones, in standard deviations, and from what is known."""
        bend, about = abs(v[1]), (v[4:6] - self.center[:2]) / self.center[2]
        # Usual shapes are between those of stereographic and equidistant lenses. The bend for the
        # scale, -a₁ h₀², is 0 for perspective, 1/4 and 1/3 for these, 1/2 for orthographic lenses.
        second = (v[2] + 0.1 * bend**2) / (0.5 * bend**2 + 0.02)
        third = (v[3] + 0.03 * bend**3) / (0.3 * bend**3 + 0.005)
        scale = -4 * v[1] * math.exp(2 * v[0]) - 1
        oblong = np.sign(v[6]) * math.sqrt(2 * math.log1p((v[6] / OBLONG) ** 2))  # Cauchy's loss
        off = 0.0 if self.rim is None else 1e4 * (_rim(v) - self.rim)
        usual = np.array((second, third, scale)) / USUAL
        return np.array((*self.weight * np.array((*usual, *about, oblong)), off))


def _angles(v: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """θ at ρ, and its derivative."""
    s, h = rho * rho, math.exp(v[0])
    depth = h * (1 + s * (v[1] + s * (v[2] + s * v[3])))
    deepens = h * 2 * s * (v[1] + s * (2 * v[2] + s * 3 * v[3]))  # ρ times the derivative
    return np.arctan2(rho, depth), np.maximum((depth - deepens) / (s + depth**2), 1e-3)


def _rim(v: np.ndarray) -> float:
    return float(_angles(v, np.ones(1))[0][0])


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


class _Planes:
    """For a lens v, the plane through the camera that is closest, in px, to each curve.

    In units of TOLERANCE: miss, of the points; straightness: (C,), its mean square for each curve.
    normal: (C, 3), of the planes, with the signs of `like`. After `orient`, axes: three orthogonal
    directions (3, 3) of each picture; along: (C,), the number of a curve's direction, or -1; agree:
    in [0, 1], how many have one; rows of the least-squares problem; cost.
    """

    def __init__(self, lines: _Lines, v: np.ndarray, like: np.ndarray | float = 1.0):
        self.lines, self.v, self.rim, self.curve = lines, v, _rim(v), _angles(v, RHO)[0]
        offset = (lines.points - v[4:6]) * np.exp((-v[6] / 2, v[6] / 2))
        self.rho = rho = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        (theta, slope), unit = _angles(v, rho), offset / rho[:, None]
        sin, cos = np.sin(theta), np.cos(theta)
        ray = np.column_stack((sin[:, None] * unit, cos))
        # The derivatives of rays along and across the radius.
        along = np.column_stack((cos[:, None] * unit, -sin)) * slope[:, None]
        across = np.column_stack((-unit[:, 1], unit[:, 0], 0 * rho)) * (sin / rho)[:, None]
        outer = lines.scale**2 * (ray[:, :, None] * ray[:, None]).reshape(-1, 9)
        starts, weight = np.cumsum(lines.counts) - lines.counts, rho / (slope * sin)
        for _ in range(3):
            scatter = np.add.reduceat(weight[:, None] * outer, starts).reshape(-1, 3, 3)
            spread, self.own = np.linalg.eigh(scatter)
            normal = self.own[:, :, 0].repeat(lines.counts, 0)
            weight = 1 / ((normal * along).sum(1) ** 2 + (normal * across).sum(1) ** 2)
        self.miss = lines.scale * (normal * ray).sum(1) * np.sqrt(weight)
        self.straightness = np.add.reduceat(self.miss**2, starts) / lines.counts
        sign = np.sign((self.own[:, :, 0] * like).sum(1) + 1e-9)  # a plane has two normals
        self.own *= sign[:, None, None]
        self.miss *= sign.repeat(lines.counts)
        self.normal, self.spread = self.own[:, :, 0], np.maximum(spread[:, 1:], 1e-9)

    def from_directions(self, directions: np.ndarray, of: np.ndarray) -> np.ndarray:
        """How far, with a sign, curves (K,) are from directions (..., 3), as an array (K, ...)."""
        part = np.tensordot(self.own[of], directions, ((1,), (-1,)))
        spread = self.spread[of].reshape(len(of), 2, *[1] * (directions.ndim - 1))
        return part[:, 0] / np.sqrt((part[:, 1:] ** 2 / spread).sum(1) + 1e-30)

    def nearest_of(self, axes: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`from_directions` and the number of the nearest of axes (3, 3) to each of curves (K,)."""
        apart = self.from_directions(axes, of)
        nearest = np.abs(apart).argmin(1)
        return apart[np.arange(len(of)), nearest], nearest

    def best_axes(self, of: np.ndarray) -> np.ndarray:
        """The directions that suit the curves of a picture, of those of pairs of long curves."""
        counts = self.lines.counts[of]
        normal = self.normal[of[np.argsort(-counts, kind="stable")[:LONGEST]]]
        i, j = np.triu_indices(len(normal), 1)
        first = _unit(np.cross(normal[i], normal[j]))[:, None]
        second = _unit(np.cross(first, normal))
        first = np.broadcast_to(first, second.shape)
        axes = np.stack((first, second, np.cross(first, second)), -2).reshape(-1, 3, 3)
        apart = np.abs(self.from_directions(axes, of)).min(-1).T
        likely = _robust(apart, counts).sum(1).argsort(kind="stable")[:LIKELY]
        turned = [self.turned(axes[k], of) for k in likely]
        return min(turned, key=lambda t: _robust(self.nearest_of(t, of)[0], counts).sum())

    def turned(self, axes: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Directions near `axes` that fit the curves of a picture better."""
        for _ in range(2):
            apart, number = self.nearest_of(axes, of)
            nearest, normal = axes[number], self.normal[of]
            sine = (normal * nearest).sum(1)
            weight = apart / np.where(np.abs(sine) > 1e-12, sine, 1)
            weight /= 1 + apart**2 / self.lines.counts[of]
            rows = weight[:, None] * np.cross(nearest, normal)
            turn = np.linalg.lstsq(rows, -weight * sine, rcond=1e-6)[0]
            turn /= max(1, 10 * np.linalg.norm(turn))
            u, _, vh = np.linalg.svd(axes + np.cross(turn, axes))
            axes = u @ vh
        return axes

    def orient(self, axes: dict[int, np.ndarray] | None = None) -> "_Planes":
        """Itself with all attributes, from directions nearby or from the best."""
        counts, of = self.lines.counts, self.lines.of
        if axes is None:
            axes = {p: self.best_axes(curves) for p, curves in of.items() if len(curves) > 2}
        self.axes = {p: self.turned(near, of[p]) for p, near in axes.items() if p in of}
        apart, self.along = np.zeros(len(counts)), np.full(len(counts), -1)
        for p, found in self.axes.items():
            apart[of[p]], self.along[of[p]] = self.nearest_of(found, of[p])
        self.along[apart**2 > STRAIGHT**2 * counts] = -1
        self.agree = 1 - _robust(apart, counts).sum() / counts.sum()
        # A curve that misses its plane or its direction by more than TOLERANCE counts little.
        bends = self.miss / np.sqrt(1 + self.straightness).repeat(counts)
        turns = math.sqrt(ORTHOGONAL) * apart / np.sqrt(1 + apart**2 / counts)
        self.rows = np.concatenate((bends, turns, self.lines.unusual(self.v)))
        self.cost = self.rows @ self.rows
        return self

    def moved(self, step: np.ndarray | float) -> "_Planes":
        return _Planes(self.lines, self.v + step, self.normal).orient(self.axes)

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """Its rows and their derivatives, (rows, 7)."""
        rows = self.moved(0).rows
        return rows, np.stack([self.moved(d).rows - rows for d in 1e-5 * np.eye(7)], 1) / 1e-5

    def refined(self, steps: int = 30, free: Sequence[int] = range(7)) -> "_Planes":
        """The lens nearby with the least cost, by the Levenberg–Marquardt method. free: the indices
        of the numbers of v that change."""
        found, damping = self, 1e-3
        for _ in range(steps):
            best, (rows, slopes) = found, found.slopes()
            slopes = slopes[:, free]
            square, slope = slopes.T @ slopes, slopes.T @ rows
            while damping < 1e6 and found is best:
                damped = square + damping * np.diag(np.diag(square) + 1e-9)
                step = np.zeros(7)
                step[free] = -np.linalg.solve(damped, slope)
                trial = best.moved(step)
                found = trial if trial.cost < best.cost else best
                damping *= 10 if found is best else 0.1
            if found.cost > (1 - 1e-4) * best.cost:
                break
        return found

    def lens(self, size: tuple[int, int], radius: float) -> OCam:
        """As a lens for pictures of (H, W)."""
        h, (a, b, c) = math.exp(self.v[0]), self.v[1:4] / radius ** np.array((1, 3, 5))
        numbers = torch.tensor([-h * radius, 0, -h * a, 0, -h * b, 0, -h * c], dtype=torch.float64)
        return OCam(numbers, center=torch.from_numpy(radius * self.v[4:6]), image_size=size)


def _robust(apart: np.ndarray, counts: np.ndarray) -> np.ndarray:
    return apart**2 / (1 + apart**2 / counts)


def _search(lines: _Lines) -> _Planes:
    """The lens that fits best."""
    # First the shape alone, like that of stereographic or of equidistant lenses.
    shapes = [(a, c * a**2 / -5, c * a**3 * 2 / 35) for a in BENDS for c in (0, 1)]
    lines, starts = lines.some(lines.counts > 0, 1.0), []
    for ratio in RATIOS:
        tried = [_Planes(lines, np.array((0, *s, *lines.center[:2], ratio))) for s in shapes]
        near = min(tried, key=lambda t: (lines.counts * np.minimum(t.straightness, 1)).sum())
        starts.append(near.orient({}).refined(free=range(6)))
    shapes = starts
    straight = np.min([shape.straightness for shape in shapes], 0) < STRAIGHT**2
    _check(straight.sum())
    lines, fits = lines.some(straight), []
    for shape in shapes:
        starts = []
        for depth in DEPTHS:
            starts.append(_Planes(lines, np.array((math.log(depth), *shape.v[1:]))).orient())
            if lines.unusual(starts[-1].v)[2] > 3 * WEIGHT / USUAL:
                break
        around = [starts[max(k - 2, 0) : k + 3] for k in range(len(starts))]
        lows = [s for s, near in zip(starts, around, strict=True) if s is min(near, key=_cost)]
        fits += sorted(lows, key=_cost)[:LOWS]
    if (known := lines.rim) is not None:
        fits = [min(fits, key=lambda start: abs(start.rim - known))]
    for _ in range(3):
        fits = [fit.refined(5) for fit in fits]
        fits = [min(fit, _Planes(lines, fit.v).orient(), key=_cost) for fit in fits]
    return min((fit.refined() for fit in fits), key=_cost)
