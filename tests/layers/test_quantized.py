"""Numbers of 8 bits."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st

from darswin.layers.quantized import Quantization, dequantize, quantize


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
