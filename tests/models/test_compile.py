"""Whole models under torch.compile: one graph, any batch size, the same results."""

import pytest
import torch
from torch._dynamo.testing import CompileCounter

from darswin import create_model
from darswin.lens import Spherical

FAMILIES = ("darswin_a", "darswin_ra", "swin", "swin_undis", "dat")


@pytest.fixture(autouse=True)
def no_graphs_before_or_after():
    """All models share a forward, of which torch.compile keeps eight graphs at most."""
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


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


@pytest.mark.parametrize("name", ["darswin_unet_a_nano", "swin_unet_undis_nano"])
def test_one_graph_of_a_dense_model_at_any_batch_size(name):
    counter = CompileCounter()
    options = {} if name.startswith("darswin") else dict(image_size=32)
    model = create_model(name, num_classes=5, drop_path_rate=0.1, **options)
    compiled = torch.compile(model, fullgraph=True, dynamic=True, backend=counter)
    for batch in (2, 3, 5):
        assert compiled(*inputs(batch)).shape == (batch, 5, 32, 32)
    assert counter.frame_count == 1


def one_block(family, **options):
    """A model of which inductor's C++ is built in seconds."""
    return create_model(f"{family}_nano", num_classes=5, depths=(1,), num_heads=(1,), **options)


def test_a_compiled_training_step():  # DarSwin's: test_darswin.py
    model, (images, lens) = one_block("swin_undis"), inputs(2)
    model(images, lens).square().sum().backward()
    expected = {name: p.grad.clone() for name, p in model.named_parameters()}
    model.zero_grad()
    torch.compile(model, fullgraph=True)(images, lens).square().sum().backward()
    for name, parameter in model.named_parameters():
        torch.testing.assert_close(parameter.grad, expected[name], rtol=1e-3, atol=1e-4, msg=name)


def test_compiled_inference():  # DarSwin's: the package in test_export.py
    model = one_block("dat", blocks=("D",), groups=(1,)).eval()
    images, lens = inputs(2)
    with torch.no_grad():
        expected = model(images, lens)
        got = torch.compile(model, fullgraph=True)(images, lens)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)
