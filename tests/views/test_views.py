"""Views of images and the ways back: perspective views, squares, and networks on them."""

import math

import pytest
import torch
import torch.nn.functional as F
from helpers import network
from torch import nn

from darswin import create_model
from darswin.lens import (
    BrownConrady,
    Equidistant,
    KannalaBrandt,
    Perspective,
    Polynomial,
    Spherical,
)
from darswin.lens.concentric import square_to_disc
from darswin.models import LensAdapter
from darswin.views import CameraView, PlainView, make_view

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 24.0)
GENERAL = KannalaBrandt(
    14.0, [0.01], 1.5, center=[22.0, 27.0], affine=[[1.0, 0.1], [0.0, 1.1]], tangential=[0.02, 0.01]
)
WIDE = Spherical.from_fov([0.2, 0.9], 2.6, 32.0)


class Network(nn.Module):
    """A network with masks of several sizes and a label, as those of other libraries."""

    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, 5, 3, padding=1)
        self.down = nn.Conv2d(5, 6, 2, 2)

    def forward(self, x):
        fine = self.conv(x)
        coarse = self.down(fine)
        return dict(masks=[fine, coarse], label=coarse.mean((2, 3)))


def pixels(height, width):
    """x and y of all pixels, (H, W) each."""
    return torch.meshgrid(torch.arange(float(width)), torch.arange(float(height)), indexing="xy")


def smooth(height, width):
    x, y = pixels(height, width)
    return torch.stack((torch.sin(x / 12), torch.cos(y / 12), torch.sin((x + y) / 16)))[None]


@pytest.mark.parametrize(
    "lens", [LENSES, Polynomial([10.0, 0.4], 2.1), GENERAL], ids=["two", "beyond 90°", "general"]
)
@pytest.mark.parametrize("spacing", ["theta", "g", "radius"])
def test_what_is_taken_to_the_square_comes_back(lens, spacing):
    images = smooth(48, 52).expand(2, -1, -1, -1)
    view = make_view("square", 192, spacing=spacing)
    out = LensAdapter(nn.Identity(), view=view)(images, lens)
    theta, _ = lens.unproject_pixels(torch.stack(pixels(48, 52), -1)[None], (48, 52))
    seen = lens.sees(theta).expand(2, -1, -1)[:, None].expand_as(out)
    inner = (theta < 0.9 * lens.theta_max[:, None, None]).expand(2, -1, -1)[:, None]
    inside = torch.zeros(48, 52, dtype=torch.bool)
    inside[4:-4, 4:-4] = True  # near the border of the image, its views are cut
    inner = (inner & inside).expand_as(out)
    assert (out[~seen] == 0).all() and inner.float().mean() > 0.3
    assert (out - images).abs()[inner].max() < 0.02
    coarse = LensAdapter(nn.AvgPool2d(4), view=view)(images, lens)
    assert coarse.shape == images.shape and (coarse - images).abs()[inner].mean() < 0.02


def test_a_field_of_view_gives_things_one_size_in_the_square():
    edge, seen = 1.2, []

    class Network(nn.Module):
        def forward(self, x):
            seen.append(x)
            return x

    wide, square = Equidistant(40.0, 1.5), make_view("square", 32, fov=2 * edge)
    for lens in (wide, wide.with_theta_max(0.8)):
        adapter, images = LensAdapter(Network(), view=square), 2 + smooth(130, 130)
        out = adapter(images, lens)
        theta, _ = lens.unproject_pixels(torch.stack(pixels(130, 130), -1)[None], (130, 130))
        inside = (theta <= min(edge, lens.theta_max.item()))[:, None].expand_as(out)
        assert (out[~inside] == 0).all() and (out[inside] > 0.9).float().mean() > 0.97
    both, common = seen, seen[1] > 0.9
    assert common.float().mean() == pytest.approx((0.8 / edge) ** 2, abs=0.05)
    torch.testing.assert_close(both[0][common], both[1][common])
    # A lens with θ_max at the edge sees the same without a fixed angle.
    lens = wide.with_theta_max(edge)
    views = (make_view("square", 32), square)
    same = (LensAdapter(nn.Identity(), view=view)(images, lens) for view in views)
    torch.testing.assert_close(*same, atol=1e-4, rtol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize("name", ["darswin_a_nano", "darswin_unet_ra_nano"])
def test_with_a_fixed_theta_max_a_wider_lens_sees_the_same_and_more(name):
    model, size = network(name, theta_max=1.2), (81, 81)
    wide = Equidistant(40.0, 1.5)
    narrow = wide.with_theta_max(0.8)
    theta, _ = wide.unproject_pixels(torch.stack(pixels(*size), -1)[None], size)
    images = torch.rand(1, 3, *size)
    images[:, :, theta[0] > 0.7] = 0
    # The head's convolutions read two pixels around.
    inside = (theta[0] < 0.7) if "unet" in name else ...
    found, expected = (model(images, lens)[..., inside] for lens in (wide, narrow))
    torch.testing.assert_close(found, expected)
    # Without the fixed angle, the tokens of the narrow lens are smaller.
    found, expected = (network(name)(images, lens)[..., inside] for lens in (wide, narrow))
    assert not torch.allclose(found, expected, atol=1e-3)


def test_a_lens_in_float32_sees_as_much_as_in_float64():
    focal = torch.tensor([40.0], dtype=torch.float64)
    exact = BrownConrady(focal, [-0.22, 0.13, 0.028], tangential=[1e-3, 1e-3], center=[25.0, 24.0])
    adapter, images = LensAdapter(nn.Identity(), 192, view="square"), 2 + smooth(48, 52)
    for lens in (exact, exact.to(torch.float32)):
        out = adapter(images, lens)[..., 2:-2, 2:-2]
        assert (out - images[..., 2:-2, 2:-2]).abs().max() < 0.2


def test_outputs_of_any_resolution_come_back_and_others_pass_through():
    network = Network().eval()
    adapter, images = LensAdapter(network, 32, view="square"), torch.randn(2, 3, 48, 40)
    prepared = adapter.prepare(LENSES, (48, 40))
    out = adapter.run(images, prepared)
    assert [m.shape for m in out["masks"]] == [(2, 5, 48, 40), (2, 6, 48, 40)]
    assert out["label"].shape == (2, 6)
    sampled = adapter.sample(images, prepared)
    assert sampled.shape == (2, 3, 32, 32)
    again = adapter.run_sampled(sampled, prepared)
    assert all(torch.equal(a, b) for a, b in zip(again["masks"], out["masks"], strict=True))
    again = adapter(images, LENSES)
    assert all(torch.equal(a, b) for a, b in zip(again["masks"], out["masks"], strict=True))
    one = adapter(images, LENSES[:1])
    torch.testing.assert_close(one["label"][0], out["label"][0])


@pytest.mark.parametrize("general", [False, True])
def test_it_trains_end_to_end_with_its_lens(general):
    adapter = LensAdapter(Network(), 32, view="square")
    images = torch.randn(2, 3, 48, 48, requires_grad=True)
    focal = torch.tensor([14.0], requires_grad=True)
    center = torch.tensor([[22.0, 27.0]], requires_grad=True)
    tangential = dict(tangential=[[0.02, 0.01]]) if general else {}
    lens = KannalaBrandt(focal, [[0.01]], 1.5, center=center, **tangential)
    out = adapter(images, lens)
    (out["masks"][0].square().mean() + out["masks"][1].square().mean()).backward()
    for tensor in (images, focal, center, *adapter.parameters()):
        assert tensor.grad.isfinite().all() and tensor.grad.abs().sum() > 0


def test_double_precision_and_half():
    lens, images = LENSES.to(torch.float64), torch.rand(2, 3, 40, 40)
    exact = LensAdapter(nn.Identity(), 64, view="square")(images.double(), lens)
    assert exact.dtype == torch.float64
    rounded = LensAdapter(nn.Identity(), 64, view="square")(images, LENSES)
    torch.testing.assert_close(rounded.double(), exact, atol=1e-3, rtol=0)
    half = LensAdapter(nn.Identity(), 64, view="square")(images.bfloat16(), LENSES)
    assert half.dtype == torch.bfloat16 and (half - rounded).abs().max() < 0.02


def test_wrong_arguments_of_an_adapter():
    for size, error in ((0, ValueError), (-1, ValueError), (2.5, TypeError), ("8", TypeError)):
        with pytest.raises(error, match=r"size must be (at least 1|a pair of ints).*, got"):
            LensAdapter(nn.Identity(), size)
    for options, message in (
        (dict(spacing="r"), r"spacing must be one of .*, got 'r'"),
        (dict(fov=7), r"fov must be in \(0, 2π\] rad, got 7"),
        (dict(spacing="g", fov=2.0), "needs spacing='theta', got 'g'"),
    ):
        with pytest.raises(ValueError, match=message):
            make_view("square", 8, **options)
    adapter, images = LensAdapter(nn.Identity(), 8), torch.zeros(3, 3, 40, 40)
    with pytest.raises(TypeError, match=r"lens must be a darswin\.lens\.Lens, got NoneType"):
        adapter(images, None)
    with pytest.raises(TypeError, match=r"images must be in floating point, got torch\.uint8"):
        adapter(images.byte(), LENSES[:1])
    with pytest.raises(ValueError, match="each of the 3 images, got 2"):
        adapter(images, LENSES)
    with pytest.raises(ValueError, match=r"belongs to images of \(H, W\) = \(20, 20\)"):
        adapter(images, LENSES.replace(image_size=torch.tensor([[20.0, 20.0]] * 2)))
    with pytest.raises(ValueError, match="spacing='tan' needs lenses"):
        make_view("square", 8, spacing="tan")(images, Equidistant(9.0, 1.7))


# -- perspective views ----------------------------------------------------------------------------


def scene(size):
    """A smooth picture (1, 1, size, size)."""
    x, y = (2 * t / (size - 1) - 1 for t in pixels(size, size))
    return (torch.sin(9 * x + 1) * torch.cos(8 * y + 5 * x * y))[None, None]


@torch.no_grad()
def reproject(images, own, lens, size):
    return CameraView(lens, size, supersampling=1)(images, own)


def undistorted(picture, lens, **options):
    """The images that a model gives to its first layer."""
    side, seen = picture.shape[2], []
    view = make_view("perspective", side, **options)
    model = create_model("swin_nano", in_chans=1, image_size=side, view=view).eval()
    model.patch_embed.register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    model(picture, lens)
    return seen[0]


@pytest.mark.parametrize("xi", [0.0, 0.4, 0.9])
def test_the_perspective_image_comes_back(xi):
    fov, side = math.radians(110), 128
    perspective = Perspective.from_fov(fov, side / 2)
    picture = scene(side)
    lens = Spherical.from_fov(xi, fov, side / 2)
    distorted = reproject(picture, perspective, lens, (side, side))
    back = undistorted(distorted, lens, reach=fov / 2, theta_max=fov / 2)
    radius = torch.hypot(*(t - (side - 1) / 2 for t in pixels(side, side)))
    inside = radius <= side / 2 - 2
    error = (back - picture)[0, 0][inside].abs().max()
    assert error < (1e-5 if xi == 0 else 0.02), error
    if xi:  # the distorted picture differs from the original
        assert (distorted - picture)[0, 0][inside].abs().max() > 0.3
    assert not back[0, 0][radius > side / 2 + 1].any()


def test_a_view_reaches_as_far_as_the_lens_up_to_its_limit():
    side, wide = 64, Polynomial([20.0], math.radians(95))
    picture = scene(side)
    end = dict(theta_max=math.radians(50), supersampling=1)
    limited = undistorted(picture, wide, reach=math.radians(50), **end)
    narrow = Polynomial([20.0], math.radians(50))
    expected = reproject(
        picture, narrow, Perspective.from_fov(math.radians(100), side / 2), (side, side)
    )
    torch.testing.assert_close(limited, expected, rtol=0, atol=1e-5)
    of_narrow = undistorted(picture, narrow, reach=math.radians(80), **end)
    torch.testing.assert_close(of_narrow, expected, rtol=0, atol=1e-5)


def test_gradients_reach_the_lens_through_the_view():
    xi = torch.tensor([0.4], requires_grad=True)
    model = create_model("swin_nano", view=make_view("perspective", 32, reach=1.4))
    model(torch.randn(2, 3, 32, 32), Spherical(xi, 12.0, 1.0)).square().sum().backward()
    assert xi.grad.isfinite().all() and xi.grad.all()


# -- Unets on views ------------------------------------------------------------------------------


def of_the_same_weights(model, name, **options):
    other = network(name, **options)
    other.load_state_dict(model.state_dict())
    return other


@torch.no_grad()
def test_a_map_coarser_than_the_image_is_resized():
    model = network("swin_unet_nano", image_size=(128, 64), patch_size=8, skip_width=0)
    images, prepared = torch.randn(2, 3, 128, 64), model.prepare(None, (128, 64))
    maps = model.encoder.forward_intermediates(images, norm=True, intermediates_only=True)
    maps = [x + place for x, place in zip(maps, prepared.tokens, strict=True)]
    x = model.segmentation_head.proj(model.decoder(maps, prepared.tables[3:]))
    assert x.shape == (2, 64, 32, 5)
    expected = F.interpolate(x.permute(0, 3, 1, 2), (128, 64), mode="bilinear")
    torch.testing.assert_close(model(images), expected)


@torch.no_grad()
def test_undistorted_it_predicts_in_the_view_and_brings_back():
    seen = dict(name="perspective", reach=1.0, theta_max=1.0)
    undis = network("swin_unet_nano", view=seen)
    plain = of_the_same_weights(undis, "swin_unet_nano")
    images = torch.randn(2, 3, 64, 64)
    half = torch.full((2,), 1.0)  # the view shows 2.0 rad of the 2.6 rad
    view = Perspective(32 / torch.tan(half), half)
    logits = plain(reproject(images, WIDE, view, (64, 64)))
    found, inner = (
        reproject(maps, view, WIDE, (64, 64)) for maps in (logits, torch.ones_like(logits))
    )
    whole = inner > 0.9999  # beside its border, where a map that is sampled mixes with 0
    torch.testing.assert_close(undis(images, WIDE)[whole], found[whole], rtol=1e-4, atol=1e-4)
    assert whole.float().mean() > 0.3
    theta, _ = WIDE.unproject_pixels(torch.tensor([[[0.0, 32.0]]]), (64, 64))
    assert (theta > 1.0).all() and (undis(images, WIDE)[:, :, 32, 0] == 0).all()


@torch.no_grad()
@pytest.mark.parametrize("spacing", ["theta", "g", "radius"])
def test_adapted_it_is_a_lens_adapter_around_it(spacing):
    adapted = network("swin_unet_nano", view=dict(name="square", spacing=spacing))
    plain = of_the_same_weights(adapted, "swin_unet_nano")
    images = torch.randn(2, 3, 64, 64)
    got = adapted(images, WIDE)
    view = make_view("square", 64, spacing=spacing)
    assert torch.equal(got, LensAdapter(plain, view=view)(images, WIDE))
    assert (got[:, :, 0, 0] == 0).all() and (got[:, :, 32, 1] != 0).all()


def rays_of_the_image(lens, size):
    points = torch.stack(pixels(size, size), -1)
    return lens.unproject_points(points[None], (size, size))


def rays_of_the_perspective_view(lens, size):
    return rays_of_the_image(Perspective(size / 2 / torch.tan(lens.theta_max), 1.5), size)


def rays_of_the_square(lens, size, edge=None):
    step = (torch.arange(size) + 0.5) * 2 / size - 1
    radius, direction = square_to_disc(torch.stack(torch.meshgrid(step, step, indexing="xy"), -1))
    edge = lens.theta_max if edge is None else torch.full((2,), edge)
    theta = edge[:, None, None, None] * radius[..., None]
    return torch.cat((theta.sin() * direction, theta.cos()), -1)


def rays_of_the_fixed_square(lens, size):
    return rays_of_the_square(lens, size, 1.5)


@torch.no_grad()
@pytest.mark.parametrize(
    ("name", "options", "rays_of"),
    [
        ("darswin_unet_a_nano", {}, rays_of_the_image),
        (
            "swin_unet_nano",
            dict(view=dict(name="perspective", reach=1.5)),
            rays_of_the_perspective_view,
        ),
        ("swin_unet_nano square", {}, rays_of_the_square),
        ("swin_unet_nano", dict(view=dict(name="square", fov=3.0)), rays_of_the_fixed_square),
    ],
)
def test_the_head_reads_the_rays_of_its_pixels(name, options, rays_of):
    model, blind = (network(name, rays=rays, **options) for rays in (True, False))
    prepared = model.prepare(WIDE, (64, 64))
    rays, expected = prepared.rays, rays_of(WIDE, 64).movedim(-1, 1)
    seen = expected[:, 2:] >= WIDE.theta_max.cos()[:, None, None, None] - 1e-6
    assert seen.any() and seen.all() == (rays_of is rays_of_the_square)
    torch.testing.assert_close(rays, torch.where(seen, expected, 0.0), rtol=0, atol=1e-5)
    # They are the last three channels of the head's first convolution.
    state, key = model.state_dict(), "segmentation_head.stem.weight"
    state[key] = state[key][:, :3]
    blind.load_state_dict(state)
    images = torch.rand(2, 3, 64, 64)
    result, sampled = model(images, WIDE), model.sample(images, prepared)
    torch.testing.assert_close(model.run_sampled(sampled, prepared, images), result)
    assert not torch.allclose(blind(images, WIDE), result)
    model.head.stem.weight[:, 3:] = 0
    torch.testing.assert_close(blind(images, WIDE), model(images, WIDE))


@pytest.mark.parametrize(
    ("name", "options", "rays"),
    [
        ("darswin_unet_a_nano", dict(task="distance"), True),
        ("darswin_unet_a_nano", {}, False),
        ("darswin_unet_a_nano", dict(task="distance", rays=False), False),
        ("darswin_unet_a_nano", dict(rays=True, skip_width=0), False),
        ("swin_unet_nano", dict(task="distance", rays=True), False),
    ],
)
def test_distances_read_rays_where_there_are_a_lens_and_convolutions(name, options, rays):
    model = network(name, **options)
    assert model.reads_rays == rays == (model.prepare(WIDE, (64, 64)).rays is not None)
    if model.head.skip_width:
        assert model.head.stem.in_channels == (6 if rays else 3)


def test_tokens_of_a_picture_are_at_the_middles_of_equal_parts():
    places = PlainView((64, 64)).token_positions(None, (2, 4))
    x, y = torch.tensor([-0.75, -0.25, 0.25, 0.75]), torch.tensor([-0.5, 0.5])
    expected = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    torch.testing.assert_close(places, expected[None])
