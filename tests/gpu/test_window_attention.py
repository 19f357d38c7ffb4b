"""window_attention's kernels: the accuracy rule, the same bits from run to run, sizes that are no
power of two. A program takes 20 ms in the interpreter, so maps are small."""

import pytest
import torch
from helpers import assert_accurate

from darswin.ops import window_attention

# (R, A), heads, head dim, images of the bias; window, shift, periodic
CASES = {
    "DarSwin-A, stage 1": ((2, 48), 1, 32, 1, (1, 16), (0, 4), (False, True)),
    "DarSwin-A, stage 3": ((8, 4), 1, 32, 2, (4, 4), (2, 0), (False, True)),
}


def attention(case):
    _, _, _, _, window, shift, periodic = CASES[case]
    return lambda qkv, bias: window_attention(
        qkv, bias, window=window, shift=shift, periodic=periodic
    )


def make_inputs(case, batch=2):
    (rings, sectors), heads, head_dim, images, window, *_ = CASES[case]
    qkv = torch.randn(batch, rings, sectors, 3, heads, head_dim)
    return qkv, torch.randn(images, heads, 2 * window[0] - 1, 2 * window[1] - 1)


@pytest.mark.parametrize("case", CASES)
def test_accuracy_rule(case, on):
    assert_accurate(on(attention(case)), lambda: make_inputs(case), draws=1)
