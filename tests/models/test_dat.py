import math

import pytest
import torch
import torch.nn.functional as F

from darswin import create_model
from darswin.lens import Spherical
from darswin.models.dat import DeformableAttention
from darswin.ops import use_reference

LENS = Spherical.from_fov([0.2, 0.9], 2.0, 16.0)


def nano(**options):
    return create_model("dat_nano", **(dict(num_classes=10) | options))


def images(batch=2, height=32, width=32):
    return torch.randn(batch, 3, height, width)


@pytest.mark.parametrize(("classes", "parameters"), [(200, 49_006_434)])
def test_parameter_counts(classes, parameters):
    with torch.device("meta"):
        model = create_model("dat_small", num_classes=classes)
    assert sum(p.numel() for p in model.parameters()) == parameters


def test_blocks_of_the_small_model():
    with torch.device("meta"):
        model = create_model("dat_small")
    stages = [[block.attn for block in stage.blocks] for stage in model.stages]
    for stage in stages[:2]:
        assert [attn.shift for attn in stage] == [(0, 0), (2, 2)]
    for stage, groups, kernel in ((stages[2], 3, 5), (stages[3], 6, 3)):
        assert all(attn.shift == (0, 0) for attn in stage[::2])
        for attn in stage[1::2]:
            assert isinstance(attn, DeformableAttention) and attn.groups == groups
            assert attn.around.kernel_size == (kernel, kernel)
    assert len(stages[2]) == 18


@pytest.mark.parametrize("size", ["tiny", "micro", "nano"])
def test_as_many_tokens_as_darswin(size):
    with torch.device("meta"):
        dat, darswin = create_model(f"dat_{size}"), create_model(f"darswin_a_{size}")
    rows, columns = dat.stages[0].blocks[0].attn.map_size
    rings, sectors = darswin.stages[0].blocks[0].attn.map_size
    assert rows * columns == rings * sectors
    counts = [sum(p.numel() for p in model.parameters()) for model in (dat, darswin)]
    assert abs(counts[0] / counts[1] - 1) < 0.03, counts


@pytest.mark.parametrize(
    "options",
    [
        {},
        dict(image_size=(16, 32)),
        dict(blocks=("S", "LS", "D"), groups=(1, 1, 4)),
        dict(drop_path_rate=0.3),
    ],
)
def test_gradients_reach_every_parameter_and_agree_with_the_reference(options):
    model = nano(**options)
    x = images(2, *model.image_size).requires_grad_()
    torch.manual_seed(1)
    model(x, LENS).square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad.isfinite().all() and parameter.grad.any(), name
    assert x.grad.any()
    model.eval()
    with torch.no_grad():
        ours = model(x, LENS)
        with use_reference():
            expected = model(x, LENS)
    torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-5)


def test_the_lens_is_ignored():
    model = nano().eval()
    x = images()
    assert torch.equal(model(x, LENS), model(x, None)) and torch.equal(model(x, LENS), model(x))


@pytest.mark.parametrize("name", ["dat_micro"])
def test_the_micro_models_run(name):
    model = create_model(name, num_classes=7).eval()
    with torch.no_grad():
        assert model(images(1, 64, 64), Spherical.from_fov(0.5, 2.0, 32.0)).shape == (1, 7)


def test_features_intermediates_and_head():
    model = nano().eval()
    x = images()
    features, maps = model.forward_intermediates(x)
    assert [tuple(m.shape) for m in maps] == [(2, 16, 16, 24), (2, 8, 8, 48), (2, 4, 4, 96)]
    assert torch.equal(features, model.norm(maps[-1]))
    assert torch.equal(model.forward_head(features), model(x))
    excluded = model.no_weight_decay()
    assert excluded == {name for name, p in model.named_parameters() if p.dim() == 3}
    assert len(excluded) == 4


def bilinear(table, y, x):
    """The entry (y, x) of (C, H, W), between its neighbours; 0 outside."""
    out = table.new_zeros(table.shape[0])
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            if 0 <= row < table.shape[1] and 0 <= column < table.shape[2]:
                out = out + (1 - abs(y - row)) * (1 - abs(x - column)) * table[:, row, column]
    return out


def test_deformable_attention_as_written_out():
    # Key after key and query after query, in pixels.
    height, width, heads, groups, dim = 3, 4, 4, 2, 8
    layer = DeformableAttention(dim, heads, map_size=(height, width), groups=groups, kernel=3)
    layer = layer.double()
    torch.nn.init.normal_(layer.offset.weight, std=2.0)
    torch.nn.init.normal_(layer.position_bias.table)
    x = torch.randn(1, height, width, dim, dtype=torch.float64)

    q = layer.q(x)[0]
    places, sampled = [], []  # of each group's keys, from the map's upper left corner
    for group in range(groups):
        channels = slice(group * dim // groups, (group + 1) * dim // groups)
        around = layer.around(q[..., channels].permute(2, 0, 1)[None])[0].permute(1, 2, 0)
        moves = torch.tanh(layer.offset(F.gelu(layer.norm(around)))).tolist()  # up to one pixel
        places.append(
            [
                (row + 0.5 + moves[row][column][0], column + 0.5 + moves[row][column][1])
                for row in range(height)
                for column in range(width)
            ]
        )
        # Sampled as if the outermost pixels' centres were at the edges.
        pixels = x[0, ..., channels].permute(2, 0, 1)
        shrink = ((height - 1) / height, (width - 1) / width)
        samples = [bilinear(pixels, y * shrink[0], x * shrink[1]) for y, x in places[-1]]
        sampled.append(torch.stack(samples))
    k, v = layer.kv(torch.cat(sampled, 1)).chunk(2, 1)

    out = torch.zeros_like(q)
    for head in range(heads):
        part = slice(head * dim // heads, (head + 1) * dim // heads)
        table = layer.position_bias.table[head : head + 1]
        for row in range(height):
            for column in range(width):
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
    torch.testing.assert_close(layer(x)[0], layer.proj(out))


def test_keys_move_with_the_offsets():
    layer = DeformableAttention(8, 2, map_size=(4, 4), groups=1, kernel=3)
    x = torch.randn(1, 4, 4, 8)
    before = layer(x)
    torch.nn.init.normal_(layer.offset.weight, std=2.0)
    moved = layer(x)
    assert (moved - before).abs().max() > 1e-3
    layer.offset_range = 0.0
    still = layer(x)
    torch.nn.init.normal_(layer.offset.weight, std=2.0)
    assert torch.equal(layer(x), still)


def test_camera_frames():
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    model = nano(mean=mean, std=std).eval()
    frames = torch.randint(256, (2, 32, 32, 3), dtype=torch.uint8)
    planes = frames.permute(0, 3, 1, 2) / 255
    planes = (planes - torch.tensor(mean)[:, None, None]) / torch.tensor(std)[:, None, None]
    torch.testing.assert_close(model(frames), model(planes))


def test_compile_fullgraph():
    model = nano(depths=(1, 2), num_heads=(1, 2), blocks=("L", "SD"), groups=(1, 2)).eval()
    x = images()
    with torch.no_grad():
        got = torch.compile(model, fullgraph=True, backend="aot_eager")(x, LENS)
        torch.testing.assert_close(got, model(x, LENS), rtol=1e-4, atol=1e-5)


def test_autocast_and_empty_batches():
    model = nano().eval()
    x = images()
    with torch.no_grad():
        expected = model(x)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            half = model(x)
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), expected, rtol=0.1, atol=0.05)
    assert model(images(0)).shape == (0, 10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(image_size=33), r"patch_size must divide image_size = \(33, 33\), got 2"),
        (dict(image_size=24), r"stage 2: window \(4, 4\) must divide the map, \(6, 6\)"),
        (dict(blocks=("L", "N", "D")), "blocks must be of the kinds 'L', 'S' and 'D'"),
        (dict(blocks=("L", "", "D")), "blocks must be of the kinds"),
        (dict(blocks=("L", "D")), "one entry a stage, 3"),
        (dict(groups=(1, 1, 3)), "groups must divide num_heads = 4, got 3"),
        (dict(num_heads=(5, 5, 5)), "num_heads must divide"),
    ],
)
def test_constructor_errors(options, message):
    with pytest.raises(ValueError, match=message):
        nano(**options)


def test_images_of_another_size():
    with pytest.raises(ValueError, match=r"image_size, \(H, W\) = \(32, 32\), got \(64, 64\)"):
        nano()(images(2, 64, 64))
