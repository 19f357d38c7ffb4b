import copy

import pytest
import torch
import torch.nn.functional as F

from darswin.layers import linear
from darswin.layers.linear import Linear, autotune_results, onednn_lack

PRODUCTS = linear._PRODUCTS


@pytest.fixture(autouse=True)
def forget():
    """Every test starts without measurements."""
    linear._measured.clear()


def results(layer, x):
    """The output and all gradients of a random projection."""
    x = x.detach().requires_grad_()
    layer.zero_grad()
    out = layer(x)
    grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(1)).to(out.dtype)
    out.backward(grad)
    return [out.detach(), x.grad, *(p.grad.clone() for p in layer.parameters())]


def measure(monkeypatch, seconds):
    """Replaces the measurement by these seconds; returns a list of the measured shapes."""
    shapes = []

    def found(runs, turns):
        shapes.append(next(iter(runs.values())).args[0].shape)
        return {name: seconds[name] for name in runs}

    monkeypatch.setattr(linear, "best_seconds", found)
    return shapes


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("shape", [(12,), (1, 12), (2, 3, 5, 12), (300, 12)])
@pytest.mark.parametrize("library", ["torch", "onednn"])
def test_both_libraries_give_the_same(monkeypatch, library, shape, bias):
    layer = Linear(12, 20, bias=bias)
    x = torch.randn(shape)
    exact = results(copy.deepcopy(layer).double(), x.double())
    usual = results(layer, x)
    measure(monkeypatch, {"torch": 1.0, "onednn": 1.0} | {library: 0.0})
    layer.matmul_backend = "autotune"
    for got, base, want in zip(results(layer, x), usual, exact, strict=True):
        assert got.is_contiguous()
        rounding = 4 * torch.finfo(torch.float32).eps * want.abs().max()
        assert (got - want).abs().max() <= max(2 * (base - want).abs().max(), rounding)


def test_onednn_measures_nothing(monkeypatch):
    monkeypatch.setattr(linear, "best_seconds", None)
    monkeypatch.setattr(linear, "_PRODUCTS", {k: dict(v, torch=None) for k, v in PRODUCTS.items()})
    layer = Linear(12, 20)
    layer.matmul_backend = "onednn"
    x = torch.randn(4, 12, requires_grad=True)
    (grad,) = torch.autograd.grad(layer(x).square().sum(), x, create_graph=True)
    assert not autotune_results()
    with pytest.raises(RuntimeError, match="once_differentiable"):
        grad.sum().backward()


def test_autotune_measures_each_shape_once(monkeypatch):
    shapes = measure(monkeypatch, dict(torch=0.2, onednn=0.1))
    layer = Linear(12, 20)
    layer.matmul_backend = "autotune"
    for rows in (5, 8, 8, 2):  # 5 to 8 rows are one shape
        results(layer, torch.randn(rows, 12))
    assert shapes == [(5, 12), (5, 20), (5, 20), (2, 12), (2, 20), (2, 20)]
    threads = torch.get_num_threads()
    assert autotune_results() == {
        (product, rows, 12, 20, threads): {"onednn": 0.1, "torch": 0.2}
        for rows in (8, 2)
        for product in ("forward", "input gradient", "weight gradient")
    }
    assert all(next(iter(seconds)) == "onednn" for seconds in autotune_results().values())


def test_the_best_of_some_turns_counts_but_not_the_first(monkeypatch):
    times = iter([0, 0, 0, 3, 3, 7, 7, 9, 9, 16])  # seconds: 3 and 4, then 2 and 7
    monkeypatch.setattr(linear.time, "perf_counter", lambda: next(times))
    calls = []
    runs = dict(a=lambda: calls.append("a"), b=lambda: calls.append("b"))
    assert linear.best_seconds(runs, turns=3) == dict(a=2, b=4)
    assert calls == ["a", "b"] * 3


def test_only_wanted_gradients():
    layer = Linear(12, 20)
    layer.matmul_backend = "autotune"
    x = torch.randn(4, 12, requires_grad=True)
    layer.requires_grad_(False)
    layer(x).sum().backward()
    assert {shape.product for shape in autotune_results()} == {"forward", "input gradient"}
    torch.testing.assert_close(x.grad, layer.weight.sum(0).expand(4, 12))
    layer.bias.requires_grad_()
    layer(x).sum().backward()
    torch.testing.assert_close(layer.bias.grad, torch.full((20,), 4.0))


@pytest.mark.parametrize("backend", ["onednn", "autotune"])
def test_where_torch_multiplies_anyway(monkeypatch, backend):
    monkeypatch.setattr(linear, "_multiply", None)
    layer = Linear(12, 20)
    layer.matmul_backend = backend
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
    monkeypatch.setattr(linear, "_multiply", None)
    layer, x = Linear(12, 20), torch.randn(4, 12)
    layer.matmul_backend = "onednn"
    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(x), F.linear(x, layer.weight, layer.bias))


def test_the_reason_why_there_is_no_onednn(monkeypatch):
    def lacks(dtype, words, place, name, value):
        monkeypatch.setattr(place, name, lambda: value, raising=False)
        found = onednn_lack(dtype)
        assert found is None if words is None else words in found

    assert "float64" in onednn_lack(torch.float64)
    with torch.backends.mkldnn.flags(enabled=False):
        assert "enabled is False" in onednn_lack(torch.float32)
    int8, cpu, mkldnn = torch.int8, torch.cpu, torch.ops.mkldnn
    lacks(torch.bfloat16, "this CPU", mkldnn, "_is_mkldnn_bf16_supported", False)
    monkeypatch.setattr(cpu, "get_capabilities", dict, raising=False)
    lacks(int8, "no VNNI", cpu, "_is_vnni_supported", False)
    monkeypatch.setattr(linear, "_int8_is_exact", lambda: False)
    lacks(int8, "overflow", cpu, "get_capabilities", {"amx_int8": True})
    lacks(int8, None, linear, "_int8_is_exact", True)
    lacks(torch.float32, "without oneDNN", torch.backends.mkldnn, "is_available", False)
