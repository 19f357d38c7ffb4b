"""Curves that are straight in the world, and the planes through the camera that are closest."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from darswin.lens import OCam

TOLERANCE = 0.3, 1 / 800  # px, at least, and of the radius: by which a line misses
STRAIGHT = 3.0  # times TOLERANCE: curves that miss by more are not lines
ORTHOGONAL = 4.0  # the weight of directions, compared with straightness
LONGEST, LIKELY = 12, 5  # curves, and their directions that are looked into
WEIGHT, USUAL = 4.0, 0.5  # of what is unusual, and its standard deviation
OBLONG, SQUARE = 0.003, 0.02  # |q|, as usual, and of pixels that a lens takes for square
RHO = np.linspace(0.05, 1, 20)  # of the radius: where curves are compared


class Lines:
    """The curves of all pictures, in radii of the image, and what is known of the lens.

    A lens is v = (log h₀, a₁, a₂, a₃, x, y, q), with tan θ = ρ / (h₀ (1 + a₁ ρ² + a₂ ρ⁴ + a₃ ρ⁶))
    at the distance ρ from the centre (x, y), where a unit has exp q times as many px along x as
    along y. scale: of a radius, in units of TOLERANCE; center: (x, y, standard deviation); rim: θ
    at ρ = 1; weight: of what is `unusual`.
    """

    def __init__(
        self, pieces: list[np.ndarray], picture: np.ndarray, scale: float, center: np.ndarray,
        rim: float | None, weight: float = WEIGHT,
    ):  # fmt: skip
        self.pieces, self.picture, self.scale, self.center = pieces, picture, scale, center
        self.rim, self.weight, self.points = rim, weight, np.concatenate(pieces)
        self.counts = np.array([len(piece) for piece in pieces])
        self.of = {p: np.nonzero(picture == p)[0] for p in np.unique(picture).tolist()}

    def some(self, keep: np.ndarray, weight: float = WEIGHT) -> "Lines":
        kept = [piece for piece, k in zip(self.pieces, keep, strict=True) if k]
        return Lines(kept, self.picture[keep], self.scale, self.center, self.rim, weight)

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


class Planes:
    """For a lens v, the plane through the camera that is closest, in px, to each curve.

    In units of TOLERANCE: miss, of the points; straightness: (C,), its mean square for each curve.
    normal: (C, 3), of the planes, with the signs of `like`. After `orient`, axes: three orthogonal
    directions (3, 3) of each picture; along: (C,), the number of a curve's direction, or -1; agree:
    in [0, 1], how many have one; rows of the least-squares problem; cost.
    """

    def __init__(self, lines: Lines, v: np.ndarray, like: np.ndarray | float = 1.0):
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

    def orient(self, axes: dict[int, np.ndarray] | None = None) -> "Planes":
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

    def moved(self, step: np.ndarray | float) -> "Planes":
        return Planes(self.lines, self.v + step, self.normal).orient(self.axes)

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """Its rows and their derivatives, (rows, 7)."""
        rows = self.moved(0).rows
        return rows, np.stack([self.moved(d).rows - rows for d in 1e-5 * np.eye(7)], 1) / 1e-5

    def refined(self, steps: int = 30, free: Sequence[int] = range(7)) -> "Planes":
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
        sides = torch.tensor([self.v[6] / 2, -self.v[6] / 2], dtype=torch.float64).exp()
        affine = sides.diag() if abs(self.v[6]) > SQUARE else None
        center = torch.from_numpy(radius * self.v[4:6])
        return OCam(numbers, center=center, affine=affine, image_size=size)


def _robust(apart: np.ndarray, counts: np.ndarray) -> np.ndarray:
    return apart**2 / (1 + apart**2 / counts)
