"""Whole models under torch.compile: one graph, any batch size, the same results."""

import pytest
import torch
from torch._dynamo.testing import CompileCounter

from darswin import create_model
from darswin.lens import Spherical

FAMILIES = ("darswin_a", "darswin_ra", "swin", "swin_undis", "dat")
SHORT = {
    "darswin_a": dict(jitter=0.0),
    "darswin_ra": dict(jitter=0.0),
    "dat": dict(blocks=("L", "SD"), groups=(1, 2)),
}


def short(family):
    """Two stages, so that compiling takes seconds; jitter off, which inductor draws otherwise."""
    options = dict(depths=(1, 2), num_heads=(1, 2)) | SHORT.get(family, {})
    return create_model(f"{family}_nano", num_classes=5, **options)


def inputs(batch):
    xi = torch.linspace(0.2, 0.9, batch)
    return torch.randn(batch, 3, 32, 32), Spherical.from_fov(xi, 2.6, 16.0)


@pytest.mark.parametrize("family", FAMILIES)
def test_one_graph_for_training_at_any_batch_size(family):
    counter = CompileCounter()
    model = create_model(f"{family}_nano", num_classes=5, drop_path_rate=0.1)
    compiled = torch.compile(model, fullgraph=True, dynamic=True, backend=counter)
    for batch in (2, 3, 5):
        assert compiled(*inputs(batch)).shape == (batch, 5)
    assert counter.frame_count == 1


@pytest.mark.parametrize("family", ["swin_undis", "dat"])  # DarSwin's: test_darswin.py
def test_a_compiled_training_step(family):
    model, (images, lens) = short(family), inputs(2)
    model(images, lens).square().sum().backward()
    expected = {name: p.grad.clone() for name, p in model.named_parameters()}
    model.zero_grad()
    torch.compile(model, fullgraph=True)(images, lens).square().sum().backward()
    for name, parameter in model.named_parameters():
        torch.testing.assert_close(parameter.grad, expected[name], rtol=1e-3, atol=1e-4, msg=name)


@pytest.mark.parametrize("family", ["darswin_a", "swin_undis", "dat"])
def test_compiled_inference(family):
    model = short(family).eval()
    compiled = torch.compile(model, fullgraph=True, dynamic=True)
    with torch.no_grad():
        for batch in (2, 5):
            images, lens = inputs(batch)
            torch.testing.assert_close(
                compiled(images, lens), model(images, lens), rtol=1e-4, atol=1e-5
            )
