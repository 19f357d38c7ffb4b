import math

import cv2
import lens_examples
import numpy as np
import pytest
import torch
from helpers import refused
from lens_examples import double, f64

from darswin.lens import (
    MODELS,
    DoubleSphere,
    EnhancedUnified,
    KannalaBrandt,
    Mei,
    Spherical,
    cat,
    fit,
)

FRONT = lens_examples.FRONT.to(f64).replace(affine=double(1, 0, 0, 1.1).view(1, 2, 2))


@pytest.mark.parametrize("lens", [
    FRONT,
    Spherical(double(0.7), 200.0, 1.6),
    EnhancedUnified(double(0.6145), 1.0862, 198.354, 1.7),
    DoubleSphere(double(-0.2135), 0.578, 331.24, 1.65),
    KannalaBrandt(double(190.98), [0.0035, 0.0007, -0.0021, 0.0002], 1.8),
], ids=lambda lens: type(lens).__name__)  # fmt: skip
def test_every_model_finds_itself(lens):
    found, error = fit(type(lens), lens)
    assert error.item() < 1e-8
    for name in lens.parameters:
        torch.testing.assert_close(getattr(found, name), getattr(lens, name), rtol=1e-6, atol=1e-6)


# The largest error of each model, px, for the front camera (1280×966) up to 95°.
@pytest.mark.parametrize(("model", "most"), [
    ("KannalaBrandt", 0.26), ("Mei", 0.56), ("Spherical", 2.4), ("EnhancedUnified", 0.61),
    ("DoubleSphere", 0.53), ("OCam", 0.21), ("OCamInverse", 1e-6), ("Polynomial", 1e-6),
    ("FieldOfView", 7.3), ("Equidistant", 34.0), ("Tabulated", 1e-5),
])  # fmt: skip
def test_the_error_is_what_is_left(model, most):
    found, error = fit(model, FRONT)
    assert type(found) is MODELS[model] and error.item() < most
    theta = torch.linspace(0, 1, 700, dtype=f64) * FRONT.theta_max
    azimuth = torch.full_like(theta, math.pi / 2)  # where the affine enlarges distances most
    apart = found.project_rays(theta, azimuth) - FRONT.project_rays(theta, azimuth)
    assert apart.norm(dim=-1).max().item() == pytest.approx(error.item(), rel=1e-2, abs=1e-6)
    assert torch.equal(found.center, FRONT.center)
    assert torch.equal(found.image_size, FRONT.image_size)


@pytest.mark.slow
def test_tangential_terms_are_fitted_where_the_model_has_them():
    lens = Mei(double(2.35), 1390.0, [0.032, 2.4], 1.7, tangential=[1.3e-3, -7e-4])
    same, error = fit("Mei", lens)
    assert error.item() < 1e-3
    torch.testing.assert_close(same.tangential, lens.tangential, rtol=1e-3, atol=1e-7)
    assert fit("KannalaBrandt", lens).error < 0.3 < 1.0 < fit("Spherical", lens).error


def test_a_batch_in_its_own_precision():
    lens = cat([Spherical(0.3, 100.0, 1.2), Spherical(0.9, 50.0, 1.2)])
    found, error = fit(KannalaBrandt, lens)
    assert len(found) == 2 and error.shape == (2,) and found.focal.dtype == torch.float32
    torch.testing.assert_close(found.radial[1], fit(KannalaBrandt, lens[1]).lens.radial[0])
    fewer = fit(KannalaBrandt, lens, terms=1)
    assert fewer.lens.radial.shape == (2, 1) and (fewer.error > error).all()
    refused("model must be a lens class", fit, 3, lens, error=TypeError)


# Cameras of OpenCV's fisheye model, of pictures with (H, W) = (480, 640).
MATRIX = np.array([[201.0, 0, 326.4], [0, 201.0, 231.7], [0, 0, 1]])
TERMS = np.array([0.021, -0.006, 0.0007, -0.0002])


def off(found, reach):
    """How far radii are at most from those of OpenCV, px."""
    theta = np.linspace(0.05, reach, 20)
    points = np.stack((np.tan(theta), 0 * theta), -1)[None]
    expected = cv2.fisheye.distortPoints(points, MATRIX, TERMS)[0, :, 0] - 326.4
    return np.abs(found.project(torch.from_numpy(theta)).numpy() - expected).max()


def rays_of_opencv(pixels):
    """(h, w, 3): the rays that OpenCV finds for pixels; of no unit length."""
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
    points = cv2.fisheye.undistortPoints(flat, MATRIX, TERMS).reshape(pixels.shape)
    rays = np.concatenate((points, np.ones_like(points[..., :1])), -1)
    rays[np.hypot(*(pixels - MATRIX[:2, 2]).T).T > 300] = np.nan  # OpenCV's rays end before 90°
    return rays


def grid(sides, size=(480, 640)):
    """(h, w, 2): the centres of the pixels of a resized picture, as OpenCV resizes it."""
    y, x = ((np.arange(n) + 0.5) * to / n - 0.5 for n, to in zip(sides, size, strict=True))
    return np.stack(np.meshgrid(x, y), -1)


@pytest.mark.parametrize("kind", [
    np.float64, np.float32, lambda rays: torch.from_numpy(rays).to(torch.float32),
    lambda rays: torch.from_numpy(rays).requires_grad_()], ids=["double", "single", "t32", "t64"],
)  # fmt: skip
def test_a_field_of_rays_gives_opencvs_camera(kind):
    scale = np.random.default_rng(0).uniform(0.1, 9, (48, 60, 1))  # rays have any length
    rays = kind(scale * rays_of_opencv(grid((48, 60))))
    found, error = fit("KannalaBrandt", rays, size=(480, 640))
    assert found.focal.dtype == (f64 if rays.dtype in (np.float64, f64) else torch.float32)
    assert error.shape == (1,) and error < 1e-3 and found.image_size.tolist() == [[480, 640]]
    torch.testing.assert_close(found.center[0].double(), double(326.4, 231.7), atol=2e-3, rtol=0)
    assert found.focal.item() == pytest.approx(201.0, rel=1e-4)
    assert off(found, 1.4) < 5e-3


@pytest.mark.parametrize(("model", "most"), [
    ("KannalaBrandt", 1.0), ("OCamInverse", 1.5), ("Tabulated", 1.5), ("Spherical", 1.5),
    ("Equidistant", 2.5),
    *(pytest.param(model, 1.5, marks=pytest.mark.slow) for model in (
        "DoubleSphere", "EnhancedUnified", "FieldOfView", "Fisheye624", "Mei", "OCam", "Polynomial")
    ),
])  # fmt: skip
def test_noise_outliers_and_holes_change_a_field_little(model, most):
    rng, sides = np.random.default_rng(1), (54, 72)
    pixels = grid(sides)
    rays = rays_of_opencv(pixels)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    far = np.hypot(*(pixels - (326.4, 231.7)).T).T[..., None] / 200
    rays += rng.normal(0, 0.004, rays.shape) * (1 + far**2)  # grows to the rim
    wrong = rng.random(sides) < 0.1
    rays[wrong] = rng.normal(size=(wrong.sum(), 3))
    rays[20:30, 30:40], rays[40:43] = np.nan, 0
    rays[:, :30:3] = rng.normal(size=rays[:, :30:3].shape)
    weights = np.ones(sides)
    weights[:, :30:3] = 0
    found, error = fit(model, rays, weights=weights, size=(480, 640))
    assert off(found, 1.2) < most
    assert (found.center[0] - double(326.4, 231.7)).norm() < 0.7
    assert 0.4 < error.item() < 4


@pytest.mark.parametrize(("model", "angle"), [
    ("Perspective", np.arctan), ("BrownConrady", np.arctan), ("Orthographic", np.arcsin),
    ("Equisolid", lambda r: 2 * np.arcsin(r / 2)),
    ("Stereographic", lambda r: 2 * np.arctan(r / 2)),
])  # fmt: skip
def test_ideal_lenses_are_found_in_fields(model, angle):
    """θ at r / f by the formulas of lens design; the picture is 40 × 30 px."""
    place = (grid((30, 40), (30, 40)) - (21, 13)) / 30
    r = np.hypot(*place.T).T
    side = np.sin(angle(r)) / np.maximum(r, 1e-9)
    rays = np.concatenate((place * side[..., None], np.cos(angle(r))[..., None]), -1)
    found, error = fit(model, rays)
    assert found.focal.item() == pytest.approx(30, rel=1e-4) and error.item() < 1e-3
    torch.testing.assert_close(found.center, double(21, 13)[None], atol=1e-3, rtol=0)
    assert found.theta_max.item() == pytest.approx(angle(r).max(), abs=1e-4)


FIELD = rays_of_opencv(grid((24, 32)))
WIDE = FRONT.unproject_points(torch.from_numpy(grid((24, 32), (966, 1280)))[None])[0]


@pytest.mark.parametrize(("change", "message"), [
    ({"lens": FIELD[:1]}, "must have 32 known rays, in rows and columns, got 20 known in 1 × 32"),
    ({"lens": FIELD[12:13, 16:17]}, "got 1 known in 1 × 1 pixels"),
    ({"lens": FIELD[:0]}, "got 0 known in 0 × 32"),
    ({"lens": FIELD * np.nan}, "got 0 known in 24 × 32"),
    ({"weights": np.zeros((24, 32))}, "got 0 known"),
    ({"weights": np.ones((32, 24))}, r"weights must be 0 or more and \(24, 32\), got \(32, 24\)"),
    ({"weights": -np.ones((24, 32))}, "weights must be 0 or more"),
    ({"lens": FIELD[..., :2]}, r"must be \(h, w, 3\), got \(24, 32, 2\)"),
    ({"lens": FIELD.transpose(2, 0, 1)}, r"must be \(h, w, 3\), got \(3, 24, 32\)"),
    ({"lens": FIELD * (-1, 1, 1)}, "no lens has these rays: x must be to the right"),
    ({"lens": FIELD * (1, 1, -1)}, "no lens has these rays"),
    ({"lens": FIELD * (1, -1, -1)}, "no lens has these rays"),
    ({"size": (0, 32)}, r"must be at least \(1, 1\), got \(0, 32\)"),
    ({"lens": FRONT, "size": (24, 32)}, "belong to a field of rays"),
    ({"model": "Perspective", "lens": WIDE}, "no Perspective lens was found that reaches"),
    ({"model": "Perspective", "lens": FRONT}, r"no Perspective lens was found .* reaches 95\.00°"),
])  # fmt: skip
def test_what_cannot_be_fitted_is_refused(change, message):
    given = {"model": "KannalaBrandt", "lens": FIELD, "weights": None, "size": None} | change
    refused(message, lambda: fit(given.pop("model"), given.pop("lens"), **given))
