from collections import Counter
from contextlib import nullcontext

import pytest
import torch
from helpers import refused
from torch import nn
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode

from darswin import PolarWindowAttention
from darswin.layers.attention import WindowAttention
from darswin.layers.checkpointing import recomputed
from darswin.layers.transformer import Block, DropPath, PatchMerging, Stage
from darswin.models.base import Model
from darswin.ops import linear, use_reference, window_attention
from darswin.views import PolarGrid

ANGLES = torch.tensor([[0.0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.3, 0.6, 0.9, 1.2]])


def grid_of(angles):
    """A grid whose rings end at these angles, and at no known radii."""
    unknown = torch.full_like(angles, torch.nan)
    return PolarGrid(unknown, unknown[0], unknown[:, :2], unknown, last=angles[:, -1])


# -- attention --------------------------------------------------------------------------------


@pytest.mark.parametrize("position_bias", ["angular_relative", "angular", "polar"])
def test_the_layer_is_two_products_around_the_operator(position_bias):
    layer = PolarWindowAttention(
        12, 3, map_size=(4, 8), window=(2, 8), shift=(1, 0), position_bias=position_bias,
        periodic_bias=True,
    )  # fmt: skip
    x = torch.randn(2, 4, 8, 12)
    bias = layer.position_bias(ANGLES)
    if position_bias != "polar":  # which has no angles, but radii
        torch.testing.assert_close(layer.angles(grid_of(ANGLES)), ANGLES)
    out = layer(x, bias)
    qkv = layer.qkv(x).unflatten(3, (3, 3, 4))
    attended = window_attention(qkv, bias, window=(2, 8), shift=(1, 0), periodic=(False, True))
    assert torch.equal(out, layer.proj(attended))
    out.sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in layer.parameters())
    refused(r"\(R, A\) = \(4, 8\), got \(8, 4\)", layer, x.transpose(1, 2), bias)


def test_a_plain_swin_block_runs_on_the_layer():
    # No axis wraps around, and windows are shifted along both.
    options = dict(map_size=(8, 8), window=(4, 4), shift=(2, 2), periodic=(False, False))
    for layer, angles in (
        (PolarWindowAttention(8, 2, **options), [torch.linspace(0, 1, 9)[None]]),
        (WindowAttention(8, 2, **options), []),
    ):
        x = torch.randn(2, 8, 8, 8, requires_grad=True)
        table = layer.position_bias(*angles)
        out = layer(x, table)
        with use_reference():
            torch.testing.assert_close(out, layer(x, table))
        (grad,) = torch.autograd.grad(out[0, 0, 0].sum(), x)
        # The shifted window has all four corners of the map; a token attends to its own corner.
        assert grad[0, :2, :2].ne(0).any(-1).all()
        assert not grad[0, 2:].any() and not grad[0, :, 2:].any()


def test_autocast_makes_no_float32_map(monkeypatch):
    layer, seen = PolarWindowAttention(8, 2, map_size=(2, 4), window=(2, 4)), []

    def record(qkv, bias, **options):
        out = window_attention(qkv, bias, **options)
        seen.append((qkv.dtype, bias.dtype, out.dtype))
        return out

    monkeypatch.setattr("darswin.layers.attention.window_attention", record)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        table = layer.position_bias(torch.linspace(0, 1, 3)[None])
        out = layer(torch.randn(1, 2, 4, 8), table)
        out.float().square().sum().backward()
    assert out.dtype == torch.bfloat16 and out.isfinite().all()
    assert seen == [(torch.bfloat16, torch.float32, torch.bfloat16)]
    assert all(p.grad.dtype == torch.float32 for p in layer.parameters())


@pytest.mark.slow
@pytest.mark.parametrize("periodic_bias", [False, True])
@pytest.mark.parametrize("position_bias", ["angular_relative", "angular"])
def test_compiled_gradients_of_the_bias(position_bias, periodic_bias):
    # A report says that inductor miscompiles the gradient of an indexed table (pytorch#191837). The
    # bias is built without an index, and 60 forms of one with torch 2.13 did not show it.
    layer = PolarWindowAttention(
        16, 8, map_size=(2, 8), window=(1, 8), position_bias=position_bias,
        periodic_bias=periodic_bias,
    )  # fmt: skip
    x, ring_angles = torch.randn(2, 2, 8, 16), torch.rand(2, 3).cumsum(1)

    def run(x, ring_angles):
        return layer(x, layer.position_bias(ring_angles)).square().sum()

    run(x, ring_angles).backward()
    expected = {name: p.grad.clone() for name, p in layer.named_parameters()}
    layer.zero_grad()
    torch.compile(run, fullgraph=True)(x, ring_angles).backward()
    for name, parameter in layer.named_parameters():
        torch.testing.assert_close(parameter.grad, expected[name], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(num_heads=5), "num_heads must divide dim = 12, got 5"),
        (dict(num_heads=0), "num_heads must divide dim = 12, got 0"),
        (dict(window=(3, 8)), r"window must divide .* \(4, 8\), got \(3, 8\)"),
        (dict(window=(2, 3)), r"window must divide .* \(4, 8\), got \(2, 3\)"),
        (dict(window=(0, 8)), "window"),
        (dict(shift=(-1, 0)), "shift"),
        (dict(position_bias="none"), "position_bias"),
    ],
)
def test_wrong_sizes_of_attention(options, message):
    settings = dict(dim=12, num_heads=3, map_size=(4, 8), window=(2, 8)) | options
    refused(message, PolarWindowAttention, **settings)


# -- blocks and stages ------------------------------------------------------------------------


def stage_of(heads=(2, 2, 3), position_bias="angular_relative", drop_path=0.0):
    blocks = []
    for count in heads:
        attn = PolarWindowAttention(
            12, count, map_size=(4, 8), window=(2, 4), position_bias=position_bias
        )
        blocks.append(Block(12, attn, mlp_ratio=2, drop_path=drop_path))
    return Stage(nn.Identity(), blocks)


@pytest.mark.parametrize("drop_path", [0.0, 0.5])
def test_a_stage_is_attention_and_mlps_behind_residuals(drop_path):
    stage, x = stage_of(drop_path=drop_path), torch.randn(2, 4, 8, 12)
    torch.manual_seed(0)
    tables = stage.tables(grid_of(ANGLES))
    out = stage(x, tables)
    torch.manual_seed(0)
    for block, table in zip(stage.blocks, tables, strict=True):
        x = x + block.drop_path(block.attn(block.norm1(x), table))
        hidden = nn.functional.gelu(block.mlp.fc1(block.norm2(x)))
        assert hidden.shape[-1] == 24
        x = x + block.drop_path(block.mlp.fc2(hidden))
    torch.testing.assert_close(out, x)


@pytest.mark.parametrize("position_bias", ["angular_relative", "angular"])
def test_tables_that_are_made_at_once_and_their_gradients(position_bias):
    stage, last = stage_of(position_bias=position_bias), ANGLES[:, -1:].clone().requires_grad_()
    biases = [block.attn.position_bias for block in stage.blocks]
    results = []
    for joined in (False, True):
        angles = last * torch.linspace(0, 1, 5)
        tables = stage.tables(grid_of(angles)) if joined else [bias(angles) for bias in biases]
        loss = sum(((k + 2) * table).sin().sum() for k, table in enumerate(tables))
        leaves = [last, *(p for bias in biases for p in bias.parameters())]
        results.append([*tables, *torch.autograd.grad(loss, leaves)])
    for apart, joined in zip(*results, strict=True):
        torch.testing.assert_close(joined, apart)


def test_merging_joins_neighbours_radius_first():
    merging = PatchMerging(1, (2, 2))
    merging.norm = merging.reduction = nn.Identity()
    x = torch.arange(8.0).reshape(1, 2, 4, 1)
    assert merging(x)[0, 0].tolist() == [[0, 4, 1, 5], [2, 6, 3, 7]]
    for shape in ((1, 3, 4, 1), (1, 2, 3, 1)):
        refused("must divide", merging, torch.zeros(shape))
    merging = PatchMerging(3, (1, 4))
    x = torch.randn(2, 2, 8, 3)
    normed = nn.functional.layer_norm(x.reshape(2, 2, 2, 12), (12,))
    torch.testing.assert_close(merging(x), normed @ merging.reduction.weight.T)
    assert merging(x).shape == (2, 2, 2, 6) and merging.reduction.bias is None


def test_drop_path_drops_whole_images_and_keeps_the_mean():
    drop = DropPath(0.25)
    out = drop(torch.ones(4000, 2, 3))
    kept = out[:, 0, 0] > 0
    assert (out[kept] == 1 / 0.75).all() and (out[~kept] == 0).all()
    assert abs(kept.float().mean() - 0.75) < 0.03
    assert torch.equal(drop.eval()(out), out)
    for wrong in (1.0, -0.1):
        refused(r"drop path must be in \[0, 1\)", DropPath, wrong)


# -- recomputation in backward ----------------------------------------------------------------


class Count(TorchDispatchMode):
    """Counts the operators that are computed."""

    def __init__(self):
        super().__init__()
        self.calls = Counter()

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        self.calls[operator.name().partition("::")[2].partition(".")[0]] += 1
        return operator(*args, **(kwargs or {}))


@pytest.mark.compiled
@pytest.mark.parametrize("ours", [False, True])
def test_products_are_kept_and_what_is_cheap_is_computed_again(ours, monkeypatch):
    monkeypatch.setattr(linear, "IS_FASTER", ours)
    monkeypatch.setattr(linear, "LEAST_ROWS", 1)
    stage = stage_of(drop_path=0.5)
    found = {}
    for enable in (False, True):
        Model.set_grad_checkpointing(stage, enable)
        x = torch.randn(2, 4, 8, 12, requires_grad=True)
        with Count() as count:
            stage(x, stage.tables(grid_of(ANGLES))).sum().backward()
        found[enable] = count.calls
        with Count() as count, torch.no_grad():
            stage(x, stage.tables(grid_of(ANGLES)))
        assert count.calls["gelu"] == 3
    for product in ("addmm", "mm", "linear", "mlp", "gelu", "bernoulli"):
        assert found[True][product] == found[False][product]
    assert found[True]["mlp"] == 3 * ours
    for cheap, times in (("native_layer_norm", 6), ("window_attention", 3)):
        assert (found[False][cheap], found[True][cheap]) == (times, 2 * times)


def test_the_value_is_not_kept_and_other_tensors_are():
    hidden, other = torch.randn(2, 6, requires_grad=True), torch.randn(2, 6, requires_grad=True)
    for when in (False, True):
        value = nn.functional.gelu(hidden)
        memory = StorageWeakRef(value.untyped_storage())
        hooks = recomputed(value, nn.functional.gelu, hidden) if when else nullcontext()
        with hooks:
            out = (value * other).sum() + (value * (other + 1)[:, :6]).sum()
        exact = value.detach().clone()
        del value
        assert memory.expired() == when
        (grad,) = torch.autograd.grad(out, other)
        torch.testing.assert_close(grad, 2 * exact)
