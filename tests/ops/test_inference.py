"""The private operator of residual and norm, and numbers of 8 bits."""

import math

import pytest
import torch
import torch.nn.functional as F
from cases import add_norm_
from hypothesis import given
from hypothesis import strategies as st

from darswin.layers.quantized import Quantization, dequantize, quantize

EPS = 1e-5
# Less than a register, registers and a remainder, the models' sizes, and enough for many threads.
SHAPES = [(1, 1), (3, 7), (2, 5, 37), (4, 16, 96), (8, 16, 64, 96), (128, 768), (64, 384),
          (9, 1500), (0, 8), (4, 0)]  # fmt: skip
every_shape = pytest.mark.parametrize("shape", SHAPES, ids=str)


def rows(shape, dtype=torch.float32, mean=0.0):
    x, y = (torch.randn(shape).to(dtype) for _ in range(2))
    return [x + mean, y, torch.randn(shape[-1]), torch.randn(shape[-1])]


# -- add_norm_ -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dtype", "mean"), [(torch.float32, 0.0), (torch.float32, 300.0), (torch.bfloat16, 0.0)]
)
@every_shape
def test_add_norm_is_as_accurate_as_torch(shape, dtype, mean):
    x, y, weight, bias = rows(shape, dtype, mean)
    total = x + y
    got = add_norm_(x, y, weight, bias)
    assert got is y and torch.equal(x, total)
    if x.numel() == 0:
        return
    own = F.layer_norm(total.float(), shape[-1:], weight, bias, EPS)
    if dtype == torch.bfloat16:  # rounded once
        torch.testing.assert_close(got.float(), own, rtol=2**-8, atol=1e-5)
        return
    want = F.layer_norm(total.double(), shape[-1:], weight.double(), bias.double(), EPS)
    error = (own - want).abs().max()
    floor = 4 * torch.finfo(torch.float32).eps * want.abs().max()
    large = mean > 0 and shape[-1] >= 384  # unlike torch, add_norm_ loses no digits to a large mean
    assert (got - want).abs().max() <= (error if large else max(2 * error, floor))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_add_norm_of_constant_rows_and_rows_that_are_not_finite(dtype):
    x, y, weight, bias = rows((5, 40), dtype)
    x[1], y[1] = 2.5, -1.25
    x[2, 33], y[3, 2] = math.nan, math.inf
    clean = x.clone()[4:], y.clone()[4:]
    add_norm_(x, y, weight, bias)
    torch.testing.assert_close(y[1], bias.to(dtype))
    assert y[2].isnan().all() and y[3].isnan().all()
    assert x[2].isnan().sum() == 1 and x[3, 2] == math.inf
    assert torch.equal(y[4:], add_norm_(*clean, weight, bias))


def test_memory_is_not_shared():
    x, y, weight, bias = rows((4, 8))
    whole = torch.randn(7, 8)
    for arguments in (
        (x, x, weight, bias), (whole[:4], whole[3:], weight, bias),
        (x, y, x[0], bias), (x, y, weight, y[3]),
    ):  # fmt: skip
        with pytest.raises(RuntimeError, match="share no memory"):
            add_norm_(*arguments)
    add_norm_(whole[:3], whole[3:6], whole[6], bias)  # neighbours


# -- 8 bits ----------------------------------------------------------------------------------------


@given(
    st.floats(1e-4, 1e3), st.integers(0, 255),
    st.lists(st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=1, max_size=40),
)  # fmt: skip
def test_quantize_takes_the_nearest_step(scale, zero_point, values):
    x = torch.tensor(values, dtype=torch.float32)
    own = quantize(x, Quantization(scale, zero_point))
    exact = (x.double() / scale + zero_point).clamp(0, 255)
    assert ((own - exact).abs() < 0.5001)[~x.isnan()].all()  # 1e-4 for roundings of numbers to 255
    back = dequantize(own, Quantization(scale, zero_point)).double()
    torch.testing.assert_close(back, (own.double() - zero_point) * scale, rtol=2e-7, atol=0)
    ties = torch.tensor([-1.5, -0.5, 0.5, 1.5, 2.5])  # to even
    assert quantize(ties, Quantization(1.0, 10)).tolist() == [8, 10, 10, 12, 12]
    assert (own[x.isnan()] == zero_point).all()
    assert (own[x == math.inf] == 255).all() and (own[x == -math.inf] == 0).all()


WRONG = [
    dict(x=torch.zeros(6, 4, dtype=torch.float64)), dict(x=torch.zeros(4, 6).t()),
    dict(y=torch.zeros(6, 4, dtype=torch.bfloat16)), dict(y=torch.zeros(5, 4)),
    dict(y=torch.zeros(4, 6)), dict(y=torch.zeros(6, 8)[:, ::2]), dict(weight=torch.zeros(3)),
    dict(bias=torch.zeros(4, dtype=torch.bfloat16)), dict(bias=torch.zeros(1, 4)),
]  # fmt: skip


@pytest.mark.parametrize("change", WRONG, ids=lambda change: "-".join(change))
def test_wrong_rows(change):
    given = dict(zip(("x", "y", "weight", "bias"), rows((6, 4)), strict=True)) | change
    with pytest.raises(RuntimeError, match="add_norm"):
        add_norm_(*given.values(), EPS)
