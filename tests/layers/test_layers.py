import math

import pytest
import torch
import torch.nn.functional as F

from darswin import PolarSample, PolarWindowAttention, polar_grid
from darswin.layers.block import DropPath, PatchMerging
from darswin.layers.embed import PolarPatchEmbed
from darswin.layers.position_bias import AngularRelativeBias, FourierBias, ring_angles
from darswin.lens import Perspective, Spherical
from darswin.ops import polar_embed, polar_sample, use_reference, window_attention

LENS = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)


def test_polar_sample_replaces_grid_sample_on_a_polar_grid():
    images = torch.randn(2, 3, 32, 33)
    sample = PolarSample(4, 8, (3, 2), spacing="tan")
    grid = polar_grid(LENS, (32, 33), rings=4, sectors=8, samples=(3, 2), spacing="tan")
    x = grid.center[:, 0, None, None] + grid.radii[:, :, None] * torch.cos(grid.azimuths)
    y = grid.center[:, 1, None, None] + grid.radii[:, :, None] * torch.sin(grid.azimuths)
    mesh = torch.stack((2 * x / 32 - 1, 2 * y / 31 - 1), -1)
    expected = F.grid_sample(images, mesh, align_corners=True)
    torch.testing.assert_close(sample(images, LENS), expected, rtol=1e-4, atol=1e-4)
    assert sample.train()(images, LENS).shape == (2, 3, 12, 16)


def test_polar_sample_passes_on_what_bends_a_lens():
    images = torch.randn(2, 3, 32, 33, dtype=torch.float64)
    affine = torch.eye(2) + 0.3 * torch.randn(2, 2, 2)
    offsets = torch.randn(1, 2, 12, 16)

    def bent(*arguments, **settings):
        return polar_grid(*arguments, **settings)._replace(affine=affine, offsets=offsets)

    grid = polar_grid(LENS, (32, 33), rings=4, sectors=8, samples=(3, 2))
    radii, azimuths, center = (t.double() for t in grid[:3])
    bends = dict(affine=affine.double(), offsets=offsets.double())
    expected = polar_sample(images, radii, azimuths, center, **bends, patch=(3, 2), layout="image")
    assert torch.equal(PolarSample(4, 8, (3, 2), grid=bent)(images, LENS), expected)
    embed = PolarPatchEmbed(4, 8, (3, 2), grid=bent).double()
    tokens = polar_embed(
        images, radii, azimuths, center, embed.proj.weight, embed.proj.bias, **bends, patch=(3, 2)
    )
    got = embed(images, embed.sample.grid(LENS, (32, 33)))
    assert torch.equal(got, embed.norm(tokens))


def test_polar_sample_jitters_only_in_training_and_by_torchs_generator():
    images = torch.randn(2, 3, 32, 32)
    sample = PolarSample(4, 8, (3, 2), jitter=1.0, layout="tokens").eval()
    assert torch.equal(sample(images, LENS), sample(images, LENS))
    sample.train()
    torch.manual_seed(3)
    first, second = sample(images, LENS), sample(images, LENS)
    torch.manual_seed(3)
    assert torch.equal(sample(images, LENS), first) and not torch.equal(first, second)


def test_one_lens_serves_all_images():
    images = torch.randn(3, 1, 20, 24)
    one = Perspective.from_fov(2.0, 10.0)
    sample = PolarSample(4, 8, (2, 2))
    assert torch.equal(sample(images, one), sample(images, one.expand(3)))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda s: s(torch.zeros(3, 32, 32), LENS), ValueError, r"\(B, C, H, W\), got \(3, 32"),
        (lambda s: s(torch.zeros(3, 1, 32, 32), LENS), ValueError, "one an image, 3, got 2"),
        (lambda s: s(torch.zeros(2, 1, 32, 32), None), TypeError, "lens must be a darswin.lens"),
        (lambda s: s([1], LENS), TypeError, "images must be a tensor, got list"),
        (lambda s: PolarSample(0, 8, (2, 2)), ValueError, "rings"),
        (lambda s: PolarSample(4, 8, (2, 2), jitter=2.0), ValueError, "jitter"),
        (lambda s: PolarSample(4, 8, (2, 2), layout="rows"), ValueError, "layout"),
        (lambda s: PolarSample(4, 8, (1, 2), placement="edges"), ValueError, "edges"),
    ],
)
def test_polar_sample_errors(call, error, message):
    with pytest.raises(error, match=message):
        call(PolarSample(4, 8, (2, 2)))


def test_angular_relative_bias_is_the_papers_formula():
    bias = AngularRelativeBias((3, 4), heads=2, sectors=8)
    ring_angles = torch.tensor([[0.0, 0.1, 0.2, 0.3], [0.0, 0.3, 0.6, 0.9]])
    table = bias(ring_angles)
    assert table.shape == (2, 2, 5, 7)
    for image in range(2):
        for head in range(2):
            for delta_r in range(-2, 3):
                for delta_a in range(-3, 4):
                    theta = math.copysign(ring_angles[image, abs(delta_r)].item(), delta_r)
                    phi = 2 * math.pi * delta_a / 8
                    expected = (
                        bias.a_theta[delta_r % 5, head] * math.sin(theta)
                        + bias.b_theta[delta_r % 5, head] * math.cos(theta)
                        + bias.a_phi[delta_a % 7, head] * math.sin(phi)
                        + bias.b_phi[delta_a % 7, head] * math.cos(phi)
                    )
                    got = table[image, head, delta_r + 2, delta_a + 3]
                    torch.testing.assert_close(got, expected)


def test_fourier_bias_is_a_series():
    bias = FourierBias((3, 1), heads=1, sectors=8, harmonics=4)
    table = bias(torch.tensor([[0.0, 0.7, 1.1]]))[0, 0, :, 0]
    for place, theta in enumerate((-1.1, -0.7, 0.0, 0.7, 1.1)):
        expected = bias.b_theta[0, 0] + bias.b_phi[0, 0] + bias.b_phi[1:, 0].sum() / 4
        for p in range(1, 5):
            wave = bias.a_theta[p - 1, 0] * math.sin(p * theta)
            expected = expected + (wave + bias.b_theta[p, 0] * math.cos(p * theta)) / 4
        torch.testing.assert_close(table[place], expected)


def test_periodic_bias_joins_at_the_seam():
    bias = AngularRelativeBias((1, 8), heads=2, sectors=8, periodic=True)
    table = bias(torch.zeros(1, 1))[0, :, 0]
    torch.testing.assert_close(table[:, :7], table[:, 8:])  # Δφ and Δφ - 8


def test_radial_positions():
    grid = polar_grid(LENS, (32, 32), rings=8, sectors=4, samples=(2, 2))
    angles = ring_angles(LENS, grid, 4, "angular_relative")
    torch.testing.assert_close(angles[0], torch.linspace(0, 1.3, 5))
    radii = ring_angles(LENS, grid, 4, "polar")
    torch.testing.assert_close(radii, grid.borders[:, ::2] * math.pi / 16)


@pytest.mark.parametrize("position_bias", ["angular_relative", "angular", "polar"])
def test_window_attention_layer(position_bias):
    layer = PolarWindowAttention(
        12, 3, map_size=(4, 8), window=(2, 8), position_bias=position_bias, periodic_bias=True
    )
    x = torch.randn(2, 4, 8, 12)
    ring_angles = torch.linspace(0, 1, 5)[None]
    out = layer(x, ring_angles)
    out.sum().backward()
    assert out.shape == x.shape
    assert all(p.grad is not None and p.grad.isfinite().all() for p in layer.parameters())
    with pytest.raises(ValueError, match=r"the map must be \(R, A\) = \(4, 8\), got \(8, 4\)"):
        layer(x.transpose(1, 2), ring_angles)


@pytest.mark.parametrize("periodic_bias", [False, True])
@pytest.mark.parametrize("position_bias", ["angular_relative", "angular"])
def test_compiled_gradients_of_the_bias(position_bias, periodic_bias):
    # torch 2.13's inductor miscompiles the gradient of an indexed table on CPU, wrong values and
    # writes out of bounds (pytorch#191837): the bias must not be built by indexing.
    layer = PolarWindowAttention(
        16, 8, map_size=(2, 8), window=(1, 8), position_bias=position_bias,
        periodic_bias=periodic_bias,
    )  # fmt: skip
    x, ring_angles = torch.randn(2, 2, 8, 16), torch.rand(2, 3).cumsum(1)
    layer(x, ring_angles).square().sum().backward()
    expected = {name: p.grad.clone() for name, p in layer.named_parameters()}
    layer.zero_grad()
    torch.compile(layer, fullgraph=True)(x, ring_angles).square().sum().backward()
    for name, parameter in layer.named_parameters():
        torch.testing.assert_close(parameter.grad, expected[name], rtol=1e-3, atol=1e-4)


def test_window_attention_layer_under_autocast():
    layer = PolarWindowAttention(8, 2, map_size=(2, 4), window=(2, 4))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = layer(torch.randn(1, 2, 4, 8), torch.linspace(0, 1, 3)[None])
    assert out.dtype == torch.bfloat16 and out.isfinite().all()


def test_autocast_makes_no_float32_map_of_the_window_attention_layer(monkeypatch):
    taken = []

    def record(qkv, bias, **options):
        out = window_attention(qkv, bias, **options)
        taken.append((qkv.dtype, bias.dtype, out.dtype))
        return out

    monkeypatch.setattr("darswin.layers.attention.window_attention", record)
    layer = PolarWindowAttention(8, 2, map_size=(2, 4), window=(2, 4))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = layer(torch.randn(1, 2, 4, 8), torch.linspace(0, 1, 3)[None])
        out.float().square().sum().backward()
    assert taken == [(torch.bfloat16, torch.float32, torch.bfloat16)]
    assert all(p.grad.dtype == torch.float32 for p in layer.parameters())


def test_a_plain_swin_block_runs_on_the_layer():
    # No axis wraps, windows are shifted along both, and the bias is any table.
    layer = PolarWindowAttention(
        8, 2, map_size=(8, 8), window=(4, 4), shift=(2, 2), periodic=(False, False)
    )
    x, ring_angles = torch.randn(2, 8, 8, 8, requires_grad=True), torch.linspace(0, 1, 9)[None]
    out = layer(x, ring_angles)
    with use_reference():
        expected = layer(x, ring_angles)
    torch.testing.assert_close(out, expected)
    (grad,) = torch.autograd.grad(out[0, 0, 0].sum(), x)
    # The corner's window holds the four corners of the map; it sees only its own.
    assert grad[0, :2, :2].ne(0).any(-1).all()
    assert not grad[0, 2:].any() and not grad[0, :, 2:].any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(num_heads=5), "num_heads must divide dim = 12, got 5"),
        (dict(window=(3, 8)), r"window must divide the map \(R, A\) = \(4, 8\), got \(3, 8\)"),
        (dict(position_bias="none"), "position_bias must be"),
    ],
)
def test_window_attention_layer_errors(options, message):
    settings = dict(dim=12, num_heads=3, map_size=(4, 8), window=(2, 8)) | options
    with pytest.raises(ValueError, match=message):
        PolarWindowAttention(**settings)


def test_merging_joins_neighbours_radius_first():
    merging = PatchMerging(1, (2, 2))
    merging.norm = torch.nn.Identity()
    merging.reduction = torch.nn.Identity()
    x = torch.arange(8.0).reshape(1, 2, 4, 1)
    assert merging(x)[0, 0].tolist() == [[0, 4, 1, 5], [2, 6, 3, 7]]
    with pytest.raises(ValueError, match="must divide"):
        merging(torch.zeros(1, 3, 4, 1))


def test_drop_path_drops_whole_images_and_keeps_the_mean():
    drop = DropPath(0.25)
    out = drop(torch.ones(4000, 2, 3))
    kept = out[:, 0, 0] > 0
    assert (out[kept] == 1 / 0.75).all() and (out[~kept] == 0).all()
    assert abs(kept.float().mean() - 0.75) < 0.03
    assert torch.equal(drop.eval()(out), out)
    with pytest.raises(ValueError, match=r"drop path must be in \[0, 1\)"):
        DropPath(1.0)
