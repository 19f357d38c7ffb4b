"""Swin, and DAT's deformable attention; the contract of all models is in test_models.py."""

import itertools
import math

import pytest
import torch
import torch.nn.functional as F

from darswin import create_model
from darswin.layers.attention import WindowAttention
from darswin.models.dat import DeformableAttention


def test_stochastic_depth_rises_from_block_to_block():
    model = create_model("swin_nano", drop_path_rate=0.3)
    rates = [block.drop_path.p for stage in model.stages for block in stage.blocks]
    assert rates == pytest.approx([0.0, 0.1, 0.2, 0.3])


def test_blocks_of_the_small_models():
    with torch.device("meta"):
        swin, dat = create_model("swin_small"), create_model("dat_small")
    shifts = [[block.attn.shift for block in stage.blocks[:2]] for stage in swin.stages]
    assert shifts == [[(0, 0), (2, 2)]] * 3 + [[(0, 0), (0, 0)]]
    stages = [[block.attn for block in stage.blocks] for stage in dat.stages]
    for stage in stages[:2]:
        assert [attn.shift for attn in stage] == [(0, 0), (2, 2)]
    for stage, groups, kernel in ((stages[2], 3, 5), (stages[3], 6, 3)):
        assert all(isinstance(a, WindowAttention) and a.shift == (0, 0) for a in stage[::2])
        for attn in stage[1::2]:
            assert isinstance(attn, DeformableAttention) and attn.groups == groups
            assert attn.around.kernel_size == (kernel, kernel)
    assert len(stages[2]) == 18


def bilinear(table, y, x):
    """Bilinear interpolation of (C, H, W) at (y, x); 0 outside."""
    out = table.new_zeros(table.shape[0])
    rows, columns = ((math.floor(place), math.floor(place) + 1) for place in (y, x))
    for row, column in itertools.product(rows, columns):
        if 0 <= row < table.shape[1] and 0 <= column < table.shape[2]:
            out = out + (1 - abs(y - row)) * (1 - abs(x - column)) * table[:, row, column]
    return out


def test_deformable_attention_as_written_out():
    # One key and one query at a time, in units of pixels.
    height, width, heads, groups, dim = 3, 4, 4, 2, 8
    layer = DeformableAttention(dim, heads, map_size=(height, width), groups=groups, kernel=3)
    layer = layer.double()
    torch.nn.init.normal_(layer.offset.weight, std=2.0)
    torch.nn.init.normal_(layer.position_bias.table)
    x = torch.randn(1, height, width, dim, dtype=torch.float64)

    q = layer.q(x)[0]
    places, sampled = [], []  # of the keys of each group, from the upper left corner of the map
    grid = list(itertools.product(range(height), range(width)))
    for group in range(groups):
        channels = slice(group * dim // groups, (group + 1) * dim // groups)
        around = layer.around(q[..., channels].permute(2, 0, 1)[None])[0].permute(1, 2, 0)
        moves = torch.tanh(layer.offset(F.gelu(layer.norm(around)))).tolist()  # up to one pixel
        places.append([(y + 0.5 + moves[y][x][0], x + 0.5 + moves[y][x][1]) for y, x in grid])
        # The released code samples as if the centres of the outermost pixels were at the edges.
        pixels = x[0, ..., channels].permute(2, 0, 1)
        shrink = ((height - 1) / height, (width - 1) / width)
        samples = [bilinear(pixels, y * shrink[0], x * shrink[1]) for y, x in places[-1]]
        sampled.append(torch.stack(samples))
    k, v = layer.kv(torch.cat(sampled, 1)).chunk(2, 1)

    out = torch.zeros_like(q)
    for head in range(heads):
        part = slice(head * dim // heads, (head + 1) * dim // heads)
        table = layer.position_bias.table[head : head + 1]
        for row, column in grid:
            logits = k[:, part] @ q[row, column, part] / math.sqrt(dim // heads)
            bias = [
                bilinear(
                    table,
                    (row + 0.5 - y) * shrink[0] + height - 1,
                    (column + 0.5 - x) * shrink[1] + width - 1,
                )
                for y, x in places[head * groups // heads]
            ]
            out[row, column, part] = (logits + torch.cat(bias)).softmax(0) @ v[:, part]
    torch.testing.assert_close(layer(x, layer.position_bias())[0], layer.proj(out))
