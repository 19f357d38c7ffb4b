"""examples/minimal.py computes the same logits and gradients as the package's DarSwin-A."""

import runpy
from pathlib import Path

import pytest
import torch

from darswin import create_model, lens

MINIMAL = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "minimal.py"))
MICRO = dict(dim=32, depths=(2, 2, 4, 2), heads=(1, 2, 4, 8), samples=6)
NANO = dict(dim=24, depths=(1, 2, 1), heads=(1, 2, 4), rings=8, sectors=32, samples=4)


def test_the_defaults_are_those_of_the_small_model():
    with torch.device("meta"):
        model, expected = MINIMAL["DarSwinA"](), create_model("darswin_a_small")
    shapes = [{k: v.shape for k, v in m.state_dict().items()} for m in (model, expected)]
    assert shapes[0] == shapes[1]
    patches = model.patch_embed
    assert (patches.rings, patches.sectors, patches.samples) == (16, 64, 10)


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("name, sizes", [("darswin_a_micro", MICRO), ("darswin_a_nano", NANO)])
def test_the_logits_equal_the_packages(name, sizes, training):
    torch.manual_seed(0)
    # Drop path is the only part that the example leaves out.
    expected = create_model(name, num_classes=7, drop_path_rate=0.0).train(training)
    model = MINIMAL["DarSwinA"](num_classes=7, **sizes).train(training)
    model.load_state_dict(expected.state_dict())
    lenses = lens.Spherical.from_fov(xi=[0.2, 0.9], fov=2.8, radius=[32.0, 20.0])
    images, weights = torch.rand(2, 3, 64, 64), torch.randn(2, 7)
    torch.manual_seed(1)  # of the jitter
    logits = expected(images, lenses)
    (logits * weights).sum().backward()
    torch.manual_seed(1)
    found = model(images, lenses.xi, lenses.focal, lenses.theta_max)
    (found * weights).sum().backward()
    torch.testing.assert_close(found, logits, rtol=1e-4, atol=1e-5)
    gradients = dict(model.named_parameters())
    for key, parameter in expected.named_parameters():
        torch.testing.assert_close(gradients[key].grad, parameter.grad, rtol=1e-3, atol=1e-4)
