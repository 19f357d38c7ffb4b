"""The Unet: the way from polar maps to pixels, the decoder and heads, and learning a lens."""

import math

import pytest
import torch
import torch.nn.functional as F
from helpers import create, network, refused

from darswin import PolarView, create_model
from darswin.layers.transformer import PatchMerging
from darswin.lens import KannalaBrandt, Mei, Polynomial, Spherical
from darswin.models.pixel import DistanceHead, PixelHead
from darswin.models.unet import PatchExpand, SkipJoin, Unet
from darswin.ops import polar_to_image

f64 = torch.float64
NANO = dict(depths=(1, 2, 1))  # of the classifiers of that size
WIDE = Polynomial([16.0, 0.4, -0.1, 0.05], 2.0, [30.0, 35.0])  # θ_max = 115°, off centre
GENERAL = Mei(
    1.5, 60.0, [0.02, 0.01], 1.4, [30.0, 35.0], tangential=[0.02, -0.01],
    affine=[[1.0, 0.05], [0.0, 1.1]],
)  # fmt: skip


@pytest.mark.parametrize("spacing", ["theta", "tan", "g", "radius"])
def test_the_decoders_rings_are_those_of_the_grid(spacing):
    """The decoder has 4 rings per ring of the grid: their centres are samples of a 4 × 4 grid."""
    lens = Spherical.from_fov([0.1, 0.9], 2.6, 32.0)
    model = create_model("darswin_unet_ra_nano", spacing=spacing, sample_spacing="radius")
    back = model.prepare(lens, (64, 64)).view.back
    grid = PolarView(
        rings=16, sectors=64, samples=(4, 4), spacing=spacing, sample_spacing="radius"
    ).grid(lens, (64, 64))
    torch.testing.assert_close(back.radii, grid.radii)
    assert torch.equal(back.center, grid.center) and (back.r_max > lens.r_max).all()
    torch.testing.assert_close(back.r_max, lens.r_max, rtol=2e-6, atol=0)
    # In `polar_to_image`, the azimuth of sector a is that of the samples of column a.
    assert torch.allclose(grid.azimuths, 2 * math.pi * (torch.arange(256) + 0.5) / 256)


@pytest.mark.compiled
@torch.no_grad()
@pytest.mark.parametrize("dtype", [torch.float32, f64])
def test_prepare_keeps_a_plan_for_a_single_lens(dtype):
    # A plan in float32 is not for a model in float64.
    model, size = network("darswin_unet_a_nano").to(dtype), (32, 32)
    assert model.prepare(WIDE[[0, 0]], size).view.back.plan is None
    prepared = model.prepare(WIDE, size)
    assert prepared.view.back.plan.shape == (1, 32, 3, 32)
    back = prepared.view.back._replace(plan=None)
    without = prepared._replace(view=prepared.view._replace(back=back))
    images = torch.rand(2, 3, 32, 32, dtype=dtype)
    assert torch.equal(model.run(images, prepared), model.run(images, without))


@torch.no_grad()
@pytest.mark.parametrize("lens", [WIDE, GENERAL], ids=["wide", "general"])
@pytest.mark.parametrize("spacing", ["theta", "g"])
def test_what_the_rays_show_comes_back_to_their_pixels(lens, spacing):
    """A function of (θ, φ) on the polar map becomes the same function of each pixel's ray."""
    lens, size = lens.to(f64), (60, 66)
    back = PolarView(32, 128, (1, 1), spacing=spacing).pixel_grid(lens, size, (128, 512))
    theta = lens.unproject(back.radii)[0][:, None]
    azimuth = 2 * math.pi * (torch.arange(512, dtype=f64) + 0.5) / 512

    def field(theta, azimuth):
        across, down = theta * torch.cos(azimuth), theta * torch.sin(azimuth)
        return torch.stack(torch.broadcast_tensors(across, down, theta), -1)

    got = polar_to_image(field(theta, azimuth)[None], size=size, layout="tokens", **back._asdict())
    pixels = torch.stack(
        torch.meshgrid(torch.arange(66, dtype=f64), torch.arange(60, dtype=f64), indexing="xy"), -1
    )
    rays = lens.unproject_pixels(pixels[None], size)
    inside = rays[0] < lens.theta_max * 0.99
    assert inside.float().mean() > 0.4
    # Between two rings the field is not quite linear in the radius; θ has a kink in the middle.
    error = (got - field(*rays)).abs()[inside & (rays[0] > 0.1)]
    assert error.max() < 2e-3
    seen = lens.sees(rays[0])
    assert (got[~seen] == 0).all() and (got[seen] != 0).any(-1).all()


EVEN = dict(periodic_bias=True)


@torch.no_grad()
@pytest.mark.parametrize(
    ("name", "options", "turns"),
    [  # the quarter turns that the logits follow exactly
        ("darswin_unet_ra_nano", {}, {1, 2, 3}),
        ("darswin_unet_ra_micro", EVEN, {1, 2, 3}),
        ("darswin_unet_ra_nano", dict(skip_width=8), set()),
        ("darswin_unet_ra_nano", dict(places=True), set()),  # directions do not turn
        ("darswin_unet_a_nano", EVEN, {1, 2, 3}),
    ],
)
def test_a_turned_image_gives_turned_logits(name, options, turns):
    model = network(name, **(dict(skip_width=0, places=False, in_chans=1) | options)).to(f64)
    lens = Spherical.from_fov(0.6, 2.6, 31.0).to(f64)
    # The size is even, because a pixel at the principal point would have no azimuth.
    image = torch.randn(1, 1, 64, 64, dtype=f64)
    logits = model(image, lens)
    for quarters in (1, 2, 3):
        turned = model(image.rot90(quarters, (2, 3)), lens)
        expected = logits.rot90(quarters, (2, 3))
        off = (turned - expected).abs().max() / expected.abs().max()
        assert (off < 1e-9) == (quarters in turns), (quarters, off)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (Polynomial, dict(coefficients=[[16.0, 0.4, -0.1]], center=[[30.3, 33.1]])),
        pytest.param(
            KannalaBrandt,
            dict(focal=[20.0], radial=[[0.02, -0.01]], center=[[30.3, 33.1]]),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_lens_is_learned_through_the_way_back(kind, values):
    """Gradients of the lens against finite differences, through the way back and the model."""
    model = network("darswin_unet_a_nano", in_chans=1, skip_width=8).to(f64).requires_grad_(False)
    images, size = torch.randn(1, 1, 48, 64, dtype=f64), (48, 64)
    labels, weights = torch.randint(5, (1, *size)), torch.rand(1, *size, dtype=f64)
    aside = dict(tangential=[[0.02, 0.01]]) if kind is KannalaBrandt else {}

    def made(*parameters):
        lens = kind(**dict(zip(values, parameters, strict=True)), **aside)
        return lens.with_theta_max(1.4 if aside else 1.9)

    leaves = [torch.tensor(v, dtype=f64, requires_grad=True) for v in values.values()]
    prepared = model.prepare(made(*(leaf.detach().clone() for leaf in leaves)), size)

    for whole in (False, True):

        def loss(*parameters, whole=whole):
            lens = made(*parameters)
            back = model.prepare(lens, size)
            if not whole:
                view = prepared.view._replace(back=back.view.back)
                back = prepared._replace(view=view, tokens=back.tokens)
            logits = model.run(images, back)
            return (F.cross_entropy(logits, labels, reduction="none") * weights).mean() * 100

        assert all((g != 0).all() for g in torch.autograd.grad(loss(*leaves), leaves))
        # The interpolation has kinks: some pixels change their cell even in a small step.
        assert torch.autograd.gradcheck(loss, leaves, eps=1e-7, rtol=1e-3, atol=1e-3)


# -- expansion and heads --------------------------------------------------------------------------


@pytest.mark.parametrize("split", [(1, 4), (2, 2), (4, 1), (4, 4)])
def test_tokens_stand_where_merging_took_them_from(split):
    """An expansion after a merging, both without their layers, gives back the map."""
    dim = 3
    joined = dim * split[0] * split[1]
    merging, expand = PatchMerging(dim, split), PatchExpand(joined, dim, split)
    merging.norm = expand.norm = torch.nn.Identity()
    merging.reduction = expand.expansion = torch.nn.Identity()
    x = torch.randn(2, 8, 16, dim)
    assert torch.equal(expand(merging(x)), x)


@pytest.mark.parametrize("split", [(1, 4), (2, 2), (4, 4)])
def test_each_token_alone_makes_its_part_and_is_normed(split):
    expand, x = PatchExpand(6, 4, split), torch.randn(2, 3, 8, 6)
    out = expand(x)
    assert out.shape == (2, 3 * split[0], 8 * split[1], 4)
    torch.testing.assert_close(expand(x.roll(1, 2)), out.roll(split[1], 2))  # a turned map
    torch.testing.assert_close(out.mean(-1), torch.zeros(out.shape[:3]), atol=1e-6, rtol=0)
    changed = x.clone()
    changed[0, 1, 2] += torch.randn(6)
    differs = (expand(changed) != out).any(-1)
    part = differs[0, split[0] : 2 * split[0], 2 * split[1] : 3 * split[1]]
    assert part.all() and differs.sum() == part.numel() == split[0] * split[1]


def test_joining():
    join = SkipJoin(4, (1, 4))
    x, skip = torch.randn(2, 3, 2, 8, requires_grad=True), torch.randn(2, 3, 8, 4)
    out = join(x, skip.requires_grad_())
    expected = join.expand(x) @ join.fuse.weight[:, :4].T + skip @ join.fuse.weight[:, 4:].T
    torch.testing.assert_close(out, expected + join.fuse.bias)
    out.square().sum().backward()
    assert x.grad.abs().sum() > 0 and skip.grad.abs().sum() > 0


def test_the_skip_adds_what_the_image_shows():
    head = PixelHead(6, 4, in_chans=3, skip_width=8)
    assert head.carried(torch.randn(2, 5, 7, 6)).shape == (2, 5, 7, 8)
    carried, images = torch.randn(2, 8, 9, 7), torch.randn(2, 3, 9, 7)
    out = head.refine(carried, images)
    assert out.shape == (2, 4, 9, 7)
    for index, inputs in enumerate(((carried, images), (images, carried))):
        changed = inputs[0].clone()
        changed[0, :, 4, 3] += 1  # 3×3 convolutions: one after the map, two after the image
        given = (changed, images) if index == 0 else (carried, changed)
        differs = (head.refine(*given) != out).any(1)
        reach = 1 + index
        near = differs[0, 4 - reach : 5 + reach, 3 - reach : 4 + reach]
        assert near.sum() == differs.sum() > 1 + 8 * index
    torch.nn.init.zeros_(head.stem.weight)
    assert torch.equal(head.refine(carried, images), head.refine(carried, 2 * images))
    without = PixelHead(6, 4, in_chans=3, skip_width=0)
    logits = without.carried(torch.randn(2, 9, 7, 6)).permute(0, 3, 1, 2)
    assert logits.shape == out.shape and without.refine(logits, images) is logits
    assert [name for name, _ in without.named_parameters()] == ["proj.weight", "proj.bias"]


def test_distances_are_positive_and_finite():
    head = DistanceHead(6, in_chans=3, skip_width=0, typical_distance=4.0)
    x = torch.tensor([-1e30, -math.inf, -3.0, 0.0, 1e-3, 3.0, 1e30, math.inf])
    meters = head.finish(x)
    assert meters.isfinite().all() and (meters > 0).all()
    torch.testing.assert_close(meters[3:5], 4 * torch.exp(x[3:5]))  # near 0 it equals e^x
    assert meters[0] == meters[1] < 2e-3 and meters[-1] > 10_000
    assert (meters.diff()[1:6] > 0).all()
    assert head.finish(x.bfloat16()).dtype == torch.float32
    assert head.finish(x.double()).dtype == torch.float64


# -- the whole ------------------------------------------------------------------------------------


def test_heads_and_depths_are_options():
    model = create_model("swin_unet_nano", decoder_depths=(1, 3))
    assert [len(stage.blocks) for stage in model.decoder.stages] == [1, 3]
    far = network("darswin_unet_a_nano", task="distance", typical_distance=40.0)
    far.reset_classifier(9)
    assert far.num_classes == 1 and far.distance_head.typical_distance == 40.0
    assert far.get_classifier() is far.head is far.distance_head


@pytest.mark.parametrize("name", ["darswin_unet_a_nano", "darswin_unet_ra_nano"])
def test_older_files_name_the_view_of_darswin(name):
    model, older = (create_model(name, **options) for options in ({}, dict(view="polar")))
    assert model.state_dict().keys() == older.state_dict().keys()
    with pytest.raises(ValueError, match="view must be 'polar', got 'square': a swin_unet takes"):
        create_model(name, view="square")


@torch.no_grad()
@pytest.mark.parametrize(
    ("classifier", "unet", "options"),
    [
        ("darswin_a_micro", "darswin_unet_a_micro", {}),
        ("darswin_ra_nano", "darswin_unet_ra_nano", dict(NANO, rings=8, sectors=32)),
        ("swin_nano", "swin_unet_nano", dict(NANO, image_size=32, patch_size=2)),
        (
            "swin_nano perspective",
            "swin_unet_nano perspective",
            dict(NANO, image_size=32, patch_size=2),
        ),
    ],
)
def test_its_encoder_starts_from_a_trained_classifier(classifier, unet, options):
    trained = create(classifier, num_classes=4).eval()
    for parameter in trained.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    model = create(unet, num_classes=5, **options).eval()
    x, lens = torch.randn(1, 3, 32, 32), Spherical.from_fov(0.5, 2.6, 16.0)
    maps = trained.forward_intermediates(x, lens, intermediates_only=True)
    trained.reset_classifier(0)
    model.encoder.load_state_dict(trained.state_dict())
    got = model.encoder.forward_intermediates(x, lens, intermediates_only=True)
    assert all(torch.equal(a, b) for a, b in zip(got, maps, strict=True))


def test_a_unet_takes_an_encoder():
    refused("encoder must be an Encoder, got int: create_model makes", Unet, 10, error=TypeError)
