"""The private operators of optimized models: norms, linear layers and the blocks of a stage."""

import math

import pytest
import torch
import torch.nn.functional as F
from cases import assert_same_bits_on_any_number_of_threads
from helpers import refused
from torch import nn

from darswin.deploy.own import norm_parameters, packed_weights
from darswin.deploy.packed import OwnBlocks
from darswin.deploy.program import BLOCK, Checked, Program, Weights
from darswin.layers.attention import WindowAttention
from darswin.layers.transformer import Block, Mlp
from darswin.ops import use_reference

_OPS = torch.ops.darswin
_norm, _linear, _pack_linear = _OPS._norm, _OPS._linear, _OPS._pack_linear
# Rows, depth, columns: less than a tile, a tile and a remainder, one and several panels, one and
# several parts of the depth, the sizes of the models, and no rows.
SIZES = [(1, 1, 1), (3, 5, 7), (9, 24, 72), (64, 48, 192), (33, 129, 50), (16, 384, 96),
         (7, 300, 1), (300, 96, 10), (256, 96, 288), (20, 1536, 64), (0, 8, 8)]  # fmt: skip


def layer(depth, columns, bias=True):
    return nn.Linear(depth, columns, bias).requires_grad_(False)


@pytest.mark.parametrize("gelu", [False, True])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_linear_is_as_accurate_as_torch(size, gelu):
    rows, depth, columns = size
    linear, x = layer(depth, columns, bias=depth % 2 == 0), torch.randn(rows, depth)
    got = _linear(x, packed_weights(linear), columns, gelu)
    bias = None if linear.bias is None else linear.bias.double()
    want, own = F.linear(x.double(), linear.weight.double(), bias), linear(x)
    if gelu:
        want, own = F.gelu(want), F.gelu(own)
    assert got.shape == want.shape and got.dtype == torch.float32
    if rows:
        floor = 4 * torch.finfo(torch.float32).eps * want.abs().max()
        assert (got - want).abs().max() <= max(2 * (own - want).abs().max(), floor)


def test_gelu_keeps_its_digits_far_from_zero_too():
    x = torch.cat((torch.linspace(-13, 13, 10_001), torch.tensor([-0.0, 0.0, 1e30])))[:, None]
    unit = nn.Linear(1, 1)
    with torch.no_grad():
        unit.weight.fill_(1.0), unit.bias.zero_()
    got = _linear(x, packed_weights(unit), 1, True).double()
    want = x.double() * torch.erfc(-x.double() / math.sqrt(2)) / 2
    relative = ((got - want).abs() / want.abs().clamp(min=1e-30)).flatten()
    near = x.flatten().abs() < 5
    assert relative[near].max() < 1e-6  # torch's GELU has no correct digits at -5
    assert relative.max() < 1e-5 and (got - want).abs()[:-1].max() < 1e-6


def test_linear_of_numbers_that_are_not_finite():
    linear, x = layer(40, 60), torch.randn(12, 40)
    clean = _linear(x, packed_weights(linear), 60, True)
    x[3, 2], x[7, 39] = math.nan, math.inf
    got = _linear(x, packed_weights(linear), 60, True)
    assert got[3].isnan().all()
    rising = linear.weight[:, 39] > 0
    assert (got[7][rising] == math.inf).all() and not got[7][~rising].isfinite().any()
    kept = [row for row in range(12) if row not in (3, 7)]
    assert torch.equal(got[kept], clean[kept])
    eye = nn.Linear(2, 2, bias=False)
    with torch.no_grad():
        eye.weight.copy_(torch.eye(2))
    large = torch.tensor([[3e38, -3e38]])
    assert torch.equal(_linear(large, packed_weights(eye), 2, True), torch.tensor([[3e38, -0.0]]))


def test_rows_do_not_depend_on_each_other():
    linear, x = layer(200, 100), torch.randn(2, 70, 200)
    weights = packed_weights(linear)
    whole = _linear(x, weights, 100, True)
    for rows in (slice(0, 1), slice(3, 12), slice(5, 70)):
        assert torch.equal(_linear(x[:, rows], weights, 100, True), whole[:, rows])
    strided = x.transpose(0, 1)
    assert torch.equal(_linear(strided, weights, 100, True), whole.transpose(0, 1))


# Less than a register, registers and a remainder, the models' sizes, and enough for many threads.
SHAPES = [(1, 1), (3, 7), (2, 5, 37), (4, 16, 96), (8, 16, 64, 96), (128, 768), (64, 384),
          (9, 1500), (0, 8)]  # fmt: skip


@pytest.mark.parametrize("mean", [0.0, 5.0, 300.0])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_norm_is_as_accurate_as_torch(shape, mean):
    norm, x = nn.LayerNorm(shape[-1]).requires_grad_(False), mean + torch.randn(shape)
    nn.init.normal_(norm.weight), nn.init.normal_(norm.bias)
    kept, got = x.clone(), _norm(x, norm_parameters(norm), norm.eps)
    assert torch.equal(x, kept) and got.shape == x.shape
    if x.numel():
        want = norm.double()(x.double())
        own = (norm.float()(x) - want).abs().max()
        floor = 4 * torch.finfo(torch.float32).eps * want.abs().max()
        large = mean == 300 and shape[-1] >= 384  # unlike torch's, it loses no digits to the mean
        assert (got - want).abs().max() <= (own if large else max(2 * own, floor))


def test_norm_of_constant_rows_and_rows_that_are_not_finite():
    x, parameters = torch.randn(5, 40), torch.randn(2, 40)
    x[1], x[2, 33], x[3, 2] = 1.25, math.nan, math.inf
    got = _norm(x, parameters, 1e-5)
    torch.testing.assert_close(got[1], parameters[1])
    assert got[2].isnan().all() and got[3].isnan().all()
    assert torch.equal(got[4:], _norm(x[4:], parameters, 1e-5))


def test_linear_behind_a_norm():
    norm, linear, x = nn.LayerNorm(37), layer(37, 50), torch.randn(3, 9, 37)
    nn.init.normal_(norm.weight), nn.init.normal_(norm.bias)
    parameters, weights = norm_parameters(norm), packed_weights(linear)
    got = _linear(x, weights, 50, False, parameters, norm.eps)
    assert torch.equal(got, _linear(_norm(x, parameters, norm.eps), weights, 50, False))
    refused("_linear", _linear, x, weights, 50, False, parameters[:, :36], error=RuntimeError)


def stage(dim=24, heads=3, map_size=(8, 16), window=(4, 8), depth=3):
    torch.manual_seed(0)
    blocks = []
    for index in range(depth):
        attn = WindowAttention(
            dim,
            heads,
            map_size=map_size,
            window=window,
            shift=(window[0] // 2, window[1] // 2) if index % 2 else (0, 0),
            periodic=(False, index > 0),
        )
        nn.init.normal_(attn.position_bias.table)
        blocks.append(Block(dim, attn, mlp_ratio=2.5))
        for norm in blocks[-1].modules():
            if isinstance(norm, nn.LayerNorm):
                nn.init.normal_(norm.weight), nn.init.normal_(norm.bias)
    return nn.ModuleList(blocks).requires_grad_(False).eval()


WINDOWS = [
    {},
    dict(dim=10, heads=1, map_size=(1, 6), window=(1, 3)),
    dict(dim=64, heads=2, depth=1),
]


def run(blocks, x):
    for block in blocks:
        x = block(x, block.attn.position_bias())
    return x


@pytest.mark.parametrize("batch", [0, 1, 3])
@pytest.mark.parametrize("sizes", WINDOWS, ids=str)
def test_blocks_are_those_of_the_layers(batch, sizes):
    blocks = stage(**sizes)
    map_size, dim = blocks[0].attn.map_size, blocks[0].attn.dim
    x = torch.randn(batch, *map_size, dim)
    tables = [block.attn.position_bias().contiguous() for block in blocks]
    own = run(blocks, x)
    got = OwnBlocks(blocks, Weights())(x.clone(), tables)
    with use_reference():
        want = run(blocks.double(), x.double())
    assert got.shape == want.shape
    if batch:
        floor = 4 * torch.finfo(torch.float32).eps * want.abs().max()
        assert (got - want).abs().max() <= max(2 * (own - want).abs().max(), floor)


def test_blocks_of_different_widths_go_in_parts_that_fit_all():
    narrow, wide = stage(depth=1), stage(depth=1)
    wide[0].mlp = Mlp(24, 960).requires_grad_(False)
    program = Program(Weights())
    x = out = program.input(8, 16, 24)
    for blocks in (narrow, wide):
        table = program.input(*blocks[0].attn.position_bias.table.shape)
        out = program.blocks(out, OwnBlocks(blocks, program.weights), [table])
    program.output(out)
    checked, numbers = program.checked(), torch.randn(100, *x.shape)  # 34 images are a part
    tables = [blocks[0].attn.position_bias() for blocks in (narrow, wide)]
    got, alone = (checked([given, *tables])[0] for given in (numbers, numbers[99:]))
    assert torch.equal(got[99:], alone)
    torch.testing.assert_close(got, run(wide, run(narrow, numbers)))


def test_same_bits_on_any_number_of_threads():
    blocks, linear = stage(dim=48, map_size=(16, 32)), layer(700, 500)
    x, rows = torch.randn(4, 16, 32, 48), torch.randn(100, 700)
    tables = [block.attn.position_bias().contiguous() for block in blocks]
    packed, weights = OwnBlocks(blocks, Weights()), packed_weights(linear)
    assert_same_bits_on_any_number_of_threads(
        lambda: dict(
            blocks=packed(x.clone(), tables), linear=_linear(rows, weights, 500, True),
            few=_linear(rows[:3], weights, 500, False),
        ),
        (1, 2, 5),
    )  # fmt: skip


def test_packing_reads_any_strides():
    linear = layer(37, 50)
    weight, bias = linear.weight.t().contiguous().t(), torch.stack((linear.bias,) * 2, 1)[:, 0]
    assert not weight.is_contiguous() and not bias.is_contiguous()
    assert torch.equal(_pack_linear(weight, bias), packed_weights(linear))


def test_packing_refuses_wrong_arguments():
    weight, bias = torch.zeros(5, 6), torch.zeros(5)
    bytes_, scales, huge = weight.char(), torch.ones(5), torch.zeros(1, 1).expand(2**31, 2**31)
    for given in (
        (weight.double(), bias), (weight[0], bias), (weight, bias[:4]), (weight, bias.double()),
        (weight.to("meta"), bias), (weight, bias.to("meta")), (bytes_, bias), (huge, None),
        (weight, bias, scales), (bytes_, bias, scales[:4]), (bytes_, bias, scales.double()),
        (bytes_, bias[:4], scales), (bytes_, bias, scales, 0.0), (bytes_, bias, scales, math.nan),
        (bytes_, bias, scales, 0.1, -1), (bytes_, bias, scales, 0.1, 256),
    ):  # fmt: skip
        with pytest.raises(RuntimeError):
            _pack_linear(*given)
    for empty in (torch.zeros(0, 6), torch.zeros(5, 0)):
        assert not _pack_linear(empty, None).any()


def test_wrong_arguments():
    weights, norm = packed_weights(layer(6, 4)), torch.ones(2, 6)
    x = torch.zeros(3, 6)
    for wrong in (x.double(), x[:, :5], x[:, :0], torch.zeros(())):
        refused("_linear", _linear, wrong, weights, 4, False, error=RuntimeError)
        refused("_linear", _norm, wrong, norm, 1e-5, error=RuntimeError)
    for packed, columns in ((weights[1:], 4), (weights.double(), 4), (weights, 40), (weights, 0),
                            (weights, -4), (weights, 2**62)):  # fmt: skip
        refused(r"_linear|too large", _linear, x, packed, columns, False, error=RuntimeError)


def test_blocks_that_do_not_fit():
    blocks = OwnBlocks(stage(depth=1), Weights())
    table, x = torch.zeros(1, *blocks.table_shapes[0]), torch.zeros(1, *blocks.map_shape)
    blocks(x, [table])
    words, weights = blocks.written.words(), blocks.written.weights.words
    run = Checked(weights, words)
    assert words[-25] == BLOCK and (blocks.heads, blocks.mlp_dim) == (3, 60)
    wrong = {1: (9, 0), 2: (0,), 3: (20,), 4: (0, -3, 5), 5: (0, 2**61), 6: (-1, 2**40),
             7: (-1, weights.numel()), 8: (2,), 16: (0, 3), 17: (7,), 18: (8, -1), 19: (16,),
             22: (0, 2)}  # fmt: skip
    for place, values in wrong.items():
        for value in values:
            changed = [*words]
            changed[place - 23] = value
            refused("the program of a network", Checked, weights, changed)
    for given in ([x], [x[..., :20], table], [x, table[:, :2]], [x.transpose(1, 2)[:, :1], table]):
        refused("_run", run, given, error=RuntimeError)
