"""The private operators: a residual with its norm, results of 8 bits, a transpose with sums."""

import math

import pytest
import torch
import torch.nn.functional as F
from cases import assert_same_bits_on_any_number_of_threads, attention
from hypothesis import given
from hypothesis import strategies as st

from darswin.layers.quantized import Quantization, dequantize, quantize
from darswin.ops import _module, cpu_capability, use_reference
from darswin.ops._inference import (
    add_norm_,
    add_norm_quantized_,
    transpose_sum,
    window_attention_quantized,
)

EPS, STEPS = 1e-5, Quantization(0.03, 117)
# Less than a register, registers and a rest, what the models have, and enough for many threads.
SHAPES = [
    (1, 1),
    (3, 7),
    (2, 5, 37),
    (4, 16, 96),
    (8, 16, 64, 96),
    (128, 768),
    (64, 384),
    (9, 1500),
]
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=str)
EMPTY = [(0, 8), (3, 0, 8), (4, 0)]
dtypes = pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])


@pytest.fixture(params=_module.tiers())
def tier(request):
    before = cpu_capability()
    _module.set_tier(request.param)
    yield request.param
    _module.set_tier(before)


def rows(shape, dtype=torch.float32, mean=0.0):
    x, y = (torch.randn(shape).to(dtype) for _ in range(2))
    return [x + mean, y, torch.randn(shape[-1]), torch.randn(shape[-1])]


def table(map_size=(4, 6), window=(2, 3), shift=(1, 0), heads=2, dim=5):
    """The arguments of attention: qkv, bias, window, shift, periodic and scale."""
    case = attention(2, *map_size, heads, dim, window)
    return [*case.inputs.values(), window, shift, (0, 1), dim**-0.5]


# -- add_norm_ -------------------------------------------------------------------------------------


@pytest.mark.parametrize("mean", [0.0, 300.0])
@every_shape
def test_add_norm_is_as_accurate_as_torch(shape, mean, tier):
    x, y, weight, bias = rows(shape, mean=mean)
    total = x + y
    want = F.layer_norm(total.double(), shape[-1:], weight.double(), bias.double(), EPS)
    theirs = F.layer_norm(total, shape[-1:], weight, bias, EPS)
    got = add_norm_(x, y, weight, bias, EPS)
    assert got is y and torch.equal(x, total)
    own = (theirs - want).abs().max()
    floor = 4 * torch.finfo(torch.float32).eps * want.abs().max()
    large = mean > 0 and shape[-1] >= 384  # a large mean costs no digits
    assert (got - want).abs().max() <= (own if large else max(2 * own, floor))


@every_shape
def test_add_norm_rounds_bfloat16_sum_and_norm_once(shape):
    x, y, weight, bias = rows(shape, torch.bfloat16)
    total = x + y
    want = F.layer_norm(total.float(), shape[-1:], weight, bias, EPS)
    got = add_norm_(x, y, weight, bias, EPS)
    assert torch.equal(x, total)
    torch.testing.assert_close(got.float(), want, rtol=2**-8, atol=1e-5)


@dtypes
def test_add_norm_of_constant_rows_and_rows_that_are_not_finite(dtype):
    x, y, weight, bias = rows((5, 40), dtype)
    x[1], y[1] = 2.5, -1.25
    x[2, 33], y[3, 2] = math.nan, math.inf
    clean = x.clone()[4:], y.clone()[4:]
    add_norm_(x, y, weight, bias, EPS)
    torch.testing.assert_close(y[1], bias.to(dtype))
    assert y[2].isnan().all() and y[3].isnan().all()
    assert x[2].isnan().sum() == 1 and x[3, 2] == math.inf
    assert torch.equal(y[4:], add_norm_(*clean, weight, bias, EPS))


@pytest.mark.parametrize("index", range(4), ids=["x", "y", "weight", "bias"])
def test_add_norm_refuses_tensors_that_require_a_gradient(index):
    inputs = rows((4, 8))
    leaf = inputs[index].requires_grad_()
    inputs[index] = leaf * 1  # not a leaf, so that torch itself would let it change
    kept = [t.detach().clone() for t in inputs]
    for run in (torch.ops.darswin._add_norm_, add_norm_):
        with pytest.raises(RuntimeError, match="add_norm_ has no gradient"):
            run(*inputs, EPS)
    assert all(torch.equal(a, b) for a, b in zip(inputs, kept, strict=True))
    with torch.no_grad():
        add_norm_(*inputs, EPS)


def test_autograd_notices_the_change():
    x, y, weight, bias = rows((4, 8))
    product = torch.randn(4, 8, requires_grad=True) * x  # keeps x for its gradient
    versions = x._version, y._version
    add_norm_(x, y, weight, bias, EPS)
    assert (x._version, y._version) == (versions[0] + 1, versions[1] + 1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        product.sum().backward()
    add_norm_quantized_(x, y, weight, bias, EPS, STEPS)
    assert (x._version, y._version) == (versions[0] + 2, versions[1] + 1)
    with torch.inference_mode():
        add_norm_(*rows((4, 8)), EPS)  # tensors without a version


def test_memory_is_not_shared():
    x, y, weight, bias = rows((4, 8))
    whole = torch.randn(7, 8)
    for arguments in (
        (x, x, weight, bias), (whole[:4], whole[3:], weight, bias),
        (x, y, x[0], bias), (x, y, weight, y[3]),
    ):  # fmt: skip
        with pytest.raises(RuntimeError, match="share no memory"):
            add_norm_(*arguments, EPS)
    add_norm_(whole[:3], whole[3:6], whole[6], bias, EPS)  # neighbours


# -- 8 bits ----------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:torch.quantize_per_tensor:UserWarning")
@given(
    st.floats(1e-4, 1e3), st.integers(0, 255),
    st.lists(st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=1, max_size=40),
)  # fmt: skip
def test_quantize_is_that_of_torch(scale, zero_point, values):
    x = torch.tensor(values, dtype=torch.float32)
    own = quantize(x, Quantization(scale, zero_point))
    # torch's own is undefined for what is not finite or does not fit an int.
    fits = x.isfinite() & ((x / scale).abs() < 1e6)
    theirs = torch.quantize_per_tensor(x[fits], scale, zero_point, torch.quint8)
    assert torch.equal(own[fits], theirs.int_repr())
    assert torch.equal(dequantize(own[fits], Quantization(scale, zero_point)), theirs.dequantize())
    assert (own[x.isnan()] == zero_point).all()
    assert (own[x == math.inf] == 255).all() and (own[x == -math.inf] == 0).all()


@every_shape
@pytest.mark.parametrize("adds", [True, False])
def test_add_norm_quantized_is_that_of_floats(shape, adds, tier):
    x, y, weight, bias = rows(shape)
    total, norm = x.clone(), y.clone() if adds else torch.zeros(shape)
    add_norm_(total, norm, weight, bias, EPS)
    kept = y.clone()
    got = add_norm_quantized_(x, y if adds else None, weight, bias, EPS, STEPS)
    assert torch.equal(x, total) and torch.equal(y, kept)
    assert torch.equal(got, quantize(norm, STEPS))


@pytest.mark.parametrize(
    "sizes",
    [((8, 12), (4, 4), (2, 2), 3, 32), ((4, 6), (2, 3), (1, 0), 2, 5), ((1, 65), (1, 65), (0, 3))],
)
def test_attention_quantized_is_that_of_floats(sizes, tier):
    arguments = table(*sizes)
    out = torch.ops.darswin.window_attention(*arguments)
    got = window_attention_quantized(*arguments, STEPS)
    assert got.dtype == torch.uint8 and torch.equal(got, quantize(out, STEPS))


def test_numbers_that_are_not_finite_are_the_zero_point(tier):
    x = torch.randn(4, 40)
    x[1, 3], x[2, 0] = math.nan, math.inf
    plain = torch.ones(40), torch.zeros(40), EPS, STEPS
    own = add_norm_quantized_(x[[0, 3]].clone(), None, *plain)
    got = add_norm_quantized_(x, None, *plain)
    assert (got[[1, 2]] == STEPS.zero_point).all() and torch.equal(got[[0, 3]], own)


def test_the_ends_of_the_range(tier):
    x = torch.tensor([[-1.0, 1.0] * 20])
    for weight, lower, upper in ((1e30, 0, 255), (1e-30, 117, 117)):
        scaled = torch.full((40,), weight)
        got = add_norm_quantized_(x.clone(), None, scaled, torch.zeros(40), EPS, STEPS)
        assert got[0, ::2].unique() == lower and got[0, 1::2].unique() == upper


# -- transpose_sum ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "shape",
    [(1, 1), (3, 7), (16, 16), (37, 5), (5, 37), (67, 100), (200, 48), (1024, 96), (128, 768),
     (131_072, 5), (1_000_000, 5)],
    ids=str,
)  # fmt: skip
def test_transpose_and_sums(shape):
    x = torch.randn(shape) + 1
    transposed, sums = transpose_sum(x)
    assert torch.equal(transposed, x.t()) and transposed.is_contiguous()
    exact, own = x.double().sum(0), x.sum(0)
    rounding = torch.finfo(torch.float32).eps * x.abs().sum(0).max()
    rounding *= 4 if len(x) < 10**5 else 1
    assert (sums - exact).abs().max() <= max(2 * (own - exact).abs().max(), rounding)


def test_values_that_are_not_finite_stay_in_their_columns():
    x = torch.ones(70, 40)
    x[3, 2], x[69, 39], x[68, 20] = math.nan, math.nan, math.inf
    transposed, sums = transpose_sum(x)
    torch.testing.assert_close(transposed, x.t(), rtol=0, atol=0, equal_nan=True)
    assert sums.isnan().nonzero().flatten().tolist() == [2, 39]
    assert sums[20] == math.inf and (sums == 70).sum() == 37


def test_the_gradient_of_transpose_sum_is_that_of_torch():
    x, grads = torch.randn(20, 7), (torch.randn(7, 20), torch.randn(7))
    results = []
    for run in (transpose_sum, lambda x: (x.t(), x.sum(0))):
        leaf = x.clone().requires_grad_()
        results.append(torch.autograd.grad(run(leaf), leaf, grads)[0])
    torch.testing.assert_close(*results)


# -- all of them -----------------------------------------------------------------------------------


def test_same_bits_for_any_number_of_threads():
    narrow, wide = rows((333, 100), torch.bfloat16), rows((333, 100))
    arguments, x = table((8, 8), (4, 4), (1, 1), 3, 16), torch.randn(1000, 100)

    def run():
        results = [
            *(add_norm_(x.clone(), y.clone(), *layer, EPS) for x, y, *layer in (narrow, wide)),
            add_norm_quantized_(wide[0].clone(), *wide[1:], EPS, STEPS),
            window_attention_quantized(*arguments, STEPS), *transpose_sum(x),
        ]  # fmt: skip
        return dict(enumerate(results))

    assert_same_bits_on_any_number_of_threads(run, (1, 2, 5))


def test_nothing():
    for shape in EMPTY:
        assert add_norm_(*rows(shape), EPS).shape == shape
        assert add_norm_quantized_(*rows(shape), EPS, STEPS).shape == shape
    for shape in ((0, 8), (8, 0), (0, 0)):
        transposed, sums = transpose_sum(torch.zeros(shape))
        assert transposed.shape == shape[::-1] and torch.equal(sums, torch.zeros(shape[1]))


def test_opcheck():
    ops = torch.ops.darswin
    for operator, arguments in (
        (ops._add_norm_, (*rows((4, 24)), EPS)),
        (ops._add_norm_quantized_, (*rows((4, 24)), EPS, *STEPS)),
        (ops._window_attention_quantized, (*table(), *STEPS)),
        (ops._transpose_sum, (torch.randn(20, 24),)),
    ):
        torch.library.opcheck(operator.default, arguments)


WRONG = [
    dict(x=torch.zeros(6, 4, dtype=torch.float64)), dict(x=torch.zeros(4, 6).t()),
    dict(y=torch.zeros(6, 4, dtype=torch.bfloat16)), dict(y=torch.zeros(5, 4)),
    dict(y=torch.zeros(4, 6)), dict(y=torch.zeros(6, 8)[:, ::2]), dict(weight=torch.zeros(3)),
    dict(bias=torch.zeros(4, dtype=torch.bfloat16)), dict(bias=torch.zeros(1, 4)),
]  # fmt: skip
WRONG_STEPS = [(0.0, 0), (-1.0, 0), (math.nan, 0), (math.inf, 0), (1.0, 256), (1.0, -1)]


@pytest.mark.parametrize("change", WRONG, ids=lambda change: "-".join(change))
def test_wrong_rows(change):
    given = dict(zip(("x", "y", "weight", "bias"), rows((6, 4)), strict=True)) | change
    for run, more in ((add_norm_, {}), (add_norm_quantized_, dict(quantization=STEPS))):
        with pytest.raises(RuntimeError, match="add_norm"):
            run(**given, eps=EPS, **more)


def test_other_wrong_arguments():
    for steps in WRONG_STEPS:
        with pytest.raises(RuntimeError, match="scale"):
            add_norm_quantized_(*rows((6, 4)), EPS, steps)
    narrow = rows((6, 4), torch.bfloat16)
    with pytest.raises(RuntimeError, match="add_norm"):
        add_norm_quantized_(*narrow, EPS, STEPS)
    qkv, bias, *others = table()
    with pytest.raises(RuntimeError, match="qkv must be float32"):
        window_attention_quantized(qkv.double(), bias.double(), *others, STEPS)
    for x in (torch.zeros(4, 6).t(), torch.zeros(4, 6).double(), torch.zeros(2, 4, 6),
              torch.zeros(4)):  # fmt: skip
        with pytest.raises(RuntimeError, match="transpose_sum"):
            transpose_sum(x)


def test_8_bits_have_no_gradient():
    x, y, weight, bias = rows((6, 4))
    with pytest.raises(RuntimeError, match=r"add_norm_quantized_ has no gradient.*quantize\("):
        add_norm_quantized_(x, y, weight.requires_grad_(), bias, EPS, STEPS)
    qkv, *others = table()
    with pytest.raises(RuntimeError, match="window_attention_quantized has no gradient"):
        window_attention_quantized(qkv.requires_grad_(), *others, STEPS)


def test_attention_quantized_is_within_a_step_of_the_reference():
    case = attention(2, 8, 12, 3, 32, (4, 4), shift=(2, 2))
    with use_reference():
        expected = quantize(case.run(**case.inputs), STEPS)
    got = window_attention_quantized(*case.inputs.values(), (4, 4), (2, 2), (0, 1), 32**-0.5, STEPS)
    assert (got.int() - expected.int()).abs().max() <= 1
