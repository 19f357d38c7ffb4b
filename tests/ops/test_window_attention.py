"""window_attention by its definition, beyond the contract."""

import math

import pytest
import torch
import torch.nn.functional as F
from cases import attention

from darswin.ops import use_reference, window_attention

references = pytest.mark.parametrize("reference", [False, True])


def arguments(*sizes, dtype=torch.float32):
    """qkv and bias, of batch, rings, sectors, heads, head dim, window and rows of the bias."""
    return attention(*sizes, dtype=dtype).inputs.values()


@references
def test_equals_a_loop_over_tokens(reference):
    # The definition, token by token: nothing here is shared with the operators.
    (rings, sectors), window, shift, periodic = (4, 6), (2, 3), (1, 2), (False, True)
    qkv, bias = arguments(1, rings, sectors, 1, 4, window, dtype=torch.float64)
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
    with use_reference(reference):
        got = window_attention(qkv, bias, window=window, shift=shift, periodic=periodic)
    torch.testing.assert_close(got[0], expected)


def test_one_window_equals_scaled_dot_product_attention():
    qkv, bias = arguments(2, 4, 6, 3, 8, (4, 6))
    q, k, v = qkv.flatten(1, 2).permute(2, 0, 3, 1, 4)
    expected = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(2, 4, 6, 24)
    torch.testing.assert_close(window_attention(qkv, 0 * bias, window=(4, 6)), expected)


@pytest.mark.parametrize("shift", [(0, 0), (1, 2)])
def test_turning_the_map_by_a_window_turns_the_result(shift):
    qkv, bias = arguments(2, 4, 12, 2, 8, (2, 4))
    for periodic in ((False, True), (False, False)):
        options = dict(window=(2, 4), shift=shift, periodic=periodic)
        turned = window_attention(qkv.roll(4, 2), bias, **options)
        expected = window_attention(qkv, bias, **options).roll(4, 2)
        # With a seam that the shift moves, it would not.
        assert torch.allclose(turned, expected, atol=1e-5) == (periodic[1] or shift == (0, 0))


def test_the_inner_and_the_outer_ring_do_not_see_each_other():
    qkv, bias = arguments(1, 4, 4, 1, 4, (2, 4))
    out = window_attention(qkv, bias, window=(2, 4), shift=(1, 0))
    changed = qkv.clone()
    changed[:, 3] += 1
    after = window_attention(changed, bias, window=(2, 4), shift=(1, 0))
    assert torch.equal(out[:, :3], after[:, :3]) and not torch.equal(out[:, 3], after[:, 3])


def test_bias_of_each_image():
    qkv, bias = arguments(3, 4, 8, 2, 5, (2, 4), 3)
    together = window_attention(qkv, bias, window=(2, 4))
    alone = [window_attention(qkv[b : b + 1], bias[b : b + 1], window=(2, 4)) for b in range(3)]
    assert torch.equal(together, torch.cat(alone))


@references
def test_minus_infinity_in_the_bias_hides_a_pair(reference):
    qkv, bias = arguments(1, 1, 2, 1, 4, (1, 2), dtype=torch.float64)
    bias[..., 0] = -math.inf  # Δφ = -1: token 0 does not see token 1
    with use_reference(reference):
        out = window_attention(qkv, bias, window=(1, 2))
    torch.testing.assert_close(out[0, 0, 0], qkv[0, 0, 0, 2, 0])


def test_windows_without_tables_read_nothing_past_their_biases():
    # 65 tokens: keys come in eights, their biases did not. AddressSanitizer sees it.
    qkv, bias = arguments(1, 1, 65, 1, 32, (1, 65))
    out = window_attention(qkv, bias, window=(1, 65))
    with use_reference():
        expected = window_attention(qkv, bias, window=(1, 65))
    torch.testing.assert_close(out, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow  # it writes 3 GB
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
