"""The start of a calibration, without guesses: principal point, curve and poses of the boards.

Whatever the curve of a radial lens is, a point lies in the direction from the principal point in
which it is seen. This constraint is linear in the part of a board's pose that is parallel to the
sensor. Depths and curve then follow, for any field of view.

Source: Tsai, 1987; Thirthala and Pollefeys, CVPR 2005; Scaramuzza et al., IROS 2006.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from darswin.calibrate.inputs import CalibrationError
from darswin.lens import Lens, OCam, Tabulated
from darswin.lens.fitting import fit_one
from darswin.lens.ideal import FocalLens
from darswin.lens.solve import length_of

POWERS = (0, 2, 3, 4)  # of ρ in the depth g(ρ); a linear term would be a kink at the axis
PRIOR = 0.02  # how far the principal point is expected from the middle, in parts of the side
TABLE = 12  # the steps of a table
FLOOR = 0.05  # px: smaller residuals say nothing


class Start(NamedTuple):
    """center (2,) px; depth: the coefficients of g in px, of the powers 0, 1, 2, …: the ray of a
    pixel (u, v) from the center is (u, v, g(ρ)); error (P,) px: by how much each picture misses
    the radial constraint."""

    center: Tensor
    depth: Tensor
    error: Tensor

    @property
    def fits(self) -> Tensor:
        """(P,) bool: the pictures that miss it by no more than others."""
        return self.error <= (10 * self.error.median()).clamp(min=2.0)

    def rays(self, corners: Tensor) -> Tensor:
        """(..., 3): unit vectors towards corners (..., 2)."""
        flat = corners - self.center
        depth = torch.zeros_like(flat[..., 0])
        for coefficient in self.depth.flip(0):
            depth = depth * length_of(flat) + coefficient
        return torch.nn.functional.normalize(torch.cat((flat, depth[..., None]), -1), dim=-1)

    def lens(self, model: type[Lens], terms: int | None, top: float, size: tuple[int, int]) -> Lens:
        """The lens of a model that is close to the curve up to the angle `top`, rad."""
        end = model._end if issubclass(model, FocalLens) else math.pi
        if top > end + 0.05:
            raise CalibrationError(
                f"The corners reach {math.degrees(top):.0f}° from the axis, but {model.__name__} "
                f"lenses end at {math.degrees(end):.0f}°: choose another model."
            )
        image = {"center": self.center[None], "image_size": self.center.new_tensor([size])}
        try:
            curve = OCam(-self.depth[None], **image)
        except ValueError:
            raise CalibrationError("No lens is close to the corners.") from None
        limit = curve.theta_limit.item()
        if issubclass(model, Tabulated):
            last = min(1.03 * top + 0.02, limit)
            angles = torch.linspace(0, last, (terms or TABLE) + 1).to(self.center)
            return Tabulated(angles, curve.project(angles), **image)
        for share in (1.0, 0.9, 0.7, 0.5):
            short = curve.with_theta_max(share * min(top, limit, 0.97 * end))
            try:
                found = fit_one(model, short, terms or model.terms, rounds=20)._tensors()
                return model(**found | image | {"theta_max": None})
            except ValueError:
                continue
        raise CalibrationError(f"No {model.__name__} lens is close to the start.")


def start(corners: Tensor, seen: Tensor, points: Tensor, size: tuple[int, int]) -> Start:
    """The start from corners (P, K, 2) px, of which `seen` (P, K) count, of points (K, 2)."""
    sides = corners.new_tensor([size[1], size[0]])
    counts = seen.sum(1)
    board = torch.cat((points, torch.ones_like(points[:, :1])), 1)

    def misses(centers: Tensor) -> tuple[Tensor, Tensor]:
        plane, square = _in_plane((corners - centers[:, None, None]) / sides.mean(), seen, board)
        return plane, square.sqrt() * sides.mean()

    # The center with the smallest robust sum, on grids that become finer.
    middle = (sides - 1) / 2
    center, step = middle, 0.05 * sides
    line = torch.arange(-4, 5, dtype=corners.dtype)
    while step.max() > 0.2:
        around = center + step * torch.cartesian_prod(line, line)
        error = misses(around)[1].square() + FLOOR**2
        prior = ((around - middle) / (PRIOR * sides)).square().sum(1)
        center = around[((counts * error.log()).sum(1) + prior).argmin()]
        step, line = step / 3, torch.arange(-3, 4, dtype=corners.dtype)
    plane, error = (x[0] for x in misses(center[None]))
    found = Start(center, center, error)
    fits = found.fits
    radius = length_of(corners - center)
    return found._replace(depth=_depth(radius[fits], seen[fits], plane[fits], board))


def _in_plane(flat: Tensor, seen: Tensor, board: Tensor) -> tuple[Tensor, Tensor]:
    """The part of each pose that is parallel to the sensor, (..., P, 2, 3) up to a factor, which
    maps points of the board to a direction from the principal point; and the mean squared distance
    (..., P) of its corners from these directions. Corners that are far off count little."""
    u, v = flat[..., :1], flat[..., 1:]
    rows = torch.cat((-v * board, u * board), -1)
    weight = seen.to(flat.dtype).expand(rows.shape[:-1])
    for _ in range(4):
        weighted = rows * weight[..., None]
        vector = torch.linalg.eigh(weighted.mT @ rows).eigenvectors[..., 0]
        plane = vector.unflatten(-1, (2, 3))
        aside = board @ plane.mT
        squared = (rows @ vector[..., None])[..., 0].square()
        squared = squared / aside.square().sum(-1).clamp(min=1e-12)
        scale = torch.where(seen, squared, torch.nan).nanmedian(-1, keepdim=True).values
        robust = seen / (1 + squared / (9 * scale + 1e-12))
        weight = robust / aside.square().sum(-1).clamp(min=1e-12)
    towards = (robust * (flat * aside).sum(-1)).sum(-1).sign()
    return plane * towards[..., None, None], (robust * squared).sum(-1) / robust.sum(-1)


def _depth(radius: Tensor, seen: Tensor, plane: Tensor, board: Tensor) -> Tensor:
    """The coefficients of g(ρ): with as many terms as leave a curve that rises.

    A board's columns have equal length and are orthogonal, which gives their z up to sign. With
    depths Z of the board's origins, ρ (z x + z' y + Z) = √(X² + Y²) g(ρ) is linear in Z and g.
    """
    first, second = plane[..., 0], plane[..., 1]
    gap = second.square().sum(-1) - first.square().sum(-1)
    tilt = torch.complex(gap, -2 * (first * second).sum(-1)).sqrt()
    scale = (first.square().sum(-1) + tilt.real.square()).sqrt()
    tilt = torch.view_as_real(tilt / scale)
    across = length_of(board @ plane.mT) / scale[:, None]
    leaning = tilt @ board[:, :2].T
    unit = torch.where(seen, radius, 0).max()
    rho = torch.where(seen, radius / unit, 0)
    # Boards almost parallel to the sensor say little: rounding decides their tilt.
    steep = tilt.square().sum(-1)
    sure = seen * (steep / (steep + 0.01))[:, None]
    line = torch.linspace(0, 1, 200, dtype=rho.dtype)
    for terms in range(len(POWERS), 0, -1):
        powers = torch.tensor(POWERS[:terms], dtype=rho.dtype)
        weight = sure / across.amax(1, keepdim=True).square()
        for _ in range(3):
            columns = across[..., None] * rho[..., None] ** powers
            known = rho * leaning
            # Each picture's Z is eliminated.
            along = weight * rho / (weight * rho * rho).sum(1, keepdim=True).clamp(min=1e-30)
            columns = columns - rho[..., None] * torch.einsum("pk,pkm->pm", along, columns)[:, None]
            known = known - rho * (along * known).sum(1, keepdim=True)
            right = torch.einsum("pk,pkm,pk->pm", weight, columns, known)
            left = torch.einsum("pk,pkm,pkn->mn", weight, columns, columns)
            left = left + 1e-12 * left.diagonal().mean() * torch.eye(terms, dtype=rho.dtype)
            solved = torch.linalg.solve(left, right.T)
            solved = solved @ _signs(right, solved)
            solved = solved if solved[0] > 0 else -solved
            # A shift of ρ by one changes the equation by Z - √(X² + Y²) g′(ρ).
            depth = (rho[..., None] ** powers) @ solved
            bends = (powers * rho[..., None].clamp(min=1e-6) ** (powers - 1)) @ solved
            far = across * (depth / rho.clamp(min=1e-6) - bends)
            typical = torch.where(seen, far.abs(), torch.nan).nanmedian(1, keepdim=True).values
            weight = sure / far.square().clamp(min=0.05 * typical.square())
        angle = torch.atan2(line, (line[:, None] ** powers) @ solved)
        if solved[0] > 0 and bool((angle.diff() > 0).all()):
            break
    coefficients = solved.new_zeros(POWERS[-1] + 1)
    coefficients[list(POWERS[:terms])] = solved
    return coefficients * unit ** (1 - torch.arange(len(coefficients), dtype=unit.dtype))


def _signs(right: Tensor, solved: Tensor) -> Tensor:
    """(P,) of ±1: the signs of the pictures' tilts whose equations agree best, up to all signs."""
    agree = right @ solved
    best, most = torch.ones_like(agree[0]), -math.inf
    for vector in torch.linalg.eigh(agree).eigenvectors.T.flip(0)[: right.shape[1]]:
        signs = torch.where(vector < 0, -1.0, 1.0).to(agree.dtype)
        for _ in range(4 * len(signs)):
            gain = agree.diagonal() - signs * (agree @ signs)
            if gain.max() <= 1e-12 * agree.diagonal().sum():
                break
            signs[gain.argmax()] *= -1
        total = (signs @ agree @ signs).item()
        if total > most:
            best, most = signs, total
    return best


def poses(rays: Tensor, weight: Tensor, board: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (P, 3, 3) and translations (P, 3) of boards whose points (K, 2) are seen along rays
    (P, K, 3), of any direction, by the linear equations ray × (H (x, y, 1)) = 0."""
    points = torch.cat((board, torch.ones_like(board[:, :1])), 1)
    cross = torch.linalg.cross(*torch.broadcast_tensors(rays[..., None, :], torch.eye(3).to(rays)))
    rows = (cross[..., None] * points[:, None, None]).flatten(-2)
    normal = torch.einsum("pk,pkci,pkcj->pij", weight, rows, rows)
    matrix = torch.linalg.eigh(normal).eigenvectors[..., 0].unflatten(-1, (3, 3))
    # ray × e_c is -[ray]× transposed: rows of `matrix` are those of H.
    towards = (weight * (rays * (points @ matrix.mT)).sum(-1)).sum(-1).sign()
    matrix = matrix * towards[:, None, None]
    first, second, third = matrix.unbind(-1)
    columns = torch.stack((first, second, torch.linalg.cross(first, second)), -1)
    scale = (first.norm(dim=-1) * second.norm(dim=-1)).sqrt()[:, None].clamp(min=1e-12)
    columns = columns / torch.stack((scale, scale, scale**2), -1)
    u, _, vt = torch.linalg.svd(columns)
    turn = torch.stack((torch.ones(len(u)), torch.ones(len(u)), (u @ vt).det().sign()), -1)
    return (u * turn.to(u)[:, None]) @ vt, third / scale
