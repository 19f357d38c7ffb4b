import math

import torch

from darswin.lens import Perspective, Spherical
from darswin.reprojection import reprojection


def test_a_ray_keeps_its_angles():
    source = Perspective.from_fov(2.4, 100.0, center=[90.0, 104.0]).to(torch.float64)
    target = Spherical.from_fov([0.2, 0.9], 2.4, 30.0).to(torch.float64)
    there = reprojection(source, (200, 200), target, (64, 61))
    assert there.shape == (2, 64, 61, 2)
    x, y = 40.0, 20.0  # of a pixel
    dx, dy = x - 30, y - 31.5
    theta = target.unproject(torch.full((2, 1), math.hypot(dx, dy), dtype=torch.float64))
    r = source.project(theta)[:, 0]
    azimuth = math.atan2(dy, dx)
    expected = torch.stack((90 + r * math.cos(azimuth), 104 + r * math.sin(azimuth)), -1)
    torch.testing.assert_close(there[:, 20, 40], expected)


def test_gradients_reach_both_lenses_also_at_the_centre():
    focal = torch.tensor([20.0], dtype=torch.float64, requires_grad=True)
    xi = torch.tensor([0.5], dtype=torch.float64, requires_grad=True)

    def places(focal, xi):
        return reprojection(Perspective(focal, 1.2), (40, 40), Spherical(xi, focal, 1.2), (9, 9))

    assert torch.autograd.gradcheck(places, (focal, xi))
