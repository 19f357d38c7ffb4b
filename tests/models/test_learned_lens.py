"""Learning a lens: the gradients of its parameters, through the samples and the bias."""

import pytest
import torch
import torch.nn.functional as F

from darswin import create_model
from darswin.lens import KannalaBrandt, Mei, Spherical
from darswin.views import PolarGrid

f64 = torch.float64
CIRCLE = 14.7  # px, the radius of the image circle
LENSES = {
    Spherical: dict(xi=[0.6], focal=[13.0], center=[[15.3, 16.1]]),
    Mei: dict(xi=[0.9], focal=[18.0], center=[[15.3, 16.1]], radial=[[0.03, -0.02]]),
    KannalaBrandt: dict(focal=[11.0], center=[[15.3, 16.1]], radial=[[0.02, -0.01, 0.004]]),
}


@pytest.fixture
def model():
    # Position biases as large as after training; new ones are near 0.
    model = create_model("darswin_a_nano", num_classes=5, in_chans=2).to(f64).eval()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if ".position_bias." in name:
                parameter.normal_()
    return model.requires_grad_(False)


def leaves(values):
    return {
        name: torch.tensor(value, dtype=f64, requires_grad=True) for name, value in values.items()
    }


def make_lens(kind, **values):
    """A lens whose θ_max depends on its parameters: the angle at the radius of the circle."""
    lens = kind(**values)
    return lens.with_theta_max(lens.unproject(CIRCLE))


def whole(prepared):
    return prepared


def without_sampling(prepared):
    """The gradients of the lens come through the bias alone."""
    grid = PolarGrid(*(None if t is None else t.detach() for t in prepared.view.grid))
    return prepared._replace(view=prepared.view._replace(grid=grid))


def without_bias(prepared):
    """The gradients of the lens come through the samples alone."""
    tables = [[t.detach() for t in of_stage] for of_stage in prepared.tables]
    return prepared._replace(tables=tables)


@pytest.mark.parametrize("kind", LENSES)
def test_gradients_are_those_of_finite_differences_and_of_their_two_parts(model, kind):
    images, labels = torch.randn(3, 2, 32, 32, dtype=f64), torch.tensor([0, 3, 4])
    values = leaves(LENSES[kind])

    def loss(*parameters, part=whole):
        lens = make_lens(kind, **dict(zip(values, parameters, strict=True)))
        prepared = part(model.prepare(lens, (32, 32)))
        return 100 * F.cross_entropy(model.run(images, prepared), labels)

    assert torch.autograd.gradcheck(loss, tuple(values.values()), rtol=1e-4, atol=1e-6)
    of_both, samples, bias = (
        torch.autograd.grad(
            loss(*values.values(), part=part), list(values.values()), materialize_grads=True
        )
        for part in (whole, without_bias, without_sampling)
    )
    for name, *gradients in zip(values, of_both, samples, bias, strict=True):
        torch.testing.assert_close(gradients[1] + gradients[2], gradients[0], rtol=1e-9, atol=1e-12)
        assert (gradients[0] != 0).all() and (gradients[1] != 0).all(), name
        # The bias depends on angles alone, so it has no gradient for the principal point.
        assert ((gradients[2] == 0) if name == "center" else (gradients[2] != 0)).all(), name
    # With a fixed θ_max, the bias is a constant.
    known = Spherical.from_fov(values["focal"] / 20, torch.tensor([2.6], dtype=f64), CIRCLE)
    model.requires_grad_(False)
    prepared = model.prepare(known, (32, 32))
    assert prepared.view.grid.radii.requires_grad
    assert not any(table.requires_grad for tables in prepared.tables for table in tables)
    model.requires_grad_(True)
