"""Angles in degrees where radians are expected: the error names the argument and converts it."""

import math

import numpy as np
import pytest
import torch

from darswin import PolarView, create_model
from darswin.data import WideAngle
from darswin.data.lens_distributions import PolynomialLenses, SphericalLenses
from darswin.lens import (
    Equidistant,
    FieldOfView,
    KannalaBrandt,
    OCamInverse,
    Orthographic,
    Perspective,
    Polynomial,
    Spherical,
    Tabulated,
    from_dict,
)
from darswin.lens.orientation import rotated
from darswin.utils.angles import check_turn, degrees_hint
from darswin.views import make_view, turned

SIZE = (3, 4)
RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("make", "name", "degrees"),
    [
        (lambda: Equidistant.from_fov(170, 100), "fov", 170),
        (lambda: Perspective.from_fov(fov=170, radius=100), "fov", 170),
        (lambda: Spherical.from_fov(0.5, torch.tensor([1.0, 170.0]), 100), "fov", 170),
        (lambda: from_dict({"model": "Stereographic", "fov": 170}, (480, 640)), "fov", 170),
        (lambda: from_dict({"model": "Equidistant", "focal": 9, "theta_max": 85}), "theta_max", 85),
        (lambda: KannalaBrandt(100, [0.1], theta_max=85), "theta_max", 85),
        (lambda: OCamInverse([150.0, 90.0], 85), "theta_max", 85),
        (lambda: Polynomial([1.0], [0.5, 85.0]), "theta_max", 85),
        (lambda: Equidistant(100).with_theta_max(85), "theta_max", 85),
        (lambda: Orthographic.from_fov(170.0, 50.0), "fov", 170),
        (lambda: FieldOfView(57, 100), "omega", 57),
        (lambda: Tabulated([0.0, 45.0, 90.0], [0.0, 100.0, 190.0]), "angles", 90),
        (lambda: rotated(Equidistant(100, center=(5, 5)), -90), "angle", -90),
        (lambda: make_view("perspective", SIZE, fov=90), "fov", 90),
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
        (lambda: make_view("square", 32, fov=85), "fov", 85),
        (lambda: create_model("darswin_a_nano", theta_max=85), "theta_max", 85),
        (lambda: make_view("perspective", 32, reach=80), "reach", 80),
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
    for make, most in (
        *((lambda fov=fov: Orthographic.from_fov(fov, 50.0), "fov must be at most") for fov in
          (3.2, 2 * math.pi, 6.5)),
        (lambda: Perspective(100, 1.6), r"theta_max must be at most 1\.57"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=most) as error:
            make()
        assert "radians" not in str(error.value) and "angles are" not in str(error.value)
