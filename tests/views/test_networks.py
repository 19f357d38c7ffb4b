"""Networks on views: adapters, and models that see a view and answer in the pixels of the image."""

import itertools
import math

import pytest
import torch
import torch.nn.functional as F
from helpers import in_turn, network, refused, slow
from torch import nn
from torch.testing import assert_close
from torch.utils._pytree import tree_leaves

from darswin import create_model, frames, optimize
from darswin.deploy import camera
from darswin.deploy.export import export_program
from darswin.lens import BrownConrady, Equidistant, Perspective, Polynomial, Spherical
from darswin.models import LensAdapter, Swin
from darswin.views import CameraView, PlainView, PolarView, View, list_views, make_view

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 24.0)
WIDE = Spherical.from_fov([0.2, 0.9], 2.6, 32.0)


def pixels(height, width):
    """x and y of all pixels, (H, W) each."""
    return torch.meshgrid(torch.arange(float(width)), torch.arange(float(height)), indexing="xy")


def angles(lens, size):
    """θ of the pixels, (N, H, W)."""
    return lens.unproject_pixels(torch.stack(pixels(*size), -1)[None], size)[0]


def smooth(height, width):
    x, y = pixels(height, width)
    return torch.stack((torch.sin(x / 12), torch.cos(y / 12), torch.sin((x + y) / 16)))[None]


def test_a_field_of_view_gives_things_one_size_in_the_square():
    edge, seen = 1.2, []
    wide, square = Equidistant(40.0, 1.5), make_view("square", 32, fov=2 * edge)
    adapter, images = LensAdapter(nn.Identity(), view=square), 2 + smooth(130, 130)
    adapter.network.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
    for lens in (wide, wide.with_theta_max(0.8)):
        out = adapter(images, lens)
        inside = (angles(lens, (130, 130)) <= min(edge, lens.theta_max.item())).expand_as(out)
        assert (out[~inside] == 0).all() and (out[inside] > 0.9).float().mean() > 0.97
    common = seen[1] > 0.9
    assert common.float().mean() == pytest.approx((0.8 / edge) ** 2, abs=0.05)
    assert_close(seen[0][common], seen[1][common])
    # A lens with θ_max at the edge sees the same without a fixed angle.
    lens = wide.with_theta_max(edge)
    same = (view(images, lens) for view in (make_view("square", 32), square))
    assert_close(*same, atol=1e-4, rtol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize("name", ["darswin_a_nano", "darswin_unet_ra_nano"])
def test_with_a_fixed_theta_max_a_wider_lens_sees_the_same_and_more(name):
    wide, images = Equidistant(40.0, 1.5), torch.rand(1, 3, 81, 81)
    narrow, theta = wide.with_theta_max(0.8), angles(wide, (81, 81))[0]
    images[:, :, theta > 0.7] = 0
    # The head's convolutions read two pixels around.
    inside = (theta < 0.7) if "unet" in name else ...
    # Without the fixed angle, the tokens of the narrow lens are smaller.
    for options, is_same in ((dict(theta_max=1.2), True), ({}, False)):
        model = network(name, **options)
        results = [model(images, lens)[..., inside] for lens in (wide, narrow)]
        assert torch.allclose(*results, atol=1e-5 if is_same else 1e-3) == is_same


def test_a_lens_in_float32_sees_as_much_as_in_float64():
    focal = torch.tensor([40.0], dtype=torch.float64)
    exact = BrownConrady(focal, [-0.22, 0.13, 0.028], tangential=[1e-3, 1e-3], center=[25.0, 24.0])
    adapter, images = LensAdapter(nn.Identity(), 192, view="square"), 2 + smooth(48, 52)
    for lens in (exact, exact.to(torch.float32)):
        out = adapter(images, lens)[..., 2:-2, 2:-2]
        assert (out - images[..., 2:-2, 2:-2]).abs().max() < 0.2
    lens, images = LENSES.to(torch.float64), torch.rand(2, 3, 40, 40)
    exact, rounded = adapter(images.double(), lens), adapter(images, LENSES)
    assert exact.dtype == torch.float64
    assert_close(rounded.double(), exact, atol=1e-3, rtol=0)
    half = adapter(images.bfloat16(), LENSES)
    assert half.dtype == torch.bfloat16 and (half - rounded).abs().max() < 0.02


def test_outputs_of_any_resolution_come_back_and_others_pass_through():
    class Nested(nn.Module):
        """A network with masks of several sizes and a label, as those of other libraries."""

        def forward(self, x):
            coarse = F.avg_pool2d(x, 2)
            return dict(masks=[x, (coarse[:, :2],)], label=coarse.mean((2, 3)))

    adapter, images = LensAdapter(Nested(), 32, view="square"), torch.randn(2, 3, 48, 40)
    out, prepared = adapter(images, LENSES), adapter.prepare(LENSES, (48, 40))
    assert [m.shape for m in tree_leaves(out)] == [(2, 3, 48, 40), (2, 2, 48, 40), (2, 3)]
    sampled = adapter.sample(images, prepared)
    assert sampled.shape == (2, 3, 32, 32)
    assert_close(adapter.run_sampled(sampled, prepared), out, rtol=0, atol=0)
    coarse = adapter.view.back(F.avg_pool2d(sampled, 2)[:, :2], prepared.view)
    assert_close(out["masks"][1][0], coarse)
    assert_close(adapter(images, LENSES[:1])["label"][0], out["label"][0])


@torch.no_grad()
def test_a_view_reaches_as_far_as_the_lens_up_to_its_limit():
    picture, end, sharp = torch.rand(1, 1, 64, 64), math.radians(50), dict(supersampling=1)
    narrow, flat = Polynomial([20.0], end), Perspective.from_fov(2 * end, 32)
    expected = CameraView(flat, (64, 64), **sharp)(picture, narrow)
    for lens, reach in ((Polynomial([20.0], math.radians(95)), end), (narrow, math.radians(80))):
        view = make_view("perspective", 64, reach=reach, theta_max=end, **sharp)
        assert_close(view(picture, lens), expected, rtol=0, atol=1e-4)


@torch.no_grad()
def test_a_map_coarser_than_the_image_is_resized():
    model = network("swin_unet_nano", image_size=(128, 64), patch_size=8, skip_width=0)
    images, prepared = torch.randn(2, 3, 128, 64), model.prepare(None, (128, 64))
    maps = model.encoder.forward_intermediates(images, norm=True, intermediates_only=True)
    maps = [x + place for x, place in zip(maps, prepared.tokens, strict=True)]
    x = model.segmentation_head.proj(model.decoder(maps, prepared.tables[3:]))
    assert x.shape == (2, 64, 32, 5)
    expected = F.interpolate(x.permute(0, 3, 1, 2), (128, 64), mode="bilinear")
    assert_close(model(images), expected)


@torch.no_grad()
@pytest.mark.parametrize(
    "view", [dict(name="square", spacing="g"), dict(name="perspective", reach=1.0, theta_max=1.0)]
)
def test_on_a_view_it_is_a_lens_adapter_around_it(view):
    adapted, images = network("swin_unet_nano", view=view), torch.randn(2, 3, 64, 64)
    plain = network("swin_unet_nano")
    plain.load_state_dict(adapted.state_dict())
    result = adapted(images, WIDE)
    assert torch.equal(result, LensAdapter(plain, view=make_view(size=64, **view))(images, WIDE))
    seen = angles(WIDE, (64, 64)) < 0.95  # of 1.3 rad
    assert (result[:, :, 0, 0] == 0).all() and (result.movedim(1, -1)[seen] != 0).all()


@torch.no_grad()
@pytest.mark.parametrize("name", ["mercator", "perspective", "polar"])
def test_a_view_may_have_another_size_than_the_images(name):
    images = torch.rand(2, 3, 32, 32)
    sizes = dict(view=make_view(name, (16, 40)), image_size=32, patch_size=2, window=(4, 5))
    sizes |= dict(depths=(1, 1), num_heads=(1, 2))
    for task in ("segmentation", "distance"):
        model = create_model("swin_unet_nano", task=task, **sizes).eval()
        assert model(images, LENSES).shape == (2, model.num_classes, 32, 32)
        assert model.sample(images, model.prepare(LENSES, (32, 32))).shape[2:] == (16, 40)
    with pytest.raises(ValueError, match=r"image_size, \(H, W\) = \(32, 32\), got \(16, 40\)"):
        model(torch.rand(2, 3, 16, 40), LENSES)


@torch.no_grad()
@pytest.mark.parametrize(
    "view", [None, dict(name="perspective", reach=1.5), dict(name="square", fov=3.0)]
)
def test_the_head_reads_the_rays_of_its_pixels(view):
    name, options = ("swin_unet_nano", dict(view=view)) if view else ("darswin_unet_a_nano", {})
    model, blind = (network(name, rays=rays, **options) for rays in (True, False))
    prepared = model.prepare(WIDE, (64, 64))
    if view:
        expected = model.view.ray_channels(WIDE, (64, 64))
    else:  # those of the image
        rays = WIDE.unproject_points(torch.stack(pixels(64, 64), -1)[None], (64, 64))
        expected = rays.nan_to_num().movedim(-1, 1)
        expected = torch.where(WIDE.sees(angles(WIDE, (64, 64)))[:, None], expected, 0.0)
    assert_close(prepared.rays, expected, rtol=0, atol=1e-5)
    # They are the last three channels of the head's first convolution.
    state, key = model.state_dict(), "segmentation_head.stem.weight"
    state[key] = state[key][:, :3]
    blind.load_state_dict(state)
    images = torch.rand(2, 3, 64, 64)
    result, sampled = model(images, WIDE), model.sample(images, prepared)
    assert_close(model.run_sampled(sampled, prepared, images), result)
    assert not torch.allclose(blind(images, WIDE), result)
    model.head.stem.weight[:, 3:] = 0
    assert_close(blind(images, WIDE), model(images, WIDE))


def test_distances_read_rays_where_there_are_a_lens_and_convolutions():
    for name, options, rays in (
        ("darswin_unet_a_nano", dict(task="distance"), True),
        ("darswin_unet_a_nano", {}, False),
        ("darswin_unet_a_nano", dict(task="distance", rays=False), False),
        ("darswin_unet_a_nano", dict(rays=True, skip_width=0), False),
        ("swin_unet_nano", dict(task="distance", rays=True), False),
    ):
        model = network(name, **options)
        assert model.reads_rays == rays == (model.prepare(WIDE, (64, 64)).rays is not None)
        if model.head.skip_width:
            assert model.head.stem.in_channels == (6 if rays else 3)


def test_tokens_of_a_picture_are_at_the_middles_of_equal_parts():
    places = PlainView((64, 64)).token_positions(None, (2, 4))
    assert_close(places[0], (torch.stack(pixels(2, 4), -1) + 0.5) / torch.tensor([2, 1]) - 1)


@pytest.mark.slow
@torch.no_grad()
def test_a_compiled_model_keeps_nothing_of_a_lens():
    # The view finds what it covers, which differs from lens to lens.
    model = create_model("conv_unet_nano", num_classes=3, widths=(4,), view="mercator", size=16)
    images, lenses = torch.rand(1, 3, 32, 32), [Spherical.from_fov(0.5, f, 16.0) for f in (3, 1.8)]
    expected = [model.eval()(images, lens) for lens in lenses]
    compiled = torch.compile(model, backend="eager")
    run = torch.compile(model.run, backend="eager", fullgraph=True)
    for lens, right in zip(lenses, expected, strict=True):
        assert_close(compiled(images, lens), right, atol=1e-4, rtol=1e-4)
        assert_close(run(images, model.prepare(lens, (32, 32))), right, atol=1e-4, rtol=1e-4)
        assert_close(model(images, lens), right)
    assert_close(model(images, lenses[0]), expected[0])


# -- what dense models say where their view shows nothing ---------------------------------------

SIZE = (48, 64)
LENS = Equidistant(18.0, theta_max=1.45, center=[[31.3, 23.6]], image_size=SIZE)


def by_frames(model, images, folder):
    camera.export_network(model, LENS, SIZE, folder / "n.safetensors")
    frame = images[0].permute(1, 2, 0).contiguous().numpy()
    return torch.from_numpy(frames.Network(folder / "n.safetensors")(frame))[None]


PATHS = {
    "eager": lambda model, images, _: model(images, LENS),
    "optimized": lambda model, images, _: optimize(model)(images, LENS),
    "frames": by_frames,
    "export": lambda model, images, _: export_program(
        model, images, LENS, fixed_lens=True
    ).module()(images),
}
TASKS = ("segmentation", "distance")
# Models, tasks and paths. One view of a picture at a time is enough: a model takes its mask.
DENSE = [
    *itertools.product(["conv_unet_nano"], TASKS, ["eager", "optimized"]),
    *itertools.product(["swin_unet_nano"], TASKS, ["eager", "optimized", "frames"]),
]
DENSE_CASES = [
    *in_turn(DENSE, sorted({*list_views()} - {"none", "tiles", "polar"})),
    *(("darswin_unet_a_nano", *row, "polar") for row in itertools.product(TASKS, [*PATHS][:3])),
    *(("swin_unet_nano", "distance", path, "polar") for path in ("eager", "optimized")),
    *(("adapter", TASKS[0], "eager", name) for name in list_views() if name != "none"),
    pytest.param("conv_unet_nano", "segmentation", "export", "mercator", marks=slow),
    pytest.param("conv_unet_nano", "distance", "export", "panorama", marks=slow),
    pytest.param("swin_unet_nano", "segmentation", "export", "square", marks=slow),
    pytest.param("swin_unet_nano", "distance", "export", "polar", marks=slow),
    *(pytest.param("darswin_unet_a_nano", of, "export", "polar", marks=slow) for of in TASKS),
]


def dense_model(name, task, view):
    if name == "adapter":
        return LensAdapter(nn.Conv2d(3, 4, 4, stride=4), 32, view=view, mean=0.0, std=1.0).eval()
    options = dict(task=task, num_classes=4, mean=0.0, std=1.0)
    if name == "darswin_unet_a_nano":
        options |= dict(theta_max=1.1)
    else:
        options |= dict(view=dict(name=view, size=32))
    if name == "swin_unet_nano":
        options |= dict(image_size=SIZE)
    return create_model(name, **options).eval()


@torch.no_grad()
@pytest.mark.parametrize(("name", "task", "path", "view"), DENSE_CASES)
def test_a_dense_model_has_no_answer_where_its_view_shows_nothing(name, task, path, view, tmp_path):
    model = dense_model(name, task, view)
    images = torch.randint(256, (1, 3, *SIZE), dtype=torch.uint8)
    shown = model.prepare(LENS, SIZE).view.shown[0]
    result = PATHS[path](model, images, tmp_path)
    assert_close(result, model(images, LENS), rtol=1e-3, atol=1e-3)
    assert 0.1 < shown.float().mean() < 0.95 and result[0, :, shown].std() > 0
    if task == "distance":
        assert (result[0, :, shown] > 0).all() and not result[0, :, ~shown].any()
    elif name == "adapter":
        assert not result[0, :, ~shown].any()


THREE = torch.zeros(3, 3, 40, 40)


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: make_view("round", (8, 8)), ValueError, "view must be one of .*, got 'round'"),
        (lambda: make_view("none", (8, 8), fov=1.0), TypeError, "'fov'; it has mean, std"),
        (lambda: make_view("square", (8, 9)), ValueError, r"must be square, got \(8, 9\)"),
        (lambda: make_view("square", 8, spacing="tan")(THREE, Equidistant(9.0, 1.7)), ValueError,
         "spacing='tan' needs lenses"),
        (lambda: make_view("mercator", 8, spacing="g"), TypeError,
         "'mercator' has no option 'spacing'; it has fov, theta_max, up,"),
        (lambda: View().prepare(None, (8, 8)), NotImplementedError, ""),
        (lambda: LensAdapter(nn.Identity()), TypeError, "size must be .*, got None"),
        (lambda: LensAdapter(nn.Identity(), -1), ValueError, "size must be at least 1.*, got"),
        (lambda: LensAdapter(nn.Identity(), view=PolarView()), ValueError, "a view of pixels"),
        (lambda: LensAdapter(nn.Identity(), 8, view=make_view("none", (8, 8)), mean=0.0),
         ValueError, "has its own size and mean"),
        (lambda: LensAdapter(nn.Identity(), 8, output="maps"), ValueError, "output must be"),
        (lambda: LensAdapter(nn.Identity(), 8)(THREE.byte(), LENSES[:1]), TypeError,
         r"images must be in floating point, got torch\.uint8"),
        (lambda: Swin(view=PolarView()), ValueError, "a view of pixels"),
        (lambda: Swin(image_size=32, view=make_view("mercator", (30, 63))), ValueError,
         r"patch_size must divide .* = \(30, 63\), got 2"),
        (lambda: create_model("conv_unet_nano", view="mercator", size=(8, 0)), ValueError,
         r"size must be at least 1 along both axes, got \(8, 0\)"),
        (lambda: create_model("conv_unet_nano", view="tiles", size=8), ValueError, "shows 5"),
    ],
)  # fmt: skip
def test_wrong_views_are_explained(make, kind, message):
    refused(message, make, error=kind)
