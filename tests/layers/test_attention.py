import pytest
import torch

from darswin import PolarWindowAttention
from darswin.ops import use_reference, window_attention


@pytest.mark.parametrize("position_bias", ["angular_relative", "angular", "polar"])
def test_window_attention_layer(position_bias):
    layer = PolarWindowAttention(
        12, 3, map_size=(4, 8), window=(2, 8), position_bias=position_bias, periodic_bias=True
    )
    x = torch.randn(2, 4, 8, 12)
    ring_angles = torch.linspace(0, 1, 5)[None]
    out = layer(x, ring_angles)
    out.sum().backward()
    assert out.shape == x.shape
    assert all(p.grad is not None and p.grad.isfinite().all() for p in layer.parameters())
    with pytest.raises(ValueError, match=r"the map must be \(R, A\) = \(4, 8\), got \(8, 4\)"):
        layer(x.transpose(1, 2), ring_angles)


@pytest.mark.parametrize("periodic_bias", [False, True])
@pytest.mark.parametrize("position_bias", ["angular_relative", "angular"])
def test_compiled_gradients_of_the_bias(position_bias, periodic_bias):
    # torch 2.13's inductor miscompiles the gradient of an indexed table on CPU, wrong values and
    # writes out of bounds (pytorch#191837): the bias must not be built by indexing.
    layer = PolarWindowAttention(
        16, 8, map_size=(2, 8), window=(1, 8), position_bias=position_bias,
        periodic_bias=periodic_bias,
    )  # fmt: skip
    x, ring_angles = torch.randn(2, 2, 8, 16), torch.rand(2, 3).cumsum(1)
    layer(x, ring_angles).square().sum().backward()
    expected = {name: p.grad.clone() for name, p in layer.named_parameters()}
    layer.zero_grad()
    torch.compile(layer, fullgraph=True)(x, ring_angles).square().sum().backward()
    for name, parameter in layer.named_parameters():
        torch.testing.assert_close(parameter.grad, expected[name], rtol=1e-3, atol=1e-4)


def test_window_attention_layer_under_autocast():
    layer = PolarWindowAttention(8, 2, map_size=(2, 4), window=(2, 4))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = layer(torch.randn(1, 2, 4, 8), torch.linspace(0, 1, 3)[None])
    assert out.dtype == torch.bfloat16 and out.isfinite().all()


def test_autocast_makes_no_float32_map_of_the_window_attention_layer(monkeypatch):
    taken = []

    def record(qkv, bias, **options):
        out = window_attention(qkv, bias, **options)
        taken.append((qkv.dtype, bias.dtype, out.dtype))
        return out

    monkeypatch.setattr("darswin.layers.transformer.window_attention", record)
    layer = PolarWindowAttention(8, 2, map_size=(2, 4), window=(2, 4))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = layer(torch.randn(1, 2, 4, 8), torch.linspace(0, 1, 3)[None])
        out.float().square().sum().backward()
    assert taken == [(torch.bfloat16, torch.float32, torch.bfloat16)]
    assert all(p.grad.dtype == torch.float32 for p in layer.parameters())


def test_a_plain_swin_block_runs_on_the_layer():
    # No axis wraps, windows are shifted along both, and the bias is any table.
    layer = PolarWindowAttention(
        8, 2, map_size=(8, 8), window=(4, 4), shift=(2, 2), periodic=(False, False)
    )
    x, ring_angles = torch.randn(2, 8, 8, 8, requires_grad=True), torch.linspace(0, 1, 9)[None]
    out = layer(x, ring_angles)
    with use_reference():
        expected = layer(x, ring_angles)
    torch.testing.assert_close(out, expected)
    (grad,) = torch.autograd.grad(out[0, 0, 0].sum(), x)
    # The corner's window holds the four corners of the map; it sees only its own.
    assert grad[0, :2, :2].ne(0).any(-1).all()
    assert not grad[0, 2:].any() and not grad[0, :, 2:].any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(num_heads=5), "num_heads must divide dim = 12, got 5"),
        (dict(window=(3, 8)), r"window must divide the map \(R, A\) = \(4, 8\), got \(3, 8\)"),
        (dict(position_bias="none"), "position_bias must be"),
    ],
)
def test_window_attention_layer_errors(options, message):
    settings = dict(dim=12, num_heads=3, map_size=(4, 8), window=(2, 8)) | options
    with pytest.raises(ValueError, match=message):
        PolarWindowAttention(**settings)
