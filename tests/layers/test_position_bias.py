import math
from typing import get_args

import pytest
import torch

from darswin import PolarView
from darswin.layers.position_bias import AngularRelativeBias, FourierBias, ring_angles
from darswin.lens import Spherical
from darswin.lens.spacing import Spacing

LENS = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)


def test_angular_relative_bias_is_the_papers_formula():
    bias = AngularRelativeBias((3, 4), heads=2, sectors=8)
    ring_angles = torch.tensor([[0.0, 0.1, 0.2, 0.3], [0.0, 0.3, 0.6, 0.9]])
    table = bias(ring_angles)
    assert table.shape == (2, 2, 5, 7)
    for image in range(2):
        for head in range(2):
            for delta_r in range(-2, 3):
                for delta_a in range(-3, 4):
                    theta = math.copysign(ring_angles[image, abs(delta_r)].item(), delta_r)
                    phi = 2 * math.pi * delta_a / 8
                    expected = (
                        bias.a_theta[delta_r % 5, head] * math.sin(theta)
                        + bias.b_theta[delta_r % 5, head] * math.cos(theta)
                        + bias.a_phi[delta_a % 7, head] * math.sin(phi)
                        + bias.b_phi[delta_a % 7, head] * math.cos(phi)
                    )
                    got = table[image, head, delta_r + 2, delta_a + 3]
                    torch.testing.assert_close(got, expected)


def test_fourier_bias_is_a_series():
    bias = FourierBias((3, 1), heads=1, sectors=8, harmonics=4)
    table = bias(torch.tensor([[0.0, 0.7, 1.1]]))[0, 0, :, 0]
    for place, theta in enumerate((-1.1, -0.7, 0.0, 0.7, 1.1)):
        expected = bias.b_theta[0, 0] + bias.b_phi[0, 0] + bias.b_phi[1:, 0].sum() / 4
        for p in range(1, 5):
            wave = bias.a_theta[p - 1, 0] * math.sin(p * theta)
            expected = expected + (wave + bias.b_theta[p, 0] * math.cos(p * theta)) / 4
        torch.testing.assert_close(table[place], expected)


def test_periodic_bias_joins_at_the_seam():
    bias = AngularRelativeBias((1, 8), heads=2, sectors=8, periodic=True)
    table = bias(torch.zeros(1, 1))[0, :, 0]
    torch.testing.assert_close(table[:, :7], table[:, 8:])  # Δφ and Δφ - 8


def test_radial_positions():
    grid = PolarView(rings=8, sectors=4, samples=(2, 2)).grid(LENS, (32, 32))
    angles = ring_angles(LENS.theta_max, grid, 4, "angular_relative")
    torch.testing.assert_close(angles[0], torch.linspace(0, 1.3, 5))
    radii = ring_angles(LENS.theta_max, grid, 4, "polar")
    torch.testing.assert_close(radii, grid.borders[:, ::2] * math.pi / 16)


@pytest.mark.parametrize("spacing", get_args(Spacing))
def test_the_angles_of_the_bias_do_not_follow_the_spacing(spacing):
    """docs/explanation/spacings.md tells that they are nominal."""
    options = dict(rings=8, sectors=4, samples=(2, 2), spacing=spacing)
    grid = PolarView(**options).grid(LENS, (32, 32))
    angles = ring_angles(LENS.theta_max, grid, 8, "angular")
    torch.testing.assert_close(angles, LENS.theta_max[:, None] * torch.linspace(0, 1, 9))
    borders = PolarView(**options).border_angles(LENS)
    assert torch.allclose(angles, borders, atol=1e-4) == (spacing == "theta")
