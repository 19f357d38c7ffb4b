import math

import lens_examples
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


@pytest.mark.parametrize(
    "lens",
    [
        FRONT,
        Spherical(torch.tensor(0.7, dtype=f64), 200.0, 1.6),
        EnhancedUnified(torch.tensor(0.6145, dtype=f64), 1.0862, 198.354, 1.7),
        DoubleSphere(torch.tensor(-0.2135, dtype=f64), 0.578, 331.24, 1.65),
        KannalaBrandt(torch.tensor(190.98, dtype=f64), [0.0035, 0.0007, -0.0021, 0.0002], 1.8),
    ],
    ids=lambda lens: type(lens).__name__,
)
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
    lens = Mei(torch.tensor(2.35, dtype=f64), 1390.0, [0.032, 2.4], 1.7,
               tangential=[1.3e-3, -7e-4])  # fmt: skip
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


def test_what_cannot_be_fitted():
    refused(r"no Perspective lens was found that reaches 95\.00°", fit, "Perspective", FRONT)
    refused("unknown lens model", fit, "Fisheye", FRONT)
    refused("model must be a lens class", fit, 3, FRONT, error=TypeError)
