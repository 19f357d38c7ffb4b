import copy

import pytest
import torch
import torch.nn.functional as F

from darswin.layers import linear
from darswin.layers.linear import Linear, onednn_lack


def by_onednn():
    layer = Linear(12, 20)
    layer.matmul_backend = "onednn"
    return layer


def results(layer, x):
    """The output and all gradients of a random projection."""
    x = x.detach().requires_grad_()
    layer.zero_grad()
    out = layer(x)
    grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(1)).to(out.dtype)
    out.backward(grad)
    return [out.detach(), x.grad, *(p.grad.clone() for p in layer.parameters())]


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("shape", [(12,), (1, 12), (2, 3, 5, 12), (300, 12)])
def test_both_libraries_give_the_same(shape, bias):
    layer = Linear(12, 20, bias=bias)
    x = torch.randn(shape)
    exact = results(copy.deepcopy(layer).double(), x.double())
    usual = results(layer, x)
    layer.matmul_backend = "onednn"
    for got, base, want in zip(results(layer, x), usual, exact, strict=True):
        assert got.is_contiguous()
        rounding = 4 * torch.finfo(torch.float32).eps * want.abs().max()
        assert (got - want).abs().max() <= max(2 * (base - want).abs().max(), rounding)


def test_onednn_has_no_second_derivatives():
    x = torch.randn(4, 12, requires_grad=True)
    (grad,) = torch.autograd.grad(by_onednn()(x).square().sum(), x, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


def test_only_wanted_gradients():
    layer = by_onednn()
    x = torch.randn(4, 12, requires_grad=True)
    layer.requires_grad_(False)
    layer(x).sum().backward()
    torch.testing.assert_close(x.grad, layer.weight.sum(0).expand(4, 12))
    layer.bias.requires_grad_()
    layer(x).sum().backward()
    torch.testing.assert_close(layer.bias.grad, torch.full((20,), 4.0))


def test_where_torch_multiplies_anyway(monkeypatch):
    monkeypatch.setattr(linear, "_onednn_product", None)
    layer = by_onednn()
    x = torch.randn(4, 12)
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(x).dtype == torch.bfloat16
    half, double = copy.deepcopy(layer).bfloat16(), copy.deepcopy(layer).double()
    assert torch.equal(half(x.bfloat16()), F.linear(x.bfloat16(), half.weight, half.bias))
    assert double(x.double()).dtype == torch.float64
    assert layer(x[:0]).shape == (0, 20)
    with torch.backends.mkldnn.flags(enabled=False):
        assert layer(x).shape == (4, 20)


@pytest.mark.slow
def test_compiled_graphs_have_torchs_product(monkeypatch):
    monkeypatch.setattr(linear, "_onednn_product", None)
    layer, x = by_onednn(), torch.randn(4, 12)
    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(x), F.linear(x, layer.weight, layer.bias))


def test_the_reason_why_there_is_no_onednn(monkeypatch):
    assert onednn_lack() is None
    with torch.backends.mkldnn.flags(enabled=False):
        assert "enabled is False" in onednn_lack()
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    assert "without oneDNN" in onednn_lack()
