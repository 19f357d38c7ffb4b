"""What holds for every view that is registered, and for the ways to make one."""

from inspect import signature

import pytest
import torch
import torch.nn.functional as F
from helpers import product
from torch import nn
from torch.utils._pytree import tree_leaves

from darswin import create_model
from darswin.lens import Equidistant, KannalaBrandt, Polynomial, Spherical
from darswin.models import LensAdapter, Swin
from darswin.views import (
    PixelView,
    PolarView,
    RayView,
    TilesView,
    View,
    list_views,
    make_view,
    register_view,
)
from darswin.views.registry import _VIEWS, view_class

LENSES = {
    "two": Spherical.from_fov([0.2, 0.9], 2.6, 24.0),
    "beyond 90°": Polynomial([13.0, 0.4], 2.0, [26.0, 22.0]),
    "general": KannalaBrandt(
        14.0, [0.01], 1.5, center=[24.0, 25.0], affine=[[1.0, 0.1], [0.0, 1.1]],
        tangential=[0.02, 0.01],
    ),
}  # fmt: skip
SIZE = (48, 52)
OF_RAYS = [name for name in list_views() if "direction" in signature(view_class(name)).parameters]
ONE_PICTURE = [name for name in list_views() if name != "tiles"]
every_view = pytest.mark.parametrize("name", list_views())


def smooth():
    x, y = torch.meshgrid(torch.arange(52.0), torch.arange(48.0), indexing="xy")
    return torch.stack((torch.sin(x / 12), torch.cos(y / 12), torch.sin((x + y) / 16)))[None]


def angles(lens):
    """θ of the pixels of the images, (N, H, W)."""
    x, y = torch.meshgrid(torch.arange(52.0), torch.arange(48.0), indexing="xy")
    return lens.unproject_pixels(torch.stack((x, y), -1)[None], SIZE)[0]


@torch.no_grad()
@pytest.mark.parametrize(("name", "kind"), product(list_views(), LENSES))
def test_what_is_seen_comes_back_also_from_coarser_maps(name, kind):
    lens = LENSES[kind]
    view, images = make_view(name, (192, 192)), smooth().expand(lens.count, -1, -1, -1)
    prepared = view.prepare(lens, SIZE)
    seen = view.see(images, prepared)
    shape = (lens.count * view.count, 3, 192, 192) if view.uses_lens else images.shape
    assert seen.shape == shape
    assert torch.equal(seen, view(images, lens))
    theta = angles(lens)
    # A perspective view ends before 90°, and the picture cuts the views near its border.
    inner = (theta < lens.theta_max[:, None, None].clamp(max=1.4) * 0.9)[:, None]
    inner = inner.expand_as(images) & F.pad(torch.ones(40, 44), (4,) * 4).bool()
    if isinstance(view, RayView | TilesView):  # maps of the sphere end above and below
        height = 192 * view.count
        shown = (prepared.back > 3) & (prepared.back < torch.tensor([188.0, height - 4.0]))
        inner &= shown.all(-1)[:, None]
    assert inner.float().mean() > (0.1 if name == "perspective" else 0.2)
    back = view.back(seen, prepared)
    assert back.shape == images.shape and (back - images).abs()[inner].max() < 0.1
    coarse = view.back(F.avg_pool2d(seen, 2), prepared)
    assert coarse.shape == images.shape and (coarse - images).abs()[inner].mean() < 0.05
    beyond = ~lens.sees(theta)[:, None].expand_as(images)
    if view.uses_lens and beyond.any():
        assert not back[beyond].any() and not coarse[beyond].any()


@torch.no_grad()
@pytest.mark.parametrize(("name", "kind"), product(list_views(), LENSES))
def test_the_rays_of_the_views_pixels_land_where_the_view_reads(name, kind):
    lens = LENSES[kind]
    size = SIZE if name == "none" else (24, 24)
    # Single points: the mean of several is not where the ray lands.
    view = make_view(name, size, supersampling=1 if name in OF_RAYS else None)
    prepared = view.prepare(lens, SIZE)
    rays = view.ray_channels(lens, SIZE).movedim(1, -1)
    landed = rays.norm(dim=-1) > 0.5
    torch.testing.assert_close(rays[landed].norm(dim=-1), torch.ones(int(landed.sum())))
    points = lens.project_points(rays.expand(lens.count, -1, -1, -1), SIZE)
    # Each pixel is marked with its own x and y, so that a view of it shows where it was read.
    x, y = torch.meshgrid(torch.arange(52.0), torch.arange(48.0), indexing="xy")
    marked = torch.stack((x, y))[None].expand(lens.count, -1, -1, -1)
    seen = view.see(marked, prepared).movedim(1, -1)
    seen = seen.unflatten(0, (-1, view.count)).flatten(1, 2)  # tiles are below each other
    inside = landed & (points > 0).all(-1) & (points < points.new_tensor([51.0, 47.0])).all(-1)
    assert inside.float().mean() > (0.05 if name == "panorama" else 0.3)
    # The ray of a token is that of the radial curve; other distortions of the lens are ignored.
    radial = lens.is_radial and lens.affine is None
    if radial or not isinstance(view, PolarView):
        torch.testing.assert_close(seen[inside], points[inside], rtol=0, atol=2e-3)


@torch.no_grad()
@pytest.mark.parametrize(("name", "kind"), product(list_views(), LENSES))
def test_autocast_moves_no_point(name, kind):
    view = make_view(name, (32, 40) if name not in ("none", "square") else (48, 48))
    size = (48, 48) if name == "none" else SIZE

    def found():
        lens = LENSES[kind]
        others = view.ray_channels(lens, size), view.token_positions(lens, (4, 8))
        return tree_leaves((view.prepare(lens, size), others))

    want = found()
    with torch.autocast("cpu", torch.bfloat16):
        pairs = zip(found(), want, strict=True)
    for one, other in pairs:
        if isinstance(one, torch.Tensor):
            torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


@every_view
def test_gradients_reach_images_and_lens(name):
    focal = torch.tensor([14.0], requires_grad=True)
    images = torch.randn(2, 3, *SIZE, requires_grad=True)
    view = make_view(name, (16, 16))
    prepared = view.prepare(Equidistant(focal, 1.5), SIZE)
    view.back(view.see(images, prepared), prepared).square().sum().backward()
    assert images.grad.isfinite().all() and images.grad.any()
    if view.uses_lens:
        assert focal.grad.isfinite().all() and focal.grad.all()


@torch.no_grad()
@every_view
def test_frames_of_uint8_are_normalized(name):
    view = make_view(name, SIZE if name == "none" else (16, 16), mean=(0.4, 0.5, 0.6), std=0.25)
    frames = torch.randint(256, (2, *SIZE, 3), dtype=torch.uint8)
    planes = (
        frames.permute(0, 3, 1, 2) / 255 - torch.tensor([0.4, 0.5, 0.6])[:, None, None]
    ) / 0.25
    lens = LENSES["two"]
    torch.testing.assert_close(view(frames, lens), view(planes, lens), rtol=1e-4, atol=1e-4)
    exact = view.see(frames.permute(0, 3, 1, 2), view.prepare(lens, SIZE), torch.float64)
    assert exact.dtype == torch.float64
    torch.testing.assert_close(exact.float(), view(planes, lens), rtol=1e-4, atol=1e-4)
    refuses = make_view(name, (16, 16), mean=None, std=None)
    with pytest.raises((TypeError, ValueError), match="mean"):
        refuses(frames, lens)


@every_view
@pytest.mark.parametrize(
    ("mean", "std", "message"),
    [
        (0.5, 0.0, r"std must be positive, got 0\.0"),
        ((0.1, 0.2), (0.1, 0.2, 0.3), r"mean must be one number or one per channel \(3\)"),
        (None, 0.5, "mean and std must be given together, got None and 0.5"),
    ],
)
def test_wrong_statistics_are_refused_before_any_image(name, mean, std, message):
    with pytest.raises(ValueError, match=message):
        make_view(name, (16, 16), mean=mean, std=std)


@torch.no_grad()
@every_view
def test_an_adapter_and_a_swin_see_every_view(name):
    lens, images = LENSES["two"], torch.rand(2, 3, *SIZE)
    for given in (dict(size=SIZE if name == "none" else 32, view=name),
                  dict(view=make_view(name, SIZE if name == "none" else (32, 32)))):  # fmt: skip
        adapter = LensAdapter(nn.Conv2d(3, 5, 3, padding=1), **given)
        prepared = adapter.prepare(lens, SIZE)
        result = adapter(images, lens)
        assert result.shape == (2, 5, *SIZE)
        sampled = adapter.sample(images, prepared)
        assert torch.equal(sampled, adapter.view(images, lens))
        assert torch.equal(adapter.run_sampled(sampled, prepared), result)
        assert adapter.uses_lens == (name != "none")
    options = dict(depths=(1, 1), num_heads=(1, 2), embed_dim=8, image_size=32, view=name)
    if name == "tiles":
        with pytest.raises(ValueError, match="one picture of each image, but the view shows 5"):
            Swin(4, **options)
        return
    model = Swin(4, **options).eval()
    assert model(images[..., :32, :32], Equidistant(14.0, 1.2)).shape == (2, 4)


@torch.no_grad()
@pytest.mark.parametrize("name", ONE_PICTURE)
def test_a_unet_sees_every_view_and_brings_its_result_back(name):
    options = dict(image_size=32, patch_size=2, window=(2, 2), task="distance", rays=True)
    for skip_width in (32, 0):
        model = create_model("swin_unet_nano", view=name, skip_width=skip_width, **options).eval()
        lens, images = LENSES["two"], torch.rand(2, 3, 32, 32)
        prepared = model.prepare(lens, (32, 32))
        result = model.run(images, prepared)
        assert result.shape == (2, 1, 32, 32) and result.isfinite().all()
        assert torch.equal(model.run_sampled(model.sample(images, prepared), prepared), result)


@torch.no_grad()
@pytest.mark.parametrize(("name", "kind"), product(ONE_PICTURE, LENSES))
def test_the_convolutional_unet_sees_pixels_and_rays_of_every_view(name, kind):
    lens = LENSES[kind]
    model = create_model(
        "conv_unet_nano", widths=(4, 6), view=name, size=32, task="distance"
    ).eval()
    plain = create_model("conv_unet_nano", widths=(4, 6), in_chans=6, rays=False, num_classes=1)
    weights = model.state_dict()
    plain.load_state_dict({k.replace("distance", "segmentation"): v for k, v in weights.items()})
    images = torch.rand(lens.count, 3, *SIZE)
    prepared = model.prepare(lens, SIZE)
    logits = plain.eval()(torch.cat((model.view.see(images, prepared.view), prepared.rays), 1))
    expected = model.head.finish(model.view.back(logits, prepared.view), prepared.view.shown)
    assert torch.equal(model(images, lens), expected)
    assert expected.shape == (lens.count, 1, *SIZE) and expected.std() > 0
    assert torch.equal(model.run_sampled(model.sample(images, prepared), prepared), expected)


@torch.no_grad()
@pytest.mark.parametrize("name", ["mercator", "perspective", "polar"])
def test_a_view_may_have_another_size_than_the_images(name):
    lens, images = LENSES["two"], torch.rand(2, 3, 32, 32)
    view = make_view(name, (16, 40))
    options = dict(view=view, image_size=32, patch_size=2, window=(4, 5))
    for task in ("segmentation", "distance"):
        model = create_model(
            "swin_unet_nano", depths=(1, 1), num_heads=(1, 2), task=task, **options
        )
        assert model.eval()(images, lens).shape == (2, model.num_classes, 32, 32)
        assert model.sample(images, model.prepare(lens, (32, 32))).shape[2:] == (16, 40)
    with pytest.raises(ValueError, match=r"image_size, \(H, W\) = \(32, 32\), got \(16, 40\)"):
        model(torch.rand(2, 3, 16, 40), lens)


@torch.no_grad()
@pytest.mark.parametrize("name", ONE_PICTURE)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float64])
def test_networks_of_every_dtype_get_frames_of_uint8_in_their_dtype(name, dtype):
    frames, lens = torch.randint(256, (2, 32, 32, 3), dtype=torch.uint8), Equidistant(14.0, 1.2)
    conv = nn.Conv2d(3, 5, 3, padding=1)
    for model in (
        LensAdapter(conv, 32, view=name, mean=0.4, std=0.2),
        Swin(4, depths=(1, 1), num_heads=(1, 2), embed_dim=8, image_size=32, view=name),
    ):
        model = model.to(dtype).eval()
        prepared = model.prepare(lens, (32, 32))
        sampled, result = model.sample(frames, prepared), model(frames, lens)
        assert sampled.dtype == result.dtype == dtype
        assert torch.equal(model.run_sampled(sampled, prepared), result)


class AnyRatio(PixelView):
    """The picture of an equidistant lens, on an image of any size."""

    def of(self, lens):
        return Equidistant(min(self.size) / 2 / lens.theta_max, lens.theta_max)

    def to_rays(self, points, lens, size):
        return self.of(lens).unproject_points(points, self.size)

    def to_points(self, rays, lens, size):
        return self.of(lens).project_points(rays, self.size)


@torch.no_grad()
def test_a_view_of_ones_own_needs_two_methods(monkeypatch):
    monkeypatch.setitem(_VIEWS, "own", AnyRatio)
    test_what_is_seen_comes_back_also_from_coarser_maps("own", "general")
    with torch.enable_grad():
        test_gradients_reach_images_and_lens("own")
    test_the_rays_of_the_views_pixels_land_where_the_view_reads("own", "two")
    test_frames_of_uint8_are_normalized("own")
    test_an_adapter_and_a_swin_see_every_view("own")
    test_a_unet_sees_every_view_and_brings_its_result_back("own")
    test_networks_of_every_dtype_get_frames_of_uint8_in_their_dtype("own", torch.bfloat16)
    assert repr(make_view("own", (24, 32))) == "AnyRatio(size=(24, 32))"
    monkeypatch.setitem(_VIEWS, "own", lambda _size: View())
    with pytest.raises(TypeError, match="'own' has no option 'mean'; it has none"):
        make_view("own", (24, 32))


def test_a_view_of_ones_own_has_a_name():
    @register_view("tall polar")
    def tall(size, **options):
        return PolarView(*size, samples=(2, 1), layout="image", **options)

    try:
        adapter = LensAdapter(nn.Identity(), (16, 8), view="tall polar")
        assert adapter.view.map_size == (32, 8)
        assert adapter(torch.rand(1, 3, *SIZE), LENSES["beyond 90°"]).shape == (1, 3, *SIZE)
    finally:
        del _VIEWS["tall polar"]


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: make_view("round", (8, 8)), ValueError, "view must be one of .*, got 'round'"),
        (lambda: make_view("none", (8, 8), fov=1.0), TypeError, "'fov'; it has mean, std"),
        (lambda: make_view("square", (8, 9)), ValueError, r"must be square, got \(8, 9\)"),
        (lambda: make_view("square", (8, 8), mean=0.5, std=None), ValueError, "given together"),
        (lambda: make_view("perspective", 8, fov=1.0, reach=0.5), ValueError,
         "either fov or reach, got 1.0 and 0.5"),
        (lambda: LensAdapter(nn.Identity()), TypeError, "size must be .*, got None"),
        (lambda: LensAdapter(nn.Identity(), (8, 8, 8)), TypeError, r"size must be .*\(8, 8, 8\)"),
        (lambda: LensAdapter(nn.Identity(), 8, view="round"), ValueError, "view must be one of"),
        (lambda: LensAdapter(nn.Identity(), view=PolarView()), ValueError, "a view of pixels"),
        (lambda: LensAdapter(nn.Identity(), 8, view=make_view("none", (8, 8))), ValueError,
         "has its own size"),
        (lambda: LensAdapter(nn.Identity(), 8, view=make_view("none", (8, 8)), mean=0.0),
         ValueError, "has its own size and mean"),
        (lambda: LensAdapter(nn.Identity(), 8, output="maps"), ValueError, "output must be"),
        (lambda: Swin(view=PolarView()), ValueError, "a view of pixels"),
        (lambda: Swin(image_size=32, view=make_view("mercator", (30, 63))), ValueError,
         r"patch_size must divide .* = \(30, 63\), got 2"),
        (lambda: create_model("conv_unet_nano", view="mercator", size=(8, 0)), ValueError,
         r"size must be at least 1 along both axes, got \(8, 0\)"),
        (lambda: create_model("conv_unet_nano", view="tiles", size=8), ValueError, "shows 5"),
        (lambda: make_view("mercator", 8, spacing="g"), TypeError,
         "'mercator' has no option 'spacing'; it has fov, theta_max, up,"),
        (lambda: View().prepare(None, (8, 8)), NotImplementedError, ""),
    ],
)  # fmt: skip
def test_wrong_views_are_explained(make, kind, message):
    with pytest.raises(kind, match=message):
        make()


@pytest.mark.parametrize("name", sorted(set(list_views()) - {"none"}))
def test_views_refuse_other_lenses_and_pixels_of_another_size(name):
    view = make_view(name, (16, 16))
    lens, images = LENSES["two"], torch.rand(3, 3, *SIZE)
    with pytest.raises(ValueError, match="each of the 3 images, got 2"):
        view(images, lens)
    with pytest.raises(TypeError, match=r"lens must be a darswin\.lens\.Lens, got NoneType"):
        view(images)
    prepared = view.prepare(lens, SIZE)
    with pytest.raises(ValueError, match="each of the 3 images, got 2"):
        view.check_seen(torch.rand(3 * view.count, 3, 16, 16), prepared, 3)
    with pytest.raises(ValueError, match=r"\(H, W\) = \(16, 16\), got \(16, 17\)"):
        view.check_seen(torch.rand(2, 3, 16, 17), prepared, 3)
