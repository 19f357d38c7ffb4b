"""A lens inside a model: the gradient at its parameters, through the samples and the bias."""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from darswin import create_model
from darswin.layers.polar import PolarGrid
from darswin.lens import KannalaBrandt, Lens, Mei, Spherical
from darswin.models.encoder import Prepared

f64 = torch.float64
CIRCLE = 14.7  # px, the radius that the images are used up to


def to_the_circle(lens: Lens) -> Lens:
    """θ_max is where the lens reaches the circle, and so a function of its parameters."""
    return lens.with_theta_max(lens.unproject(CIRCLE))


def spherical(xi, focal, center):
    return to_the_circle(Spherical(xi, focal, center=center))


def mei(xi, focal, center, radial):
    return to_the_circle(Mei(xi, focal, radial, center=center))


def kannala_brandt(focal, center, radial):
    return to_the_circle(KannalaBrandt(focal, radial, center=center))


LENSES: dict[Callable, dict] = {
    spherical: dict(xi=[0.6], focal=[13.0], center=[[15.3, 16.1]]),
    mei: dict(xi=[0.9], focal=[18.0], center=[[15.3, 16.1]], radial=[[0.03, -0.02]]),
    kannala_brandt: dict(focal=[11.0], center=[[15.3, 16.1]], radial=[[0.02, -0.01, 0.004]]),
}


@pytest.fixture
def model():
    # Position biases of training's size: at the start they are near 0.
    model = create_model("darswin_a_nano", num_classes=5, in_chans=2).to(f64).eval()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if ".position_bias." in name:
                parameter.normal_()
    return model.requires_grad_(False)


@pytest.fixture
def loss(model):
    images, labels = torch.randn(3, 2, 32, 32, dtype=f64), torch.tensor([0, 3, 4])

    def of(lens: Lens) -> Tensor:
        return 100 * F.cross_entropy(model(images, lens), labels)

    return of


def leaves(values: dict) -> dict[str, Tensor]:
    return {
        name: torch.tensor(value, dtype=f64, requires_grad=True) for name, value in values.items()
    }


def gradients(loss: Callable[[Lens], Tensor], make: Callable) -> dict[str, Tensor]:
    parameters = leaves(LENSES[make])
    grads = torch.autograd.grad(
        loss(make(**parameters)), list(parameters.values()), materialize_grads=True
    )
    return dict(zip(parameters, grads, strict=True))


def differences(loss: Callable[[Lens], Tensor], make: Callable, step: float) -> dict[str, Tensor]:
    """The same by central differences."""
    found = {}
    for name, value in leaves(LENSES[make]).items():
        found[name] = torch.zeros_like(value)
        for k in range(value.numel()):
            ends = []
            for sign in (-1, 1):
                moved = {n: v.detach().clone() for n, v in leaves(LENSES[make]).items()}
                moved[name].view(-1)[k] += sign * step
                ends.append(loss(make(**moved)))
            found[name].view(-1)[k] = (ends[1] - ends[0]) / (2 * step)
    return found


def without_sampling(model, monkeypatch) -> None:
    """The lens's parameters reach the model through the bias alone."""
    prepare = model.prepare

    def detached(*args):
        points, positions = prepare(*args)
        return Prepared(PolarGrid(*(None if t is None else t.detach() for t in points)), positions)

    monkeypatch.setattr(model, "prepare", detached)


def without_bias(model, monkeypatch) -> None:
    """The lens's parameters reach the model through the samples alone."""
    prepare = model.prepare

    def detached(*args):
        points, positions = prepare(*args)
        return Prepared(points, [[t.detach() for t in of_stage] for of_stage in positions])

    monkeypatch.setattr(model, "prepare", detached)


@pytest.mark.parametrize("make", LENSES)
def test_gradients_are_those_of_finite_differences(loss, make):
    got, expected = gradients(loss, make), differences(loss, make, 1e-6)
    for name, gradient in got.items():
        assert (gradient != 0).all(), name
        torch.testing.assert_close(gradient, expected[name], rtol=1e-4, atol=1e-6, msg=name)


@pytest.mark.parametrize("make", LENSES)
def test_samples_and_bias_each_carry_their_part(model, loss, make, monkeypatch):
    whole = gradients(loss, make)
    with monkeypatch.context() as patch:
        without_bias(model, patch)
        samples = gradients(loss, make)
    with monkeypatch.context() as patch:
        without_sampling(model, patch)
        bias = gradients(loss, make)
    for name, gradient in whole.items():
        torch.testing.assert_close(samples[name] + bias[name], gradient, rtol=1e-9, atol=1e-12)
        assert (samples[name] != 0).all(), name
        # The bias knows angles only: it says nothing about the principal point.
        assert ((bias[name] == 0) if name == "center" else (bias[name] != 0)).all(), name


@pytest.mark.parametrize("make", LENSES)
def test_a_model_without_bias_learns_through_the_samples(model, loss, make, monkeypatch):
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if ".position_bias." in name:
                parameter.zero_()
    got, expected = gradients(loss, make), differences(loss, make, 1e-6)
    for name, gradient in got.items():
        torch.testing.assert_close(gradient, expected[name], rtol=1e-4, atol=1e-6, msg=name)
    without_sampling(model, monkeypatch)
    assert all((gradient == 0).all() for gradient in gradients(loss, make).values())


def test_a_known_field_of_view_leaves_the_samples_alone(model, loss, monkeypatch):
    # With θ_max given and not a function of the parameters, the bias is a constant.
    without_sampling(model, monkeypatch)
    xi = torch.tensor([0.6], dtype=f64, requires_grad=True)
    lens = Spherical.from_fov(xi, torch.tensor([2.6], dtype=f64), CIRCLE)
    assert not loss(lens).requires_grad


def test_a_lens_is_found_by_descent_on_a_known_scene(model):
    # What the true lens makes of a scene is the target; descent starts far from it.
    y, x = torch.meshgrid(torch.arange(32.0, dtype=f64), torch.arange(32.0, dtype=f64),
                          indexing="ij")  # fmt: skip
    scene = torch.stack((torch.sin(x / 4 + y / 9), torch.cos(y / 5 - x / 12)))[None]
    with torch.no_grad():
        truth = Spherical(torch.tensor([0.8], dtype=f64), 17.0, 1.2, center=[15.2, 16.4])
        target = model.forward_features(scene, truth)
    parameters = leaves(dict(xi=[0.3], focal=[12.0], center=[[17.0, 14.5]]))
    optimizer = torch.optim.LBFGS(list(parameters.values()), max_iter=60, tolerance_change=1e-12,
                                  line_search_fn="strong_wolfe")  # fmt: skip

    def closure() -> Tensor:
        optimizer.zero_grad()
        found = model.forward_features(scene, Spherical(theta_max=1.2, **parameters))
        error = (found - target).square().mean()
        error.backward()
        return error

    optimizer.step(closure)
    theta = torch.linspace(0, 1.2, 20, dtype=f64)[None]
    found = Spherical(theta_max=1.2, **parameters)
    torch.testing.assert_close(found.center, truth.center, rtol=0, atol=1e-3)
    torch.testing.assert_close(found.project(theta), truth.project(theta), rtol=0, atol=1e-3)
