"""The refinement of a calibration: the lens and all poses together, by robust least squares.

Levenberg–Marquardt steps in float64 on the distances of corners in pixels. Each pose touches its
own picture only, so poses are eliminated first (the Schur complement).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from darswin.lens import Lens, OCam, OCamInverse, Tabulated
from darswin.lens.fitting import Packing

ROUNDS = 100
LOST = 1e4  # px: the distance of a corner whose ray the lens does not see
SCALE = 3.0  # of the Cauchy loss, in standard deviations of a corner
RAYLEIGH = math.sqrt(2 * math.log(2))  # the median of a corner's distance, in standard deviations
FINEST = 1e-4  # px: the least scale
# The places of numbers that stay as they are.
HELD = {(OCam, "coefficients"): (1,), (OCamInverse, "coefficients"): (0,),
        (Tabulated, "radii"): (0,)}  # fmt: skip


class Free:
    """The free numbers of a lens as a vector (n,), and the lens of a vector.

    Free are the parameters of the model and the principal point; and, unless pixels are square, the
    ratio of their sides. OCam's linear term stays 0, and a table's angles stay as they are.
    """

    def __init__(self, lens: Lens, square_pixels: bool):
        tensors = {n: v for n, v in lens._tensors().items() if n not in lens.common}
        tensors["center"] = lens.center
        if not square_pixels:
            tensors["affine"] = lens._affine()
        self.model, self.image_size = type(lens), lens.image_size
        self.packing = Packing(self.model, tensors)
        self.names, free = [], []
        for name, tensor in tensors.items():
            count = tensor[0].numel()
            self.names += [f"{name}[{k}]" if tensor.dim() > 1 else name for k in range(count)]
            held = HELD.get((self.model, name), ())
            if name in ("angles", "affine"):  # of an affine, the ratio of the sides is free
                held = range(count - (name == "affine"))
            free += [k not in held for k in range(count)]
        self.free = torch.tensor(free)
        self.names = [name for name, is_free in zip(self.names, free, strict=True) if is_free]
        start = self.packing.vector(tensors)
        self.start = start[self.free]
        self.low, self.high = self.packing.low[self.free], self.packing.high[self.free]
        self._rest = torch.where(self.free, 0, start)
        self._places = torch.eye(len(free), dtype=start.dtype)[:, self.free]

    def tensors(self, vector: Tensor) -> dict[str, Tensor | None]:
        found = self.packing.tensors(self._rest + self._places @ vector)
        if self.model is OCamInverse:  # r(0) = 0
            slopes = found["coefficients"][:, 1:]
            powers = (-math.pi / 2) ** torch.arange(1, slopes.shape[1] + 1, dtype=vector.dtype)
            found["coefficients"] = torch.cat((-(slopes * powers).sum(1, keepdim=True), slopes), 1)
        return found | {"image_size": self.image_size}

    def lens(self, vector: Tensor) -> Lens | None:
        """The lens up to its limit; None if there is none."""
        if not bool(vector.isfinite().all()):
            return None
        try:
            return self.model(**self.tensors(vector))
        except ValueError:
            return None

    def held(self, vector: Tensor, side: Tensor) -> Tensor:
        """(n,) bool: the numbers that are at a bound and would leave it, along `side`."""
        return ((vector <= self.low) & (side <= 0)) | ((vector >= self.high) & (side >= 0))

    def pixels(self, vector: Tensor, points: Tensor, theta_max: Tensor) -> Tensor:
        """Where the lens of a vector sees points (..., 3); differentiable."""
        return self.model._from_tensors(
            self.tensors(vector) | {"theta_max": theta_max}
        ).project_points(points)


@dataclass
class Views:
    """What is calibrated from: corners (P, K, 2) px, 0 where not `seen`, (P, K), and the board's
    points (K, 3), whose z is 0."""

    corners: Tensor
    seen: Tensor
    board: Tensor

    def miss(self, lens: Lens | None, rotations: Tensor, translations: Tensor) -> Tensor:
        """(P, K, 2) px: by how much the lens misses the corners; 0 where not seen."""
        if lens is None:
            return torch.full_like(self.corners, math.inf)
        points = self.board @ rotations.mT + translations[:, None]
        off = lens.project_points(points) - self.corners
        lost = off.isnan().any(-1, keepdim=True)
        off = torch.where(lost, LOST, off)
        return torch.where(self.seen[..., None], off, 0.0)


class Equations(NamedTuple):
    """The normal equations of one step, for each picture: of the lens (P, n, n), of the pose
    (P, 6, 6), and between them (P, n, 6); the right sides (P, n) and (P, 6); and the derivatives of
    the pixels, (P, K, 2, n + 6)."""

    lens: Tensor
    poses: Tensor
    mixed: Tensor
    lens_side: Tensor
    pose_side: Tensor
    slopes: Tensor

    def reduced(self, damping: float, held: Tensor) -> "Reduced":
        """The equations of the lens alone; numbers of the lens that are `held` do not move."""
        total = self.lens.sum(0).diagonal().clamp(min=1e-30)
        scale = ~held / total.sqrt()
        size = 1 / self.poses.diagonal(dim1=1, dim2=2).clamp(min=1e-30).sqrt()
        poses = size[:, :, None] * self.poses * size[:, None]
        mixed = scale[:, None] * self.mixed * size[:, None]
        # A picture without corners has no equations.
        poses = poses + (damping + 1e-14) * torch.eye(6).to(scale)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky_ex(poses)[0])
        back = mixed @ inverse
        matrices = scale[:, None] * self.lens * scale - back @ mixed.mT
        sides = self.pose_side * size
        lens_sides = scale * self.lens_side - (back @ sides[..., None])[..., 0]
        return Reduced(scale, size, inverse, back, matrices, sides, lens_sides)


class Reduced(NamedTuple):
    """Each picture's equations of the lens after its pose is eliminated, in units in which the
    diagonals are 1: factors of the lens (n,) and of poses (P, 6), the inverses (P, 6, 6) of the
    poses' matrices, and the products (P, n, 6) with them; matrices (P, n, n); right sides."""

    scale: Tensor
    size: Tensor
    inverse: Tensor
    back: Tensor
    matrices: Tensor
    pose_sides: Tensor
    sides: Tensor

    def step(self, damping: float) -> tuple[Tensor, Tensor]:
        """The steps of the lens (n,) and of the poses (P, 6)."""
        eye = torch.eye(len(self.scale)).to(self.scale)
        step = _inverse(self.matrices.sum(0) + damping * eye) @ self.sides.sum(0)
        return self.scale * step, self.poses(step)

    def poses(self, steps: Tensor) -> Tensor:
        """(P, 6): the steps of the poses that follow from that of the lens, (n,) or (P, n)."""
        own = (self.inverse @ self.pose_sides[..., None])[..., 0]
        steps = steps.expand(len(own), -1)
        return self.size * (own - (self.back.mT @ steps[..., None])[..., 0])

    def without(self) -> tuple[Tensor, Tensor]:
        """The steps of the lens, (P, n), and of each pose, (P, 6), if its picture is left out of
        the lens."""
        rest = _inverse(self.matrices.sum(0) - self.matrices)
        steps = (rest @ (self.sides.sum(0) - self.sides)[..., None])[..., 0]
        return self.scale * steps, self.poses(steps)

    def covariance(self, used: Tensor) -> Tensor:
        """(n + 3, n + 3) of the lens and of the mean rotation of the poses that are `used`, for
        corners with a standard deviation of 1 px."""
        lens = _inverse(self.matrices.sum(0))
        turned = self.size[:, :3, None] * self.back.mT[:, :3]
        follow = -turned[used].mean(0)
        own = self.size[:, :3, None] * self.inverse[:, :3, :3] * self.size[:, None, :3]
        both = torch.cat((torch.diag(self.scale), follow))
        joint = both @ lens @ both.T
        joint[-3:, -3:] += own[used].sum(0) / used.sum() ** 2
        return joint


def _inverse(matrix: Tensor) -> Tensor:
    """The inverse of symmetric matrices (..., n, n); what is not determined is very large."""
    values, vectors = torch.linalg.eigh(matrix)
    values = values.clamp(min=1e-14 * values[..., -1:].clamp(min=1e-14))
    return (vectors / values[..., None, :]) @ vectors.mT


def equations(
    views: Views, free: Free, vector: Tensor, lens: Lens, rotations: Tensor,
    translations: Tensor, weights: Tensor,
) -> Equations:  # fmt: skip
    """Those for weights (P, K) of the corners; the slopes of the lens by forward differentiation.

    A pose moves by a rotation vector in the camera's frame and a translation."""
    turned = views.board @ rotations.mT
    points = turned + translations[:, None]
    count = len(vector)
    ways = torch.eye(count + 3, dtype=vector.dtype)

    def along(way: Tensor) -> Tensor:
        tangents = way[:count], way[count:].expand_as(points)
        return torch.func.jvp(
            lambda v, p: free.pixels(v, p, lens.theta_max), (vector, points), tangents
        )[1]

    slopes = torch.func.vmap(along, out_dims=-1)(ways)
    used = views.seen & slopes.isfinite().all(-1).all(-1)
    slopes = torch.where(used[..., None, None], slopes, 0.0)
    by_point = slopes[..., count:]  # (P, K, 2, 3)
    # The pixel moves by by_point @ (ω × turned + shift).
    by_turn = torch.linalg.cross(turned[..., None, :].expand_as(by_point), by_point)
    slopes = torch.cat((slopes[..., :count], by_turn, by_point), -1)
    miss = views.miss(lens, rotations, translations)
    rows = slopes * (weights * used)[..., None, None]
    flat = slopes.flatten(1, 2)
    normal = rows.flatten(1, 2).mT @ flat
    side = -(rows * miss[..., None]).sum((1, 2))
    return Equations(
        normal[:, :count, :count], normal[:, count:, count:], normal[:, :count, count:],
        side[:, :count], side[:, count:], slopes,
    )  # fmt: skip


class Refined(NamedTuple):
    """The free numbers, their lens, the poses, the misses (P, K, 2), and the weights (P, K)."""

    vector: Tensor
    lens: Lens
    rotations: Tensor
    translations: Tensor
    miss: Tensor
    weights: Tensor
    scale: float


def turns(vectors: Tensor) -> Tensor:
    """(P, 3, 3): rotations by vectors (P, 3), rad."""
    axes = torch.broadcast_tensors(vectors[:, None], torch.eye(3).to(vectors))
    return torch.matrix_exp(torch.linalg.cross(*axes).mT)


def refine(
    views: Views, free: Free, vector: Tensor, rotations: Tensor, translations: Tensor,
    lens_moves: bool = True,
) -> Refined | None:  # fmt: skip
    """The smallest sum of Cauchy losses near a start; None if the start has no lens."""
    lens = free.lens(vector)
    if lens is None:
        return None
    miss = views.miss(lens, rotations, translations)
    damping, scale, fine, still = 1e-3, math.inf, False, 0
    for _ in range(ROUNDS):
        distance = miss.norm(dim=-1)[views.seen]
        part, typical = (0.5, RAYLEIGH) if fine else (0.9, math.sqrt(2 * math.log(10)))
        spread = distance.quantile(part).item() / typical
        scale = max(min(scale, SCALE * spread), FINEST)
        cost = _cost(miss, views.seen, scale)
        weights = weights_of(miss, views.seen, scale)
        normal = equations(views, free, vector, lens, rotations, translations, weights)
        held = free.held(vector, normal.lens_side.sum(0)) | (not lens_moves)
        before = cost
        while damping < 1e10:
            step, moves = normal.reduced(damping, held).step(damping)
            trial = (vector + step).clamp(free.low, free.high)
            trial_lens = free.lens(trial) if lens_moves else lens
            poses = turns(moves[:, :3]) @ rotations, translations + moves[:, 3:]
            trial_miss = views.miss(trial_lens, *poses)
            trial_cost = _cost(trial_miss, views.seen, scale)
            if trial_lens is not None and trial_cost < cost:
                vector, lens, miss, cost = trial, trial_lens, trial_miss, trial_cost
                rotations, translations = poses
                damping = max(damping / 10, 1e-12)
                break
            damping *= 10
        still = still + 1 if cost > (1 - (1e-8 if fine else 1e-3)) * before else 0
        if damping >= 1e10 or still >= 2:
            if fine:
                break
            fine, damping, still = True, 1e-4, 0
    return Refined(
        vector, lens, rotations, translations, miss, weights_of(miss, views.seen, scale), scale
    )


def weights_of(miss: Tensor, seen: Tensor, scale: float) -> Tensor:
    return seen / (1 + miss.square().sum(-1) / scale**2)


def _cost(miss: Tensor, seen: Tensor, scale: float) -> float:
    loss = (miss.square().sum(-1) / scale**2).log1p()
    return torch.where(seen, loss, 0.0).sum().item()
