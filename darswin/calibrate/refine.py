"""The refinement of a calibration: the lens and all poses together, by robust least squares.

Levenberg–Marquardt steps in float64 on the distances of corners in pixels. A pose touches its own
picture only, so the poses are eliminated first (the Schur complement).
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.lens import Lens, OCam, OCamInverse, Tabulated
from darswin.lens.fitting import Packing, slopes_of
from darswin.lens.solve import length_of

ROUNDS = 30
SCALE = 3.0  # of the Cauchy loss, in standard deviations of a corner
OFF = 6.0  # standard deviations: a corner this far off does not fit
SHARPEST = 0.05  # px: no detector finds corners better than this
# The distance that 50 % and 97 % of the corners do not exceed, in standard deviations.
MEDIAN, MOST = (math.sqrt(-2 * math.log(1 - part)) for part in (0.5, 0.97))
# Stages of a refinement: the part of the corners whose largest distance gives the scale; this
# distance in standard deviations; the smallest gain of a round. ROUGH follows the worst corners.
# AGAIN starts where FINE has ended, with a part of the pictures.
ROUGH, FINE, AGAIN = (0.97, MOST, 1e-3), (0.5, MEDIAN, 1e-5), (0.5, MEDIAN, 1e-3)
# More than a model has: the ratio of a pixel's sides; and the shape of a board, by which its points
# (x, y, 0) become (x, (1 + stretch) y, bends · (x², y²)).
PIXELS, BEND, STRETCH = ("affine[3]",), ("bend[0]", "bend[1]"), ("stretch",)
FLAT = torch.zeros(3, dtype=torch.float64)
# The places of numbers that stay as they are; of an affine, all but the ratio of a pixel's sides.
HELD: dict[tuple[type[Lens], str], Any] = {
    (OCam, "coefficients"): [1], (OCamInverse, "coefficients"): [0],
    (Tabulated, "radii"): [0], (Tabulated, "angles"): ...,
}  # fmt: skip


class Free:
    """The free numbers of a lens and of the board as a vector (n,), and the lens of a vector.

    Free are the parameters of the model, the principal point, and those of PIXELS, BEND and STRETCH
    that `more` names, from a `shape` (3,) of the board on. OCam's linear term stays 0, and a
    table's angles stay as they are.
    """

    def __init__(self, lens: Lens, more: Sequence[str] = (), shape: Tensor = FLAT):
        tensors = {n: v for n, v in lens._tensors().items() if n not in lens.common}
        tensors["center"] = lens.center
        held = {name: torch.zeros_like(value[0]).bool() for name, value in tensors.items()}
        for (model, name), places in HELD.items():
            if isinstance(lens, model):
                held[name][places] = True
        if PIXELS[0] in more:
            tensors["affine"] = lens._affine()
            held["affine"] = torch.tensor([[True, True], [True, False]])
        free = ~torch.cat([value.flatten() for value in held.values()])
        names = [
            name + (f"[{k}]" if value.dim() > 1 else "")
            for name, value in tensors.items()
            for k in range(value[0].numel())
        ]
        self.names = [name for name, is_free in zip(names, free, strict=True) if is_free]
        self.model, self.image_size = type(lens), lens.image_size
        self.packing = Packing(self.model, tensors)
        self.low, self.high = self.packing.low[free], self.packing.high[free]
        vector = self.packing.vector(tensors)
        self.start, self._rest = vector[free], torch.where(free, 0, vector)
        self._places = torch.eye(len(vector)).to(vector)[:, free]
        # The lens has no part in the numbers of the board, which come last.
        own = [name for name in (*BEND, *STRETCH) if name in more]
        self.names, self.more = self.names + own, [*more]
        self.shaped = torch.tensor([name in own for name in (*BEND, *STRETCH)])
        self.start = torch.cat((self.start, shape[self.shaped]))
        self._places = F.pad(self._places, (0, len(own)))
        self.low, self.high = (
            F.pad(x, (0, len(own)), value=end)
            for x, end in ((self.low, -math.inf), (self.high, math.inf))
        )

    def tensors(self, vectors: Tensor) -> dict[str, Tensor]:
        """The parameters of the lenses of vectors (B, n)."""
        found = self.packing.tensors(self._rest + vectors @ self._places.T)
        if self.model is OCamInverse:  # r(0) = 0
            slopes = found["coefficients"][:, 1:]
            powers = (-math.pi / 2) ** torch.arange(1, slopes.shape[1] + 1).to(vectors)
            found["coefficients"] = torch.cat((-(slopes * powers).sum(1, keepdim=True), slopes), 1)
        return found | {"image_size": self.image_size}

    def lens(self, vector: Tensor) -> Lens | None:
        """The lens up to its limit; None if there is none."""
        try:
            return self.model(**self.tensors(vector[None]))
        except ValueError:
            return None

    def at(self, vectors: Tensor, theta_max: Tensor) -> Lens:
        """The lenses of vectors (B, n), without checks; differentiable."""
        limits = {"theta_max": theta_max.expand(len(vectors))}
        return self.model._from_tensors(self.tensors(vectors) | limits)

    def slopes(self, vector: Tensor, theta_max: Tensor, rays: Tensor) -> Tensor:
        """(K, 2, n + 3): the derivatives of the pixels of rays (K, 3) by the numbers, and by a turn
        of the rays."""
        count = len(vector)

        def pixels(numbers: Tensor) -> Tensor:
            turned = torch.linalg.cross(*torch.broadcast_tensors(numbers[:, None, count:], rays))
            return self.at(numbers[:, :count], theta_max).project_points(rays + turned)

        return slopes_of(pixels, torch.cat((vector, vector.new_zeros(3))))

    def shape(self, vector: Tensor) -> Tensor:
        """(3,): the shape of the board of a vector (n,)."""
        count = int(self.shaped.sum())
        return vector.new_zeros(3).masked_scatter(self.shaped, vector[len(vector) - count :])

    def held(self, vector: Tensor, side: Tensor) -> Tensor:
        """(n,) bool: the numbers that are at a bound and would leave it in the direction `side`."""
        return ((vector <= self.low) & (side <= 0)) | ((vector >= self.high) & (side >= 0))


def pixels_of(lens: Lens, points: Tensor) -> Tensor:
    """(..., 2) px: where points (..., 3) are seen; those beyond θ_max as if at θ_max, so that no
    corner is lost while the lens changes."""
    aside = length_of(points[..., :2])
    limit = lens._row(lens.theta_max, aside.dim())
    theta = torch.minimum(torch.atan2(aside, points[..., 2]), limit)
    return lens.pixels(theta, points[..., :2] / aside[..., None])


class State(NamedTuple):
    """The free numbers, their lens, the poses of the boards, and the shape of all of them, (3,)."""

    vector: Tensor
    lens: Lens
    rotations: Tensor
    translations: Tensor
    shape: Tensor = FLAT

    def of(self, which: Tensor) -> "State":
        """The state of some pictures."""
        return self._replace(rotations=self.rotations[which], translations=self.translations[which])

    def moved(self, free: Free, steps: Tensor, lens_moves: bool) -> "State | None":
        """The state after steps (P, n + 6); None if it has no lens."""
        count = len(self.vector)
        vector = (self.vector + steps[0, :count]).clamp(free.low, free.high)
        lens = free.lens(vector) if lens_moves else self.lens
        if lens is None:
            return None
        axes = torch.broadcast_tensors(steps[:, None, count:-3], torch.eye(3).to(steps))
        turns = torch.matrix_exp(torch.linalg.cross(*axes).mT)
        shape = free.shape(vector) if lens_moves else self.shape
        return State(vector, lens, turns @ self.rotations, self.translations + steps[:, -3:], shape)


class Views(NamedTuple):
    """What is calibrated from: corners (P, K, 2) px, 0 where not `seen`, (P, K); the board's points
    (K, 3), whose z is 0; and numbers (P,), equal for pictures that show it at one place."""

    corners: Tensor
    seen: Tensor
    board: Tensor
    place: Tensor

    def of(self, which: Tensor) -> "Views":
        """Some of the pictures."""
        return Views(self.corners[which], self.seen[which], self.board, self.place[which])

    @property
    def group(self) -> Tensor:
        """(P,): `place` as numbers from 0 without gaps."""
        return self.place.unique(return_inverse=True)[1]

    def shaped(self, shape: Tensor) -> Tensor:
        """(K, 3): the points of a board with a shape (3,)."""
        return self.board + (self.by_shape() * shape[:, None, None]).sum(0)

    def by_shape(self) -> Tensor:
        """(3, K, 3): the derivatives of the board's points by the numbers of its shape."""
        x, y, z = self.board.unbind(-1)
        bends = torch.stack((x.square(), y.square()))
        slopes = (F.pad(bends[..., None], (2, 0)), torch.stack((z, y, z), -1)[None])
        return torch.cat(slopes)

    def points(self, state: State) -> Tensor:
        """(P, K, 3): the board's points in the camera's frame."""
        return self.shaped(state.shape) @ state.rotations.mT + state.translations[:, None]

    def miss(self, state: State) -> Tensor:
        """(P, K, 2) px: by how much the lens misses the corners; 0 where not seen."""
        off = pixels_of(state.lens, self.points(state)) - self.corners
        return torch.where(self.seen[..., None], off, 0.0)

    def slopes(self, free: Free, state: State) -> Tensor:
        """(P, K, 2, n + 6): the derivatives of the pixels by the free numbers, by the rotation
        vector of each pose in the camera's frame, and by its translation; 0 where not seen."""
        points, count = self.points(state), len(state.vector)

        def pixels(numbers: Tensor) -> Tensor:
            lens = free.at(numbers[:, :count], state.lens.theta_max)
            return pixels_of(lens, points + numbers[:, None, None, count:])

        slopes = slopes_of(pixels, torch.cat((state.vector, state.vector.new_zeros(3))))
        there = self.seen & slopes.isfinite().flatten(2).all(-1)
        slopes = torch.where(there[..., None, None], slopes, 0.0)
        by_point = slopes[..., count:]
        # A turn ω moves a point by ω × turned.
        turned = (self.shaped(state.shape) @ state.rotations.mT)[:, :, None].expand_as(by_point)
        by_turn = torch.linalg.cross(turned, by_point)
        along = torch.einsum("pij,skj->pkis", state.rotations, self.by_shape()[free.shaped])
        slopes[..., count - along.shape[-1] : count] = by_point @ along
        return torch.cat((slopes[..., :count], by_turn, by_point), -1)


class Normal:
    """The normal equations of a step after the poses are eliminated, for slopes (P, K, 2, n + 6),
    misses (P, K, 2) and weights (P, K); numbers of the lens that are held do not move."""

    def __init__(
        self, slopes: Tensor, miss: Tensor, weights: Tensor, free: Free, vector: Tensor,
        lens_moves: bool = True,
    ):  # fmt: skip
        flat = (slopes * weights[..., None, None]).flatten(1, 2)
        self.matrix = flat.mT @ slopes.flatten(1, 2)
        self.side = -(flat.mT @ miss.flatten(1, 2)[..., None])[..., 0]
        self.count = len(vector)
        squares = self.matrix.diagonal(dim1=1, dim2=2)
        self.scale = torch.where(
            torch.arange(squares.shape[1]) < self.count, squares.sum(0), squares
        ).clamp(min=1e-30).rsqrt()  # fmt: skip
        held = free.held(vector, self.side[:, : self.count].sum(0)) | (not lens_moves)
        self.scale[:, : self.count] *= ~held

    def damped(self, damping: float) -> "Normal":
        """The same after elimination, in units in which the diagonals are 1."""
        n = self.count
        matrix = self.scale[:, :, None] * self.matrix * self.scale[:, None]
        side = self.scale * self.side
        # A picture without corners has no equations.
        poses = matrix[:, n:, n:] + (damping + 1e-14) * torch.eye(6).to(matrix)
        self.inverse = torch.cholesky_inverse(torch.linalg.cholesky_ex(poses)[0])
        self.own = (self.inverse @ side[:, n:, None])[..., 0]
        self.follow = -self.inverse @ matrix[:, n:, :n]
        self.lens = matrix[:, :n, :n] + matrix[:, :n, n:] @ self.follow
        self.lens_side = side[:, :n] + (self.follow.mT @ side[:, n:, None])[..., 0]
        self.damping = damping * torch.eye(n).to(matrix)
        return self

    def steps(self, place: Tensor | None = None) -> Tensor:
        """(P, n + 6): the step of the lens, and that of each pose; with `place`, (P,): of a lens
        without the equations of all pictures of the pose's place."""
        matrix, side = self.lens.sum(0) + self.damping, self.lens_side.sum(0)
        if place is not None:
            own, own_side = (
                torch.zeros_like(part).index_add(0, place, part)[place]
                for part in (self.lens, self.lens_side)
            )
            matrix, side = matrix - own, side - own_side
        lens = (_inverse(matrix) @ side[..., None])[..., 0].expand_as(self.lens_side)
        poses = self.own + (self.follow @ lens[..., None])[..., 0]
        return self.scale * torch.cat((lens, poses), 1)

    def covariance(self) -> Tensor:
        """(n + 3, n + 3): of the lens and the mean rotation of the poses, for corners with a
        standard deviation of 1 px."""
        size = self.scale[:, self.count : -3, None]
        both = torch.cat(
            (torch.diag(self.scale[0, : self.count]), (size * self.follow[:, :3]).mean(0))
        )
        joint = both @ _inverse(self.lens.sum(0)) @ both.T
        joint[-3:, -3:] += (size * self.inverse[:, :3, :3] * size.mT).mean(0) / len(size)
        return joint


def _inverse(matrix: Tensor) -> Tensor:
    """The inverse of symmetric matrices (..., n, n); what is not determined is very large."""
    values, vectors = torch.linalg.eigh(matrix)
    values = values.clamp(min=1e-14 * values[..., -1:].clamp(min=1e-14))
    return (vectors / values[..., None, :]) @ vectors.mT


def refine(
    views: Views,
    free: Free,
    state: State,
    lens_moves: bool = True,
    stages: Sequence[tuple[float, float, float]] = (ROUGH, FINE),
) -> tuple[State, float]:
    """The state near a start with the smallest sum of Cauchy losses, and the scale of the loss."""
    sigma = math.inf
    for part, typical, least_gain in stages:
        miss, damping, still = views.miss(state), 1e-3, 0
        for _ in range(ROUNDS):
            distance = miss.norm(dim=-1)[views.seen].quantile(part).item()
            sigma = min(sigma, distance / typical)
            scale = SCALE * max(sigma, SHARPEST)
            before = cost = losses(miss, scale).sum().item()
            slopes, weights = views.slopes(free, state), weights_of(miss, scale)
            normal = Normal(slopes, miss, weights, free, state.vector, lens_moves)
            while damping < 1e10:
                trial = state.moved(free, normal.damped(damping).steps(), lens_moves)
                if trial is not None:
                    trial_miss = views.miss(trial)
                    cost = losses(trial_miss, scale).sum().item()
                    if cost < before:
                        state, miss, damping = trial, trial_miss, max(damping / 10, 1e-12)
                        break
                damping *= 10
            still = still + 1 if cost > (1 - least_gain) * before else 0
            if damping >= 1e10 or still >= 2:
                break
    return state, scale


def weights_of(miss: Tensor, scale: float) -> Tensor:
    """(P, K): the weight of each corner in the Cauchy loss."""
    return 1 / (1 + miss.square().sum(-1) / scale**2)


def losses(miss: Tensor, scale: float) -> Tensor:
    """(P, K): the Cauchy loss of each corner."""
    return (miss.square().sum(-1) / scale**2).log1p()
