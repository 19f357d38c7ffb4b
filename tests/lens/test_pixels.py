"""θ and solid angle of pixels against spherical polygons, and z against points in space."""

import math

import pytest
import torch

from darswin.lens import Equidistant, KannalaBrandt, Mei, Perspective, Spherical
from darswin.lens.pixels import distance_to_z, pixel_angles, solid_angles, z_to_distance
from tests.lens_examples import ASIDE

f64 = torch.float64


def corners(lens, x, y, parts):
    """Unit vectors of the grid of corners that cut the pixels at (x, y) into parts × parts."""
    step = torch.linspace(-0.5, 0.5, parts + 1, dtype=f64)
    places = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1)
    pixels = torch.stack((x, y), -1)[:, None, None] + places
    return (
        lens.with_theta_max(None)
        .unproject_points(pixels.reshape(1, -1, 2))
        .view(*pixels.shape[:-1], 3)
    )


def triangle(a, b, c):
    """The solid angles of spherical triangles, after Van Oosterom and Strackee, 1983."""
    above = (a * torch.linalg.cross(b, c)).sum(-1).abs()
    below = 1 + (a * b).sum(-1) + (b * c).sum(-1) + (a * c).sum(-1)
    return 2 * torch.atan2(above, below)


def polygons(lens, x, y, parts=8):
    at = corners(lens, x, y, parts)
    a, b, c, d = at[:, :-1, :-1], at[:, :-1, 1:], at[:, 1:, 1:], at[:, 1:, :-1]
    return (triangle(a, b, c) + triangle(a, c, d)).sum((1, 2))


LENSES = {
    "general": Mei(1.5, 40.0, (0.05, 0.2), 1.1, (30.0, 22.5), affine=[[1.0, 0.05], [0.0, 0.8]],
                   tangential=(0.02, -0.03), image_size=(46, 64)).to(f64),
    "beyond 90°": KannalaBrandt(13.0, [0.02], 1.9, (31.5, 22.5), image_size=(46, 64)).to(f64),
    "perspective": Perspective(30.0, 1.0, (20.0, 22.0), image_size=(46, 64)).to(f64),
    "centre on a pixel": Spherical(0.7, 28.0, 1.4, (30.0, 23.0), image_size=(46, 64)).to(f64),
}  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_solid_angles_are_those_of_spherical_polygons(name):
    lens = LENSES[name]
    found = solid_angles(lens, (46, 64))[0]
    theta = pixel_angles(lens, (46, 64))[0]
    assert torch.equal(found == 0, theta.isnan()) and (found >= 0).all()
    # Not where a corner of the pixel is beyond what the model is valid for.
    y, x = (theta < lens.theta_max - 0.1).nonzero().unbind(1)
    assert len(x) > 300
    expected = polygons(lens, x.to(f64), y.to(f64))
    torch.testing.assert_close(found[y, x], expected, rtol=2e-3, atol=0)
    assert found.sum() > 0


@pytest.mark.parametrize("theta_max", [0.8, math.pi / 2, 2.4])
def test_a_whole_circle_sums_up_to_the_cap(theta_max):
    for make in (Equidistant, lambda f, t: Spherical(0.9, f, t)):
        one = make(1.0, theta_max).to(f64)
        lens = make(150 / one.r_max.item(), theta_max).to(f64)
        total = solid_angles(lens, (310, 311)).sum().item()
        assert total == pytest.approx(2 * math.pi * (1 - math.cos(theta_max)), rel=3e-3)


def test_angles_are_those_of_the_rays():
    lens = LENSES["general"]
    theta = pixel_angles(lens, (46, 64))
    assert theta.shape == (1, 46, 64) and 0.2 < theta.isnan().double().mean() < 0.8
    y, x = (~theta[0].isnan()).nonzero().unbind(1)
    points = lens.unproject_points(torch.stack((x, y), -1).to(f64))
    torch.testing.assert_close(theta[0, y, x], torch.acos(points[..., 2].clamp(-1, 1)))
    seen = lens.unproject_pixels(torch.stack((x, y), -1).to(f64))[0]
    assert (seen <= lens.theta_max * (1 + 1e-12)).all()


def test_float32_and_batches():
    lens = Spherical([0.2, 0.9], 20.0, 1.2)
    found = solid_angles(lens, (40, 48))
    assert found.shape == (2, 40, 48) and found.dtype == torch.float32
    for k in range(2):
        exact = solid_angles(lens[k].to(f64), (40, 48))[0]
        torch.testing.assert_close(found[k].double(), exact, rtol=1e-5, atol=0)
    assert solid_angles(lens[:0], (40, 48)).shape == (0, 40, 48)


@pytest.mark.parametrize("name", ["KannalaBrandt", "Mei"])
def test_z_is_that_of_points_in_space(name):
    lens, size = ASIDE[name], (60, 80)
    lens = lens.resized(0.1).replace(center=torch.tensor([[41.0, 28.0]], dtype=f64))
    distance = 0.5 + 9 * torch.rand(1, *size, dtype=f64)
    z = distance_to_z(distance, lens)
    y, x = torch.meshgrid(torch.arange(60), torch.arange(80), indexing="ij")
    points = lens.unproject_points(torch.stack((x, y), -1)[None].to(f64)) * distance[..., None]
    seen = ~points[..., 2].isnan()
    torch.testing.assert_close(z[seen], points[..., 2][seen])
    assert not z[~seen].any()
    torch.testing.assert_close(z_to_distance(z, lens), torch.where(seen, distance, 0.0))
    with_channel = distance_to_z(distance[:, None], lens)
    torch.testing.assert_close(with_channel[:, 0], z)


def test_what_is_not_known_stays_so():
    lens = Equidistant(10.0, 2.0).to(f64)
    distance = torch.ones(1, 51, 51, dtype=f64)
    distance[:, 10:30] = 0
    z = distance_to_z(distance, lens)
    assert not z[:, 10:30].any() and (z < 0).any() and (z > 0).any()
    assert not z_to_distance(z, lens)[:, 10:30].any()
    # In front of the camera z is above 0, behind it below.
    front = pixel_angles(lens, (51, 51)) < math.pi / 2
    assert not z_to_distance(-z, lens).any()
    assert z_to_distance(torch.ones_like(z), lens)[~front].sum() == 0


def test_gradients_go_to_the_distance():
    lens = Equidistant(3.0, 1.4).to(f64)
    distance = torch.rand(1, 7, 7, dtype=f64).add(0.5).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: distance_to_z(d, lens), distance)
    assert torch.autograd.gradcheck(lambda z: z_to_distance(z, lens), distance)


def test_wrong_maps_are_named():
    lens = Equidistant([3.0, 4.0], 1.4)
    with pytest.raises(ValueError, match=r"\(N, H, W\) or \(N, 1, H, W\), got \(2, 3, 4, 4\)"):
        distance_to_z(torch.ones(2, 3, 4, 4), lens)
    with pytest.raises(ValueError, match="2 lenses for 3 maps"):
        z_to_distance(torch.ones(3, 4, 4), lens)
    with pytest.raises(TypeError, match="tensor, got float"):
        distance_to_z(1.0, lens)
