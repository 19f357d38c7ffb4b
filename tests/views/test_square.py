import math

import pytest
import torch
from helpers import refused
from lens_examples import ASIDE
from torch.testing import assert_close

from darswin.lens import Equidistant, Perspective, Polynomial, Spherical
from darswin.lens.pixels import OUTSIDE
from darswin.lens.spacing import SPACINGS
from darswin.views.square import SquareView, disc_to_square, square_to_disc

f64 = torch.float64


def published(a, b):
    """Shirley and Chiu's map of one place, with the four regions of their paper."""
    if a > -b:
        return (a, math.pi / 4 * (b / a)) if a > b else (b, math.pi / 4 * (2 - a / b))
    if a < b:
        return -a, math.pi / 4 * (4 + b / a)
    return -b, math.pi / 4 * (6 - a / b) if b else 0.0


def grid(count):
    steps = torch.linspace(-1, 1, count, dtype=f64)
    return torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1)


def disc(places):
    radius, direction = square_to_disc(places)
    return radius[..., None] * direction


@pytest.mark.parametrize("count", [12, 13])  # without and with the middle and the axes
def test_it_is_the_published_map_and_back(count):
    places = grid(count)
    r, phi = torch.tensor([published(*p) for p in places.view(-1, 2).tolist()], dtype=f64).unbind(1)
    expected = r[:, None] * torch.stack((phi.cos(), phi.sin()), -1)
    assert_close(disc(places).view(-1, 2), expected, rtol=0, atol=1e-14)
    radius, direction = square_to_disc(places)
    assert torch.allclose(direction.norm(dim=-1), torch.ones((), dtype=f64))
    assert_close(disc_to_square(radius, direction), places)
    middle = disc_to_square(torch.zeros(1), torch.zeros(1, 2))  # the direction that lenses return
    assert torch.equal(middle, torch.zeros(1, 2))


def test_areas_keep_their_ratio_and_nothing_jumps_at_diagonals_and_axes():
    areas = torch.linalg.det(torch.func.vmap(torch.func.jacrev(disc))(grid(12).view(-1, 2)))
    assert_close(areas, torch.full_like(areas, math.pi / 4))
    line = torch.linspace(-1, 1, 201, dtype=f64)[:, None]
    sides = torch.tensor([(1, 1), (1, -1), (1, 0), (0, 1)], dtype=f64)
    steps = torch.tensor([(1, 0), (0, 1), (-1, 0), (0, -1)], dtype=f64)
    on = (sides[:, None] * line)[:, :, None]
    assert (disc(on + 1e-9 * steps) - disc(on)).abs().max() < 4e-9
    there = disc(on) + 1e-9 * steps
    radius = there.norm(dim=-1)
    assert (disc_to_square(radius, there / radius[..., None]) - on).abs().max() < 4e-9


EXAMPLES = {
    "radial, off centre": (Spherical(0.6, 20.0, 1.4, center=[18.0, 25.0]).to(f64), (48, 40)),
    "beyond 90°": (Polynomial([12.0, 0.5, -0.3, 0.1], 2.0).to(f64), (60, 60)),
    "two lenses": (Spherical.from_fov([0.1, 0.9], 2.6, 20.0).to(f64), (40, 40)),
    "general": (ASIDE["Mei"].resized(1 / 35), (40, 40)),
}


@pytest.mark.parametrize("name", EXAMPLES)
@pytest.mark.parametrize("spacing", SPACINGS)
def test_the_pixels_of_the_square_are_where_their_rays_land_and_back(name, spacing):
    lens, size = EXAMPLES[name]
    if spacing == "tan":
        lens = lens.with_theta_max(1.3)
    view = SquareView((9, 9), spacing=spacing)
    steps = (2 * torch.arange(9, dtype=f64) + 1) / 9 - 1
    r, phi = torch.tensor([[published(a, b) for a in steps] for b in steps], dtype=f64).unbind(-1)
    last = lens.theta_max[:, None, None]
    theta_of = {
        "theta": lambda: r * last,
        "tan": lambda: torch.atan(r * torch.tan(last)),
        "radius": lambda: lens.unproject(r * lens.project(last)),
    }
    if spacing in theta_of:
        expected = lens.project_rays(theta_of[spacing](), phi[None], size)
        assert_close(view.image_points(lens, size), expected, atol=1e-7, rtol=1e-9)
    pixels = view.view_points(lens, size)
    places, beyond = (2 * pixels + 1) / 9 - 1, (pixels == OUTSIDE).all(-1)
    y, x = torch.meshgrid(*(torch.arange(side, dtype=f64) for side in size), indexing="ij")
    theta, azimuth = lens.unproject_pixels(torch.stack((x, y), -1)[None], size)
    assert torch.equal(beyond, ~lens.sees(theta))
    assert (places[~beyond].abs() <= 1).all()
    # The directions at the places of the image's pixels are those of the image's rays.
    radius, direction = square_to_disc(places)
    apart = torch.atan2(direction[..., 1], direction[..., 0]) - azimuth.expand_as(radius)
    same = torch.cos(apart[~beyond & (radius > 1e-3)])
    assert torch.allclose(same, torch.ones((), dtype=f64))
    if spacing == "theta":
        share = (theta / last)[~beyond]
        assert_close(radius[~beyond], share.clamp(max=1), atol=1e-7, rtol=1e-7)


def test_tan_ends_before_90_degrees():
    view, too_wide = SquareView((8, 8), spacing="tan"), Equidistant(4.0, 1.6)
    for points in (view.image_points, view.view_points):
        refused("spacing='tan' needs lenses with θ_max below 90°", points, too_wide, (8, 8))
        assert points(Perspective(4.0, 1.2), (8, 8)).isfinite().all()
