"""Pixels: solid angles against spherical polygons, z against points, views of other lenses."""

import math

import pytest
import torch
from helpers import refused
from lens_examples import ASIDE

from darswin.lens import (
    Equidistant,
    KannalaBrandt,
    Mei,
    Perspective,
    Spherical,
    distance_to_z,
    z_to_distance,
)
from darswin.lens.pixels import pixel_angles, pixel_rays, ray_channels, solid_angles

f64 = torch.float64


def triangle(a, b, c):
    """The solid angles of spherical triangles, after Van Oosterom and Strackee, 1983."""
    above = (a * torch.linalg.cross(b, c)).sum(-1).abs()
    return 2 * torch.atan2(above, 1 + (a * b).sum(-1) + (b * c).sum(-1) + (a * c).sum(-1))


def polygons(lens, x, y, parts=4):
    """The solid angles of the pixels at (x, y), each divided into parts × parts."""
    step = torch.linspace(-0.5, 0.5, parts + 1, dtype=f64)
    corners = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1)
    pixels = torch.stack((x, y), -1)[:, None, None] + corners
    at = lens.with_theta_max(None).unproject_points(pixels[None])[0]
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
    found, theta = solid_angles(lens, (46, 64))[0], pixel_angles(lens, (46, 64))[0]
    assert torch.equal(found == 0, theta.isnan()) and (found >= 0).all()
    y, x = (~theta.isnan()).nonzero().unbind(1)
    points = lens.unproject_points(torch.stack((x, y), -1).to(f64))
    torch.testing.assert_close(theta[y, x], torch.acos(points[..., 2].clamp(-1, 1)))
    # Not at pixels with a corner beyond the model's limit.
    y, x = (theta < lens.theta_max - 0.1).nonzero().unbind(1)
    assert len(x) > 300
    torch.testing.assert_close(found[y, x], polygons(lens, x.to(f64), y.to(f64)), rtol=2e-3, atol=0)


@pytest.mark.parametrize("theta_max", [0.8, math.pi / 2, 2.4])
def test_a_whole_circle_sums_up_to_the_cap(theta_max):
    for make in (Equidistant, lambda f, t: Spherical(0.9, f, t)):
        lens = make(150 / make(1.0, theta_max).to(f64).r_max.item(), theta_max).to(f64)
        total = solid_angles(lens, (310, 311)).sum().item()
        assert total == pytest.approx(2 * math.pi * (1 - math.cos(theta_max)), rel=3e-3)


def test_float32_batches_and_wrong_maps():
    lens, distance = Spherical([0.2, 0.9], 20.0, 1.2), torch.rand(2, 30, 40)
    with_channel = distance_to_z(distance[:, None], lens)
    assert torch.equal(with_channel, distance_to_z(distance, lens)[:, None])
    found = solid_angles(lens, (40, 48))
    assert found.shape == (2, 40, 48) and found.dtype == torch.float32
    for k in range(2):
        exact = solid_angles(lens[k].to(f64), (40, 48))[0]
        torch.testing.assert_close(found[k].double(), exact, rtol=1e-5, atol=0)
    assert solid_angles(lens[:0], (40, 48)).shape == (0, 40, 48)
    said = r"\(N, H, W\) or \(N, 1, H, W\), got \(2, 3, 4, 4\)"
    refused(said, distance_to_z, torch.ones(2, 3, 4, 4), lens)
    refused("2 lenses for 3 maps", z_to_distance, torch.ones(3, 4, 4), lens)
    refused("tensor, got float", distance_to_z, 1.0, lens, error=TypeError)


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


@pytest.mark.parametrize("name", LENSES)
def test_rays_as_channels(name):
    lens, size = LENSES[name].with_theta_max(0.9), (46, 64)
    center = lens.center.clone().requires_grad_()
    rays = ray_channels(*pixel_rays(lens.replace(center=center), size))
    theta = pixel_angles(lens, size)
    seen = ~theta.isnan()
    assert rays.shape == (1, 3, *size) and seen.any() and not seen.all()
    torch.testing.assert_close(rays.norm(dim=1), seen.to(f64))
    torch.testing.assert_close(rays[:, 2][seen], theta[seen].cos())
    landed = lens.project_points(rays.movedim(1, -1)[seen][None], size)[0]
    y, x = seen[0].nonzero().T
    torch.testing.assert_close(landed, torch.stack((x, y), -1).to(f64))
    rays.square().mul(torch.rand_like(rays)).sum().backward()
    assert center.grad.isfinite().all() and center.grad.all()


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
    few, lens = torch.rand(1, 7, 7, dtype=f64).add(0.5).requires_grad_(), lens.with_theta_max(1.4)
    assert torch.autograd.gradcheck(lambda d: distance_to_z(d, lens), few)
    assert torch.autograd.gradcheck(lambda z: z_to_distance(z, lens), few)
