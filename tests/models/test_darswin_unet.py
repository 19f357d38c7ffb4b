import math

import pytest
import torch
import torch.nn.functional as F

from darswin import create_model, polar_grid
from darswin.layers.polar import PolarGridSpec
from darswin.lens import KannalaBrandt, Mei, Polynomial, Spherical
from darswin.ops import polar_to_image

f64 = torch.float64
WIDE = Polynomial([16.0, 0.4, -0.1, 0.05], 2.0, [30.0, 35.0])  # θ_max = 115°, off centre
GENERAL = Mei(
    1.5, 60.0, [0.02, 0.01], 1.4, [30.0, 35.0], tangential=[0.02, -0.01],
    affine=[[1.0, 0.05], [0.0, 1.1]],
)  # fmt: skip


def network(name="darswin_unet_a_nano", **options):
    model = create_model(name, **(dict(num_classes=4) | options)).eval()
    for key, parameter in model.named_parameters():
        spread = 1.0 if parameter.dim() == 1 and key.endswith("weight") else 0.0
        torch.nn.init.normal_(parameter, mean=spread, std=0.1)
    return model


@torch.no_grad()
@pytest.mark.parametrize("lens", [WIDE, GENERAL], ids=["wide", "general"])
def test_projecting_first_is_projecting_on_the_pixels(lens):
    """A linear layer commutes with the interpolation, to rounding."""
    model = network(skip_width=0)
    x, size = torch.randn(2, 64, 256, 24), (64, 64)
    back = model.view.prepare(lens, size).back
    first = model.view.to_pixels(model.segmentation_head.proj(x), back, size)
    pixels = model.view.to_pixels(x, back, size)
    proj = model.segmentation_head.proj
    after = F.linear(pixels.permute(0, 2, 3, 1), proj.weight, proj.bias).permute(0, 3, 1, 2)
    # Beyond θ_max a map is 0, and the bias alone is left of what is projected after.
    beyond = (pixels == 0).all(1, keepdim=True).expand_as(after)
    assert 0.02 < beyond.float().mean() < 0.7 and (first[beyond] == 0).all()
    torch.testing.assert_close(first[~beyond], after[~beyond], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("spacing", ["theta", "tan", "g", "radius"])
def test_the_decoders_rings_are_those_of_the_grid(spacing):
    """Four to a ring: the samples of a grid of 4 × 4 samples a token stand at their centres."""
    lens = Spherical.from_fov([0.1, 0.9], 2.6, 32.0)
    model = create_model("darswin_unet_ra_nano", spacing=spacing, sample_spacing="radius")
    way, _ = model.view.prepare(lens, (64, 64)).back
    grid = polar_grid(lens, (64, 64), rings=16, sectors=64, samples=(4, 4), spacing=spacing,
                      sample_spacing="radius")  # fmt: skip
    torch.testing.assert_close(way.radii, grid.radii)
    assert torch.equal(way.center, grid.center) and torch.equal(way.r_max, lens.r_max)
    # `polar_to_image` takes sector a to be where the samples of column a stand.
    assert torch.allclose(grid.azimuths, 2 * math.pi * (torch.arange(256) + 0.5) / 256)


@torch.no_grad()
@pytest.mark.parametrize("lens", [WIDE, GENERAL], ids=["wide", "general"])
@pytest.mark.parametrize("spacing", ["theta", "g"])
def test_what_the_rays_show_comes_back_to_their_pixels(lens, spacing):
    """A field of (θ, φ) on the rings and sectors, brought back, is that of each pixel's ray."""
    lens, size = lens.to(f64), (60, 66)
    way = PolarGridSpec(32, 1, (1, 1), spacing).pixel_grid(lens, size, split=4)
    theta = lens.unproject(way.radii)[0][:, None]
    azimuth = 2 * math.pi * (torch.arange(512, dtype=f64) + 0.5) / 512

    def field(theta, azimuth):
        across, down = theta * torch.cos(azimuth), theta * torch.sin(azimuth)
        return torch.stack(torch.broadcast_tensors(across, down, theta), -1)

    got = polar_to_image(field(theta, azimuth)[None], size=size, layout="tokens", **way._asdict())
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
        ("darswin_unet_ra_nano", dict(places=True), set()),  # it knows which way is up
        ("darswin_unet_a_nano", EVEN, {1, 2, 3}),
    ],
)
def test_a_turned_image_gives_turned_logits(name, options, turns):
    model = network(name, **(dict(skip_width=0, places=False, in_chans=1) | options)).to(f64)
    lens = Spherical.from_fov(0.6, 2.6, 31.0).to(f64)
    image = torch.randn(1, 1, 64, 64, dtype=f64)  # a pixel at the very middle has no azimuth
    logits = model(image, lens)
    for quarters in (1, 2, 3):
        turned = model(image.rot90(quarters, (2, 3)), lens)
        expected = logits.rot90(quarters, (2, 3))
        off = (turned - expected).abs().max() / expected.abs().max()
        assert (off < 1e-9) == (quarters in turns), (quarters, off)


@pytest.mark.parametrize("size", [(64, 64), (37, 80), (90, 64), (1, 1)])
@pytest.mark.parametrize("lens", [WIDE, GENERAL], ids=["wide", "general"])
def test_any_image_size(size, lens):
    model = network()
    images = torch.randn(2, 3, *size, requires_grad=True)
    out = model(images, lens)
    assert out.shape == (2, 4, *size) and out.isfinite().all()
    out.square().sum().backward()
    assert images.grad.isfinite().all() and images.grad.abs().sum() > 0


def kannala_brandt(focal, radial, center):
    lens = KannalaBrandt(focal, radial, center=center, tangential=[[0.02, 0.01]])
    return lens.with_theta_max(1.4)


def polynomial(coefficients, center):
    return Polynomial(coefficients, 1.9, center)


@pytest.mark.parametrize(
    ("make", "values"),
    [
        (polynomial, dict(coefficients=[[16.0, 0.4, -0.1]], center=[[30.3, 33.1]])),
        (kannala_brandt, dict(focal=[20.0], radial=[[0.02, -0.01]], center=[[30.3, 33.1]])),
    ],
)
def test_a_lens_is_learned_through_the_way_back(make, values):
    """Against central differences, with the encoder's part left out and in."""
    model = network(in_chans=1).to(f64).requires_grad_(False)
    images, size = torch.randn(1, 1, 48, 64, dtype=f64), (48, 64)
    labels = torch.randint(4, (1, *size))
    weights = torch.rand(1, *size, dtype=f64)
    fixed = make(**{k: torch.tensor(v, dtype=f64) for k, v in values.items()})
    prepared = model.prepare(fixed, size)

    def loss(whole: bool, **parameters):
        lens = make(**parameters)
        if whole:
            logits = model(images, lens)
        else:
            logits = model.run(images, prepared._replace(way=model.view.prepare(lens, size)))
        return (F.cross_entropy(logits, labels, reduction="none") * weights).mean() * 100

    for whole in (False, True):
        leaves = {k: torch.tensor(v, dtype=f64, requires_grad=True) for k, v in values.items()}
        gradients = torch.autograd.grad(loss(whole, **leaves), list(leaves.values()))
        for (name, value), gradient in zip(leaves.items(), gradients, strict=True):
            assert gradient.isfinite().all() and (gradient != 0).all()
            # Pixels change their cell somewhere in any step: no closer than a few percent.
            for k in range(value.numel()):
                ends = []
                for sign in (-1, 1):
                    moved = {n: v.detach().clone() for n, v in leaves.items()}
                    moved[name].view(-1)[k] += sign * 1e-7
                    ends.append(loss(whole, **moved))
                difference = ((ends[1] - ends[0]) / 2e-7).item()
                got = gradient.view(-1)[k].item()
                assert abs(got - difference) < 1e-3 * max(1.0, abs(difference)), (name, k)


def test_compat_is_not_for_unets():
    with pytest.raises(ValueError, match="got 'official' for Unet"):
        create_model("darswin_unet_a_nano", compat="official")
