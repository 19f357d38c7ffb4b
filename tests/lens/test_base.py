"""Rays to pixels and back."""

import math

import numpy as np
import pytest
import torch
from lens_examples import ASIDE, CALIBRATIONS, assert_projects, double, f64, points_around

from darswin.lens import MODELS, KannalaBrandt, Lens, Perspective, Polynomial, Spherical


def test_radii_where_nothing_lands_are_nan():
    assert Spherical(2.0, 10.0, 1.5).unproject(1e3).isnan().all()
    polynomial = Polynomial([20.0, 1.0], 1.5)
    outside = polynomial.unproject(torch.tensor([-1.0, 1e3, math.nan, math.inf]))
    assert outside.isnan().all()


def test_a_parameter_can_be_learned():
    xi = torch.nn.Parameter(torch.tensor(0.3))
    lens = Spherical(xi, 10.0, 1.4)
    lens.project(torch.tensor([0.5, 1.0])).sum().backward()
    assert xi.grad is not None and xi.grad < 0
    coefficients = torch.nn.Parameter(torch.tensor([20.0, 1.0]))
    Polynomial(coefficients, 1.4).unproject(torch.tensor([5.0, 10.0])).sum().backward()
    assert (coefficients.grad < 0).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Perspective(0.0, 1.0), "focal must be"),
        (lambda: Perspective(-3.0, 1.0), r"focal must be .* got -3.0"),
        (lambda: Perspective(math.inf, 1.0), "focal must be"),
        (
            lambda: Perspective(1.0, math.pi / 2 + 1e-3),
            r"theta_max must be at most 1.570795 rad \(90.00°\).* got 1.57179",
        ),
        (lambda: Perspective(1.0, 0.0), "theta_max must be finite and above 0"),
        (lambda: Perspective(1.0, math.nan), "theta_max must be"),
        (lambda: Spherical(-0.1, 1.0, 1.0), r"xi must be .* got -0.1"),
        (lambda: Spherical(math.nan, 1.0, 1.0), "xi must be"),
        (lambda: Spherical(0.5, 0.0, 1.0), "focal must be"),
        (
            lambda: Spherical(0.0, 1.0, 1.6),
            r"theta_max must be at most 1.57.*Spherical lens's r rises",
        ),
        (lambda: Spherical(0.5, 1.0, 2.2), r"theta_max must be at most 2.09"),
        (lambda: Spherical(2.0, 1.0, 2.2), r"theta_max must be at most 2.09"),
        (lambda: Spherical([0.1, 0.2], [1.0, 2.0, 3.0], 1.0), "agree in the number of lenses"),
        (lambda: Spherical([0.1, -0.2], 1.0, 1.0), r"xi must be .* got -0.2"),
        (lambda: Spherical([[0.1]], 1.0, 1.0), r"xi must be a number or \(N,\)"),
        (
            lambda: Polynomial([1.0, -5.0], 1.0),
            r"theta_max must be at most 0.09999.*as far as .* r rises",
        ),
        (lambda: Polynomial([0.0, 1.0], 1.0), "coefficients must be such that r rises"),
        (lambda: Polynomial([1.0, math.nan], 1.0), "coefficients must be finite"),
        (lambda: Polynomial(1.0, 1.0), r"coefficients must be \(K\) or \(N, K\)"),
        (lambda: Polynomial([1.0], 3.2), "theta_max must be at most 3.14159"),
        (lambda: Perspective(1.0, 1.0, center=[1.0, 2.0, 3.0]), "center must be"),
        (lambda: Perspective(1.0, 1.0, center=3.0), r"center must be \(2\) or \(N, 2\)"),
        (lambda: Perspective.from_fov(3.2, 10.0), "focal must be"),  # tan(θ_max) < 0
        (lambda: Spherical.from_fov(0.5, 2.0, -1.0), "focal must be"),
    ],
)  # fmt: skip
def test_a_parameter_out_of_range_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_angles_at_the_sides_of_the_image():
    lens = Polynomial([350.4, -17.5, 27.5, -2.4], None, [639.5, 482.5],
                      image_size=(966, 1280))  # fmt: skip
    left, top, right, bottom = torch.rad2deg(lens.side_angles()[0]).tolist()
    # The roots of r(θ) = 640 and r(θ) = 483, by bisection with 40 digits.
    assert left == pytest.approx(94.989, abs=1e-3) and right == pytest.approx(left, abs=1e-4)
    assert top == pytest.approx(74.957, abs=1e-3) and bottom == pytest.approx(top, abs=1e-4)
    # An image that ends beyond the circle sees as far as the lens.
    small = Spherical(2.0, 10.0, image_size=(100, 8))
    assert small.side_angles()[0].tolist()[1] == small.theta_limit.item()


def test_another_theta_max():
    lens = Spherical([0.5, 2.0], 10.0, 1.0)
    assert torch.equal(lens.with_theta_max(None).theta_max, lens.theta_limit)
    assert lens.with_theta_max(1.5).theta_max.tolist() == [1.5, 1.5]
    assert lens.theta_max.tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match=r"theta_max must be at most 2\.09"):
        lens.with_theta_max(2.5)


@pytest.mark.parametrize("name", ASIDE)
def test_pixels_and_rays_undo_each_other(name):
    lens = ASIDE[name]
    theta = torch.linspace(0, 1, 40, dtype=f64)[:, None] * lens.theta_max
    azimuth = torch.linspace(-3.1, 3.1, 33, dtype=f64)[None]
    pixels = lens.project_rays(theta, azimuth)
    assert pixels.shape == (40, 33, 2)
    # The last ring may land where only rays beyond θ_max do.
    found, direction = lens.with_theta_max(None).unproject_pixels(pixels)
    assert (found - theta).abs().max() < 1e-9
    assert (direction - azimuth)[1:].abs().max() < 1e-9


@pytest.mark.parametrize("name", ASIDE)
def test_gradients_of_rays_and_pixels(name):
    lens = ASIDE[name]
    names = [n for n in lens._names() if n != "theta_max" and getattr(lens, n) is not None]
    values = [getattr(lens, n).clone().requires_grad_() for n in names]
    theta = (lens.theta_max * double(0.1, 0.5, 0.9)).requires_grad_()
    azimuth = double(0.3, 2.5, -1.2).requires_grad_()

    def project(theta, azimuth, *values):
        return lens.replace(**dict(zip(names, values, strict=True))).project_rays(theta, azimuth)

    def unproject(pixels, *values):
        return lens.replace(**dict(zip(names, values, strict=True))).unproject_pixels(pixels)

    assert torch.autograd.gradcheck(project, (theta, azimuth, *values))
    pixels = project(theta, azimuth, *values).detach().requires_grad_()
    assert torch.autograd.gradcheck(unproject, (pixels, *values))


def test_pixels_that_no_ray_reaches_are_nan():
    lens = ASIDE["Mei"]
    theta, _ = lens.unproject_pixels(
        double(708.5 + 900, 697.0, 5000, 5000, 708.5, 697.0).view(3, 2)
    )
    assert theta.isnan().tolist() == [True, True, False] and theta[2].abs() < 1e-9


def test_rays_are_found_in_inference_mode():
    for lens in ASIDE.values():
        expected = lens.unproject_pixels(lens.project_rays(0.5, 0.3))
        with torch.inference_mode():
            found = lens.to(f64).unproject_pixels(lens.project_rays(0.5, 0.3))
        torch.testing.assert_close(found, expected)


def test_points_are_projected_as_opencvs_fisheye_projects_them():
    cv2 = pytest.importorskip("cv2")
    d, points = (0.01, -0.002, 0.0005, -0.0001), points_around(1.5)
    lens = KannalaBrandt(double(300.0), double(*d), center=double(400, 310))
    lens = lens.replace(affine=double(1, 0, 0, 1.1).view(1, 2, 2))
    camera = np.array([[300.0, 0, 400], [0, 330, 310], [0, 0, 1]])
    pixels, _ = cv2.fisheye.projectPoints(
        points[None], np.zeros(3), np.zeros(3), camera, np.array(d)
    )
    assert_projects(lens, points, pixels[0])


def test_points_are_projected_as_opencvs_pinhole_projects_them():
    cv2 = pytest.importorskip("cv2")
    affine = double(1, 0, 0, 1.2).view(1, 2, 2)
    lens, points = ASIDE["BrownConrady"].replace(prism=None, affine=affine), points_around(0.9)
    camera = np.array([[500.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    d = np.array([*lens.radial[0], *lens.tangential[0]])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera, d)
    assert_projects(lens, points, pixels[:, 0])


@pytest.mark.parametrize("name", ASIDE)
def test_points_and_pixels_undo_each_other(name):
    lens = ASIDE[name]
    points = torch.from_numpy(points_around(lens.theta_max.item() - 1e-6)).unflatten(0, (40, 5))
    pixels = lens.project_points(points)
    assert pixels.shape == (40, 5, 2)
    torch.testing.assert_close(lens.unproject_points(pixels), points, rtol=0, atol=1e-8)
    for scale in (1e-30, 1e30):  # how far away changes nothing
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
    # Beyond 90°, what is behind the plane of the camera may be seen.
    wide = CALIBRATIONS["TUM-VI Kalibr"][0]
    behind = wide.project_points(double(1, 0, -0.2), (1, 1))
    expected = wide.project_rays(math.pi / 2 + math.atan(0.2), 0.0, (1, 1))
    torch.testing.assert_close(behind, expected)
    found = lens.unproject_points(torch.tensor([[[1e4, 4.0], [3.0, 4.0]]]))
    assert found[:, 0].isnan().all() and found[:, 1].tolist() == [[0, 0, 1]] * 2


def test_gradients_of_points():
    lens = ASIDE["Mei"]
    points = double(0.3, -0.2, 0.5, 0, 0, 2, 0.9, 0.1, 0.1, 1, 1, -9).view(4, 3)
    seen = torch.tensor([0, 1, 2])

    def project(points, focal):
        return lens.replace(focal=focal).project_points(points)[seen]

    leaves = points.requires_grad_(), lens.focal.clone().requires_grad_()
    assert torch.autograd.gradcheck(project, leaves)
    pixels = project(*leaves).detach().requires_grad_()
    assert torch.autograd.gradcheck(lens.unproject_points, (pixels,))
    lens.replace(focal=leaves[1]).project_points(points).nan_to_num().sum().backward()
    assert points.grad.isfinite().all() and leaves[1].grad.isfinite().all()
    assert points.grad.any(1).tolist() == [True, True, True, False]


def test_a_class_is_a_model_unless_it_says_otherwise():
    assert MODELS["Spherical"] is Spherical
    assert all(model.__name__ == name for name, model in MODELS.items())
    bases = {base for model in MODELS.values() for base in model.__mro__} - {*MODELS.values()}
    assert not {base.__name__ for base in bases} & {*MODELS}
    with pytest.raises(ValueError, match="there is a lens model Spherical already"):
        type("Spherical", (Lens,), {})

    class OfNoName(Spherical, register=False):
        pass

    assert "OfNoName" not in MODELS and len(OfNoName(0.5, 10.0)) == 1
