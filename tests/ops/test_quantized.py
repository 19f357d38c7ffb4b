"""What comes out as 8 bits is what the float operator gives, quantized."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from darswin.layers.quantized import Quantization, dequantize, quantize
from darswin.ops import _module, cpu_capability, use_reference, window_attention
from darswin.ops._inference import add_norm_, add_norm_quantized_, window_attention_quantized

EPS = 1e-5
SHAPES = [(1, 1), (3, 7), (2, 5, 37), (4, 16, 96), (128, 768)]
STEPS = Quantization(0.03, 117)


@pytest.fixture(params=_module.tiers())
def tier(request):
    before = cpu_capability()
    _module.set_tier(request.param)
    yield request.param
    _module.set_tier(before)


def rows(shape):
    return torch.randn(shape), torch.randn(shape), torch.randn(shape[-1]), torch.randn(shape[-1])


@pytest.mark.filterwarnings("ignore:torch.quantize_per_tensor:UserWarning")
@given(
    st.floats(1e-4, 1e3), st.integers(0, 255),
    st.lists(st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=1, max_size=40),
)  # fmt: skip
def test_quantize_is_as_torch_has_it(scale, zero_point, values):
    x = torch.tensor(values, dtype=torch.float32)
    own = quantize(x, Quantization(scale, zero_point))
    # torch's own is undefined for what is not finite or does not fit an int.
    fits = x.isfinite() & ((x / scale).abs() < 1e6)
    theirs = torch.quantize_per_tensor(x[fits], scale, zero_point, torch.quint8)
    assert torch.equal(own[fits], theirs.int_repr())
    assert torch.equal(dequantize(own[fits], Quantization(scale, zero_point)), theirs.dequantize())
    assert (own[x.isnan()] == zero_point).all()
    assert (own[x == math.inf] == 255).all() and (own[x == -math.inf] == 0).all()


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("adds", [True, False])
def test_add_norm_is_that_of_floats_quantized(shape, adds, tier):
    x, y, weight, bias = rows(shape)
    total, norm = x.clone(), y.clone() if adds else torch.zeros(shape)
    add_norm_(total, norm, weight, bias, EPS)
    kept = y.clone()
    got = add_norm_quantized_(x, y if adds else None, weight, bias, EPS, STEPS)
    assert torch.equal(x, total) and torch.equal(y, kept)
    assert torch.equal(got, quantize(norm, STEPS))


@pytest.mark.parametrize(
    ("map_size", "window", "shift", "heads", "dim"),
    [
        ((8, 12), (4, 4), (2, 2), 3, 32),
        ((4, 6), (2, 3), (1, 0), 2, 5),
        ((1, 65), (1, 65), (0, 3), 1, 8),
    ],
)  # fmt: skip
def test_attention_is_that_of_floats_quantized(map_size, window, shift, heads, dim, tier):
    qkv = torch.randn(2, *map_size, 3, heads, dim)
    bias = torch.randn(1, heads, 2 * window[0] - 1, 2 * window[1] - 1)
    scale = dim**-0.5
    out = window_attention(qkv, bias, window=window, shift=shift, periodic=(False, True))
    got = window_attention_quantized(qkv, bias, window, shift, (0, 1), scale, STEPS)
    assert got.dtype == torch.uint8
    assert torch.equal(got, quantize(out, STEPS))
    with use_reference():
        theirs = window_attention(qkv, bias, window=window, shift=shift, periodic=(False, True))
    assert (got.int() - quantize(theirs, STEPS).int()).abs().max() <= 1


def test_numbers_that_are_not_finite(tier):
    x = torch.randn(4, 40)
    x[1, 3], x[2, 0] = math.nan, math.inf
    clean = x[[0, 3]].clone()
    got = add_norm_quantized_(x, None, torch.ones(40), torch.zeros(40), EPS, STEPS)
    assert (got[[1, 2]] == STEPS.zero_point).all()
    own = add_norm_quantized_(clean, None, torch.ones(40), torch.zeros(40), EPS, STEPS)
    assert torch.equal(got[[0, 3]], own)


def test_the_ends_of_the_range(tier):
    x = torch.tensor([[-1.0, 1.0] * 20])
    for weight, lower, upper in ((1e30, 0, 255), (1e-30, 117, 117)):
        got = add_norm_quantized_(
            x.clone(), None, torch.full((40,), weight), torch.zeros(40), EPS, STEPS
        )
        assert got[0, ::2].unique() == lower and got[0, 1::2].unique() == upper


def test_same_bits_for_any_number_of_threads(threads):
    x, y, weight, bias = rows((333, 100))
    qkv, table = torch.randn(3, 8, 8, 3, 3, 16), torch.randn(3, 3, 7, 7)
    results = []
    for count in (1, 2, 5):
        threads(count)
        normed = add_norm_quantized_(x.clone(), y, weight, bias, EPS, STEPS)
        attended = window_attention_quantized(qkv, table, (4, 4), (1, 1), (1, 1), 0.25, STEPS)
        results.append(torch.cat((normed.flatten(), attended.flatten())))
    assert all(torch.equal(results[0], other) for other in results[1:])


@pytest.mark.parametrize("shape", [(0, 8), (3, 0, 8), (4, 0)], ids=str)
def test_nothing(shape):
    x, y, weight, bias = rows(shape)
    assert add_norm_quantized_(x, y, weight, bias, EPS, STEPS).shape == shape


def test_opcheck():
    torch.library.opcheck(
        torch.ops.darswin._add_norm_quantized_.default, (*rows((4, 24)), EPS, *STEPS)
    )
    torch.library.opcheck(
        torch.ops.darswin._window_attention_quantized.default,
        (
            torch.randn(2, 4, 4, 3, 2, 8),
            torch.randn(1, 2, 3, 3),
            [2, 2],
            [1, 0],
            [0, 1],
            0.3,
            *STEPS,
        ),
    )


@pytest.mark.parametrize(
    "change",
    [
        dict(x=torch.zeros(6, 4, dtype=torch.bfloat16)),
        dict(x=torch.zeros(4, 6).t()),
        dict(y=torch.zeros(5, 4)),
        dict(weight=torch.zeros(3)),
        dict(bias=torch.zeros(1, 4)),
        dict(quantization=(0.0, 0)),
        dict(quantization=(-1.0, 0)),
        dict(quantization=(math.nan, 0)),
        dict(quantization=(math.inf, 0)),
        dict(quantization=(1.0, 256)),
        dict(quantization=(1.0, -1)),
    ],
    ids=str,
)
def test_wrong_arguments(change):
    x, y, weight, bias = rows((6, 4))
    given = dict(x=x, y=y, weight=weight, bias=bias, quantization=STEPS) | change
    with pytest.raises(RuntimeError, match=r"add_norm|scale"):
        add_norm_quantized_(**given, eps=EPS)
    with pytest.raises(RuntimeError, match="qkv must be float32"):
        window_attention_quantized(
            torch.zeros(1, 2, 2, 3, 1, 4).double(), torch.zeros(1, 1, 3, 3).double(),
            (2, 2), (0, 0), (0, 1), 1.0, STEPS,
        )  # fmt: skip


def test_there_is_no_gradient():
    x, y, weight, bias = rows((6, 4))
    with pytest.raises(RuntimeError, match=r"add_norm_quantized_ has no gradient.*quantize\("):
        add_norm_quantized_(x, y, weight.requires_grad_(), bias, EPS, STEPS)
    qkv, table = torch.randn(1, 2, 2, 3, 1, 4, requires_grad=True), torch.zeros(1, 1, 3, 3)
    with pytest.raises(RuntimeError, match="window_attention_quantized has no gradient"):
        window_attention_quantized(qkv, table, (2, 2), (0, 0), (0, 1), 1.0, STEPS)
    version = x._version
    with torch.no_grad():
        add_norm_quantized_(x, y, weight, bias, EPS, STEPS)
    assert x._version == version + 1
