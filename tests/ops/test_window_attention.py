"""Tests of window_attention beyond the contract, against its definition."""

import math

import pytest
import torch
from cases import attention

from darswin.ops import use_reference, window_attention

references = pytest.mark.parametrize("reference", [False, True])


def arguments(*sizes, dtype=torch.float32):
    """qkv and bias for a batch size, rings, sectors, heads, head dim, window and bias rows."""
    return attention(*sizes, dtype=dtype).inputs.values()


@references
def test_equals_a_loop_over_tokens(reference):
    # The definition, token by token. It shares no code with the operators.
    (rings, sectors), window, shift, periodic = (4, 6), (2, 3), (1, 2), (False, True)
    qkv, bias = arguments(1, rings, sectors, 1, 4, window, dtype=torch.float64)
    q, k, v = qkv[0, :, :, :, 0].unbind(2)
    expected = torch.zeros(rings, sectors, 4, dtype=torch.float64)

    def place(r, a):
        """The window, the position in it, and whether the roll moved the token across a border."""
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


@references
def test_minus_infinity_in_the_bias_hides_a_pair(reference):
    qkv, bias = arguments(1, 1, 2, 1, 4, (1, 2))
    bias[..., 0] = -math.inf  # Δφ = -1: token 0 does not see token 1
    with use_reference(reference):
        out = window_attention(qkv, bias, window=(1, 2))
        assert window_attention(qkv, bias - math.inf, window=(1, 2)).isnan().all()
    torch.testing.assert_close(out[0, 0, 0], qkv[0, 0, 0, 2, 0])


@pytest.mark.parametrize(
    ("dim", "window"), [(32, (1, 16)), (24, (1, 8)), (33, (1, 16)), (32, (2, 16))]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_map_beyond_the_caches_gives_the_gradients_of_its_parts(dim, window, dtype):
    # The gradients of a large map may be stored past the caches, those of one image never are.
    qkv, bias = arguments(32, 8, 64, 3, dim, window, dtype=dtype)
    assert qkv.nbytes > 2**22 > qkv[0].nbytes

    def gradient(images):
        images = images.clone().requires_grad_()
        out = window_attention(images, bias, window=window, shift=(0, 4))
        out.backward(torch.linspace(-1, 1, dim).repeat(3).to(dtype).expand_as(out))
        return images.grad

    parts = [gradient(qkv[k : k + 1]) for k in range(len(qkv))]
    assert torch.equal(gradient(qkv), torch.cat(parts))


@pytest.mark.slow  # it writes 3 GB
def test_indices_beyond_two_to_the_31():
    # Only the output (3 GB) needs memory: the pages of a new tensor are allocated when they are
    # written, not when they are read.
    dim = 1024
    tokens = 2**31 // (3 * dim) + 2
    qkv = torch.empty(1, 1, tokens, 3, 1, dim)
    assert qkv.numel() > 2**31
    qkv[0, 0, -1] = torch.arange(3.0 * dim).reshape(3, 1, dim) / dim
    out = window_attention(qkv, torch.zeros(1, 1, 1, 1), window=(1, 1))
    assert torch.equal(out[0, 0, -1], qkv[0, 0, -1, 2, 0])
