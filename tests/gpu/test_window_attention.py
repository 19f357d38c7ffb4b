"""window_attention's kernels: the accuracy rule, the same bits from run to run, sizes that are no
power of two. A program takes 20 ms in the interpreter, so maps are small."""

import math

import pytest
import torch
from helpers import assert_accurate, with_gradients

from darswin.ops import triton, use_reference, window_attention

# (R, A), heads, head dim, images of the bias; window, shift, periodic
CASES = {
    "DarSwin-A, stage 1": ((2, 48), 1, 32, 1, (1, 16), (0, 4), (False, True)),
    "DarSwin-A, stage 2, a seam": ((2, 32), 1, 32, 1, (1, 16), (0, 4), (False, False)),
    "DarSwin-A, stage 3": ((8, 4), 1, 32, 2, (4, 4), (2, 0), (False, True)),
    "DarSwin-A, stage 4": ((16, 1), 2, 32, 2, (16, 1), (4, 0), (False, True)),
    "DarSwin-RA": ((8, 8), 1, 32, 1, (4, 4), (2, 2), (False, True)),
    "DarSwin-RA, stage 4": ((2, 8), 2, 32, 1, (2, 8), (0, 0), (False, True)),
    "Swin, 7×7": ((14, 14), 1, 32, 1, (7, 7), (3, 3), (False, False)),
    "Swin, 8×8": ((8, 16), 1, 32, 1, (8, 8), (4, 4), (False, False)),
    "both axes periodic": ((4, 8), 1, 5, 1, (2, 4), (3, 7), (True, True)),
    "radius periodic": ((4, 8), 1, 5, 1, (2, 4), (1, 3), (True, False)),
    "head dim 1": ((4, 4), 3, 1, 1, (4, 2), (0, 0), (False, True)),
    "head dim 33": ((4, 8), 1, 33, 1, (2, 4), (1, 1), (False, True)),
    "odd windows": ((3, 14), 2, 5, 2, (3, 7), (2, 5), (False, True)),
    "one token a window": ((2, 3), 2, 5, 1, (1, 1), (1, 1), (False, True)),
    "one token": ((1, 1), 1, 5, 1, (1, 1), (0, 0), (False, True)),
    "empty batch": ((4, 8), 2, 5, 1, (2, 4), (0, 0), (False, True)),
    "no heads": ((4, 8), 0, 5, 1, (2, 4), (0, 0), (False, True)),
}


def attention(case):
    *_, window, shift, periodic = CASES[case]
    return lambda qkv, bias: window_attention(
        qkv, bias, window=window, shift=shift, periodic=periodic
    )


def make_inputs(case):
    (rings, sectors), heads, head_dim, images, window, *_ = CASES[case]
    batch = 0 if case == "empty batch" else 2
    qkv = torch.randn(batch, rings, sectors, 3, heads, head_dim)
    return qkv, torch.randn(images, heads, 2 * window[0] - 1, 2 * window[1] - 1)


@pytest.mark.parametrize("case", CASES)
def test_accuracy_rule(case, on):
    assert_accurate(on(attention(case)), lambda: make_inputs(case), draws=1)


@pytest.mark.parametrize("size", [1e-20, 30.0], ids=["flat softmax", "sharp softmax"])
def test_accuracy_rule_at_extreme_values(size, on):
    def make():
        qkv, bias = make_inputs("DarSwin-A, stage 3")
        if size > 1:
            # Pairs of keys between which a query's logits differ by about 1. Else almost every
            # probability is exactly 0 or 1, and the largest error is that of the few queries whose
            # two largest logits happen to be close: it depends on the draw and on the CPU.
            keys = qkv[:, ::2, :, 1]
            qkv[:, 1::2, :, 1] = keys + torch.randn_like(keys) / size**2
        return qkv * size, bias

    assert_accurate(on(attention("DarSwin-A, stage 3")), make)


@pytest.fixture
def few_programs(monkeypatch, device):
    """A program gets several windows, here three of four, as in large batches."""
    kernels = triton.launcher("window_attention").__globals__
    monkeypatch.setitem(kernels, "PROGRAMS", 2)


@pytest.mark.parametrize("images", [1, 2])
def test_several_windows_a_program(images, on, few_programs):
    run = on(lambda qkv, bias: window_attention(qkv, bias, window=(1, 3), shift=(0, 1)))
    assert_accurate(
        run, lambda: (torch.randn(2, 2, 6, 3, 1, 4), torch.randn(images, 1, 1, 5)), draws=1
    )


@pytest.mark.parametrize("case", ["DarSwin-A, stage 1", "DarSwin-A, stage 3", "odd windows"])
def test_two_runs_give_the_same_bits(case, on):
    inputs, run = make_inputs(case), on(attention(case))
    for one, two in zip(with_gradients(run, inputs), with_gradients(run, inputs), strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("case", ["DarSwin-A, stage 1", "odd windows", "head dim 33"])
def test_types_of_16_bits_are_float32_rounded_once(case, dtype, device):
    qkv, bias = make_inputs(case)
    qkv, (*_, window, shift, periodic) = qkv.to(dtype), CASES[case]
    settings = (window, shift, [int(wraps) for wraps in periodic], 0.3)
    # The operators themselves: the public function takes float16 on CUDA devices alone.
    operators = torch.ops.darswin
    out = operators.window_attention(qkv.to(device), bias.to(device), *settings)
    grad = torch.randn(out.shape).to(dtype)
    grads = operators.window_attention_backward(
        qkv.to(device), bias.to(device), *settings, grad.to(device)
    )
    leaves = [qkv.double().requires_grad_(), bias.double().requires_grad_()]
    with use_reference():
        exact = window_attention(
            *leaves, window=window, shift=shift, periodic=periodic, scale=settings[-1]
        )
    expected = [exact.detach(), *torch.autograd.grad(exact, leaves, grad.double())]
    ours = [t.cpu() for t in (out, *grads)]
    assert [t.dtype for t in ours] == [dtype, dtype, torch.float32]
    # The interpreter cuts bfloat16 off where a GPU rounds it.
    cut = dtype == torch.bfloat16 and device.type == "cpu"
    for got, want in zip(ours, expected, strict=True):
        narrow = got.dtype == dtype
        rounding = torch.finfo(dtype).eps / (1 if cut else 2) if narrow else 2**-15
        torch.testing.assert_close(got.double(), want, rtol=1.1 * rounding, atol=1e-4)
        if narrow and not cut:
            assert (got == want.to(dtype)).float().mean() > 0.95


def test_strided_inputs_and_expanded_gradients(on):
    qkv, bias = make_inputs("DarSwin-A, stage 3")
    run = on(attention("DarSwin-A, stage 3"))
    expected = run(qkv, bias)
    strided = torch.stack((qkv, qkv), -1)[..., 0]
    assert not strided.is_contiguous()
    assert torch.equal(run(strided, bias), expected)
    assert torch.equal(run(qkv, bias[:1].expand(2, -1, -1, -1)), run(qkv, bias[:1]))
    leaf = qkv.requires_grad_()
    (from_sum,) = torch.autograd.grad(run(leaf, bias).sum(), leaf)  # stride 0 comes back
    (from_ones,) = torch.autograd.grad(run(leaf, bias), leaf, torch.ones_like(expected))
    assert torch.equal(from_sum, from_ones)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("window", [(2, 4), (3, 7)], ids=["8 tokens", "21 tokens"])
def test_a_bad_token_spoils_only_its_window(bad, window, on):
    rings, sectors = window[0], 2 * window[1]
    qkv = torch.randn(1, rings, sectors, 3, 1, 4)
    bias = torch.randn(1, 1, 2 * window[0] - 1, 2 * window[1] - 1)
    qkv[0, 0, 0] = bad
    run = on(lambda qkv, bias: window_attention(qkv, bias, window=window))
    out, grad, _ = with_gradients(run, (qkv, bias))
    spoiled, rest = out[:, :, : window[1]], out[:, :, window[1] :]
    assert rest.isfinite().all() and not spoiled.isfinite().any()
    assert grad[:, :, window[1] :].isfinite().all()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_query_and_key_spoil_nothing_beyond_the_seam(bad, on):
    qkv, bias = torch.randn(1, 4, 4, 3, 1, 4), torch.randn(1, 1, 3, 7)
    qkv[0, 0, 1, :2] = bad  # in the window of the rings 3 and 0, which do not see each other
    run = on(lambda qkv, bias: window_attention(qkv, bias, window=(2, 4), shift=(1, 0)))
    out = run(qkv, bias)
    assert out[0, 1:].isfinite().all() and not out[0, 0].isfinite().all()


def test_minus_infinity_in_the_bias_hides_a_pair(on):
    qkv, bias = torch.randn(1, 1, 2, 3, 1, 4), torch.randn(1, 1, 1, 3)
    bias[..., 0] = -math.inf  # Δφ = -1: token 0 does not see token 1
    run = on(lambda qkv, bias: window_attention(qkv, bias, window=(1, 2)))
    torch.testing.assert_close(run(qkv, bias)[0, 0, 0], qkv[0, 0, 0, 2, 0])
    bias[:] = -math.inf
    assert run(qkv, bias).isnan().all()
