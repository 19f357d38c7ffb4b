import math

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_accurate, assert_equals_reference, with_gradients

from darswin.ops import use_reference, window_attention


def make_inputs(
    batch=2,
    rings=4,
    sectors=8,
    heads=2,
    head_dim=5,
    window=(2, 4),
    bias_rows=1,
    dtype=torch.float32,
):
    qkv = torch.randn(batch, rings, sectors, 3, heads, head_dim, dtype=dtype)
    bias = torch.randn(bias_rows, heads, 2 * window[0] - 1, 2 * window[1] - 1, dtype=dtype)
    return qkv, bias


def attention(**options):
    """window_attention as a function of its differentiable inputs."""
    return lambda qkv, bias: window_attention(qkv, bias, **options)


CASES = {
    "DarSwin-A stage 1": (
        dict(rings=3, sectors=64, head_dim=32, window=(1, 16)),
        dict(window=(1, 16), shift=(0, 4)),
    ),
    "DarSwin-A stage 2": (
        dict(rings=3, sectors=16, head_dim=32, window=(1, 16)),
        dict(window=(1, 16), shift=(0, 4), periodic=(False, False)),
    ),
    "DarSwin-A stage 3": (
        dict(rings=16, sectors=4, window=(4, 4), bias_rows=2),
        dict(window=(4, 4), shift=(2, 0)),
    ),
    "DarSwin-A stage 4": (
        dict(rings=16, sectors=1, window=(16, 1), bias_rows=2),
        dict(window=(16, 1), shift=(4, 0)),
    ),
    "DarSwin-RA": (
        dict(rings=8, sectors=32, window=(4, 4)),
        dict(window=(4, 4), shift=(2, 2)),
    ),
    "Swin": (
        dict(rings=8, sectors=8, window=(4, 4)),
        dict(window=(4, 4), shift=(2, 2), periodic=(False, False)),
    ),
    "both axes periodic": (
        dict(window=(2, 4)),
        dict(window=(2, 4), shift=(3, 7), periodic=(True, True)),
    ),
    "radius periodic": (
        dict(window=(2, 4)),
        dict(window=(2, 4), shift=(1, 3), periodic=(True, False)),
    ),
    "head dim 1": (dict(head_dim=1, heads=3, window=(4, 2)), dict(window=(4, 2), scale=0.7)),
    "head dim 33": (dict(head_dim=33, window=(2, 4)), dict(window=(2, 4), shift=(1, 1))),
    "odd windows": (
        dict(rings=9, sectors=35, window=(3, 7), bias_rows=2),
        dict(window=(3, 7), shift=(2, 5)),
    ),
    "one token a window": (dict(window=(1, 1)), dict(window=(1, 1), shift=(1, 1))),
    "one token": (dict(rings=1, sectors=1, window=(1, 1)), dict(window=(1, 1))),
    "one window of 1024": (
        dict(batch=1, rings=16, sectors=64, heads=1, window=(16, 64)),
        dict(window=(16, 64), shift=(3, 0)),
    ),
    "windows without tables of pairs": (
        dict(rings=16, sectors=18, head_dim=24, window=(8, 9), bias_rows=2),
        dict(window=(8, 9), shift=(3, 4), periodic=(False, False)),
    ),
    "several chunks of windows": (
        dict(batch=3, rings=16, sectors=32, heads=3, head_dim=8, window=(2, 4)),
        dict(window=(2, 4), shift=(1, 2)),
    ),
    "empty batch": (dict(batch=0), dict(window=(2, 4))),
    "no heads": (dict(heads=0), dict(window=(2, 4))),
}


@pytest.mark.parametrize("case", CASES)
def test_equals_reference_in_float64(case):
    sizes, options = CASES[case]
    inputs = make_inputs(**sizes, dtype=torch.float64)
    assert_equals_reference(attention(**options), inputs, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("case", CASES)
def test_accuracy_rule(case):
    sizes, options = CASES[case]
    assert_accurate(attention(**options), lambda: make_inputs(**sizes))


@pytest.mark.parametrize("size", [1e-20, 30.0], ids=["flat softmax", "sharp softmax"])
def test_accuracy_rule_at_extreme_values(size):
    sizes = dict(rings=4, sectors=16, head_dim=16, window=(4, 4))

    def make():
        qkv, bias = make_inputs(**sizes)
        return qkv * size, bias

    assert_accurate(attention(window=(4, 4), shift=(2, 1)), make)


def test_equals_a_loop_over_tokens():
    # The definition, token by token: nothing here is shared with the operators.
    (rings, sectors), window, shift, periodic = (4, 6), (2, 3), (1, 2), (False, True)
    qkv, bias = make_inputs(1, rings, sectors, 1, 4, window, dtype=torch.float64)
    q, k, v = qkv[0, :, :, :, 0].unbind(2)
    expected = torch.zeros(rings, sectors, 4, dtype=torch.float64)

    def place(r, a):
        """Window, position in it, and whether the roll carried the token over the inner border."""
        rolled_r, rolled_a = (r - shift[0]) % rings, (a - shift[1]) % sectors
        at = (rolled_r // window[0], rolled_a // window[1])
        return at, (rolled_r % window[0], rolled_a % window[1]), r < shift[0]

    tokens = [(r, a) for r in range(rings) for a in range(sectors)]
    for r, a in tokens:
        mine, (qr, qa), carried = place(r, a)
        logits, values = [], []
        for kr, ka in tokens:
            at, (pr, pa), other = place(kr, ka)
            if at == mine and other == carried:
                logit = q[r, a] @ k[kr, ka] * 4**-0.5
                logits.append(logit + bias[0, 0, qr - pr + window[0] - 1, qa - pa + window[1] - 1])
                values.append(v[kr, ka])
        expected[r, a] = torch.stack(logits).softmax(0) @ torch.stack(values)
    for reference in (False, True):
        with use_reference(reference):
            got = window_attention(qkv, bias, window=window, shift=shift, periodic=periodic)
        torch.testing.assert_close(got[0], expected)


def test_one_window_equals_scaled_dot_product_attention():
    qkv, _ = make_inputs(2, 4, 6, 3, 8, (4, 6))
    zero = torch.zeros(1, 3, 7, 11)
    q, k, v = qkv.flatten(1, 2).permute(2, 0, 3, 1, 4)
    expected = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(2, 4, 6, 24)
    torch.testing.assert_close(window_attention(qkv, zero, window=(4, 6)), expected)


@pytest.mark.parametrize("shift", [(0, 0), (1, 2)])
def test_turning_the_map_by_a_window_turns_the_result(shift):
    qkv, bias = make_inputs(2, 4, 12, 2, 8, (2, 4))
    options = dict(window=(2, 4), shift=shift)
    turned = window_attention(qkv.roll(4, 2), bias, **options)
    torch.testing.assert_close(turned, window_attention(qkv, bias, **options).roll(4, 2))
    # With a seam it would not.
    options["periodic"] = (False, False)
    seam = window_attention(qkv.roll(4, 2), bias, **options)
    same = torch.allclose(seam, window_attention(qkv, bias, **options).roll(4, 2))
    assert same == (shift == (0, 0))


def test_the_inner_and_the_outer_ring_do_not_see_each_other():
    qkv, bias = make_inputs(1, 4, 4, 1, 4, (2, 4))
    out = window_attention(qkv, bias, window=(2, 4), shift=(1, 0))
    changed = qkv.clone()
    changed[:, 3] += 1
    after = window_attention(changed, bias, window=(2, 4), shift=(1, 0))
    assert torch.equal(out[:, :3], after[:, :3]) and not torch.equal(out[:, 3], after[:, 3])


def test_bias_of_each_image():
    qkv, bias = make_inputs(3, bias_rows=3)
    together = window_attention(qkv, bias, window=(2, 4))
    alone = [window_attention(qkv[b : b + 1], bias[b : b + 1], window=(2, 4)) for b in range(3)]
    assert torch.equal(together, torch.cat(alone))


@pytest.mark.parametrize("bias_rows", [1, 2])
@pytest.mark.parametrize("periodic", [(False, True), (False, False)])
def test_gradcheck(bias_rows, periodic):
    inputs = make_inputs(2, 4, 4, 2, 3, (2, 4), bias_rows, torch.float64)
    run = attention(window=(2, 4), shift=(1, 2), periodic=periodic)
    assert torch.autograd.gradcheck(run, [t.requires_grad_() for t in inputs])


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("requires_grad", [False, True])
def test_opcheck(requires_grad, dtype):
    qkv, bias = make_inputs()
    qkv, bias = qkv.to(dtype).requires_grad_(requires_grad), bias.requires_grad_(requires_grad)
    torch.library.opcheck(
        torch.ops.darswin.window_attention.default,
        (qkv, bias, (2, 4), (1, 2), (False, True), 0.5),
    )


def test_opcheck_backward():
    qkv, bias = make_inputs()
    settings = ((2, 4), (1, 2), (False, True), 0.5)
    out = torch.ops.darswin.window_attention(qkv, bias, *settings)
    torch.library.opcheck(
        torch.ops.darswin.window_attention_backward.default,
        (qkv, bias, *settings, torch.randn_like(out)),
        test_utils=("test_schema", "test_faketensor"),
    )


def test_no_second_derivative():
    qkv, bias = make_inputs()
    out = window_attention(qkv.requires_grad_(), bias, window=(2, 4))
    (grad,) = torch.autograd.grad(out.square().sum(), qkv, create_graph=True)
    with pytest.raises(NotImplementedError, match="no second derivative"):
        grad.sum().backward()


@pytest.mark.unsanitized
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_compile_fullgraph(backend):
    inputs = make_inputs()

    def run(qkv, bias):
        return window_attention(qkv + 1, bias, window=(2, 4), shift=(1, 2)) * 2

    compiled = torch.compile(run, fullgraph=True, backend=backend)
    for got, want in zip(
        with_gradients(compiled, inputs), with_gradients(run, inputs), strict=True
    ):
        torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-6)


@pytest.mark.unsanitized
def test_export():
    class Module(torch.nn.Module):
        def forward(self, qkv, bias):
            return window_attention(qkv, bias, window=(2, 4), shift=(1, 2))

    inputs = make_inputs()
    batch = torch.export.Dim("batch", min=1)
    program = torch.export.export(Module(), inputs, dynamic_shapes=({0: batch}, None))
    other = make_inputs(batch=5)
    assert torch.equal(program.module()(*other), Module()(*other))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("bias_rows", [1, 3])
def test_same_bits_for_any_number_of_threads(threads, dtype, bias_rows):
    inputs = make_inputs(3, 8, 16, 3, 16, (4, 4), bias_rows, dtype)
    results = []
    for count in (1, 2, 3):
        threads(count)
        results.append(with_gradients(attention(window=(4, 4), shift=(2, 1)), inputs))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_strided_inputs_and_expanded_gradients():
    qkv, bias = make_inputs(bias_rows=2)
    run = attention(window=(2, 4), shift=(1, 2))
    expected = run(qkv, bias)
    strided = torch.stack((qkv, qkv), -1)[..., 0]
    expanded = bias[:1].expand(2, -1, -1, -1)
    assert not strided.is_contiguous() and not expanded.is_contiguous()
    assert torch.equal(run(strided, bias), expected)
    assert torch.equal(run(qkv, expanded), run(qkv, bias[:1]))
    leaf = qkv.clone().requires_grad_()
    (from_sum,) = torch.autograd.grad(run(leaf, bias).sum(), leaf)  # stride 0 comes back
    (from_ones,) = torch.autograd.grad(run(leaf, bias), leaf, torch.ones_like(expected))
    assert torch.equal(from_sum, from_ones)
    turned = torch.randn(24, 8, 10)[:8, :, :].permute(1, 0, 2)[None, :4, :, :].expand(2, -1, -1, -1)
    (grad,) = torch.autograd.grad(run(leaf, bias), leaf, turned)
    (same,) = torch.autograd.grad(run(leaf, bias), leaf, turned.contiguous())
    assert torch.equal(grad, same)


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_token_spoils_only_its_window(bad, reference):
    qkv, bias = make_inputs(1, 2, 8, 1, 4, (2, 4))
    qkv[0, 0, 0] = bad
    with use_reference(reference):
        out, grad, _ = with_gradients(attention(window=(2, 4)), (qkv, bias))
    assert out[0, :, 4:].isfinite().all() and not out[0, :, :4].isfinite().all()
    assert grad[0, :, 4:].isfinite().all()


@pytest.mark.parametrize("reference", [False, True])
def test_minus_infinity_in_the_bias_hides_a_pair(reference):
    qkv, bias = make_inputs(1, 1, 2, 1, 4, (1, 2), dtype=torch.float64)
    bias[..., 0] = -math.inf  # Δφ = -1: token 0 does not see token 1
    with use_reference(reference):
        out = window_attention(qkv, bias, window=(1, 2))
    torch.testing.assert_close(out[0, 0, 0], qkv[0, 0, 0, 2, 0])


def test_indices_beyond_two_to_the_31():
    # The pages of a fresh tensor are not there before they are written, and reading them is free:
    # only the output (3 GB) takes memory.
    dim = 1024
    tokens = 2**31 // (3 * dim) + 2
    qkv = torch.empty(1, 1, tokens, 3, 1, dim)
    assert qkv.numel() > 2**31
    qkv[0, 0, -1] = torch.arange(3.0 * dim).reshape(3, 1, dim) / dim
    out = window_attention(qkv, torch.zeros(1, 1, 1, 1), window=(1, 1))
    assert torch.equal(out[0, 0, -1], qkv[0, 0, -1, 2, 0])


@pytest.mark.parametrize("case", CASES)
def test_bfloat16_is_float32_rounded_once(case):
    sizes, options = CASES[case]
    qkv, bias = make_inputs(**sizes)
    half = qkv.bfloat16()

    def widened(qkv, bias):
        return attention(**options)(qkv.float(), bias).to(qkv.dtype)

    ours = with_gradients(attention(**options), (half, bias))
    assert [t.dtype for t in ours] == [torch.bfloat16, torch.bfloat16, torch.float32]
    # Sums may run in another order: the last bit of float32 may differ, and so may the rounding.
    for got, want in zip(ours, with_gradients(widened, (half, bias)), strict=True):
        tolerance = 2**-7 if got.dtype == torch.bfloat16 else 1e-5
        torch.testing.assert_close(got, want, rtol=tolerance, atol=1e-5)
        if got.dtype == torch.bfloat16 and got.numel() > 0:
            assert (got == want).float().mean() > 0.99


@pytest.mark.parametrize("case", ["DarSwin-A stage 3", "Swin", "head dim 33"])
def test_the_reference_rounds_bfloat16_once(case):
    sizes, options = CASES[case]
    qkv, bias = make_inputs(**sizes)
    ours = with_gradients(attention(**options), (qkv.bfloat16(), bias))
    with use_reference():
        expected = with_gradients(attention(**options), (qkv.bfloat16(), bias))
    for got, want in zip(ours, expected, strict=True):
        assert got.dtype == want.dtype
        tolerance = 2**-7 if got.dtype == torch.bfloat16 else 1e-5
        torch.testing.assert_close(got, want, rtol=tolerance, atol=1e-5)


def test_a_bias_in_bfloat16_is_widened():
    qkv, bias = make_inputs(dtype=torch.bfloat16)
    out, _, grad_bias = with_gradients(attention(window=(2, 4)), (qkv, bias))
    assert torch.equal(out, window_attention(qkv, bias.float(), window=(2, 4)))
    assert grad_bias.dtype == torch.bfloat16


@pytest.mark.parametrize("reference", [False, True])
def test_autocast(reference):
    qkv, bias = make_inputs()
    run = attention(window=(2, 4))
    with use_reference(reference):
        plain, narrow = run(qkv, bias), run(qkv.bfloat16(), bias)
        from_float16 = run(qkv.half().float(), bias)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            # bfloat16 is taken as it is, whatever autocast made of the bias; float16 as float32.
            assert torch.equal(run(qkv.bfloat16(), bias), narrow)
            assert run(qkv.bfloat16(), bias.bfloat16()).dtype == torch.bfloat16
            assert torch.equal(run(qkv.half(), bias), from_float16)
            assert torch.equal(run(qkv, bias), plain)
        with pytest.raises(TypeError, match=r"float64 or bfloat16, got torch.float16"):
            run(qkv.half(), bias)


def test_other_devices_run_torch():
    qkv, bias = (t.to("meta") for t in make_inputs())
    out = window_attention(qkv, bias, window=(2, 4))
    assert out.shape == (2, 4, 8, 10) and out.device.type == "meta"


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(qkv=None), TypeError, "qkv must be a tensor, got NoneType"),
        (dict(qkv=torch.zeros(2, 4, 8, 30)), ValueError, r"3, heads, d\), got \(2, 4, 8, 30\)"),
        (dict(qkv=torch.zeros(2, 4, 8, 2, 2, 5)), ValueError, "qkv must have shape"),
        (dict(qkv=torch.zeros(2, 4, 8, 3, 2, 0)), ValueError, "head dim"),
        (dict(qkv=torch.zeros(2, 0, 8, 3, 2, 5)), ValueError, "rings"),
        (dict(qkv=torch.zeros(2, 4, 8, 3, 2, 5).long()), TypeError, "float32, float64 or bfloat16"),
        (
            dict(bias=torch.zeros(1, 2, 3, 7).double()),
            TypeError,
            "bias must be float32, got",
        ),
        (dict(bias=torch.zeros(1, 2, 3, 7, device="meta")), ValueError, "bias must be on the same"),
        (dict(bias=torch.zeros(2, 3, 7)), ValueError, r"\(2 or 1, 2, 3, 7\), got \(2, 3, 7\)"),
        (dict(bias=torch.zeros(3, 2, 3, 7)), ValueError, "bias must have shape"),
        (dict(bias=torch.zeros(1, 2, 2, 7)), ValueError, "bias must have shape"),
        (dict(bias=torch.zeros(1, 1, 3, 7)), ValueError, "bias must have shape"),
        (dict(window=(3, 4)), ValueError, r"window must divide \(R, A\) = \(4, 8\), got \(3, 4\)"),
        (dict(window=(0, 4)), ValueError, "window must be at least 1"),
        (dict(window=4), TypeError, "window must be a pair of ints"),
        (dict(window=(2.0, 4)), TypeError, "window must be a pair of ints"),
        (dict(shift=(4, 0)), ValueError, r"shift must lie inside \(R, A\) = \(4, 8\)"),
        (dict(shift=(0, -1)), ValueError, "shift must be at least 0"),
        (dict(periodic=True), TypeError, "periodic must be a pair of bools"),
    ],
)
def test_errors_say_what_was_expected(change, error, message, reference):
    qkv, bias = make_inputs()
    arguments = dict(qkv=qkv, bias=bias, window=(2, 4))
    with use_reference(reference), pytest.raises(error, match=message):
        window_attention(**(arguments | change))


def test_the_compiled_operator_itself_reads_nothing_outside():
    # Without the checks of the public function, wrong sizes must still not crash.
    qkv, bias = make_inputs()
    good = (qkv, bias, (2, 4), (1, 2), (False, True), 0.5)
    for index, value in {
        0: torch.zeros(3), 1: torch.zeros(1, 2, 3, 3), 2: (3, 4), 3: (0, 8), 4: (True,),
    }.items():  # fmt: skip
        arguments = [value if k == index else v for k, v in enumerate(good)]
        with pytest.raises(RuntimeError):
            torch.ops.darswin.window_attention(*arguments)
