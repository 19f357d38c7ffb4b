"""Angles in degrees where radians are expected: the error names the argument and converts it."""

import math

import numpy as np
import pytest
import torch

from darswin import PolarView, create_model
from darswin.data import WideAngle
from darswin.data.lens_distributions import PolynomialLenses, SphericalLenses
from darswin.models import LensAdapter
from darswin.utils.angles import check_turn, degrees_hint
from darswin.views import make_view, turned

SIZE = (3, 4)
RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("make", "name", "degrees"),
    [
        (lambda: make_view("tangent", SIZE, fov=90), "fov", 90),
        (lambda: make_view("cylindrical", SIZE, fov=180), "fov", 180),
        (lambda: make_view("equirectangular", SIZE, fov=360), "fov", 360),
        (lambda: make_view("mercator", SIZE, theta_max=85), "theta_max", 85),
        (lambda: turned(-30), "yaw", -30),
        (lambda: turned(yaw=30), "yaw", 30),
        (lambda: turned(0.5, pitch=45), "pitch", 45),
        (lambda: SphericalLenses(0.2, 0.3).draw(RNG, 170, 32), "fov", 170),
        (lambda: PolynomialLenses().draw(RNG, 170, 32), "fov", 170),
        (lambda: WideAngle(None, SphericalLenses(0, 1), fov=170), "fov", 170),
        (lambda: PolarView(4, 8, (2, 2), theta_max=85), "theta_max", 85),
        (lambda: LensAdapter(torch.nn.Identity(), 32, theta_max=85), "theta_max", 85),
        (lambda: create_model("darswin_a_nano", theta_max=85), "theta_max", 85),
        (lambda: create_model("swin_unet_adapted_nano", theta_max=85), "theta_max", 85),
        (lambda: create_model("swin_unet_undis_nano", max_fov=170), "max_fov", 170),
    ],
)
def test_an_angle_in_degrees_is_named_and_converted(make, name, degrees):
    with pytest.raises(ValueError) as error:
        make()
    assert str(error.value).startswith(f"{name} must be")
    assert f"{degrees}° is {math.radians(degrees):.4g}" in str(error.value)


def test_only_angles_that_look_like_degrees_are_converted():
    assert degrees_hint(90) == "; angles are in radians, and 90° is 1.571"
    assert not any(map(degrees_hint, (0.0, -1.6, math.pi, 361.0, math.inf, math.nan)))
    check_turn("yaw", -2 * math.pi)
    with pytest.raises(ValueError, match=r"yaw must be in .* rad, got nan"):
        check_turn("yaw", math.nan)
