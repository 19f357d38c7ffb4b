"""Lenses as curves, and several models in one batch."""

import pytest
import torch
from helpers import refused
from lens_examples import ASIDE, calibrated, double, example, f64
from scipy.interpolate import PchipInterpolator

from darswin.lens import (
    MODELS,
    DoubleSphere,
    Equidistant,
    OCamInverse,
    Perspective,
    Polynomial,
    Spherical,
    Stereographic,
    Tabulated,
    cat,
)
from darswin.lens.curves import as_curves


def alone(name, camera=None):
    """A calibrated lens without its image."""
    return calibrated(name, camera).replace(center=None, affine=None, image_size=None)


def test_lenses_of_several_models_are_one_batch_of_curves():
    lenses = [alone(name) for name in ("woodscape.json", "kalibr_ds.yaml", "colmap.txt")]
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
    aside = [ASIDE["Mei"], ASIDE["affine alone"]]
    refused("tangential or thin-prism terms is no curve", cat, aside)
    xi = torch.tensor([0.5], dtype=f64, requires_grad=True)
    as_curves(Spherical(xi, 10.0, 1.0)).project(double(0.7)).backward()
    slope = -10 * torch.sin(double(0.7)) / (0.5 + torch.cos(double(0.7))) ** 2
    torch.testing.assert_close(xi.grad, slope, rtol=1e-5, atol=0)


@pytest.mark.parametrize("name", MODELS)
def test_a_curve_is_its_lens_to_1e_7_of_the_largest_radius(name):
    lens = example(name, torch.Generator().manual_seed(3), (100, 1000))
    steps = torch.linspace(0, 1, 1001, dtype=f64)
    for part in (0.5, 0.99):
        used = lens.with_theta_max(part * lens.theta_limit)
        exact = used.project(used.theta_max[:, None] * steps)
        for dtype, most in ((f64, 1e-7), (torch.float32, 1e-5)):
            theta = (used.theta_max[:, None] * steps).to(dtype)
            error = (as_curves(used.to(dtype)).project(theta) - exact).abs() / used.r_max[:, None]
            if name == "OCamInverse" and dtype == f64:
                error = error[:, 100:]  # r(0) is not 0 there
            assert error.max() < (1e-3 if name == "Tabulated" else most)
    # Joined with lenses of other models, up to the limit.
    ideal = [Equidistant(double(300.0), 2.0), Perspective(double(300.0))]
    for before, after in zip([*lens, *ideal], cat([lens, *ideal]), strict=True):
        theta = before.theta_max * torch.linspace(0, 1, 2001, dtype=f64)
        radius = before.project(theta)
        error = (after.project(theta) - radius)[radius < 1000].abs().max()
        assert error < {"Tabulated": 0.1, "OCamInverse": 0.01}.get(name, 1e-3)
        assert after.theta_max == before.theta_max


@pytest.mark.parametrize("shift", [-30.0, -1.5, 2.0, 30.0])
def test_a_lens_that_begins_beside_the_axis_is_no_curve(shift):
    curve = torch.linspace(0, 1.9, 400, dtype=f64)
    fitted = OCamInverse.closest(curve, alone("ocamcalib.txt").project(curve), curve, 12)
    lens = OCamInverse(fitted, 1.9)
    moved = lens.replace(coefficients=lens.coefficients + double(shift, *[0] * 12))
    other = Equidistant(double(300.0))
    refused(r"only if r\(0\) is 0 to .* got r\(0\) = -?[\d.]+ px", cat, [moved, other])
    refused("only if", cat, [other, moved.with_theta_max(1.7).resized(0.01)])
    theta = 0.9 * moved.theta_max * torch.linspace(0, 1, 50, dtype=f64)
    assert torch.equal(cat([moved, moved]).project(theta[None])[1], moved.project(theta))
    assert isinstance(cat([lens, other]), Tabulated)  # the r(0) of a fitted polynomial is small


def test_slopes_of_a_table_are_used_and_checked():
    angles = torch.linspace(0, 1.5, 40, dtype=f64)
    exact = Stereographic(double(200.0))
    slopes = 200 / torch.cos(angles / 2) ** 2
    lens = Tabulated(angles, exact.project(angles), slopes=slopes)
    theta = torch.linspace(0, 1.5, 1001, dtype=f64)
    made = lens, Tabulated(angles, exact.project(angles))
    error, usual = ((of.project(theta) - exact.project(theta)).abs().max() for of in made)
    assert error < 1e-5 < 1e-3 < usual
    torch.testing.assert_close(lens.resized(2).project(theta), 2 * lens.project(theta))
    straight = dict(angles=[0.0, 1.0, 2.0], radii=[0.0, 10.0, 20.0])
    assert len(Tabulated(**straight, slopes=[30.0, 0.0, 30.0])) == 1
    for wrong in ([30.1, 10.0, 10.0], [-0.1, 10.0, 10.0]):
        said = "slopes must be from 0 to 3 times the table's"
        refused(said, Tabulated, **straight, slopes=wrong)
    table, said = (angles, exact.project(angles)), r"the shape of angles and radii, \(1, 40"
    refused(f"slopes must have {said}", Tabulated, *table, slopes=slopes[:-1])
    # A table of two is straight.
    lens = Tabulated([0.0, 1.0], [0.0, 50.0])
    torch.testing.assert_close(lens.project(torch.tensor([0.25, 1.0])), torch.tensor([12.5, 50.0]))
    assert lens.theta_limit.item() == 1.0


def test_a_table_without_slopes_is_scipys_pchip():
    """Except in the first and last interval, where scipy limits the slopes differently."""
    lens = example("Tabulated", torch.Generator().manual_seed(0))[0]
    exact = PchipInterpolator(lens.angles[0], lens.radii[0])
    theta = torch.linspace(lens.angles[0, 1], lens.angles[0, -2], 100, dtype=f64)
    torch.testing.assert_close(lens.project(theta), torch.from_numpy(exact(theta)))
    angles = double(0, 0.2, 0.5, 0.9)
    parabola = Tabulated(angles, 100 * angles - 20 * angles**2)
    torch.testing.assert_close(parabola._slope(angles[[0, -1]]), double(100, 100 - 40 * 0.9))
