"""A lens from ordinary pictures: from curves that are straight and often orthogonal in the world.

The rays of a straight line lie in a plane. That determines the curve of a lens up to a factor of
tan θ, because the map (x, y, z) → (x, y, s z) of rays keeps planes. Rooms, houses and streets
have three orthogonal directions; they determine the factor, or the field of view does.

Source: Devernay and Faugeras, MVA 2001; Coughlan and Yuille, ICCV 1999.
"""

import math, os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch

from darswin.calibrate import edges
from darswin.calibrate.errors import CalibrationError
from darswin.lens import OCam, fit, to_dict
from darswin.lens.base import MODELS, Lens
from darswin.lens.files.load import reach

MOST, FEWEST = 120, 10  # curves of a picture; of all
TOLS = [float(x) for x in os.environ.get('TOLS','1,1').split(',')]
STEP = 4  # points of an edge that are averaged
NEAR = 1.0  # px: a curve that misses its plane or direction by more counts little
ORTHOGONAL = 4.0  # the weight of directions, compared with straightness
BENDS = np.linspace(-2.0, 0.3, 47)  # a₁ of the first search
DEPTHS = np.geomspace(0.12, 4.0, 40)  # h₀ of the first search
# Standard deviations of a₁, a₂, a₃ and of the centre, for few curves.
USUAL = np.array([3.0, 0.5, 0.2, 0.01, 0.01])
import os
PRIOR = 3.0 / USUAL * np.array([1,1,1,*[float(os.environ.get("CP","1"))]*2])
GROUPS = 8  # of curves, each of which is left out once


@dataclass(frozen=True)
class Estimate:
    """A lens from pictures without a board.

    Attributes:
        lens: one lens in float64.
        rim: θ, rad, at `radius`, px: at the image circle, or at the nearest side without one.
        interval: rad, the θ at the rim that the pictures allow: one standard deviation on each
            side, and all answers that are nearly as good.
        curves: the number of curves that are straight with this lens.
        covered: the part of the radius, in [0, 1], that they cover.
        verdict: how well they support the lens, in one sentence. doubts: further sentences.
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
        """All of it as a JSON object, with the lens as `darswin.lens.to_dict` describes it."""
        return vars(self) | {"lens": to_dict(self.lens)}


class _Curves:
    """The curves of all pictures, and how a radial lens sees them.

    A lens is a vector v = (log h₀, a₁, a₂, a₃, x, y): tan θ = ρ / h₀ (1 + a₁ ρ² + a₂ ρ⁴ + a₃ ρ⁶),
    with ρ the distance from the centre (x, y), both in radii of the image.
    """

    def __init__(self, points: list[np.ndarray], picture: Sequence[int]):
        self.points, self.picture = np.concatenate(points), np.array(picture)
        self.counts = np.array([len(p) for p in points])
        self.starts = np.cumsum(self.counts) - self.counts

    def some(self, keep: np.ndarray) -> "_Curves":
        pieces = np.split(self.points, self.starts[1:])
        return _Curves([p for p, k in zip(pieces, keep, strict=True) if k], self.picture[keep])

    def radii(self, v: np.ndarray) -> np.ndarray:
        return np.linalg.norm(self.points - v[4:], axis=1)

    def planes(self, v: np.ndarray, scale: float, like: np.ndarray | None = None) -> "_Planes":
        """The planes through the camera that are closest to curves in px; `scale`: px of ρ = 1."""
        offset, rho = self.points - v[4:], np.maximum(self.radii(v), 1e-9)
        theta, slope = _angles(v, rho)
        sin, cos, unit = np.sin(theta), np.cos(theta), offset / rho[:, None]
        ray = np.column_stack((sin[:, None] * unit, cos))
        # The derivatives of rays along and across the radius, per px.
        along = np.column_stack((cos[:, None] * unit, -sin)) * (slope / scale)[:, None]
        across = np.column_stack((-unit[:, 1], unit[:, 0], 0 * rho)) * (sin / rho / scale)[:, None]
        outer = (ray[:, :, None] * ray[:, None]).reshape(-1, 9)
        weight = scale**2 / (slope * sin / rho)
        for _ in range(3):
            scatter = np.add.reduceat(weight[:, None] * outer, self.starts).reshape(-1, 3, 3)
            spread, axes = np.linalg.eigh(scatter)
            normal = np.repeat(axes[:, :, 0], self.counts, 0)
            weight = 1 / ((normal * along).sum(1) ** 2 + (normal * across).sum(1) ** 2)
        if like is not None:  # a plane has two normals
            axes *= np.sign((axes[:, :, 0] * like).sum(1) + 1e-9)[:, None, None]
            normal = np.repeat(axes[:, :, 0], self.counts, 0)
        miss = (normal * ray).sum(1) * np.sqrt(weight)
        return _Planes(self, miss, axes, np.maximum(spread, 1e-9))


def _angles(v: np.ndarray, rho: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """θ at ρ, and its derivative."""
    s = rho * rho
    depth = math.exp(v[0]) * (1 + s * (v[1] + s * (v[2] + s * v[3])))
    deepens = math.exp(v[0]) * 2 * s * (v[1] + s * (2 * v[2] + s * 3 * v[3]))
    return np.arctan2(rho, depth), np.maximum((depth - deepens) / (s + depth**2), 1e-3)


class _Planes:
    """Planes of C curves. miss: (N,) px of points; normal: (C, 3), unit."""

    def __init__(self, curves: _Curves, miss: np.ndarray, axes: np.ndarray, spread: np.ndarray):
        self.curves, self.miss, self.axes, self.spread = curves, miss, axes, spread
        self.normal = axes[:, :, 0]
        self.straightness = np.add.reduceat(miss**2, curves.starts) / curves.counts  # px²

    def from_directions(self, directions: np.ndarray, of: np.ndarray) -> np.ndarray:
        """By how much curves (K,) miss vanishing points (..., 3): the root of the sum of squares,
        px, that turning their planes into these directions adds; (K, ...)."""
        part = np.tensordot(self.axes[of], directions, ((1,), (-1,)))
        spread = self.spread[of][:, 1:].reshape(len(of), 2, *[1] * (directions.ndim - 1))
        return part[:, 0] / np.sqrt((part[:, 1:] ** 2 / spread).sum(1) + 1e-30)

    def axes_of(self, of: np.ndarray) -> tuple[float, np.ndarray]:
        """The cost of curves (K,) of a picture with the best three orthogonal directions, (3, 3)."""
        counts = self.curves.counts[of][:, None]
        normal = self.normal[of[np.argsort(-counts[:, 0], kind="stable")[:11]]]
        i, j = np.triu_indices(len(normal), 1)
        first = _unit(np.cross(normal[i], normal[j]))[:, None]
        second = _unit(np.cross(first, normal))
        first = np.broadcast_to(first, second.shape)
        axes = np.stack((first, second, np.cross(first, second)), -2).reshape(-1, 3, 3)
        miss = np.abs(self.from_directions(axes, of)).min(-1)
        cost = (counts * np.minimum(miss**2 / counts, 1)).sum(0)
        return cost.min(), axes[cost.argmin()]

    def turned(self, axes: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The directions near `axes` that fit best, and the `from_directions` of the nearest."""
        counts = self.curves.counts[of]
        for step in range(3):
            all_ = self.from_directions(axes, of)
            nearest = np.abs(all_).argmin(1)
            miss = np.take_along_axis(all_, nearest[:, None], 1)[:, 0]
            if step == 2:
                break
            d = axes[nearest]
            sine = (self.normal[of] * d).sum(1)
            factor = miss / np.where(np.abs(sine) > 1e-12, sine, 1.0)
            factor /= 1 + miss**2 / counts / NEAR**2
            rows = factor[:, None] * np.cross(d, self.normal[of])
            turn = np.linalg.lstsq(rows, -factor * sine, rcond=1e-6)[0]
            turn *= min(1.0, 0.1 / (np.linalg.norm(turn) + 1e-12))
            u, _, vh = np.linalg.svd(axes + np.cross(turn, axes))
            axes = u @ vh
        return axes, miss


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


@dataclass(frozen=True)
class _Fit:
    """A lens v, the directions of pictures, and the cost."""

    v: np.ndarray
    axes: dict[int, np.ndarray]
    cost: float
    rows: np.ndarray
    planes: _Planes
    apart: np.ndarray

    @property
    def rim(self):
        return float(_angles(self.v, np.ones(1))[0][0])


class _Problem:
    def __init__(self, curves: _Curves, scale: float, rim: float | None = None):
        self.curves, self.scale, self.rim = curves, scale, rim

    def at(self, v, axes, like: _Fit | None = None, prior=None) -> _Fit:
        """weights of like"""
        planes = self.curves.planes(v, self.scale, None if like is None else like.planes.normal)
        counts = self.curves.counts
        apart, turned = np.zeros(len(counts)), {}
        for picture, near in axes.items():
            of = np.nonzero(self.curves.picture == picture)[0]
            turned[picture], apart[of] = planes.turned(near, of)
        source = planes, apart
        if like is not None:
            source = like.planes, like.apart
        w1 = 1 / (1 + source[0].straightness / NEAR**2)
        w2 = math.sqrt(ORTHOGONAL) / (1 + source[1] ** 2 / counts / NEAR**2)
        rows = [np.repeat(w1, counts) * planes.miss, w2 * apart, PRIOR * (v[1:] - self.prior)]
        rim = float(_angles(v, np.ones(1))[0][0])
        if self.rim is not None:
            rows.append(np.array([1e4 * (rim - self.rim)]))
        rows = np.concatenate(rows)
        cost = (counts * planes.straightness / (1 + planes.straightness / NEAR**2)).sum()
        cost += ORTHOGONAL * (apart**2 / (1 + apart**2 / counts / NEAR**2)).sum()
        cost += (rows[len(planes.miss) + len(apart):] ** 2).sum()
        return _Fit(v, turned, cost, rows, planes, apart)

    def refine(self, v, axes, steps=30):
        found = self.at(v, axes)
        damp = 1e-3
        for _ in range(steps):
            base = self.at(found.v, found.axes, found)
            J = np.stack([(self.at(found.v + 1e-5 * e, found.axes, base).rows - base.rows) / 1e-5 for e in np.eye(6)], 1)
            H, g = J.T @ J, J.T @ base.rows
            before = found.cost
            while damp < 1e6:
                step = np.linalg.solve(H + damp * np.diag(np.diag(H) + 1e-9), g)
                trial = self.at(found.v - step, found.axes)
                if trial.cost < found.cost:
                    found, damp = trial, max(damp / 10, 1e-9)
                    break
                damp *= 10
            if found.cost > (1 - 1e-4) * before:
                break
        self.n = _ + 1
        return found


def solve(curves, scale, center, fov=None, verbose=False):
    """basins sorted"""
    global NEAR
    NEAR = 1.0
    v = np.array([0, 0, 0, 0, *center])
    costs = []
    for a, c in [(a, c) for a in BENDS for c in (0, 1) if a < 0 or c == 0]:
        v[1:4] = a, -c * a**2 / 5, c * 2 * a**3 / 35
        p = curves.planes(v, scale)
        cost = (curves.counts * np.minimum(p.straightness / NEAR**2, 1)).sum()
        costs.append((cost if a * curves.radii(v).max() ** 2 < 0.9 else np.inf, v.copy()))
    v = min(costs, key=lambda x: x[0])[1]
    if verbose: print(v)
    everything = curves
    for NEAR in TOLS:
        good = everything.planes(v, scale).straightness < NEAR**2
        curves = everything.some(good)
        problem = _Problem(curves, scale, fov)
        problem.prior = np.array([0, 0, 0, *center])
        starts = []
        for h in DEPTHS:
            w = v.copy(); w[0] = math.log(h)
            p = curves.planes(w, scale)
            total, axes = 0, {}
            for picture in np.unique(curves.picture):
                of = np.nonzero(curves.picture == picture)[0]
                if len(of) >= 3:
                    cost, axes[picture] = p.axes_of(of)
                    total += cost
            starts.append((total, w, axes))
        total = np.array([s[0] for s in starts])
        lows = [k for k in range(len(total)) if total[k] == total[max(k - 2, 0) : k + 3].min()]
        lows = sorted(lows, key=lambda k: total[k])[:3]
        fits = sorted((problem.refine(*starts[k][1:], steps=5) for k in lows), key=lambda f: f.cost)
        fits = [problem.refine(f.v, f.axes) for f in fits if f.cost < 1.3 * fits[0].cost]
        fits = sorted(fits, key=lambda f: f.cost)
        if verbose:
            print("  ", [(round(math.degrees(f.rim), 1), round(f.cost), f.v.round(3).tolist()) for f in fits])
        v = fits[0].v
    return problem, fits


def ocam(v, scale, size):
    h = scale * math.exp(v[0])
    a = [-h, 0, -h * v[1] / scale**2, 0, -h * v[2] / scale**4, 0, -h * v[3] / scale**6]
    return OCam(torch.tensor([a], dtype=torch.float64), center=torch.tensor(scale * v[4:]), image_size=size)
