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
            held = {("OCam", "coefficients"): [1], ("OCamInverse", "coefficients"): [0],
                    ("Tabulated", "radii"): [0]}.get((self.model.__name__, name), [])  # fmt: skip
            if name == "affine":
                held = [0, 1, 2]
            free += [name != "angles" and k not in held for k in range(count)]
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
    """The normal equations of one step: of the lens (n, n), of poses (P, 6, 6), and between them
    (P, n, 6); and the right sides."""

    lens: Tensor
    poses: Tensor
    mixed: Tensor
    lens_side: Tensor
    pose_side: Tensor
    slopes: Tensor  # (P, K, 2, n + 6): the derivatives of pixels

    def step(self, damping: float, held: Tensor) -> tuple[Tensor, Tensor]:
        """The step of the lens (n,), 0 where `held`, and those of the poses (P, 6)."""
        scale = 1 / self.lens.diagonal().clamp(min=1e-30).sqrt() * ~held
        size = 1 / self.poses.diagonal(dim1=1, dim2=2).clamp(min=1e-30).sqrt()
        eye, six = torch.eye(len(scale)).to(scale), torch.eye(6).to(scale)
        poses = size[:, :, None] * self.poses * size[:, None] + damping * six
        mixed = scale[:, None] * self.mixed * size[:, None]
        # A picture without corners has no equations.
        factor, _ = torch.linalg.cholesky_ex(poses + 1e-14 * six)
        solved = torch.cholesky_solve(mixed.mT, factor)  # (P, 6, n)
        sides = size * self.pose_side
        schur = scale[:, None] * self.lens * scale + damping * eye - (mixed @ solved).sum(0)
        side = scale * self.lens_side - (mixed @ torch.cholesky_solve(sides[..., None], factor))[
            ..., 0
        ].sum(0)
        schur = schur + torch.diag(held.to(scale)) + 1e-14 * eye
        lens_step = torch.linalg.lstsq(schur, side[:, None]).solution[:, 0]
        rest = sides[..., None] - (mixed.mT @ lens_step)[..., None]
        return scale * lens_step, size * torch.cholesky_solve(rest, factor)[..., 0]


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
        normal[:, :count, :count].sum(0), normal[:, count:, count:], normal[:, :count, count:],
        side[:, :count].sum(0), side[:, count:], slopes,
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
    eye = torch.eye(3).to(vectors)
    return torch.matrix_exp(
        torch.linalg.cross(*torch.broadcast_tensors(vectors[:, None], eye)).mT
    ).mT.mT


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
        weights = _weights(miss, views.seen, scale)
        normal = equations(views, free, vector, lens, rotations, translations, weights)
        low = (vector <= free.low) & (normal.lens_side < 0)
        held = low | ((vector >= free.high) & (normal.lens_side > 0))
        held = held if lens_moves else torch.ones_like(held)
        before = cost
        while damping < 1e10:
            step, moves = normal.step(damping, held)
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
        vector, lens, rotations, translations, miss, _weights(miss, views.seen, scale), scale
    )


def _weights(miss: Tensor, seen: Tensor, scale: float) -> Tensor:
    return seen / (1 + miss.square().sum(-1) / scale**2)


def _cost(miss: Tensor, seen: Tensor, scale: float) -> float:
    loss = (miss.square().sum(-1) / scale**2).log1p()
    return torch.where(seen, loss, 0.0).sum().item()


# Other models have no number that is held.
HELD = {OCam: {"coefficients": [1]}, OCamInverse: {"coefficients": [0]},
        Tabulated: {"radii": [0]}}  # fmt: skip
