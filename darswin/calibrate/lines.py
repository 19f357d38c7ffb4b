"""PROTO"""

import math
import numpy as np
import torch

from darswin.calibrate import edges
from darswin.lens import MODELS, Lens, OCam, fit

STEP = 4  # px
MOST = 120  # curves per picture
NEAR = 1.0  # px


class Bundle:
    """Curves of all pictures."""

    def __init__(self, curves, picture):
        means = [c[: len(c) // STEP * STEP].reshape(-1, STEP, 2).mean(1) for c in curves]
        self.points = np.concatenate(means)
        self.counts = np.array([len(m) for m in means])
        self.starts = np.concatenate(([0], np.cumsum(self.counts)[:-1]))
        self.picture = np.asarray(picture)

    def some(self, keep):
        pieces = np.split(self.points, self.starts[1:])
        new = object.__new__(Bundle)
        kept = np.nonzero(keep)[0]
        new.points = np.concatenate([pieces[k] for k in kept])
        new.counts = self.counts[kept]
        new.starts = np.concatenate(([0], np.cumsum(new.counts)[:-1]))
        new.picture = self.picture[kept]
        return new

    def planes(self, theta, slope, offset):
        """residual (N,), vectors (C,3,3), values (C,3)"""
        r = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        u = offset / r[:, None]
        sin, cos = np.sin(theta), np.cos(theta)
        ray = np.column_stack((sin[:, None] * u, cos))
        along = np.column_stack((cos[:, None] * u, -sin)) / slope[:, None]
        across = np.column_stack((-u[:, 1], u[:, 0], 0 * r)) * (sin / r)[:, None]
        weight = slope * r / sin
        outer = (ray[:, :, None] * ray[:, None, :]).reshape(-1, 9)
        for _ in range(3):
            scatter = np.add.reduceat(weight[:, None] * outer, self.starts).reshape(-1, 3, 3)
            values, vectors = np.linalg.eigh(scatter)
            normal = np.repeat(vectors[:, :, 0], self.counts, 0)
            weight = 1 / ((normal * along).sum(1) ** 2 + (normal * across).sum(1) ** 2)
        residual = (normal * ray).sum(1) * np.sqrt(weight)
        return residual, vectors, values

    def rms2(self, residual):
        return np.add.reduceat(residual**2, self.starts) / self.counts


def misses(vectors, values, directions):
    """D² (C, ...) of directions (..., 3)"""
    part = np.tensordot(vectors, directions, (1, -1))  # (C, 3, ...)
    part = part**2
    spread = (part[:, 1:] / np.maximum(values[:, 1:], 1e-12).reshape(values.shape[0], 2, *[1] * (part.ndim - 2))).sum(1)
    return part[:, 0] / np.maximum(spread, 1e-30)


def frames_of(vectors, values, counts, tol):
    """best R (3,3) rows d_k and the cost."""
    normal = vectors[:, :, 0]
    top = np.argsort(-counts)[:14]
    i, j = np.triu_indices(len(top), 1)
    first = np.cross(normal[top[i]], normal[top[j]])
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(first[:, None], normal[top][None])  # (P, T, 3)
    second /= np.maximum(np.linalg.norm(second, axis=-1, keepdims=True), 1e-12)
    first = np.broadcast_to(first[:, None], second.shape)
    third = np.cross(first, second)
    R = np.stack((first, second, third), -2).reshape(-1, 3, 3)
    d2 = misses(vectors, values, R) / (counts * tol**2)[:, None, None]
    cost = (counts[:, None] * np.minimum(d2.min(-1), 1)).sum(0)
    best = cost.argmin()
    return R[best], cost[best]


def refine_frame(vectors, values, counts, R, tol, steps=4):
    for _ in range(steps):
        d2 = misses(vectors, values, R)
        k = d2.argmin(1)
        miss2 = d2[np.arange(len(k)), k]
        rho = 1 / (1 + miss2 / (counts * tol**2)) ** 2
        d = R[k]
        e0 = (vectors[:, :, 0] * d).sum(1)
        q = miss2 / np.maximum(e0**2, 1e-30)
        row = np.cross(d, vectors[:, :, 0])
        w = rho * q
        H = (row * w[:, None]).T @ row + 1e-9 * np.eye(3) * (w.sum() + 1e-30)
        om = -np.linalg.solve(H, (row * (w * e0)[:, None]).sum(0))
        om *= min(1, 0.1 / (np.linalg.norm(om) + 1e-12))
        R = R + np.cross(om, R)
        u, _, vt = np.linalg.svd(R)
        R = u @ vt
    d2 = misses(vectors, values, R)
    k = d2.argmin(1)
    miss2 = d2[np.arange(len(k)), k]
    return R, miss2, k


def division(r, h0, lam):
    h = h0 * (1 + lam * r * r)
    theta = np.arctan2(r, h)
    slope = (r * r + h * h) / np.maximum(h0 * (1 - lam * r * r), 1e-9)
    return theta, slope


def start(b, center, R, tol=NEAR, verbose=False):
    offset = b.points - center
    r = np.linalg.norm(offset, axis=1)
    grid = np.linspace(-2.0, 0.3, 93)
    costs = []
    for a in grid:
        lam = a / R**2
        if lam * r.max() ** 2 > 0.9:
            costs.append(np.inf)
            continue
        res, *_ = b.planes(*division(r, R, lam), offset)
        costs.append((b.counts * np.minimum(b.rms2(res) / tol**2, 1)).sum())
    a = grid[int(np.argmin(costs))]
    res, vectors, values = b.planes(*division(r, R, a / R**2), offset)
    good = b.rms2(res) < tol**2
    if verbose:
        print("a", a, "good", good.sum(), len(good), b.counts[good].sum() / b.counts.sum())
    return a, good


def scale(b, center, R, a, tol=NEAR):
    offset = b.points - center
    r = np.linalg.norm(offset, axis=1)
    found = []
    for h in np.geomspace(0.12, 4, 45):
        _, vectors, values = b.planes(*division(r, h * R, a / R**2), offset)
        total, Rs = 0, {}
        for p in np.unique(b.picture):
            m = b.picture == p
            if m.sum() < 3:
                continue
            Rp, cost = frames_of(vectors[m], values[m], b.counts[m], tol)
            Rs[p] = Rp
            total += cost
        found.append((total, h, Rs))
    return found
