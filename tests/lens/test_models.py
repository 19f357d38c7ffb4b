"""The lens models: their curves, how far they reach, and that what they do can be undone."""

import math

import pytest
import torch
from lens_examples import CALIBRATIONS, double, example, f64

from darswin.lens import (
    MODELS,
    BrownConrady,
    DoubleSphere,
    EnhancedUnified,
    Equidistant,
    FieldOfView,
    KannalaBrandt,
    Mei,
    OCam,
    Perspective,
    Polynomial,
    Spherical,
    Tabulated,
)


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_radii_of_calibrations_to_a_thousandth_of_a_pixel(name):
    lens, radii = CALIBRATIONS[name]
    theta = torch.deg2rad(double(10, 30, 45, 60, 75, 85, 90, 95))
    torch.testing.assert_close(lens.project(theta), double(*radii), rtol=0, atol=1e-3)


def test_the_direct_polynomial_of_ocamcalib_agrees_with_its_inverse():
    direct = OCam(double(-288.5, 0, 3.6e-4, 7.4e-7, -6e-11))
    radius = torch.linspace(50, 605, 100, dtype=f64)
    inverse = CALIBRATIONS["OCam"][0]
    torch.testing.assert_close(inverse.project(direct.unproject(radius)), radius, rtol=0, atol=2e-3)


@pytest.mark.parametrize("name", MODELS)
def test_unproject_undoes_project_on_the_whole_valid_range(name):
    generator = torch.Generator().manual_seed(5)
    near = double(0, 1e-12, 1e-9, 1e-6, 1e-3)
    fractions = torch.cat((near, torch.linspace(0.01, 1, 997, dtype=f64), 1 - near))
    for _ in range(25):
        lens = example(name, generator)
        assert torch.equal(lens.theta_max, lens.theta_limit)
        theta = (lens.theta_max[:, None] * fractions).sort(dim=1).values
        radius = lens.project(theta)
        assert radius.isfinite().all()
        evenly = lens.theta_max[:, None] * torch.linspace(0, 0.999, 1000, dtype=f64)
        assert (lens.project(evenly).diff(dim=1) > 0).all()
        found = lens.unproject(radius)
        if name == "OCamInverse":  # its polynomial need not be 0 at θ = 0
            theta, found = theta[:, 5:], found[:, 5:]
        else:
            small = found[:, 1:6] - theta[:, 1:6]
            assert (small.abs() <= 1e-9 * theta[:, 1:6]).all()
        assert (found - theta).abs().max() < 1e-9


@pytest.mark.parametrize("coefficients", [[20.0], [30.0, 0, -1.1, 0, 0.4, 0, -0.05, 0, 0.003]])
def test_a_polynomial_has_any_degree(coefficients):
    lens = Polynomial(double(*coefficients), 2.5)
    theta = torch.linspace(0.01, 2.5, 50, dtype=f64)
    torch.testing.assert_close(lens.unproject(lens.project(theta)), theta, rtol=1e-9, atol=0)
    leaves = theta[::10].requires_grad_(), lens.coefficients.requires_grad_()
    for direction, x in (("project", 1), ("unproject", 20)):
        assert torch.autograd.gradcheck(
            lambda t, c, d=direction, x=x: getattr(lens.replace(coefficients=c), d)(x * t), leaves
        )


@pytest.mark.parametrize("name", MODELS)
def test_nothing_is_valid_beyond_the_limit(name):
    """Just beyond it r falls, is infinite, or the angle is none."""
    generator = torch.Generator().manual_seed(6)
    for _ in range(5):
        lens = example(name, generator)
        limit = lens.theta_limit
        half_turn = limit > math.pi - 1e-5
        before, after = lens.project(limit - 2e-5), lens.project(limit + 2e-5)
        ends = (after <= lens.r_max + 1e-9) | (before > 1e3 * lens.project(limit / 2))
        if name == "Tabulated":
            assert torch.equal(limit, lens.angles[:, -1])
        elif name in ("OCam", "OCamInverse"):
            assert (limit <= math.pi).all()
        else:
            assert (half_turn | ends).all(), (limit, before, after)


@pytest.mark.parametrize("name", MODELS)
def test_gradients_of_both_directions(name):
    lens = example(name, torch.Generator().manual_seed(7), (0.8, 3))
    lens = lens.with_theta_max(0.7 * lens.theta_limit)
    names = [n for n in (*lens.parameters, *lens.optional) if getattr(lens, n) is not None]
    values = [getattr(lens, n).clone().requires_grad_() for n in names]

    def run(x, *values, direction):
        return getattr(lens.replace(**dict(zip(names, values, strict=True))), direction)(x)

    theta = (lens.theta_max[:, None] * double(0.12, 0.51, 0.83)).requires_grad_()
    assert torch.autograd.gradcheck(lambda *a: run(*a, direction="project"), (theta, *values))
    radius = lens.project(theta).detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda *a: run(*a, direction="unproject"), (radius, *values))


@pytest.mark.parametrize("name", MODELS)
def test_radii_that_no_ray_up_to_theta_max_reaches_have_no_angle(name):
    lens = example(name, torch.Generator().manual_seed(10))
    for end in (1.0, 0.5):
        used = lens.with_theta_max(end * lens.theta_limit)
        beyond = double(-1e-3, -1, -1e9, math.inf, -math.inf, math.nan).expand(4, -1)
        # At the limit r may rise so steeply that it is known to 1e-9 only.
        more = double(1.5, 1e6) if end == 1 else double(1 + 1e-9, 1.5, 1e6)
        beyond = torch.cat((beyond, used.r_max[:, None] * more), 1)
        assert used.unproject(beyond).isnan().all()
        assert used.unproject(used.r_max[:, None]).isfinite().all()


@pytest.mark.parametrize("name", MODELS)
def test_float32_finds_angles_that_land_where_they_were_asked_for(name):
    """Near the limit, where r hardly rises, an angle is known no better; its radius is."""
    exact = example(name, torch.Generator().manual_seed(8))
    lens = exact.with_theta_max(0.999 * exact.theta_limit).to(torch.float32)
    radius = lens.project(lens.theta_max[:, None] * torch.linspace(0.01, 1, 200))
    error = (lens.project(lens.unproject(radius)) - radius).abs()
    # Rounding of θ, where r is steep, and of r.
    allowed = torch.finfo(torch.float32).eps * (8 * radius + 4 * 3.2 * lens._slope(
        lens.theta_max[:, None] * torch.linspace(0.01, 1, 200)))  # fmt: skip
    assert (error <= allowed).all()


@pytest.mark.parametrize("name", MODELS)
def test_second_and_third_derivatives(name):
    lens = example(name, torch.Generator().manual_seed(7), (0.8, 3))[0]
    lens = lens.with_theta_max(0.7 * lens.theta_limit)
    names = [n for n in (*lens.parameters, *lens.optional) if getattr(lens, n) is not None]

    def run(x, *values, direction):
        return getattr(lens.replace(**dict(zip(names, values, strict=True))), direction)(x)

    theta = (lens.theta_max * double(0.52, 0.83)).requires_grad_()
    radius = lens.project(theta).detach().requires_grad_()
    for x, direction in ((theta, "project"), (radius, "unproject")):
        values = [getattr(lens, n).clone().requires_grad_() for n in names]
        assert torch.autograd.gradgradcheck(
            lambda *a, direction=direction: run(*a, direction=direction), (x, *values), atol=1e-6
        )

        def second(value, x=x, rest=values[1:], direction=direction):
            slope = run(x, value, *rest, direction=direction)
            for _ in range(2):
                (slope,) = torch.autograd.grad(
                    slope.sum(), x, create_graph=True, materialize_grads=True
                )
            return slope

        if second(values[0]).requires_grad:
            assert torch.autograd.gradcheck(second, (values[0],), atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_float32(name):
    exact = example(name, torch.Generator().manual_seed(8))
    exact = exact.with_theta_max(0.9 * exact.theta_limit)
    lens = exact.to(torch.float32)
    theta = exact.theta_max[:, None] * torch.linspace(0.01, 1, 200, dtype=f64)
    radius = lens.project(theta.float())
    assert radius.dtype == torch.float32
    error = (radius - exact.project(theta)).abs() / exact.r_max[:, None]
    assert error.max() < 1e-5
    found = lens.unproject(radius)
    assert found.dtype == torch.float32 and (found - theta).abs().max() < 2e-5


def test_models_that_contain_each_other():
    theta = torch.linspace(0.01, 1.4, 50, dtype=f64)
    xi = 1.7
    spherical = Spherical(double(xi), 1000.0)
    alpha = xi / (1 + xi)
    for lens in (
        Mei(double(xi), 1000.0),
        EnhancedUnified(double(alpha), 1.0, 1000.0 * (1 - alpha)),
        DoubleSphere(double(0.0), alpha, 1000.0 * (1 - alpha)),
        DoubleSphere(double(xi), 0.0, 1000.0),
    ):
        torch.testing.assert_close(lens.project(theta), spherical.project(theta))
        torch.testing.assert_close(lens.theta_limit, spherical.theta_limit, rtol=0, atol=3e-6)
    pinhole = Perspective(double(300.0))
    for lens in (BrownConrady(double(300.0)), Mei(double(0.0), 300.0)):
        torch.testing.assert_close(lens.project(theta), pinhole.project(theta))
    k = double(0.01, -0.002)
    torch.testing.assert_close(
        BrownConrady(double(300.0), k).project(theta[:30]),
        Mei(double(0.0), 300.0, k).project(theta[:30]),
    )
    torch.testing.assert_close(
        KannalaBrandt(double(300.0)).project(theta), Equidistant(double(300.0)).project(theta)
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EnhancedUnified(1.1, 1.0, 1.0), r"alpha must be in \[0, 1\], got 1.1"),
        (lambda: EnhancedUnified(0.5, 0.0, 1.0), "beta must be finite and above 0"),
        (lambda: DoubleSphere(-1.0, 0.5, 1.0), "xi must be finite and above -1"),
        (lambda: FieldOfView(3.2, 1.0), r"omega must be in \(0, 3.14159\)"),
        (lambda: OCam([100.0, 0.0]), "coefficients must be such that a₀ is below 0"),
        (lambda: Polynomial([-1.0, 2.0]), "coefficients must be such that r rises"),
        (lambda: KannalaBrandt(1.0, [math.nan]), "radial must be finite"),
        (
            lambda: KannalaBrandt(1.0, [0.1], tangential=[0.1, 0.1, 0.1]),
            r"tangential must be \(2\) or \(N, 2\)",
        ),
        (lambda: KannalaBrandt(1.0, [-1.0], 1.0), r"theta_max must be at most 0.57734.*got 1.0"),
        (lambda: Tabulated([0.0, 1.0], [0.0, 1.0, 2.0]), "angles and radii must have the same"),
        (lambda: Tabulated([0.0, 1.0, 0.5], [0.0, 1.0, 2.0]), "angles must be finite and rising"),
        (lambda: Tabulated([0.0, 1.0], [1.0, 2.0]), "radii must be finite and rising from 0"),
        (lambda: Equidistant(1.0, affine=[[1.0, 0.0], [0.0, 0.0]]), "affine must be invertible"),
        (lambda: Equidistant(1.0, affine=[1.0, 2.0]), r"affine must be \(2, 2\) or \(N, 2, 2\)"),
        (lambda: Equidistant(1.0, image_size=(0, 5)), "image_size must be finite and at least 1"),
    ],
)
def test_a_parameter_out_of_range_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("name", MODELS)
def test_where_nothing_lands_there_is_no_gradient_either(name):
    lens = example(name, torch.Generator().manual_seed(9), (0.8, 3))
    lens = lens.with_theta_max(0.9 * lens.theta_limit)
    names = [n for n in (*lens.parameters, *lens.optional) if getattr(lens, n) is not None]
    values = [getattr(lens, n).clone().requires_grad_() for n in names]
    made = lens.replace(**dict(zip(names, values, strict=True)))
    radius = torch.cat((lens.r_max[:, None] * double(0.3, 0.8), double(1e9).expand(4, 1)), 1)
    theta = made.unproject(radius)
    torch.where(theta <= lens.theta_max[:, None], theta, 0.0).sum().backward()
    assert all(value.grad.isfinite().all() and value.grad.any() for value in values)


def test_spherical_is_perspective_at_0_and_stereographic_at_1():
    theta = torch.linspace(0, 1.4, 50, dtype=f64)
    flat, conformal = (Spherical(torch.tensor(x, dtype=f64), 10.0, 1.5) for x in (0.0, 1.0))
    torch.testing.assert_close(flat.project(theta), 10 * torch.tan(theta))
    torch.testing.assert_close(conformal.project(theta), 10 * torch.tan(theta / 2))
    torch.testing.assert_close(
        Perspective.from_fov(2.8, 7.0).r_max, torch.tensor([7.0]), rtol=1e-5, atol=0
    )
