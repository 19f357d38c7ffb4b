"""The report on a lens: fields of view, pixels per degree, patches of each spacing."""

import math

import pytest
import torch
from lens_examples import FRONT

from darswin.lens import Mei, Perspective, Polynomial, Spherical
from darswin.viz.report import (
    best_spacing,
    describe,
    largest_offset,
    outside_share,
    patches,
    pixels_per_degree,
)

MEI = Mei(
    2.35, 1390.0, (0.032, 2.4),
    math.radians(102), (708.5, 697.0), image_size=(1400, 1400),
    tangential=(6e-4, -3.5e-4),
)  # fmt: skip


def test_pixels_per_degree_are_those_between_neighbours():
    lens = MEI.to(torch.float64)
    theta = torch.tensor([0.0, 0.5, 1.7], dtype=torch.float64)
    along, around = pixels_per_degree(lens, theta)
    step = math.radians(1e-4)
    torch.testing.assert_close(
        along, (lens.project(theta + step) - lens.project(theta - step)) / 2e-4, rtol=1e-5, atol=0
    )
    # Two rays that are a small angle apart on a cone of half angle θ.
    torch.testing.assert_close(around[0], along[0])
    apart = lens.project(theta)[1:] * step / (torch.sin(theta[1:]) * step * 180 / math.pi)
    torch.testing.assert_close(around[1:], apart)


def test_field_of_view_and_sides():
    text = describe(FRONT)
    sides, end = FRONT.to(torch.float64).side_angles()[0], FRONT.theta_max.item()
    seen = sides.clamp(max=end).rad2deg().tolist()
    assert f"{seen[0] + seen[2]:.2f}° across, {seen[1] + seen[3]:.2f}° down" in text
    for side, angle in zip(("left", "top", "right", "bottom"), sides.tolist(), strict=True):
        beyond = " (beyond θ_max)" * (angle > end)
        assert f"{side} {math.degrees(angle):.2f}°{beyond}" in text
    assert "° between the corners (beyond θ_max)" in text
    assert "the lens ends before the corners" in describe(MEI)
    with pytest.raises(ValueError, match="give image_size"):
        describe(Spherical(0.5, 100.0))
    assert "480 × 640 px (H × W)" in describe(Spherical(0.5, 100.0), (480, 640))


def test_a_principal_point_outside_the_sensor():
    """A part of an image to the right of the principal point."""
    lens = Perspective(100.0, 1.2, center=[-100.5, 49.5], image_size=(100, 100))
    text = describe(lens)
    # The part begins 45° to the right of the axis.
    across = math.degrees(math.atan(2.0)) - 45
    assert f"{across:.2f}° across, 53.13° down, on the row and the column" in text
    assert "left -45.00°" in text and "are integers), outside the sensor" in text
    assert "outside the sensor" not in describe(FRONT)


def test_how_much_is_outside_the_sensor():
    lens = Perspective(100.0, math.atan(0.5), image_size=(100, 100))  # a circle in a square
    assert outside_share(lens.to(torch.float64), (100, 100)) == 0
    # Half of each circle's radii end in the upper half.
    half = lens.replace(center=torch.tensor([[49.5, -0.5]]))
    assert outside_share(half.to(torch.float64), (100, 100)) == pytest.approx(0.5, abs=0.01)
    assert "50.0% of the samples up to θ_max" in describe(half)
    assert "left: the lens ends before" in describe(Polynomial([30.0, 0.0, -3.0], 1.0), (99, 99))


def test_tangential_size():
    assert largest_offset(FRONT) == 0 and "tangential" not in describe(FRONT)
    theta = MEI.theta_max
    azimuth = torch.linspace(0, 2 * math.pi, 721)
    radial = MEI.replace(tangential=None)
    apart = MEI.project_rays(theta, azimuth) - radial.project_rays(theta, azimuth)
    largest = apart.norm(dim=-1).max().item()
    assert largest_offset(MEI) == pytest.approx(largest, rel=1e-3)
    assert f"{largest:.2f} px at most, by tangential" in describe(MEI)


def test_spacings():
    text = describe(FRONT)
    assert "tan θ ends at 90°" in text
    narrow = Spherical.from_fov(0.5, 2.0, 100.0, image_size=(200, 200))
    assert "tan θ ends" not in describe(narrow)
    # Equal steps of the radius: the areas of the rings are as 1, 3, 5, …
    found = patches(narrow, "radius", 16, 64)
    assert found.ratio == pytest.approx(31, rel=1e-3)
    assert found.width == pytest.approx((100 / 16, 100 / 16), rel=1e-3)
    assert found.area[0] == pytest.approx(math.pi * (100 / 16) ** 2 / 64, rel=1e-3)
    ratios = {s: patches(narrow, s, 16, 64).ratio for s in ("theta", "tan", "g")}
    assert best_spacing(narrow, 16, 64) == min(ratios, key=ratios.get)
    halved = narrow.replace(affine=torch.tensor([[[1.0, 0.0], [0.0, 0.5]]]))
    assert patches(halved, "theta", 16, 64).area[0] == pytest.approx(
        patches(narrow, "theta", 16, 64).area[0] / 2
    )


@pytest.mark.parametrize("focal", [1e-300, 1e-200, 1e200, 1e300])
def test_lengths_whose_squares_are_no_numbers(focal):
    usual, extreme = (Perspective(torch.tensor(f, dtype=torch.float64), 1.0) for f in (1.0, focal))
    for spacing in ("theta", "tan", "g", "radius"):
        ratio = patches(usual, spacing, 16, 64).ratio
        assert patches(extreme, spacing, 16, 64).ratio == pytest.approx(ratio, rel=1e-6)
    assert describe(extreme, (100, 100))
