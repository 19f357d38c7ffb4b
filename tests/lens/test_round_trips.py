"""Rays to pixels and back, for every model, in float64 and float32."""

import json
import math

import pytest
import torch
from helpers import refused
from lens_examples import (
    ASIDE,
    CALIBRATIONS,
    RANDOM,
    calibrated,
    double,
    example,
    f64,
    points_around,
    random_lens,
)
from torch import Tensor
from torch.utils import _pytree as pytree

from darswin.lens import MODELS, BrownConrady, Mei, Spherical, cat, from_dict, load, save, to_dict
from darswin.lens.base import MARGIN
from darswin.lens.solve import direction_of

# A camera of OpenCV's omnidir. Its curve turns shortly beyond the image.
OMNIDIR = Mei(double(1.72), 1040.0, double(-0.18, -0.5595), tangential=double(0.0014, -0.0006))


@pytest.mark.parametrize("name", MODELS)
def test_unproject_undoes_project_and_finds_nothing_beyond(name):
    generator = torch.Generator().manual_seed(5)
    near = double(0, 1e-12, 1e-9, 1e-6, 1e-3)
    fractions = torch.cat((near, torch.linspace(0.01, 1, 297, dtype=f64), 1 - near))
    nowhere = double(-1e-3, -1, -1e9, math.inf, -math.inf, math.nan).expand(4, -1)
    for _ in range(2):
        lens = example(name, generator)
        assert torch.equal(lens.theta_max, lens.theta_limit)
        theta = (lens.theta_max[:, None] * fractions).sort(dim=1).values
        radius = lens.project(theta)
        evenly = lens.theta_max[:, None] * torch.linspace(0, 0.999, 300, dtype=f64)
        assert radius.isfinite().all() and (lens.project(evenly).diff(dim=1) > 0).all()
        inner = evenly[:, :200]
        torch.testing.assert_close(lens.resized(2).project(inner), 2 * lens.project(inner))
        found = lens.unproject(radius)
        if name == "OCamInverse":  # its polynomial need not be 0 at θ = 0
            theta, found = theta[:, 5:], found[:, 5:]
        else:
            assert ((found[:, 1:6] - theta[:, 1:6]).abs() <= 1e-9 * theta[:, 1:6]).all()
        assert (found - theta).abs().max() < 1e-9
        for end in (1.0, 0.5):
            used = lens.with_theta_max(end * lens.theta_limit)
            # At the limit, r may rise so steeply that it is exact to 1e-9 only.
            more = double(1.5, 1e6) if end == 1 else double(1 + 1e-9, 1.5, 1e6)
            assert used.unproject(torch.cat((nowhere, used.r_max[:, None] * more), 1)).isnan().all()
            assert used.unproject(used.r_max[:, None]).isfinite().all()


def rays_of(lens, rings=16, spokes=24):
    """θ (N, rings, 1), almost up to θ_max, and φ (1, 1, spokes)."""
    near = 1 - double(1e-3, 1e-5, 1e-7)
    fractions = torch.cat((torch.linspace(0.01, 1, rings - 3, dtype=f64), near))
    azimuth = torch.arange(spokes, dtype=f64) * (2 * math.pi / spokes) - 3.1
    return (lens.theta_max[:, None] * fractions)[..., None], azimuth[None, None]


@pytest.mark.parametrize("name", [
    *ASIDE, "omnidir", "kitti360_02.yaml", "kitti360_03.yaml",
    *((name, aside) for name in RANDOM[:4] for aside in (1, 10)),
])  # fmt: skip
def test_every_ray_is_found(name):
    if isinstance(name, tuple):
        lens = random_lens(name[0], 0, name[1], 3)
    else:
        lens = (ASIDE | {"omnidir": OMNIDIR}).get(name) or calibrated(name)
    lens = lens.with_theta_max(None)
    theta, azimuth = rays_of(lens)
    found, direction = lens.unproject_pixels(lens.project_rays(theta, azimuth, (1, 1)), (1, 1))
    # Where a curve turns, the error of an angle is the square root of the pixel's error.
    assert (found - theta).abs().max() < 1e-8
    off = torch.remainder(direction - azimuth + math.pi, 2 * math.pi) - math.pi
    assert off.abs().max() < 1e-9


def area(lens, theta, azimuth):
    """The factor by which the lens enlarges an area, from `pixels` alone, which go beyond θ_max."""

    def place(point):  # in the plane θ (cos φ, sin φ)
        angle = torch.atan2(point[..., 1], point[..., 0])
        return lens.pixels(point.norm(dim=-1), direction_of(angle), (1, 1))

    point, axes = theta[..., None] * direction_of(azimuth), torch.eye(2, dtype=f64)
    columns = [torch.func.jvp(place, (point,), (axis.expand_as(point),))[1] for axis in axes]
    return torch.linalg.det(torch.stack(columns, -1))


@pytest.mark.parametrize("name", RANDOM[:4])
def test_no_two_rays_share_a_pixel_up_to_the_limit_and_not_further(name):
    folds = 0
    for aside in (1, 10):
        lens = random_lens(name, 3, aside, 4)
        theta, azimuth = rays_of(lens, rings=8, spokes=360)
        assert (area(lens, theta, azimuth) > 0).all()
        straight = lens.replace(tangential=None, prism=None).theta_limit
        folded = lens.theta_limit < straight - 10 * MARGIN
        beyond = area(lens, (lens.theta_limit + 20 * MARGIN)[:, None, None], azimuth)
        assert (beyond.amin((1, 2)) < 0)[folded].all()
        folds += folded.sum()
    assert folds > 0


def test_the_sides_of_an_image_are_found_near_the_limit():
    side = 1.95 * OMNIDIR.r_max.item()
    centered = OMNIDIR.replace(center=double(side / 2, side / 2)[None])
    sides = centered.side_angles((side, side + 2))[0]
    assert (sides > 1.7).all() and (sides < OMNIDIR.theta_limit).all()
    pixels = double(-0.5, side / 2, side / 2, -0.5, side + 1.5, side / 2, side / 2, side - 0.5)
    theta, azimuth = centered.unproject_pixels(pixels.view(4, 2))
    torch.testing.assert_close(theta, sides)
    again = centered.project_rays(theta, azimuth)
    torch.testing.assert_close(again, pixels.view(4, 2), rtol=0, atol=1e-9)


@pytest.mark.parametrize("theta", [1.955, 2.0])
def test_a_side_whose_ray_is_hard_to_find_is_not_beyond_the_lens(theta):
    turn, terms = 26 * math.pi / 24, OMNIDIR.tangential[0]
    terms = terms * math.cos(turn) + terms.flip(0) * double(1, -1) * math.sin(turn)
    lens = OMNIDIR.replace(tangential=terms[None], center=double(700, 700)[None])
    lens = lens.with_theta_max(None)
    right = lens.project_rays(theta, 0.0)[0, 0].item()  # where the image ends
    found = lens.side_angles((1400, right + 0.5))[0, 2].item()
    assert found == pytest.approx(theta, abs=2e-3)  # the ray lands a little below the row


def test_a_pixel_outside_the_circle_has_no_ray_and_no_gradient():
    values = [OMNIDIR.xi.clone().requires_grad_(), OMNIDIR.tangential.clone().requires_grad_()]
    moved = OMNIDIR.replace(xi=values[0], tangential=values[1])
    pixels = double(0, 0, 300, 100, 5000, 0, 1e200, -3, math.nan, 1).view(5, 2)
    theta, _ = moved.theta_and_direction(pixels, (1, 1))
    assert theta.isnan().tolist() == [False, False, True, True, True]
    torch.where(theta.isnan(), 0.0, theta).sum().backward(retain_graph=True)
    assert all(value.grad.isfinite().all() and value.grad.any() for value in values)


@pytest.mark.parametrize("name", ASIDE)
def test_points_and_pixels_undo_each_other(name):
    lens = ASIDE[name]
    points = torch.from_numpy(points_around(lens.theta_max.item() - 1e-6)).unflatten(0, (40, 5))
    pixels = lens.project_points(points)
    assert pixels.shape == (40, 5, 2)
    torch.testing.assert_close(lens.unproject_points(pixels), points, rtol=0, atol=1e-8)
    with torch.inference_mode():
        assert torch.equal(lens.to(f64).project_points(points), pixels)
        torch.testing.assert_close(lens.to(f64).unproject_points(pixels), points, rtol=0, atol=1e-8)
    for scale in (1e-30, 1e30):  # the distance does not matter
        torch.testing.assert_close(lens.project_points(scale * points), pixels)


def test_points_that_are_not_seen_are_nan():
    lens = Spherical(0.5, 10.0, [1.0, 1.5], center=[3.0, 4.0])
    points = torch.tensor([[0.0, 0, 2], [0, 0, -2], [0, 0, 0], [1, 0, 0.4], [math.nan, 0, 1]])
    pixels = lens.project_points(points[None])
    assert pixels.shape == (2, 5, 2) and pixels[:, 0].tolist() == [[3, 4]] * 2
    nan = pixels.isnan()
    assert torch.equal(nan[..., 0], nan[..., 1])
    assert nan[0, :, 0].tolist() == [False, True, True, True, True]
    assert nan[1, :, 0].tolist() == [False, True, True, False, True]
    # Beyond 90°, points behind the camera's plane may be seen.
    wide = calibrated("kalibr_tumvi.yaml", "cam0")
    behind = wide.project_points(double(1, 0, -0.2))
    torch.testing.assert_close(behind, wide.project_rays(math.pi / 2 + math.atan(0.2), 0.0))
    found = lens.unproject_points(torch.tensor([[[1e4, 4.0], [3.0, 4.0]]]))
    assert found[:, 0].isnan().all() and found[:, 1].tolist() == [[0, 0, 1]] * 2


# -- float32 ------------------------------------------------------------------------------------

EPS = torch.finfo(torch.float32).eps
SIZE = (480, 640)
ROWS, COLUMNS = (torch.arange(0, side, 40, dtype=f64) for side in SIZE)
PIXELS = torch.stack(torch.meshgrid(COLUMNS, ROWS, indexing="xy"), -1).flatten(0, 1)

# A pinhole camera up to 90°, where the powers of w overflow in float32.
PINHOLE = BrownConrady(
    double(500.0), double(-0.22, 0.13, 0.028), tangential=double(1e-3, 1e-3),
    center=double(320, 240), image_size=double(*SIZE),
)  # fmt: skip


def in_image(lens):
    """The lenses with their principal point near the middle of images of `SIZE`."""
    center, size = (double(*pair).expand(len(lens), 2) for pair in ((322, 237), SIZE))
    return lens.replace(center=center, image_size=size)


def check(exact, lens):
    """Compares one lens in float64 with the same lens in float32."""
    assert lens.theta_max.dtype == torch.float32 and lens.r_max.isfinite()
    limit, eps = min(exact.theta_max.item(), lens.theta_max.item()), 64 * EPS
    theta, _ = exact.unproject_pixels(PIXELS)
    found, azimuth = lens.unproject_pixels(PIXELS.float())
    # Rounding may move the rim, near a fold by the square root of the rounding.
    inner = theta < (1 - 2 * EPS**0.5) * limit
    assert inner.any() and not found[inner].isnan().any()
    seen = ~theta.isnan() & ~found.isnan()
    assert (theta.isnan() & ~found.isnan()).sum() <= 0.01 * len(PIXELS)
    # Rays and pixels are exact to their last bits.
    again = exact.project_rays(found.double(), azimuth.double())
    slope = exact._slope(theta.nan_to_num().clamp(max=limit)).abs()
    off = (again - PIXELS).abs().amax(-1)
    assert (off <= eps * (640 + exact.r_max.clamp(max=640) + slope))[seen].all()
    theta, azimuth = torch.linspace(0, 0.98 * limit, 50, dtype=f64), torch.linspace(-3, 3, 50)
    expected = exact.project_rays(theta, azimuth.double())
    off = (lens.project_rays(theta.float(), azimuth) - expected).abs().amax(-1)
    assert (off <= eps * (640 + expected.abs().amax(-1) + exact._slope(theta).abs())).all()


LENSES = {
    **{f"random {n}": lambda n=n: random_lens(n, 1, 0.4, 2) for n in RANDOM},
    **{n: lambda n=n: example(n, torch.Generator().manual_seed(1), (100, 600))[:2] for n in MODELS},
    **{f"aside {n}": lambda n=n: ASIDE[n] for n in ASIDE},
    **{name: lambda name=name, camera=camera: calibrated(name, camera)
       for name, camera in CALIBRATIONS},
}  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_float32_is_float64_but_for_rounding(name):
    lenses = in_image(LENSES[name]())
    for exact in lenses.replace(focal=lenses.focal.clamp(max=600)) if "random" in name else lenses:
        check(exact, exact.to(torch.float32))


def test_conversions(tmp_path):
    def loaded(name):
        save(PINHOLE, tmp_path / name)
        return load(tmp_path / name)

    for lens in (
        PINHOLE.to("cpu", torch.float32), cat([PINHOLE, PINHOLE]).to(dtype=torch.float32)[1],
        from_dict(json.loads(json.dumps(to_dict(PINHOLE)))), loaded("lens.json"),
        loaded("lens.yaml").with_theta_max(None),
    ):  # fmt: skip
        check(PINHOLE, lens)
    # Without a check, their θ_max may be beyond what float32 can represent.
    theta, _ = PINHOLE.unproject_pixels(PIXELS)
    assert not theta.isnan().any()
    for lens in (
        pytree.tree_map_only(torch.Tensor, Tensor.float, PINHOLE),
        PINHOLE.replace(**{name: t.float() for name, t in PINHOLE._tensors().items()}),
        cat([PINHOLE.to(torch.float32), PINHOLE])[0],
    ):
        found, _ = lens.unproject_pixels(PIXELS.to(lens.theta_max.dtype))
        torch.testing.assert_close(found.double(), theta, rtol=0, atol=64 * EPS)
    described = to_dict(PINHOLE)
    refused(r"theta_max must be at most 1\.57079", from_dict, described | {"theta_max": 1.58})
    assert from_dict(described | {"theta_max": 1.5}).theta_max.item() == pytest.approx(1.5)
    # Also if only the radial terms overflow.
    assert PINHOLE.replace(tangential=None).to(torch.float32).r_max.isfinite()
    assert PINHOLE.to(f64).same_as(PINHOLE) and PINHOLE.to("cpu").same_as(PINHOLE)
