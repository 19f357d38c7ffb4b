"""The operators of optimized models with 8-bit weights and tokens."""

import itertools
import math

import pytest
import torch
import torch.nn.functional as F
from cases import assert_same_bits_on_any_number_of_threads
from hypothesis import example, given
from hypothesis import strategies as st
from test_blocks import WINDOWS, stage

from darswin.deploy.own import norm_parameters, own_linear, packed_weights
from darswin.deploy.packed import OwnBlocks
from darswin.deploy.program import Weights
from darswin.layers.quantized import (
    QuantizedLinear,
    quantize,
    with_quantized_layers,
)
from darswin.ops import _module, cpu_capability

OPS = torch.ops.darswin


@pytest.fixture(autouse=True, scope="module", params=_module.BYTE_PRODUCTS)
def products(request):
    """Each way to multiply bytes that this CPU has."""
    if _module.byte_products(request.param) != request.param:
        pytest.skip(f"this tier or CPU has no products by {request.param}")
    yield
    _module.byte_products(_module.BYTE_PRODUCTS[-1])


def layer(depth, columns, activation=(1.0, 0), *, bias=True, weight=None):
    """A quantized layer whose weights are all equal to `weight`, or random."""
    made = QuantizedLinear(depth, columns, bias=bias, activation=activation)
    lowest, highest = (-128, 127) if weight is None else (weight, weight)
    made.weight = torch.randint(lowest, highest + 1, (columns, depth), dtype=torch.int8)
    return made


def tokens(*shape, value=None):
    lowest, highest = (0, 255) if value is None else (value, value)
    return torch.randint(lowest, highest + 1, shape, dtype=torch.uint8)


@given(
    st.integers(0, 20), st.integers(1, 75), st.integers(1, 120), st.sampled_from([0, 1, 119, 255]),
    st.sampled_from([None, -128, 127]), st.sampled_from([None, 0, 255]), st.integers(0, 2**31),
)  # fmt: skip
@example(300, 96, 288, 119, None, None, 0)
@example(47, 64, 48, 119, None, None, 0)  # tiles of AMX, and fewer tokens at the end
@example(33, 530, 80, 119, -128, 255, 0)
@example(130, 1100, 101, 7, None, None, 0)  # several parts of the depth, and its rest
@example(17, 3075, 50, 255, None, None, 0)  # several parts of the depth
@example(9, 2048, 96, 0, -128, 255, 0)
@example(1, 2**16, 1, 255, -128, 0, 0)  # the largest sum
@example(1, 2**16, 1, 255, 127, 0, 0)
def test_sums_are_exact(rows, depth, columns, zero_point, weight, value, seed):
    torch.manual_seed(seed)
    linear = layer(depth, columns, (1.0, zero_point), weight=weight)
    q = tokens(rows, depth, value=value)
    sums = (q.int() - zero_point) @ linear.weight.int().t()
    assert sums.dtype == torch.int32
    assert torch.equal(own_linear(linear)(q), sums.float())


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("size", [(1, 1, 1), (33, 130, 50), (64, 96, 288), (20, 1536, 384)])
def test_products_are_exact_but_for_roundings(size, bias):
    rows, depth, columns = size
    linear = layer(depth, columns, (0.0317, 119), bias=bias)
    linear.weight_scale = torch.rand(columns) / 100
    if bias:
        linear.bias = torch.randn(columns)
    q = tokens(2, rows, depth)
    sums = ((q.int() - 119) @ linear.weight.int().t()).double()
    product, bias = (
        sums * 0.0317 * linear.weight_scale,
        linear.bias if bias else torch.zeros(columns),
    )
    most = 4 * torch.finfo(torch.float32).eps * (product.abs() + bias.abs())  # of four roundings
    assert ((own_linear(linear)(q) - (product + bias)).abs() <= most).all()
    found = own_linear(linear, gelu=True)(q)
    torch.testing.assert_close(found, F.gelu(product + bias).float(), rtol=1e-5, atol=1e-5)


def test_merging():
    linear, x = layer(37, 50, (0.03, 100), bias=False), torch.randn(3, 9, 37)
    norm = torch.nn.LayerNorm(37).requires_grad_(False)
    parameters, weights = norm_parameters(norm), packed_weights(linear)
    q = quantize(OPS._norm(x, parameters, norm.eps), linear.activation)
    got = OPS._linear(x, weights, 50, False, parameters, norm.eps)
    assert torch.equal(got, OPS._linear(q, weights, 50, False))


LAYERS = ("attn.qkv", "attn.proj", "mlp.fc1", "mlp.fc2")


def quantized_stage(names=LAYERS, **sizes):
    """The blocks of a stage whose layers with these names are quantized."""
    blocks = stage(**sizes)
    steps = {"attn.proj": (0.02, 130), "mlp.fc2": (0.01, 17)}
    for block in blocks:
        with_quantized_layers(block, {name: steps.get(name, (0.03, 121)) for name in names})
    return blocks, [block.attn.position_bias().contiguous() for block in blocks]


def step_by_step(blocks, tables, x):
    """The blocks by the operators of single layers."""

    def product(linear, tokens, gelu=False):
        is_quantized = isinstance(linear, QuantizedLinear)
        tokens = quantize(tokens, linear.activation) if is_quantized else tokens
        return OPS._linear(tokens, packed_weights(linear), linear.out_features, gelu)

    def normed(norm, x):
        return OPS._norm(x, norm_parameters(norm), norm.eps)

    for block, table in zip(blocks, tables, strict=True):
        attn, mlp = block.attn, block.mlp
        qkv = product(attn.qkv, normed(block.norm1, x))
        qkv = qkv.unflatten(-1, (3, attn.num_heads, attn.dim // attn.num_heads))
        settings = (attn.window, attn.shift, attn.periodic, (attn.dim // attn.num_heads) ** -0.5)
        x = x + product(attn.proj, OPS.window_attention(qkv, table, *settings))
        x = x + product(mlp.fc2, product(mlp.fc1, normed(block.norm2, x), gelu=True))
    return x


@pytest.mark.parametrize("batch", [0, 1, 3])
@pytest.mark.parametrize("names", [LAYERS, LAYERS[:1], LAYERS[1:2], LAYERS[2:], ("mlp.fc2",)])
@pytest.mark.parametrize("sizes", WINDOWS, ids=str)
def test_blocks_are_those_of_the_layers(batch, names, sizes):
    blocks, tables = quantized_stage(names, **sizes)
    x = torch.randn(batch, *blocks[0].attn.map_size, blocks[0].attn.dim)
    got = OwnBlocks(blocks, Weights())(x.clone(), tables)
    assert torch.equal(got, step_by_step(blocks, tables, x) if batch else x)


def test_same_bits_on_any_number_of_threads():
    blocks, tables = quantized_stage(dim=48, map_size=(16, 32))
    packed, x = OwnBlocks(blocks, Weights()), torch.randn(4, 16, 32, 48)
    weights, rows = packed_weights(layer(701, 500)), tokens(100, 701)
    assert_same_bits_on_any_number_of_threads(
        lambda: dict(
            blocks=packed(x.clone(), tables), linear=OPS._linear(rows, weights, 500, True),
            few=OPS._linear(rows[:3], weights, 500, False),
        ),
        (1, 2, 5),
    )  # fmt: skip


def test_numbers_that_are_not_finite_stay_in_their_windows():
    blocks, tables = quantized_stage(depth=1)
    x = torch.randn(1, 8, 16, 24)
    clean = OwnBlocks(blocks, Weights())(x.clone(), tables)
    x[0, 0, 0, 3] = math.nan
    got = OwnBlocks(blocks, Weights())(x, tables)
    assert torch.equal(got[:, 4:], clean[:, 4:]) and torch.equal(got[:, :, 8:], clean[:, :, 8:])


def test_wrong_arguments():
    weights, q = packed_weights(layer(6, 4)), tokens(3, 6)
    for x, packed, columns in (
        (q.float(), weights, 4), (q.char(), weights, 4), (q, weights[1:], 4), (q, weights, 40),
        (q, weights.view(torch.float32), 4), (q[:, :1], weights, 4), (q, weights.long(), 4),
        (tokens(1, 2**16 + 1), packed_weights(layer(2**16 + 1, 1)), 1),
    ):  # fmt: skip
        with pytest.raises(RuntimeError, match="_linear"):
            OPS._linear(x, packed, columns, False)


def test_any_parameters_are_safe():
    """A file may hold any. A sanitizer sees sums that overflow."""
    norm = norm_parameters(torch.nn.LayerNorm(37)), 1e-5
    packed = packed_weights(layer(37, 50))
    for value in (-(2**31), 2**31 - 1):
        given = torch.full_like(packed, value)
        assert OPS._linear(tokens(9, 37), given, 50, False).shape == (9, 50)
        assert OPS._linear(torch.randn(9, 37), given, 50, True, *norm).shape == (9, 50)


EXTREMES = [(255, 127), (255, -127), (255, -128), (0, -128), (None, None)]


@pytest.mark.parametrize("zero_point", [0, 119, 255])
@pytest.mark.parametrize("depth", [1, 2, 3, 4, 5, 37, 256, 259, 1030])
def test_every_tier_gives_the_same_bits(depth, zero_point):
    before = cpu_capability()
    try:
        for (value, weight), columns in itertools.product(EXTREMES, (1, 17, 50)):
            linear = layer(depth, columns, (0.0317, zero_point), weight=weight)
            linear.weight_scale, linear.bias = torch.rand(columns) / 100, torch.randn(columns)
            q, packed = tokens(13, depth, value=value), packed_weights(linear)
            sums = (q.int() - zero_point) @ linear.weight.int().t()
            want = sums.float() * torch.tensor(0.0317) * linear.weight_scale + linear.bias
            for tier in _module.tiers():
                _module.set_tier(tier)
                for rows in (1, 4, 13):
                    assert torch.equal(OPS._linear(q[:rows], packed, columns, False), want[:rows])
    finally:
        _module.set_tier(before)


def test_numbers_that_are_not_finite_count_as_zero():
    linear, x = layer(37, 50, (0.03, 100)), torch.randn(9, 37)
    linear.bias = torch.randn(50)
    norm = torch.nn.LayerNorm(37).requires_grad_(False)
    given = packed_weights(linear), 50, False, norm_parameters(norm), norm.eps
    clean = OPS._linear(x, *given)
    x[3, 2], x[7, 36] = math.nan, math.inf
    got = OPS._linear(x, *given)
    for row in range(9):
        assert torch.equal(got[row], linear.bias if row in (3, 7) else clean[row])
