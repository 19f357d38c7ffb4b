"""Random rigs: boards seen through a known lens, as the corners that a perfect detector would find,
with noise."""

import math
from typing import NamedTuple

import torch
from numpy.polynomial import Polynomial
from torch import Tensor

from darswin.lens import MODELS, EnhancedUnified, Lens, fit
from darswin.lens.solve import vector_of

f64 = torch.float64
# The widest field of view, degrees, that a model shows well.
WIDEST = {"Perspective": 120, "BrownConrady": 120, "Orthographic": 170}
OFF_CURVE = {
    "BrownConrady": {"tangential": 2},
    "Mei": {"tangential": 2},
    "Fisheye624": {"tangential": 2, "prism": 4},
}


class Rig(NamedTuple):
    """Corners (P, K, 2) px, NaN where unseen; the board's points (K, 2); the true lens, poses and
    (H, W)."""

    corners: Tensor
    board: Tensor
    lens: Lens
    rotations: Tensor
    translations: Tensor
    size: tuple[int, int]


def board(columns: int = 9, rows: int = 6, square: float = 0.03) -> Tensor:
    """(K, 2): the inner corners of a chessboard, row by row."""
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return square * torch.stack((x, y), -1).reshape(-1, 2).to(f64)


def true_lens(model: str, fov: float, size=(960, 1000), seed=0, shift=0.1) -> Lens:
    """A lens of a model whose field of view (degrees) fills the image's shorter side, with its
    principal point off the middle by up to a part `shift` of the side."""
    generator = torch.Generator().manual_seed(seed)
    alpha, beta, x, y = torch.rand(4, generator=generator, dtype=f64).tolist()
    alpha, beta = torch.tensor([0.4 + 0.2 * alpha], dtype=f64), 0.9 + 0.4 * beta
    base = EnhancedUnified.from_fov(alpha, beta, math.radians(fov), min(size) / 2)
    lens = fit(MODELS["Polynomial" if model == "OCamInverse" else model], base).lens
    if model == "OCamInverse":  # of a fit, r(0) is not 0
        shifted = Polynomial([0, *lens.coefficients[0].tolist()])(Polynomial([math.pi / 2, 1]))
        lens = MODELS[model](torch.from_numpy(shifted.coef), base.theta_max)
    for name, count in OFF_CURVE.get(model, {}).items():
        off = 2e-3 * (2 * torch.rand(1, count, generator=generator, dtype=f64) - 1)
        lens = lens.replace(**{name: off})
    lens = lens.with_theta_max(torch.minimum(lens.theta_max, 0.98 * lens.theta_limit))
    sides = torch.tensor([size[1], size[0]], dtype=f64)
    off = 2 * torch.tensor([x, y], dtype=f64) - 1
    center = ((sides - 1) / 2 + shift * off * sides)[None]
    return lens.replace(center=center, image_size=torch.tensor([size], dtype=f64))


def turn(vector: Tensor) -> Tensor:
    """(..., 3, 3): the rotation by a vector (..., 3), rad."""
    eye = torch.eye(3, dtype=f64)
    return torch.matrix_exp(
        torch.linalg.cross(*torch.broadcast_tensors(vector[..., None, :], eye)).mT
    )


def rig(lens: Lens, pictures=20, points=None, *, noise=0.2, seed=0, least=12) -> Rig:
    """Boards at random places of the whole field of view, turned to the camera up to 45°. Each
    picture shows at least `least` corners."""
    points = board() if points is None else points
    generator = torch.Generator().manual_seed(seed)
    height, width = (round(side) for side in lens.image_size[0].tolist())
    theta_max = lens.theta_max.item()
    middle = points.mean(0)
    half = (points - middle).norm(dim=1).max().clamp(min=0.01)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    while len(found) < pictures:
        u = torch.rand(7, generator=generator, dtype=f64)
        theta, azimuth = u[0] * theta_max, 2 * math.pi * u[1]
        direction = torch.stack((azimuth.cos(), azimuth.sin()))
        ray = vector_of(theta, direction)
        # As seen along the ray, x of the board is to the right.
        facing = turn(theta * torch.stack((-direction[1], direction[0], 0 * theta)))
        lean = math.radians(45) * u[2].sqrt() * torch.stack(
            (torch.cos(2 * math.pi * u[3]), torch.sin(2 * math.pi * u[3]), 0 * theta)
        )  # fmt: skip
        spin = (u[4] - 0.5) * torch.stack((0 * theta, 0 * theta, 1 + 0 * theta))
        rotation = facing @ turn(lean) @ turn(spin)
        radius = theta_max * (0.25 + 0.35 * u[5])  # half the board's size, as an angle
        distance = half / math.tan(min(radius, math.radians(40)))
        translation = distance * ray - rotation[:, :2] @ middle
        pixels = lens.project_points(points @ rotation[:, :2].T + translation)
        inside = (pixels > 2).all(1) & (pixels[:, 0] < width - 3) & (pixels[:, 1] < height - 3)
        pixels = torch.where(inside[:, None], pixels, torch.nan)
        if inside.sum() >= min(least, len(points)):
            found.append((pixels, rotation, translation))
    corners, rotations, translations = (torch.stack(x) for x in zip(*found, strict=True))
    corners = corners + noise * torch.randn(corners.shape, generator=generator, dtype=f64)
    return Rig(corners, points, lens, rotations, translations, (height, width))


def ray_errors(found: Lens, true: Lens, best: bool = False) -> Tensor:
    """Degrees between the rays of two lenses at pixels over the picture that the true lens sees;
    `best`: after the rotation that makes them smallest."""
    height, width = (round(side) for side in true.image_size[0].tolist())
    sides = (torch.linspace(0, side - 1, 41, dtype=f64) for side in (height, width))
    y, x = torch.meshgrid(*sides, indexing="ij")
    pixels = torch.stack((x, y), -1).reshape(-1, 2)
    wanted = true.unproject_points(pixels)
    seen = ~wanted.isnan().any(-1)
    wanted, got = wanted[seen], found.with_theta_max(None).unproject_points(pixels)[seen]
    if best:
        u, _, vt = torch.linalg.svd(wanted.T @ got.nan_to_num())
        got = got @ (u @ vt).T
    # The chord, which is exact for small angles; a ray that is not there is 180° off.
    chord = (got - wanted).norm(dim=-1).nan_to_num(2.0)
    return torch.rad2deg(2 * torch.asin((chord / 2).clamp(max=1)))
