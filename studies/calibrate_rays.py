"""The sets of corners of the calibration study, and how wrong the rays of a calibration are."""

import math
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from calibrate_peers import Given

from darswin.lens import MODELS, Lens

# The makers of random lenses and rigs are those of the tests.
sys.path.append(str(Path(__file__).parent.parent / "tests" / "calibrate"))
import rigs

FOVS = (60, 100, 150, 190, 220, 250)  # degrees
NARROW = {"Perspective": 150, "Orthographic": 150, "BrownConrady": 100}  # the widest of a model
COLUMNS, ROWS = 9, 6
GRID = 41  # the rays of 41 × 41 pixels over the picture are compared


class Set(NamedTuple):
    """Which corners: the model of the true lens, its field of view in degrees, pictures, and the
    noise of corners, px."""

    model: str
    fov: int
    pictures: int = 20
    noise: float = 0.2


QUICK = (
    Set("KannalaBrandt", 150, 8),
    Set("Spherical", 220, 20),
    Set("BrownConrady", 60, 5),
)


def fovs(model: str) -> list[int]:
    """The fields of view that a model can show."""
    return [fov for fov in FOVS if fov <= NARROW.get(model, FOVS[-1])]


def all_sets() -> list[Set]:
    """Each model with every second field of view and 20 pictures, and half of the models without
    noise; then each with 8, 5 and 30 pictures, with one field of view after the other."""
    able = {model: fovs(model) for model in MODELS}
    first, others = [], []
    for k, (model, known) in enumerate(able.items()):
        first += [Set(model, fov) for fov in known[k % 2 :: 2]]
        if k % 2:
            first.append(Set(model, known[k % len(known)], noise=0.0))
    for i, count in enumerate((8, 5, 30)):
        others += [
            Set(m, known[(k + i) % len(known)], count) for k, (m, known) in enumerate(able.items())
        ]
    return first + others


def _lens(model: str, fov: int, seed: int) -> Lens:
    """A random lens whose field of view fills the picture's shorter side."""
    lens = rigs.true_lens(model, fov, seed=seed)
    if "focal" in lens.parameters:
        radius = lens.project(lens.theta_max[:, None]).item()
        lens = lens.replace(focal=lens.focal * min(lens.image_size[0].tolist()) / 2 / radius)
    return lens


def make(which: Set, seed: int) -> tuple[Given, np.ndarray]:
    """What the methods are given, and the true rays at its pixels."""
    lens = _lens(which.model, which.fov, seed)
    board = rigs.board(COLUMNS, ROWS)
    rig = rigs.rig(lens, which.pictures, board, noise=which.noise, seed=seed, least=len(board))
    places = board @ rig.rotations[:, :, :2].mT + rig.translations[:, None]
    angles = torch.rad2deg(torch.atan2(places[..., :2].norm(dim=-1), places[..., 2]))
    pixels = grid(rig.size)
    rays = lens.unproject_points(torch.from_numpy(pixels)).numpy()
    seen = ~np.isnan(rays).any(1)
    near = math.radians(1)
    focal = lens.project(torch.full((1, 1), near, dtype=torch.float64)).item() / near
    flat = np.concatenate((board.numpy(), np.zeros((len(board), 1))), 1)
    given = Given(
        rig.corners.numpy(), flat, COLUMNS, rig.size, angles.numpy(), which.fov, focal,
        which.model, pixels[seen],
    )  # fmt: skip
    return given, rays[seen]


def grid(size: tuple[int, int]) -> np.ndarray:
    """(M, 2): pixels over a picture."""
    y, x = (np.linspace(0, side - 1, GRID) for side in size)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def ray_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(M,) degrees between rays (M, 3), after the rotation that makes their sum smallest, since a
    camera's frame is arbitrary. A ray that is not there is 180° off."""
    there = np.isfinite(found).all(1)
    off = np.full(len(found), 180.0)
    if there.sum() < 3:
        return off
    one, other = found[there], true[there]
    weight = np.ones(len(one))
    for _ in range(20):
        u, _, vt = np.linalg.svd((other * weight[:, None]).T @ one)
        turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        chord = np.linalg.norm(one @ turn.T - other, axis=1)
        weight = 1 / (chord + 1e-6)
    off[there] = np.degrees(2 * np.arcsin((chord / 2).clip(max=1)))
    return off
