"""The start of a calibration: exact for exact corners, for any field of view."""

import math

import pytest
import torch
from rigs import board, f64, rig, true_lens
from torch.nn.functional import normalize

from darswin.calibrate import radial


def started(found):
    """The start of a rig, and the board in its units."""
    seen = ~found.corners.isnan().any(-1)
    middle = found.board.mean(0)
    flat = (found.board - middle) / (found.board - middle).norm(dim=1).max()
    return radial.start(found.corners.nan_to_num(), seen, flat, found.size), seen, flat


@pytest.mark.parametrize("fov", [60, 120, 180, 220, 250])
@pytest.mark.parametrize("model", ["KannalaBrandt", "Stereographic"])
def test_rays_of_exact_corners(model, fov):
    lens = true_lens(model, fov)
    found = rig(lens, 10, noise=0.0)
    start, seen, _ = started(found)
    assert (start.center - lens.center[0]).norm() < 2
    apart = (start.rays(found.corners) - lens.unproject_points(found.corners)).norm(dim=-1)[seen]
    assert apart.max() < 2 * math.sin(math.radians(1))  # 2°
    assert start.error.max() < 0.1 and start.fits.all()


def test_poses_are_exact_in_front_and_behind():
    points = board(5, 4) - board(5, 4).mean(0)
    generator = torch.Generator().manual_seed(0)
    turns = torch.linalg.qr(torch.randn(20, 3, 3, generator=generator, dtype=f64)).Q
    turns = turns * turns.det()[:, None, None]
    shifts = normalize(torch.randn(20, 3, generator=generator, dtype=f64), dim=1)
    rays = normalize(points @ turns[:, :, :2].mT + shifts[:, None], dim=-1)
    rotations, translations = radial.poses(rays, torch.ones(20, 20, dtype=f64), points)
    torch.testing.assert_close(rotations, turns, rtol=0, atol=1e-6)
    torch.testing.assert_close(translations, shifts, rtol=0, atol=1e-6)
    assert (shifts[:, 2] < 0).any()


def test_one_wrong_corner_and_one_wrong_picture_do_not_move_the_start():
    found = rig(true_lens("KannalaBrandt", 180), 12, noise=0.1)
    right, _, _ = started(found)
    corners = found.corners.clone()
    corners[3] = corners[3].flip(0)[torch.randperm(54, generator=torch.Generator().manual_seed(0))]
    corners[5, (~corners[5, :, 0].isnan()).nonzero()[0]] += 20
    wrong, _, _ = started(found._replace(corners=corners))
    assert (wrong.center - right.center).norm() < 2
    assert wrong.fits.tolist() == [k != 3 for k in range(12)]
