"""A lens from ordinary pictures: from curves that are straight, and often orthogonal, in the world.

The rays of a straight line lie in a plane. This determines the curve of a lens up to a factor of
tan θ, because the map (x, y, z) → (x, y, s z) of rays keeps planes. What people build has three
orthogonal directions, which determine the factor; so does the field of view of the image circle.

Source: Devernay and Faugeras, MVA 2001; Coughlan and Yuille, ICCV 1999.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from darswin.calibrate import edges
from darswin.calibrate.boards import image_circle
from darswin.calibrate.inputs import CalibrationError
from darswin.lens import OCam, fit, to_dict
from darswin.lens.base import MODELS, Lens, unknown_model
from darswin.lens.files.load import reach
from darswin.utils.parameters import check

MOST, FEWEST, ENOUGH = 120, 10, 300  # curves: of a picture, of all, and to find the centre too
STEP = 4  # points of an edge that are averaged
ORTHOGONAL = 4.0  # the weight of directions, compared with straightness
BENDS, DEPTHS = np.linspace(-2, 0.3, 47), np.geomspace(0.12, 4, 40)  # a₁ and h₀ that are tried
AS_GOOD = 1.1  # times the least cost: other answers that the pictures allow
GROUPS = 8  # of curves; the answers without each of them show the uncertainty
UNSURE, OFF, COVERED = 0.05, 2.0, 0.8  # of the rim's angle; px; of the radius
NARROWEST = math.radians(3)  # at the rim


@dataclass(frozen=True)
class Estimate:
    """A lens from pictures without a board.

    Attributes:
        lens: one lens in float64.
        rim: rad, its θ at `radius`, px: at the image circle, or at the nearest side without one.
        interval: rad: the least and the largest θ at the rim that the pictures allow, one standard
            deviation around all answers that are nearly as good.
        curves: the number of curves that are straight with this lens.
        covered: the part of the radius, in [0, 1], on which they lie.
        verdict: what supports the lens, in one sentence; doubts: sentences on what does not.
    """

    lens: Lens
    rim: float
    radius: float
    interval: tuple[float, float]
    curves: int
    covered: float
    verdict: str
    doubts: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """All of it as a JSON object; the lens is described as by `darswin.lens.to_dict`."""
        return vars(self) | {"lens": to_dict(self.lens)}


def estimate(
    pictures: Sequence[np.ndarray],
    model: str = "Spherical",
    *,
    center: tuple[float, float] | None = None,
    fov: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Estimate:
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
        ValueError: an unknown model, or pictures of several sizes.
    """
    if model not in MODELS and model != "Division":
        raise ValueError(unknown_model(model))
    if fov is not None:
        check("fov", fov, 0 < fov < 2 * math.pi, "above 0 and below 2π")
    sizes = {picture.shape[:2] for picture in pictures}
    if len(sizes) != 1:
        found = ", ".join(f"{w} × {h}" for h, w in sorted(sizes)) or "no pictures"
        raise ValueError(f"pictures must be of one camera and one size (W × H), got {found}")
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
    curves: Sequence[Sequence[np.ndarray]],
    size: tuple[int, int],
    model: str = "Spherical",
    *,
    center: tuple[float, float] | None = None,
    fov: float | None = None,
    circle: tuple[float, float, float] | None = None,
) -> Estimate:
    """`estimate` from the curves of each picture, (n, 2) px; circle: (x, y, radius), px."""
    height, width = size
    x, y = center or (circle[:2] if circle else ((width - 1) / 2, (height - 1) / 2))
    radius = circle[2] if circle else min(x, y, width - 1 - x, height - 1 - y) + 0.5
    pieces, picture = [], []
    for number, of_picture in enumerate(curves):
        for curve in of_picture[:MOST]:
            points = curve[: len(curve) // STEP * STEP].reshape(-1, STEP, 2).mean(1)
            at_rim = circle and (np.hypot(*(points - circle[:2]).T) > 0.98 * radius).mean() > 0.1
            if len(points) > 3 and not at_rim:
                pieces.append(points / radius)
                picture.append(number)
    about = 1e-4 if center else 0.01 if len(pieces) > ENOUGH and not circle else 0.002
    known = np.array((x / radius, y / radius, about)), fov and fov / 2
    _check(len(pieces))
    found = _search(_Lines(pieces, np.array(picture), radius, *known))
    best = found[0]
    oriented = best.oriented_pictures()
    if fov is None and not oriented:
        raise CalibrationError(
            "straight lines alone do not tell the focal length, and no picture has several lines "
            "in two orthogonal directions: give other pictures, or the image circle's field of view"
        )
    raw, last = best.lens(size), best.rho.max()
    theta = raw.unproject(min(radius * last, raw.r_max.item()))
    kind, terms = ("OCam", 2) if model == "Division" else (model, min(MODELS[model].terms, 2))
    for part in (1.0, 0.95, 0.9, 0.85, 0.8):  # some models do not reach the corners of pictures
        try:
            lens, error = fit(kind, raw.with_theta_max(part * theta), terms=terms)
            break
        except ValueError as reason:
            if part == 0.8:
                raise CalibrationError(
                    f"no {model} lens is close to what the lines show: give more pictures, or "
                    "try another model"
                ) from reason
    lens = lens.with_theta_max(None)
    rim = lens.unproject(min(radius, lens.r_max.item())).item()
    if rim < NARROWEST:
        raise CalibrationError("the lines do not determine a lens: give more pictures")
    lens = lens.with_theta_max(rim if circle else reach(lens))
    sigma, rims = 0.0 if fov else best.deviation(), [rim, *(f.rim for f in found)]
    low, high = min(rims) - sigma, max(rims) + sigma
    covered = len(np.unique(np.minimum(20 * best.rho, 19).astype(int))) / 20
    source = f"orthogonal directions in {oriented} of {len(curves)} pictures set the scale"
    verdict = (
        f"{len(best.normal)} straight curves over {covered:.0%} of the radius support this lens, "
        f"and {'the given field of view sets the scale' if fov else source}: "
        "{:.1f}° at the rim, between {:.1f}° and {:.1f}°".format(*np.degrees((rim, low, high)))
    )
    doubts = {
        "the pictures allow very different lenses: give more of them": high - low
        > 2 * UNSURE * rim,
        f"{model} is up to {error.item():.1f} px from what the lines show": error.item() > OFF,
        f"no line is beyond {last:.0%} of the radius, where the lens is a guess": last < COVERED,
    }
    said = tuple(doubt for doubt, holds in doubts.items() if holds)
    return Estimate(lens, rim, radius, (low, high), len(best.normal), covered, verdict, said)


def _check(count: int) -> None:
    if count < FEWEST:
        raise CalibrationError(
            f"only {count} curves may be straight lines, but an estimate needs {FEWEST}: "
            "give more pictures, or some of rooms, houses or streets"
        )


class _Lines:
    """The curves of all pictures, in radii of the image, and what is known of the lens.

    A lens is v = (log h₀, a₁, a₂, a₃, x, y), with tan θ = ρ / (h₀ (1 + a₁ ρ² + a₂ ρ⁴ + a₃ ρ⁶))
    at the distance ρ from the centre (x, y). center: (x, y, standard deviation); rim: θ at ρ = 1.
    """

    def __init__(
        self, pieces: list[np.ndarray], picture: np.ndarray, scale: float, center: np.ndarray,
        rim: float | None,
    ):  # fmt: skip
        self.pieces, self.picture, self.scale, self.center = pieces, picture, scale, center
        self.rim, self.points = rim, np.concatenate(pieces)
        self.counts = np.array([len(piece) for piece in pieces])
        self.of = {p: np.nonzero(picture == p)[0] for p in np.unique(picture).tolist()}

    def some(self, keep: np.ndarray) -> "_Lines":
        kept = [piece for piece, k in zip(self.pieces, keep, strict=True) if k]
        return _Lines(kept, self.picture[keep], self.scale, self.center, self.rim)

    def unusual(self, v: np.ndarray) -> np.ndarray:
        """How far a lens is from usual ones, and from what is known."""
        bend, about = abs(v[1]), (v[4:] - self.center[:2]) / self.center[2]
        # Usual shapes are between those of stereographic and equidistant lenses.
        second = (v[2] + 0.1 * bend**2) / (0.5 * bend**2 + 0.02)
        third = (v[3] + 0.03 * bend**3) / (0.3 * bend**3 + 0.005)
        off = 0.0 if self.rim is None else 1e4 * (_rim(v) - self.rim)
        return np.array((10 * second, 10 * third, *3 * about, off))


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


class _Seen:
    """What a lens v sees: the plane through the camera that is closest, in px, to each curve.

    Attributes: miss: px, of the points; straightness: (C,) px², its mean square for each curve;
    normal: (C, 3), of the planes. After `orient`, axes: three orthogonal directions (3, 3) of each
    picture; apart: (C,), the root of the sum of squares, px, that the nearest direction adds to a
    curve; nearest: (C,), its number; cost, and rows of the least-squares problem.
    """

    def __init__(self, lines: _Lines, v: np.ndarray, like: "_Seen | None" = None):
        self.lines, self.v = lines, v
        self.normal: np.ndarray
        offset = lines.points - v[4:]
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
        if like is not None:  # a plane has two normals
            sign = np.sign((self.own[:, :, 0] * like.normal).sum(1) + 1e-9)
            self.own *= sign[:, None, None]
            self.miss *= sign.repeat(lines.counts)
        self.normal, self.spread = self.own[:, :, 0], np.maximum(spread[:, 1:], 1e-9)

    @property
    def rim(self) -> float:
        return _rim(self.v)

    def from_directions(self, directions: np.ndarray, of: np.ndarray) -> np.ndarray:
        """`apart`, with a sign, of curves (K,) from directions (..., 3); (K, ...)."""
        part = np.tensordot(self.own[of], directions, ((1,), (-1,)))
        spread = self.spread[of].reshape(len(of), 2, *[1] * (directions.ndim - 1))
        return part[:, 0] / np.sqrt((part[:, 1:] ** 2 / spread).sum(1) + 1e-30)

    def best_axes(self, of: np.ndarray) -> tuple[float, np.ndarray]:
        """The directions that suit the curves of a picture, and their cost, by trying those of
        pairs of long curves."""
        counts = self.lines.counts[of]
        normal = self.normal[of[np.argsort(-counts, kind="stable")[:11]]]
        i, j = np.triu_indices(len(normal), 1)
        first = _unit(np.cross(normal[i], normal[j]))[:, None]
        second = _unit(np.cross(first, normal))
        first = np.broadcast_to(first, second.shape)
        axes = np.stack((first, second, np.cross(first, second)), -2).reshape(-1, 3, 3)
        apart = np.abs(self.from_directions(axes, of)).min(-1).T
        cost = np.minimum(apart**2, counts).sum(1)
        return cost.min(), axes[cost.argmin()]

    def turned(self, axes: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Directions near `axes` that fit the curves of a picture better."""
        for _ in range(2):
            all_ = self.from_directions(axes, of)
            nearest = np.abs(all_).argmin(1)
            apart, nearest = all_[np.arange(len(of)), nearest], axes[nearest]
            sine = (self.normal[of] * nearest).sum(1)
            weight = apart / np.where(np.abs(sine) > 1e-12, sine, 1)
            weight /= 1 + apart**2 / self.lines.counts[of]
            rows = weight[:, None] * np.cross(nearest, self.normal[of])
            turn = np.linalg.lstsq(rows, -weight * sine, rcond=1e-6)[0]
            turn /= max(1, 10 * np.linalg.norm(turn))
            u, _, vh = np.linalg.svd(axes + np.cross(turn, axes))
            axes = u @ vh
        return axes

    def orient(self, axes: dict[int, np.ndarray], like: "_Seen | None" = None) -> "_Seen":
        """Itself with all attributes, from directions nearby; `rows` have the weights of `like`."""
        counts = self.lines.counts
        self.axes = {p: self.turned(near, self.lines.of[p]) for p, near in axes.items()}
        self.apart, self.nearest = np.zeros(len(counts)), np.full(len(counts), -1)
        for p, found in self.axes.items():
            of = self.lines.of[p]
            apart = self.from_directions(found, of)
            self.nearest[of] = np.abs(apart).argmin(1)
            self.apart[of] = apart[np.arange(len(of)), self.nearest[of]]
        # A curve that misses its plane or its direction by more than 1 px counts little.
        unusual, turned = self.lines.unusual(self.v), self.apart**2 / counts
        bent, turned = (square / (1 + square) for square in (self.straightness, turned))
        self.cost = (counts * (bent + ORTHOGONAL * turned)).sum() + (unusual**2).sum()
        like = like or self
        bends = (self.miss / (1 + like.straightness).repeat(counts)), unusual
        turns = math.sqrt(ORTHOGONAL) * self.apart / (1 + like.apart**2 / counts)
        self.rows = np.concatenate((*bends, turns))
        return self

    def refined(self, steps: int) -> "_Seen":
        """The lens nearby with the least cost, by the Levenberg–Marquardt method."""
        found, damping = self, 1e-3
        for _ in range(steps):
            best, before = found, found.cost

            def at(v: np.ndarray, best: _Seen = best) -> _Seen:
                return _Seen(best.lines, v, best).orient(best.axes, best)

            rows = at(best.v).rows
            moved = [at(best.v + step).rows - rows for step in 1e-5 * np.eye(6)]
            slopes = np.stack(moved, 1) / 1e-5
            square, slope = slopes.T @ slopes, slopes.T @ rows
            while damping < 1e6 and found is best:
                damped = square + damping * np.diag(np.diag(square) + 1e-9)
                trial = at(best.v - np.linalg.solve(damped, slope))
                found = trial if trial.cost < before else best
                damping *= 10 if found is best else 0.1
            if found.cost > (1 - 1e-4) * before:
                break
        return found

    def oriented_pictures(self) -> int:
        """The number of pictures with several lines in each of two orthogonal directions."""
        along = np.where(self.apart**2 < self.lines.counts, self.nearest, -1)
        return sum(
            sum(int((along[of] == k).sum() > 2) for k in range(3)) > 1
            for of in self.lines.of.values()
        )

    def deviation(self) -> float:
        """The standard deviation of the rim, rad, by the jackknife over groups of curves."""
        lines, of = self.lines, self.lines.picture
        group = (of if len(lines.of) >= GROUPS else np.arange(len(of))) % GROUPS
        depths = math.exp(self.v[0]) * np.geomspace(0.7, 1.4, 9)
        rims = [_round(lines.some(group != k), self.v, depths)[0].rim for k in range(GROUPS)]
        return math.sqrt((GROUPS - 1) * np.var(rims))

    def lens(self, size: tuple[int, int]) -> OCam:
        """As a lens for pictures of (H, W)."""
        scale, h, (a, b, c) = self.lines.scale, math.exp(self.v[0]), self.v[1:4]
        numbers = [-h * scale, 0, -h * a / scale, 0, -h * b / scale**3, 0, -h * c / scale**5]
        center = torch.from_numpy(scale * self.v[4:])
        return OCam(torch.tensor(numbers, dtype=torch.float64), center=center, image_size=size)


def _search(lines: _Lines) -> list[_Seen]:
    """The lenses that fit nearly best, the best first."""
    # First the shape alone, like that of stereographic or of equidistant lenses.
    shapes = [(a, c * a**2 / -5, c * a**3 * 2 / 35) for a in BENDS for c in (0, 1)]
    tried = [_Seen(lines, np.array((0, *shape, *lines.center[:2]))) for shape in shapes]
    v = min(tried, key=lambda t: (lines.counts * np.minimum(t.straightness, 1)).sum()).v
    for _ in range(2):
        straight = _Seen(lines, v).straightness < 1
        _check(straight.sum())
        fits = _round(lines.some(straight), v, DEPTHS)
        v = fits[0].v
    return [f for f in fits if f.cost <= AS_GOOD * fits[0].cost]


def _round(lines: _Lines, v: np.ndarray, depths: np.ndarray) -> list[_Seen]:
    """The best lenses from a search with any of the depths, the best first."""
    starts, costs = [], []
    for depth in depths:
        start = _Seen(lines, np.array((math.log(depth), *v[1:])))
        found = {p: start.best_axes(of) for p, of in lines.of.items() if len(of) >= 3}
        starts.append((start, {p: axes for p, (_, axes) in found.items()}))
        costs.append(sum(cost for cost, _ in found.values()))
    lows = [k for k in range(len(costs)) if costs[k] == min(costs[max(k - 2, 0) : k + 3])]
    if lines.rim is not None:
        lows = [int(np.argmin([abs(start.rim - lines.rim) for start, _ in starts]))]
    lows = sorted(lows, key=lambda k: costs[k])[:3]
    fits = [starts[k][0].orient(starts[k][1]).refined(5) for k in lows]
    least = min(f.cost for f in fits)
    return sorted((f.refined(30) for f in fits if f.cost < 1.3 * least), key=lambda f: f.cost)
