"""The lens models: their curves, how far they reach, and that what they do can be undone."""

import math

import pytest
import torch

from darswin.lens import (
    MODELS,
    BrownConrady,
    DoubleSphere,
    EnhancedUnified,
    Equidistant,
    Equisolid,
    FieldOfView,
    Fisheye624,
    KannalaBrandt,
    Mei,
    OCam,
    OCamInverse,
    Orthographic,
    Perspective,
    Polynomial,
    Spherical,
    Stereographic,
    Tabulated,
    as_curves,
    cat,
)

f64 = torch.float64


def double(*values):
    return torch.tensor(values, dtype=f64)


KODAK_INVERSE = (583.439624, 470.805865, 97.165132, 120.712689, 100.686168, 55.067847, 67.348203,
                 15.186683, 1.492255, 84.459767, 105.607698, 48.090642, 7.785426)  # fmt: skip

# Public calibrations, and r in px at 10, 30, 45, 60, 75, 85, 90 and 95°.
CALIBRATIONS = {
    "WoodScape front": (
        Polynomial(double(339.749, -31.988, 48.275, -7.201)),
        (58.573, 175.511, 267.754, 367.484, 477.055, 556.367, 598.013, 641.012)),
    "SynWoodScape front": (
        Polynomial(double(341.725, -26.4448, 32.7864, 0.50499)),
        (59.012, 176.421, 268.154, 367.112, 477.025, 558.253, 601.678, 647.167)),
    "KITTI-360 image_02": (
        Mei(double(2.2134047507854890), 1336.3220825849971,
            double(0.016798235660113681, 1.6548773243373522)),
        (72.561, 217.321, 325.705, 434.562, 543.590, 614.149, 647.437, 678.331)),
    "KITTI-360 image_03": (
        Mei(double(2.5535139132482758), 1485.4388981875156,
            double(0.049370396274089505, 4.5068455478645308)),
        (72.911, 217.875, 326.095, 435.253, 545.159, 615.474, 647.793, 676.794)),
    "TUM-VI Kalibr": (
        KannalaBrandt(double(190.97847715128717), double(
            .0034823894022493434, .0007150348452162257, -.0020532361418706202,
            .00020293673591811182)),
        (33.336, 100.093, 150.289, 200.445, 249.862, 281.623, 296.876, 311.559)),
    "TUM-VI basalt": (
        EnhancedUnified(double(.6291060871161842), 1.0418067403139693, 191.14799816648748),
        (33.367, 100.226, 150.530, 200.814, 250.436, 282.377, 297.682, 312.319)),
    "Kalibr ds": (
        DoubleSphere(double(-0.19963086), 0.592459, 317.55256),
        (69.238, 207.505, 310.799, 413.247, 513.388, 577.148, 607.417, 636.127)),
    "basalt ds": (
        DoubleSphere(double(-0.075347), 0.743925, 402.5),
        (75.832, 224.005, 328.202, 421.858, 499.463, 538.813, 553.844, 565.320)),
    "COLMAP": (
        KannalaBrandt(double(2134.23762), double(.00372, -.00331, .00167, -.00032)),
        (372.536, 1118.382, 1678.541, 2239.077, 2800.133, 3173.961, 3360.005, 3544.469)),
    "OCam kodak": (
        OCamInverse(double(*KODAK_INVERSE)),
        (47.875, 153.327, 247.086, 352.748, 465.102, 543.019, 583.440, 625.352)),
}  # fmt: skip


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_radii_of_public_calibrations_to_a_thousandth_of_a_pixel(name):
    lens, radii = CALIBRATIONS[name]
    theta = torch.deg2rad(double(10, 30, 45, 60, 75, 85, 90, 95))
    torch.testing.assert_close(lens.project(theta), double(*radii), rtol=0, atol=1e-3)


def test_the_direct_polynomial_of_ocamcalib_agrees_with_its_inverse():
    direct = OCam(double(-271.6972, 0, -2.741744e-6, 1.840940e-6, -8.024838e-10))
    radius = torch.linspace(50, 583, 100, dtype=f64)
    inverse = CALIBRATIONS["OCam kodak"][0]
    torch.testing.assert_close(inverse.project(direct.unproject(radius)), radius, rtol=0, atol=2e-3)


def random_lens(name: str, generator: torch.Generator, focal: tuple[float, float] = (5, 2000)):
    """Four lenses of a model with random parameters, used as far as the model goes."""

    def uniform(low: float, high: float, *shape: int):
        return low + (high - low) * torch.rand(4, *shape, generator=generator, dtype=f64)

    focal = uniform(*focal)
    terms = torch.tensor([0.05, 0.01, 0.005, 0.001], dtype=f64)
    radial = uniform(-1, 1, 4) * terms
    return {
        "Perspective": lambda: Perspective(focal),
        "Equidistant": lambda: Equidistant(focal),
        "Equisolid": lambda: Equisolid(focal),
        "Stereographic": lambda: Stereographic(focal),
        "Orthographic": lambda: Orthographic(focal),
        "FieldOfView": lambda: FieldOfView(uniform(0.05, 3.0), focal),
        "Spherical": lambda: Spherical(uniform(0, 3), focal),
        "EnhancedUnified": lambda: EnhancedUnified(uniform(0, 1), uniform(0.3, 3), focal),
        "DoubleSphere": lambda: DoubleSphere(uniform(-0.8, 1.6), uniform(0, 1), focal),
        "Polynomial": lambda: Polynomial(focal[:, None] * torch.cat(
            (torch.ones(4, 1, dtype=f64), uniform(-0.1, 0.1, 3)), 1)),
        "OCam": lambda: OCam(torch.stack(
            (-focal, 0 * focal, uniform(0.1, 0.5) / focal, uniform(-0.1, 0.1) / focal**2,
             uniform(-0.1, 0.1) / focal**3), 1)),
        "OCamInverse": lambda: OCamInverse(
            focal[:, None] / 500 * double(*KODAK_INVERSE) * uniform(0.98, 1.02, 1)),
        "KannalaBrandt": lambda: KannalaBrandt(focal, radial),
        "Fisheye624": lambda: Fisheye624(focal, radial),
        "Mei": lambda: Mei(uniform(0, 3), focal, radial[:, :2]),
        "BrownConrady": lambda: BrownConrady(
            focal, radial[:, :3], denominator=uniform(-0.1, 0.1, 3)),
        "Tabulated": lambda: Tabulated(
            torch.nn.functional.pad(uniform(0.01, 0.3, 9).cumsum(1), (1, 0)),
            focal[:, None] * torch.nn.functional.pad(uniform(0.01, 0.3, 9).cumsum(1), (1, 0))),
    }[name]()  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_unproject_undoes_project_on_the_whole_valid_range(name):
    generator = torch.Generator().manual_seed(5)
    near = double(0, 1e-12, 1e-9, 1e-6, 1e-3)
    fractions = torch.cat((near, torch.linspace(0.01, 1, 997, dtype=f64), 1 - near))
    for _ in range(25):
        lens = random_lens(name, generator)
        assert torch.equal(lens.theta_max, lens.theta_limit)
        theta = (lens.theta_max[:, None] * fractions).sort(dim=1).values
        radius = lens.project(theta)
        assert radius.isfinite().all()
        evenly = lens.theta_max[:, None] * torch.linspace(0, 0.999, 1000, dtype=f64)
        assert (lens.project(evenly).diff(dim=1) > 0).all()
        found = lens.unproject(radius)
        if name == "OCamInverse":  # its polynomial need not be 0 at θ = 0
            theta, found = theta[:, 5:], found[:, 5:]
        assert (found - theta).abs().max() < 1e-9


@pytest.mark.parametrize("name", MODELS)
def test_nothing_is_valid_beyond_the_limit(name):
    """Just beyond it r falls, is infinite, or the angle is none."""
    generator = torch.Generator().manual_seed(6)
    for _ in range(5):
        lens = random_lens(name, generator)
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
    lens = random_lens(name, torch.Generator().manual_seed(7), (0.8, 3))
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
    lens = random_lens(name, torch.Generator().manual_seed(10))
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
    exact = random_lens(name, torch.Generator().manual_seed(8))
    lens = exact.with_theta_max(0.999 * exact.theta_limit).to(torch.float32)
    radius = lens.project(lens.theta_max[:, None] * torch.linspace(0.01, 1, 200))
    error = (lens.project(lens.unproject(radius)) - radius).abs()
    # Rounding of θ, where r is steep, and of r.
    allowed = torch.finfo(torch.float32).eps * (8 * radius + 4 * 3.2 * lens._slope(
        lens.theta_max[:, None] * torch.linspace(0.01, 1, 200)))  # fmt: skip
    assert (error <= allowed).all()


@pytest.mark.parametrize("name", MODELS)
def test_second_and_third_derivatives(name):
    lens = random_lens(name, torch.Generator().manual_seed(7), (0.8, 3))[0]
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
    exact = random_lens(name, torch.Generator().manual_seed(8))
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


ASIDE = {
    "Mei": Mei(double(2.2134), 1336.3, double(0.0168, 1.6549), 1.75, double(716.9, 705.8),
               tangential=double(4.2e-4, 4.2e-3), affine=double(1, 0.001, 0, 0.9996).view(2, 2)),
    "KannalaBrandt": KannalaBrandt(double(300.0), double(0.01, -0.002), 1.8, double(400, 300),
                                   tangential=double(1e-3, -2e-3),
                                   prism=double(1e-3, -1e-4, 2e-3, 1e-4)),
    "Fisheye624": Fisheye624(double(300.0), double(0.01, -0.002, 0, 0, 0, 0), 1.8, double(40, 30),
                             tangential=double(1e-3, -2e-3), prism=double(1e-3, 0, 2e-3, 0)),
    "BrownConrady": BrownConrady(double(500.0), double(-0.1, 0.02), 0.9, double(320, 240),
                                 tangential=double(1e-3, 5e-4), prism=double(1e-3, 0, -1e-3, 0)),
    "affine alone": Polynomial(double(339.749, -31.988, 48.275, -7.201), 1.9, double(643.4, 479.4),
                               affine=double(1.001, -8e-4, 2e-4, 1).view(2, 2)),
}  # fmt: skip


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
        double(716.9 + 900, 705.8, 5000, 5000, 716.9, 705.8).view(3, 2)
    )
    assert theta.isnan().tolist() == [True, True, False] and theta[2].abs() < 1e-9


def test_the_tangential_terms_are_opencvs():
    cv2 = pytest.importorskip("cv2")
    lens = ASIDE["BrownConrady"].replace(prism=None, affine=double(1, 0, 0, 1.2).view(1, 2, 2))
    theta, azimuth = double(0.3, 0.6, 0.85), double(0.5, 2.9, -2.0)
    x, y = torch.tan(theta) * torch.cos(azimuth), torch.tan(theta) * torch.sin(azimuth)
    rays = torch.stack((x, y, torch.ones_like(x)), 1)
    camera = double(500, 0, 320, 0, 600, 240, 0, 0, 1).view(3, 3)
    p1, p2 = lens.tangential[0].tolist()
    expected, _ = cv2.projectPoints(
        rays.numpy(), double(0, 0, 0).numpy(), double(0, 0, 0).numpy(), camera.numpy(),
        double(-0.1, 0.02, p1, p2).numpy(),
    )  # fmt: skip
    torch.testing.assert_close(
        lens.project_rays(theta, azimuth), torch.from_numpy(expected[:, 0]), rtol=0, atol=1e-9
    )


def test_lenses_of_several_models_are_one_batch_of_curves():
    lenses = [CALIBRATIONS[name][0] for name in ("WoodScape front", "Kalibr ds", "COLMAP")]
    lenses = [lens.with_theta_max(1.6).replace(center=double(1, 2)[None]) for lens in lenses]
    lenses[1] = lenses[1].replace(affine=2 * torch.eye(2, dtype=f64)[None])
    batch = cat(lenses)
    assert isinstance(batch, Tabulated) and len(batch) == 3
    theta = torch.linspace(0, 1.6, 777, dtype=f64)[None]
    exact = torch.cat([lens.project(theta) for lens in lenses])
    torch.testing.assert_close(batch.project(theta), exact, rtol=0, atol=2e-5)
    torch.testing.assert_close(batch.unproject(exact), theta.expand(3, -1), rtol=0, atol=1e-7)
    assert batch.affine[0].tolist() == [[1, 0], [0, 1]] and batch.affine[1, 0, 0] == 2
    degrees = cat([Polynomial(double(10.0), 1.0), Polynomial(double(10.0, 1.0), 1.0)])
    assert isinstance(degrees, Tabulated)
    same = cat([lenses[1], lenses[1]])
    assert isinstance(same, DoubleSphere) and len(same) == 2
    with pytest.raises(ValueError, match="tangential or thin-prism terms is no curve"):
        cat([ASIDE["Mei"], ASIDE["affine alone"]])
    xi = torch.tensor([0.5], dtype=f64, requires_grad=True)
    curve = as_curves(Spherical(xi, 10.0, 1.0))
    curve.project(double(0.7)).backward()
    torch.testing.assert_close(
        xi.grad, -10 * torch.sin(double(0.7)) / (0.5 + torch.cos(double(0.7))) ** 2,
        rtol=1e-5, atol=0,
    )  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_a_curve_is_its_lens_to_1e_7_of_the_largest_radius(name):
    lens = random_lens(name, torch.Generator().manual_seed(3), (100, 1000))
    steps = torch.linspace(0, 1, 20001, dtype=f64)
    for part in (0.5, 0.99):
        used = lens.with_theta_max(part * lens.theta_limit)
        theta = used.theta_max[:, None] * steps
        error = (as_curves(used).project(theta) - used.project(theta)).abs() / used.r_max[:, None]
        if name == "OCamInverse":
            error = error[:, 100:]  # r(0) is not 0 there
        assert error.max() < (1e-3 if name == "Tabulated" else 1e-7)
        curve, exact = as_curves(used.to(torch.float32)), used.project(theta)
        error = (curve.project(theta.float()) - exact).abs() / used.r_max[:, None]
        assert error.max() < (1e-3 if name == "Tabulated" else 1e-5)


def test_mixed_ideal_lenses_in_one_batch_are_exact_to_1e_5_px():
    ends = {
        Perspective: 89.0,
        Equidistant: 110,
        Equisolid: 110,
        Stereographic: 110,
        Orthographic: 85,
    }
    lenses = [model(double(300.0), math.radians(end)) for model, end in ends.items()]
    batch = cat(lenses)
    theta = batch.theta_max[:, None] * torch.linspace(0, 1, 30001, dtype=f64)
    exact = torch.cat([lens.project(t[None]) for lens, t in zip(lenses, theta, strict=True)])
    error = (batch.project(theta) - exact).abs().amax(1)
    assert error[1:].max() < 1e-6 and error[0] < 1e-4  # r_max is 17,187 px there
    radius = exact[:, ::7]
    torch.testing.assert_close(batch.unproject(radius), theta[:, ::7], rtol=0, atol=1e-8)


def test_slopes_of_a_table_are_used_and_checked():
    angles = torch.linspace(0, 1.5, 40, dtype=f64)
    exact = Stereographic(double(200.0))
    slopes = 200 / torch.cos(angles / 2) ** 2
    lens = Tabulated(angles, exact.project(angles), slopes=slopes)
    plain = Tabulated(angles, exact.project(angles))
    theta = torch.linspace(0, 1.5, 1001, dtype=f64)
    error, usual = (
        (made.project(theta) - exact.project(theta)).abs().max() for made in (lens, plain)
    )
    assert error < 1e-5 < 1e-3 < usual
    double_size = lens.resized(2).project(theta)
    torch.testing.assert_close(double_size, 2 * lens.project(theta))
    with pytest.raises(ValueError, match="slopes must be from 0 to 3 times the table's"):
        Tabulated(angles, exact.project(angles), slopes=4 * slopes)
    with pytest.raises(
        ValueError, match=r"slopes must have the shape of angles and radii, \(1, 40"
    ):
        Tabulated(angles, exact.project(angles), slopes=slopes[:-1])


def test_a_column_of_coefficients_is_not_many_lenses():
    column = [[0.01], [0.002], [-0.001], [0.0003]]  # as OpenCV has its D
    for make in (lambda: KannalaBrandt(300.0, column), lambda: KannalaBrandt([300.0], column)):
        with pytest.raises(ValueError, match=r"radial of shape \(4, 1\) is 4 lenses of one coef"):
            make()
    assert len(KannalaBrandt([300.0] * 4, column)) == 4
    assert len(KannalaBrandt(300.0, [[0.01]])) == 1


def test_a_table_of_two_is_straight():
    lens = Tabulated([0.0, 1.0], [0.0, 50.0])
    torch.testing.assert_close(lens.project(torch.tensor([0.25, 1.0])), torch.tensor([12.5, 50.0]))
    assert lens.theta_limit.item() == 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EnhancedUnified(1.1, 1.0, 1.0), r"alpha must be in \[0, 1\], got 1.1"),
        (lambda: EnhancedUnified(0.5, 0.0, 1.0), "beta must be finite and above 0"),
        (lambda: DoubleSphere(-1.0, 0.5, 1.0), "xi must be finite and above -1"),
        (lambda: FieldOfView(3.2, 1.0), r"omega must be in \(0, π\)"),
        (lambda: OCam([100.0, 0.0]), "coefficients must be such that a₀ is below 0"),
        (lambda: Polynomial([-1.0, 2.0]), "coefficients must be such that r rises"),
        (lambda: KannalaBrandt(1.0, [math.nan]), "radial must be finite"),
        (lambda: KannalaBrandt(1.0, [0.1], tangential=[0.1, 0.1, 0.1]), "tangential must be 2 num"),
        (lambda: KannalaBrandt(1.0, [-1.0], 1.0), r"theta_max must be at most 0.57734.*got 1.0"),
        (lambda: Tabulated([0.0, 1.0], [0.0, 1.0, 2.0]), "angles and radii must have the same"),
        (lambda: Tabulated([0.0, 1.0, 0.5], [0.0, 1.0, 2.0]), "angles must be finite and rising"),
        (lambda: Tabulated([0.0, 1.0], [1.0, 2.0]), "radii must be finite and rising from 0"),
        (lambda: Equidistant(1.0, affine=[[1.0, 0.0], [0.0, 0.0]]), "affine must be invertible"),
        (lambda: Equidistant(1.0, affine=[1.0, 2.0]), r"affine must be \(K, L\) or \(N, K, L\)"),
        (lambda: Equidistant(1.0, image_size=(0, 5)), "image_size must be at least"),
    ],
)
def test_a_parameter_out_of_range_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_rays_are_found_in_inference_mode():
    for lens in ASIDE.values():
        expected = lens.unproject_pixels(lens.project_rays(0.5, 0.3))
        with torch.inference_mode():
            found = lens.to(f64).unproject_pixels(lens.project_rays(0.5, 0.3))
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("name", MODELS)
def test_where_nothing_lands_there_is_no_gradient_either(name):
    lens = random_lens(name, torch.Generator().manual_seed(9), (0.8, 3))
    lens = lens.with_theta_max(0.9 * lens.theta_limit)
    names = [n for n in (*lens.parameters, *lens.optional) if getattr(lens, n) is not None]
    values = [getattr(lens, n).clone().requires_grad_() for n in names]
    made = lens.replace(**dict(zip(names, values, strict=True)))
    radius = torch.cat((lens.r_max[:, None] * double(0.3, 0.8), double(1e9).expand(4, 1)), 1)
    theta = made.unproject(radius)
    torch.where(theta <= lens.theta_max[:, None], theta, 0.0).sum().backward()
    assert all(value.grad.isfinite().all() and value.grad.any() for value in values)
