"""The lens models: their curves, their limits, derivatives, constructors and errors."""

import math
import re

import pytest
import torch
from helpers import product, refused, slow_but
from lens_examples import ASIDE, RANDOM, double, example, f64, random_lens
from torch.fx.experimental.proxy_tensor import make_fx
from torch.testing import assert_close

from darswin.lens import (
    MODELS,
    BrownConrady,
    DoubleSphere,
    EnhancedUnified,
    Equidistant,
    FieldOfView,
    KannalaBrandt,
    Lens,
    Mei,
    OCam,
    OCamInverse,
    Perspective,
    Polynomial,
    Spherical,
    Stereographic,
    Tabulated,
    solve,
    to_dict,
)
from darswin.lens.ideal import FocalLens
from darswin.lens.solve import direction_of


@pytest.mark.parametrize("name", MODELS)
def test_the_limit_is_where_r_stops_rising(name):
    """Just beyond the limit, r falls or is infinite, or θ exceeds 180°."""
    lens = example(name, torch.Generator().manual_seed(6))
    limit = lens.theta_limit
    before, after = lens.project(limit - 2e-5), lens.project(limit + 2e-5)
    ends = (after <= lens.r_max + 1e-9) | (before > 1e3 * lens.project(limit / 2))
    assert (limit <= math.pi).all()
    if name == "Tabulated":
        assert torch.equal(limit, lens.angles[:, -1])
    elif name not in ("OCam", "OCamInverse"):
        assert ((limit > math.pi - 1e-5) | ends).all(), (limit, before, after)


def test_models_that_contain_each_other():
    xi, f, k, none = double(1.7), double(300.0), double(0.01, -0.002), double(0.0)
    alpha, spherical, pinhole = xi / (1 + xi), Spherical(xi, 1000.0), Perspective(f)
    focal, of_spheres = 1000 * (1 - alpha), [Mei(xi, 1000.0), DoubleSphere(xi, 0.0, 1000.0)]
    of_spheres += [EnhancedUnified(alpha, 1.0, focal), DoubleSphere(none, alpha, focal)]
    for lens in of_spheres:
        assert_close(lens.theta_limit, spherical.theta_limit, rtol=0, atol=3e-6)
    theta = torch.linspace(0.01, 1.4, 50, dtype=f64)
    for one, other, count in (
        *((lens, spherical, 50) for lens in of_spheres),
        *((lens, pinhole, 50) for lens in (BrownConrady(f), Mei(none, f), Spherical(none, f))),
        (Spherical(double(1.0), 2 * f), Stereographic(f), 50),
        (BrownConrady(f, k), Mei(none, f, k), 30),
        (KannalaBrandt(f), Equidistant(f), 50),
    ):
        assert_close(one.project(theta[:count]), other.project(theta[:count]))


def in_parameters(lens, method):
    """`lens.method` as a function of its arguments and the parameters; the parameters."""
    tensors = {n: t.clone().requires_grad_() for n, t in lens._tensors().items()}
    tensors.pop("theta_max")

    def run(*values):
        x, values = values[: -len(tensors)], values[-len(tensors) :]
        return getattr(lens.replace(**dict(zip(tensors, values, strict=True))), method)(*x)

    return run, list(tensors.values())


# Lenses whose derivatives take seconds.
SOLVED = {"OCam", "OCamInverse", "BrownConrady", "Tabulated", "Fisheye624", "Mei"}


@pytest.mark.parametrize("name", slow_but(MODELS, *MODELS.keys() - SOLVED))
def test_derivatives_of_both_directions_up_to_the_third(name):
    lens = example(name, torch.Generator().manual_seed(7), (0.8, 3))[:2]
    lens = lens.with_theta_max(0.7 * lens.theta_limit)
    theta = (lens.theta_max[:, None] * double(0.12, 0.83)).requires_grad_()
    radius = lens.project(theta).detach().requires_grad_()
    for method, x in (("project", theta), ("unproject", radius)):
        run, values = in_parameters(lens, method)
        assert torch.autograd.gradcheck(run, (x, *values), fast_mode=True)
        run, values = in_parameters(lens[0], method)
        x = x[0].detach().requires_grad_()
        assert torch.autograd.gradgradcheck(run, (x, *values), atol=1e-6, fast_mode=True)

        def second(value, run=run, x=x, rest=values[1:]):
            slope, options = run(x, value, *rest), dict(create_graph=True, materialize_grads=True)
            for _ in range(2):
                (slope,) = torch.autograd.grad(slope.sum(), x, **options)
            return slope

        if second(values[0]).requires_grad:
            assert torch.autograd.gradcheck(second, (values[0],), atol=1e-5)


@pytest.mark.parametrize("name", slow_but(ASIDE, "KannalaBrandt", "affine alone"))
def test_gradients_of_rays_and_pixels(name):
    lens = ASIDE[name]
    theta = (lens.theta_max * double(0.1, 0.5, 0.9)).requires_grad_()
    azimuth = double(0.3, 2.5, -1.2).requires_grad_()
    run, values = in_parameters(lens, "project_rays")
    assert torch.autograd.gradcheck(run, (theta, azimuth, *values), fast_mode=True)
    pixels = run(theta, azimuth, *values).detach().requires_grad_()
    back, _ = in_parameters(lens, "unproject_pixels")
    assert torch.autograd.gradcheck(back, (pixels, *values), fast_mode=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", RANDOM)
def test_second_derivatives_of_rays(name):
    lens = random_lens(name, 3)[0]
    lens = lens.with_theta_max(0.8 * lens.theta_limit)
    pixels = lens.project_rays(lens.theta_max * double(0.3, 0.9), double(0.4, 2.0), (1, 1))

    def rays(pixels, focal, radial, tangential):
        made = lens.replace(focal=focal, radial=radial, tangential=tangential)
        return made.unproject_pixels(pixels, (1, 1))

    inputs = (t.detach().clone() for t in (pixels, lens.focal, lens.radial, lens.tangential))
    assert torch.autograd.gradgradcheck(rays, [t.requires_grad_() for t in inputs], atol=1e-6)


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


# What is made of wrong arguments, and the words of its error.
OUT_OF_RANGE = (
    (lambda: Perspective(0.0, 1.0), "focal must be finite and above 0, got 0.0"),
    (lambda: Perspective(1.0, math.pi / 2 + 1e-3), "theta_max must be at most 1.570795 rad"),
    (lambda: Perspective(1.0, 0.0), "theta_max must be finite and above 0"),
    (lambda: Spherical(-0.1, 1.0, 1.0), "xi must be finite and at least 0, got -0.1"),
    (lambda: Spherical(0.0, 1.0, 1.6), "at most 1.57"),
    (lambda: Spherical(0.5, 1.0, 2.2), "theta_max must be at most 2.09"),
    (lambda: Spherical([0.1, 0.2], [1.0, 2.0, 3.0], 1.0), "agree in the number of lenses"),
    (lambda: Spherical([0.1, -0.2], 1.0, 1.0), "got -0.2"),
    (lambda: Spherical([[0.1]], 1.0, 1.0), "xi must be a number or (N,)"),
    (lambda: EnhancedUnified(1.1, 1.0, 1.0), "alpha must be in [0, 1], got 1.1"),
    (lambda: EnhancedUnified(0.5, 0.0, 1.0), "beta must be finite and above 0"),
    (lambda: DoubleSphere(-1.0, 0.5, 1.0), "xi must be finite and above -1"),
    (lambda: FieldOfView(math.pi, 1.0), "omega must be in (0, 3.14159)"),
    (lambda: OCam([100.0, 0.0]), "coefficients must be such that a₀ is below 0"),
    (lambda: OCamInverse([3e6, *[0.0] * 9, 3e6]), "such that float32 rounds r by less than a pix"),
    (lambda: Polynomial([1.0, -5.0], 1.0), "at most 0.09999"),
    (lambda: Polynomial([0.0, 1.0], 1.0), "coefficients must be such that r rises"),
    (lambda: Polynomial([]), "coefficients must be at least one per lens"),
    (lambda: Polynomial([1.0, math.nan], 1.0), "coefficients must be finite"),
    (lambda: Polynomial(1.0, 1.0), "coefficients must be (K) or (N, K)"),
    (lambda: Polynomial([1.0], 3.2), "theta_max must be at most 3.14159"),
    (lambda: KannalaBrandt(1.0, [0.1], tangential=[0.1] * 3), "tangential must be (2) or"),
    (lambda: KannalaBrandt(1.0, [0.1], prism=[0.1] * 2), "prism must be (4) or"),
    (lambda: KannalaBrandt(1.0, [-1.0], 1.0), "theta_max must be at most 0.57734"),
    (lambda: Tabulated([0.0, 1.0], [0.0, 1.0, 2.0]), "angles and radii must have the same"),
    (lambda: Tabulated([0.0, 1.0, 0.5], [0.0, 1.0, 2.0]), "angles must be finite and rising"),
    (lambda: Tabulated([0.0, 1.0], [1.0, 2.0]), "radii must be finite and rising from 0"),
    (lambda: Perspective(1.0, 1.0, center=[1.0, 2.0, 3.0]), "center must be (2) or"),
    (lambda: Equidistant(1.0, affine=[[1.0, 0.0], [0.0, 0.0]]), "affine must be invertible"),
    (lambda: Equidistant(1.0, affine=[1.0, 2.0]), "affine must be (2, 2) or (N, 2, 2)"),
    (lambda: Equidistant(1.0, image_size=(0, 5)), "image_size must be finite and at least 1"),
    (lambda: Perspective.from_fov(3.2, 10.0), "fov must be at most 3.14159"),  # tan(θ_max) < 0
    (lambda: Spherical.from_fov(0.5, 2.0, -1.0), "radius must be finite and above 0"),
    (lambda: Spherical(0.5, 10.0).with_theta_max(2.5), "theta_max must be at most 2.09"),
    (lambda: to_dict(Spherical([0.1, 0.2], 300.0)), "one lens, got 2"),
    (lambda: type("Spherical", (Lens,), {}), "a lens model Spherical exists already"),
)  # fmt: skip
OF_WRONG_TYPES = (
    (lambda: Perspective("wide", 1.0), "focal must be a number or a tensor, got 'wide'"),
    (lambda: Spherical(0.5, 1.0, thetamax=1.0), "thetamax"),
    (lambda: Spherical.from_fov(2.0, 30.0), "'radius'"),
    (lambda: Spherical.from_fov(0.5, 2.0, 30.0, None, 1.0), "too many positional"),
    (lambda: Spherical.from_fov(0.5, 2.0, 30.0, xi=0.5), "multiple values"),
)  # fmt: skip


@pytest.mark.parametrize(("error", "make", "said"), [
    *((ValueError, *row) for row in OUT_OF_RANGE), *((TypeError, *row) for row in OF_WRONG_TYPES),
])  # fmt: skip
def test_a_wrong_argument_is_named(error, make, said):
    refused(re.escape(said), make, error=error)


@pytest.mark.parametrize("name", MODELS)
def test_rays_and_pixels_beyond_the_limit_are_nowhere_and_have_no_gradient(name):
    """As `project_points`; 45 is an angle in degrees by mistake."""
    lens = example(name, torch.Generator().manual_seed(6), (0.8, 3))
    lens = lens.with_theta_max(0.7 * lens.theta_limit)
    theta = lens.theta_max[:, None] * double(0.2, 1.0, 1.001, 1.3)
    theta = torch.cat((theta, torch.full_like(theta[:, :2], 45.0)), 1).requires_grad_()
    azimuth = double(0.3).requires_grad_()
    pixels = lens.project_rays(theta, azimuth, (480, 640))
    assert pixels[:, :2].isfinite().all() and pixels[:, 2:].isnan().all()
    assert torch.equal(pixels[:, :2], lens.pixels(theta[:, :2], direction_of(azimuth), (480, 640)))
    pixels[:, :2].sum().backward()
    assert theta.grad.isfinite().all() and azimuth.grad.isfinite().all()
    back, values = in_parameters(lens, "unproject")
    radius = torch.cat((lens.r_max[:, None] * double(0.3, 0.8), double(1e9).expand(4, 1)), 1)
    found = back(radius, *values)
    torch.where(found <= lens.theta_max[:, None], found, 0.0).sum().backward()
    assert all(value.grad.isfinite().all() and value.grad.any() for value in values)


def test_a_class_is_a_model_unless_it_says_otherwise():
    class OfNoName(Spherical, register=False):
        pass

    assert all(model.__name__ == name for name, model in MODELS.items())
    bases = {base for model in MODELS.values() for base in model.__mro__} - {*MODELS.values()}
    assert not {base.__name__ for base in bases} & {*MODELS}
    assert "OfNoName" not in MODELS and len(OfNoName(0.5, 10.0)) == 1


def test_angles_at_the_sides_of_the_image():
    lens = Polynomial([350.4, -17.5, 27.5, -2.4], None, [639.5, 482.5], image_size=(966, 1280))
    left, top, right, bottom = torch.rad2deg(lens.side_angles()[0]).tolist()
    # The roots of r(θ) = 640 and r(θ) = 483, by bisection with 40 digits.
    assert left == pytest.approx(94.989, abs=1e-3) and right == pytest.approx(left, abs=1e-4)
    assert top == pytest.approx(74.957, abs=1e-3) and bottom == pytest.approx(top, abs=1e-4)
    # For an image larger than the image circle, the angle is the limit.
    small = Spherical(2.0, 10.0, image_size=(100, 8))
    assert small.side_angles()[0].tolist()[1] == small.theta_limit.item()


def test_spherical_has_the_papers_focal_lengths():
    # The circle fills a 64 px image at a field of view of 174.63° (released data).
    xi = double(0.0, 0.05, 0.2, 0.35, 0.5, 0.7, 0.93, 1.0)
    lens = Spherical.from_fov(xi, 3.0479112779, 32.0)
    expected = double(1.5, 3.102, 7.907, 12.712, 17.518, 23.925, 31.293, 33.535)
    assert_close(lens.focal, expected, rtol=0, atol=1e-3)
    assert_close(lens.r_max, torch.full((8,), 32.0, dtype=f64))


@pytest.mark.parametrize("name", [name for name, m in MODELS.items() if issubclass(m, FocalLens)])
def test_the_field_of_view_fills_the_circle(name):
    lens = example(name, torch.Generator().manual_seed(2))
    lens = lens.with_theta_max(0.9 * lens.theta_limit)
    own = {n: t for n, t in lens._tensors().items() if n not in ("focal", "theta_max")}
    made = type(lens).from_fov(fov=2 * lens.theta_max, radius=37.0, **own)
    assert torch.equal(made.theta_max, lens.theta_max)
    assert_close(made.r_max, torch.full((4,), 37.0, dtype=f64))
    assert_close(made.focal, lens.focal * 37 / lens.r_max)


def test_arguments_by_place_and_by_name():
    by_place = Mei.from_fov(0.5, 2.0, 30.0, [3.0, 4.0], radial=[0.1, 0.2], image_size=(60, 80))
    by_name = Mei.from_fov(xi=0.5, fov=2.0, radius=30.0, center=[3.0, 4.0], radial=[0.1, 0.2])
    assert repr(by_place.replace(image_size=None)) == repr(by_name)
    made = Mei(0.5, 300.0, [0.1, 0.2], 1.2, [3.0, 4.0])
    named = Mei(xi=0.5, focal=300.0, radial=[0.1, 0.2], theta_max=1.2, center=[3.0, 4.0])
    assert made.same_as(named) and not hasattr(Polynomial, "from_fov")


@pytest.mark.parametrize(("dtype", "steps"), [(torch.float32, 24), (f64, 40)])
def test_an_inverse_has_no_more_steps_than_its_numbers_have_bits(dtype, steps):
    calls, value = [], torch.linspace(0, 1, 9, dtype=dtype)

    def cube(x):
        calls.append(x)
        return x**3

    found = solve.inverse(cube, lambda x: 3 * x**2, value, torch.ones((), dtype=dtype))
    assert len(calls) <= 1 + steps + 2
    assert_close(found[1:], value[1:] ** (1 / 3))


@pytest.mark.parametrize(
    ("name", "precision"), product(MODELS, [(torch.float32, 1e-5), (f64, 1e-12)])
)
def test_an_image_is_solved_as_its_rows_are(name, precision, monkeypatch):
    """Many values begin at a table, and few do not. Bounds are relative to the largest value."""
    dtype, bound = precision
    lenses = example(name, torch.Generator().manual_seed(7), (30, 40)).to(dtype)
    lenses = lenses.with_theta_max((0.97 * lenses.theta_limit).clamp(max=2))
    leaves = {n: t.detach().clone().requires_grad_() for n, t in lenses._tensors().items()}
    lenses, calls = lenses._from_tensors(leaves), []

    def count(method, whole):
        def counted(lens, x):
            if torch.as_tensor(x).numel() > 1e4:
                calls.append(method)
            return whole(lens, x)

        monkeypatch.setattr(type(lenses), method, counted)

    def close(found, expected, bound):
        size = expected.nan_to_num().abs().max().item()
        assert_close(found, expected, rtol=0, atol=bound * size, equal_nan=True)

    for method in ("project", "_angle_at"):
        count(method, getattr(type(lenses), method))
    part = 1.1 * torch.rand(1, 120, 160, generator=torch.Generator().manual_seed(0), dtype=dtype)
    none = lenses[:0]
    assert none.unproject(part[:0]).shape == none.project(part[:0]).shape == (0, 120, 160)
    for lens in (lenses, lenses[2]):
        radius = lens._row(lens.r_max.detach(), 3) * part
        theta = lens._row(lens.theta_max.detach(), 3) * part.clamp(max=1)
        for function, values in ((lens.unproject, radius), (lens.project, theta)):
            calls.clear()
            image = function(values)
            assert len(calls) <= 8
            rows = torch.cat([function(few) for few in values.split(6, 1)], 1)
            assert image.isfinite().double().mean() > 0.8
            close(image, rows, bound)
            options = dict(allow_unused=True, retain_graph=True, materialize_grads=True)
            tensors = [*lens._tensors().values()]
            slopes = (
                torch.autograd.grad(x.nan_to_num().square().mean(), tensors, **options)
                for x in (image, rows)
            )
            for pair in zip(*slopes, strict=True):
                close(*pair, 100 * bound)


def test_where_no_gradients_are_recorded_a_lens_does_not_switch_them_off():
    # An export would take its graph apart there, and put it together again.
    lens, radius = Spherical.from_fov(0.5, 2.6, 16.0), torch.rand(1, 5, requires_grad=True)
    assert lens.unproject(radius).requires_grad
    for switch, count in ((torch.enable_grad, 2), (torch.no_grad, 0)):
        with switch():
            graph = make_fx(lambda x: lens.unproject(x), pre_dispatch=True)(radius).graph
        switched = [node for node in graph.nodes if "set_grad_enabled" in str(node.target)]
        assert len(switched) == count
