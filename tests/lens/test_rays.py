"""Pixels and rays of lenses with tangential and thin-prism terms, on the whole range of each."""

import math

import pytest
import torch

from darswin.lens import BrownConrady, Fisheye624, KannalaBrandt, Mei
from darswin.lens.base import MARGIN

f64 = torch.float64


def double(*values):
    return torch.tensor(values, dtype=f64)


# A camera of OpenCV's omnidir, whose curve turns shortly behind what it sees, and the cameras of
# tests/lens/files/kitti360_0?.yaml, whose curve turns at its sphere; the left one's p₂ is larger.
CALIBRATIONS = {
    "omnidir": Mei(double(1.72), 1040.0, double(-0.18, -0.5595),
                   tangential=double(0.0014, -0.0006)),
    "left": Mei(double(2.35), 1390.0, double(0.032, 2.4), tangential=double(6e-4, -3.5e-3)),
    "right": Mei(double(2.7), 1600.4, double(-0.021, 5.2), tangential=double(-9e-4, 1.1e-3)),
}  # fmt: skip
RANDOM = ("Mei", "KannalaBrandt", "Fisheye624", "BrownConrady")


def random_lens(name: str, seed: int, aside: float = 1.0):
    """Eight lenses with terms as calibrations have them, times `aside`, used as far as they go."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int):
        return low + (high - low) * torch.rand(8, *shape, generator=generator, dtype=f64)

    focal = uniform(200, 2000)
    terms = dict(tangential=aside * uniform(-5e-3, 5e-3, 2))
    if name == "Mei":
        radial = uniform(-1, 1, 2) * double(0.3, 0.5)
        return Mei(uniform(0.5, 3), focal, radial, **terms)
    terms["prism"] = aside * uniform(-1e-2, 1e-2, 4)
    if name == "BrownConrady":
        return BrownConrady(focal, uniform(-1, 1, 3) * double(0.4, 0.2, 0.1), **terms)
    radial = uniform(-1, 1, 6) * double(0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
    if name == "KannalaBrandt":
        return KannalaBrandt(focal, radial[:, :4], **terms)
    return Fisheye624(focal, 3 * radial, **terms)


def rays_of(lens, rings: int = 60, spokes: int = 72):
    """θ (N, rings, 1), up to θ_max itself, and φ (1, 1, spokes)."""
    near = 1 - double(1e-3, 1e-5, 1e-7)
    fractions = torch.cat((torch.linspace(0.01, 1, rings - 3, dtype=f64), near))
    azimuth = torch.arange(spokes, dtype=f64) * (2 * math.pi / spokes) - 3.1
    return (lens.theta_max[:, None] * fractions)[..., None], azimuth[None, None]


def check_rays(lens):
    theta, azimuth = rays_of(lens)
    pixels = lens.project_rays(theta, azimuth, (1, 1))
    found, direction = lens.unproject_pixels(pixels, (1, 1))
    assert not found.isnan().any()
    # Where a curve turns, an angle is known to the root of what the pixel is.
    assert (found - theta).abs().max() < 1e-8
    assert (
        torch.remainder(direction - azimuth + math.pi, 2 * math.pi) - math.pi
    ).abs().max() < 1e-9


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_every_ray_of_a_calibration_is_found(name):
    check_rays(CALIBRATIONS[name])


@pytest.mark.parametrize("aside", [1, 10])
@pytest.mark.parametrize("name", RANDOM)
def test_every_ray_of_random_lenses_is_found(name, aside):
    for seed in range(3):
        check_rays(random_lens(name, seed, aside))


def area(lens, theta, azimuth):
    """By how much the lens makes an area larger, found from `project_rays` alone."""

    def place(point):  # in the plane θ (cos φ, sin φ)
        angle = torch.atan2(point[..., 1], point[..., 0])
        return lens.project_rays(point.norm(dim=-1), angle, (1, 1))

    direction = torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)
    point = theta[..., None] * direction
    columns = [
        torch.func.jvp(place, (point,), (axis.expand_as(point),))[1]
        for axis in torch.eye(2, dtype=f64)
    ]
    return columns[0][..., 0] * columns[1][..., 1] - columns[0][..., 1] * columns[1][..., 0]


@pytest.mark.parametrize("name", RANDOM)
def test_no_two_rays_share_a_pixel_up_to_the_limit_and_not_further(name):
    folds = 0
    for aside in (1, 10):
        lens = random_lens(name, 3, aside)
        theta, azimuth = rays_of(lens, spokes=360)
        assert (area(lens, theta, azimuth) > 0).all()
        straight = lens.replace(tangential=None, prism=None).theta_limit
        folded = lens.theta_limit < straight - 10 * MARGIN
        beyond = area(lens, (lens.theta_limit + 20 * MARGIN)[:, None, None], azimuth)
        assert (beyond.amin((1, 2)) < 0)[folded].all()
        folds += folded.sum()
    assert folds > 0


def test_the_sides_of_an_image_are_found_near_the_limit():
    lens = CALIBRATIONS["omnidir"]
    side = 1.95 * lens.r_max.item()
    centered = lens.replace(center=double(side / 2, side / 2)[None])
    sides = centered.side_angles((side, side + 2))[0]
    assert (sides > 1.7).all() and (sides < lens.theta_limit).all()
    pixels = double(-0.5, side / 2, side / 2, -0.5, side + 1.5, side / 2, side / 2, side - 0.5)
    theta, azimuth = centered.unproject_pixels(pixels.view(4, 2))
    torch.testing.assert_close(theta, sides)
    torch.testing.assert_close(
        centered.project_rays(theta, azimuth), pixels.view(4, 2), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("theta", [1.955, 2.0])
def test_a_side_whose_ray_is_hard_to_find_is_not_beyond_the_lens(theta):
    turn, terms = 26 * math.pi / 24, CALIBRATIONS["omnidir"].tangential[0]
    turned = terms * math.cos(turn) + terms.flip(0) * double(1, -1) * math.sin(turn)
    lens = CALIBRATIONS["omnidir"].replace(tangential=turned[None], center=double(700, 700)[None])
    lens = lens.with_theta_max(None)
    right = lens.project_rays(theta, 0.0)[0, 0].item()  # where the image ends
    found = lens.side_angles((1400, right + 0.5))[0, 2].item()
    assert found == pytest.approx(theta, abs=2e-3)  # the ray lands a little below the row


def test_a_pixel_outside_the_circle_has_no_ray_and_no_gradient():
    lens = CALIBRATIONS["omnidir"]
    values = [lens.xi.clone().requires_grad_(), lens.tangential.clone().requires_grad_()]
    moved = lens.replace(xi=values[0], tangential=values[1])
    pixels = double(0, 0, 300, 100, 5000, 0, 1e200, -3, math.nan, 1).view(5, 2)
    theta, _ = moved.rays(pixels, (1, 1))
    assert theta.isnan().tolist() == [False, False, True, True, True]
    torch.where(theta.isnan(), 0.0, theta).sum().backward(retain_graph=True)
    assert all(value.grad.isfinite().all() and value.grad.any() for value in values)


def test_float32_rays_land_where_they_came_from():
    for name in CALIBRATIONS:
        lens = CALIBRATIONS[name].to(torch.float32)
        theta, azimuth = rays_of(CALIBRATIONS[name])
        pixels = lens.project_rays(theta.float(), azimuth.float(), (1, 1))
        found, angle = lens.unproject_pixels(pixels, (1, 1))
        assert not found.isnan().any()
        again = lens.project_rays(found, angle, (1, 1))
        assert ((again - pixels).norm(dim=-1) / lens.r_max).max() < 1e-6


@pytest.mark.parametrize("name", RANDOM)
def test_second_derivatives_of_rays(name):
    lens = random_lens(name, 3)[0]
    lens = lens.with_theta_max(0.8 * lens.theta_limit)
    pixels = lens.project_rays(lens.theta_max * double(0.3, 0.9), double(0.4, 2.0), (1, 1))
    names = ("focal", "radial", "tangential")

    def rays(pixels, *values):
        made = lens.replace(**dict(zip(names, values, strict=True)))
        return made.unproject_pixels(pixels, (1, 1))

    values = [getattr(lens, n).clone().requires_grad_() for n in names]
    inputs = (pixels.detach().requires_grad_(), *values)
    assert torch.autograd.gradgradcheck(rays, inputs, atol=1e-6)
