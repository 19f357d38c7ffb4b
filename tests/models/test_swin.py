import math

import pytest
import torch

from darswin import create_model
from darswin.lens import Perspective, Polynomial, Spherical
from darswin.lens.pixels import reproject
from darswin.ops import use_reference

LENS = Spherical.from_fov([0.2, 0.9], 2.0, 16.0)


def nano(name="swin_nano", **options):
    return create_model(name, **(dict(num_classes=10) | options))


def images(batch=2, height=32, width=32):
    return torch.randn(batch, 3, height, width)


def scene(size):
    """A smooth picture (1, 1, size, size)."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, size), torch.linspace(-1, 1, size), indexing="ij")
    return (torch.sin(9 * x + 1) * torch.cos(8 * y + 5 * x * y))[None, None]


def circle(size, radius):
    y, x = torch.meshgrid(*[torch.arange(size) - (size - 1) / 2] * 2, indexing="ij")
    return torch.hypot(x, y) <= radius


@pytest.mark.parametrize("name", ["swin_small", "swin_undis_small"])
@pytest.mark.parametrize(("classes", "parameters"), [(200, 48_953_762), (1000, 49_568_962)])
def test_parameter_counts(name, classes, parameters):
    with torch.device("meta"):
        model = create_model(name, num_classes=classes)
    assert sum(p.numel() for p in model.parameters()) == parameters


def test_stages_of_the_small_model():
    with torch.device("meta"):
        model = create_model("swin_small")
    sizes = [[(b.attn.map_size, b.attn.window, b.attn.shift) for b in s.blocks[:2]]
             for s in model.stages]  # fmt: skip
    assert sizes == [
        [((32, 32), (4, 4), (0, 0)), ((32, 32), (4, 4), (2, 2))],
        [((16, 16), (4, 4), (0, 0)), ((16, 16), (4, 4), (2, 2))],
        [((8, 8), (4, 4), (0, 0)), ((8, 8), (4, 4), (2, 2))],
        [((4, 4), (4, 4), (0, 0)), ((4, 4), (4, 4), (0, 0))],
    ]


def test_stochastic_depth_rises_from_block_to_block():
    model = nano(drop_path_rate=0.3)
    rates = [block.drop_path.p for stage in model.stages for block in stage.blocks]
    assert rates == pytest.approx([0.0, 0.1, 0.2, 0.3])


@pytest.mark.parametrize("size", ["tiny", "micro", "nano"])
def test_as_many_tokens_as_darswin(size):
    with torch.device("meta"):
        swin, darswin = create_model(f"swin_{size}"), create_model(f"darswin_a_{size}")
    rows, columns = swin.stages[0].blocks[0].attn.map_size
    rings, sectors = darswin.stages[0].blocks[0].attn.map_size
    assert rows * columns == rings * sectors
    counts = [sum(p.numel() for p in model.parameters()) for model in (swin, darswin)]
    assert abs(counts[0] / counts[1] - 1) < 0.03, counts


@pytest.mark.parametrize("options", [{}, dict(image_size=(16, 32)), dict(window=(2, 4))])
@pytest.mark.parametrize("name", ["swin_nano", "swin_undis_nano"])
def test_gradients_reach_every_parameter_and_agree_with_the_reference(name, options):
    model = nano(name, **options)
    x = images(2, *model.image_size).requires_grad_()
    model(x, LENS).square().sum().backward()
    for parameter_name, parameter in model.named_parameters():
        assert parameter.grad.isfinite().all() and parameter.grad.any(), parameter_name
    assert x.grad.any()
    with torch.no_grad():
        ours = model(x, LENS)
        with use_reference():
            expected = model(x, LENS)
    torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-5)


def test_swin_ignores_the_lens():
    model = nano().eval()
    x = images()
    assert torch.equal(model(x, LENS), model(x, None)) and torch.equal(model(x, LENS), model(x))


def test_no_axis_wraps():
    # The corner's shifted window holds the map's four corners, each of 2 × 2 tokens; a
    # token there sees its own corner.
    model = nano()
    shifted = model.stages[1].blocks[1]
    x = torch.randn(1, 8, 8, 48, requires_grad=True)
    (grad,) = torch.autograd.grad(shifted(x)[0, 0, 0].sum(), x)
    seen = grad[0].ne(0).any(-1)
    assert seen[:2, :2].all() and seen.sum() == 4


@pytest.mark.parametrize("name", ["swin_micro", "swin_undis_micro"])
def test_the_micro_models_run(name):
    model = create_model(name, num_classes=7).eval()
    with torch.no_grad():
        assert model(images(1, 64, 64), Spherical.from_fov(0.5, 2.0, 32.0)).shape == (1, 7)


def test_features_intermediates_and_head():
    model = nano().eval()
    x = images()
    features, maps = model.forward_intermediates(x)
    assert [tuple(m.shape) for m in maps] == [(2, 16, 16, 24), (2, 8, 8, 48), (2, 4, 4, 96)]
    assert torch.equal(features, model.forward_features(x))
    assert torch.equal(features, model.norm(maps[-1]))
    assert torch.equal(model.forward_head(features), model(x))
    assert torch.equal(model.forward_head(features, pre_logits=True), features.mean((1, 2)))
    (last,) = model.forward_intermediates(x, LENS, indices=1, intermediates_only=True)
    assert torch.equal(last, maps[-1])
    model.reset_classifier(0)
    assert model(x).shape == (2, 96)
    excluded = model.no_weight_decay()
    assert excluded == {name for name, p in model.named_parameters() if p.dim() == 3}
    assert len(excluded) == 4


def test_camera_frames():
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    frames = torch.randint(256, (2, 32, 32, 3), dtype=torch.uint8)
    planes = frames.permute(0, 3, 1, 2)
    values = (planes / 255 - torch.tensor(mean)[:, None, None]) / torch.tensor(std)[:, None, None]
    for name in ("swin_nano", "swin_undis_nano"):
        model = nano(name, mean=mean, std=std).eval()
        expected = model(values, LENS)
        torch.testing.assert_close(model(frames, LENS), expected)
        torch.testing.assert_close(model(planes, LENS), expected)


# -- undistortion ---------------------------------------------------------------------------------


class Seen(torch.nn.Module):
    """In place of the first layer: keeps what comes in."""

    def __init__(self, model):
        super().__init__()
        self.images, self.inner = None, model.patch_embed
        model.patch_embed = self

    def forward(self, x):
        self.images = x.permute(0, 3, 1, 2).detach()
        return self.inner(x)


def undistorted(picture, lens, **options):
    side = picture.shape[2]
    model = nano("swin_undis_nano", in_chans=1, image_size=side, **options).eval()
    seen = Seen(model)
    with torch.no_grad():
        model(picture, lens)
    return seen.images


@pytest.mark.parametrize("xi", [0.0, 0.4, 0.9])
def test_the_perspective_image_comes_back(xi):
    fov, side = math.radians(110), 128
    perspective = Perspective.from_fov(fov, side / 2)
    picture = scene(side)
    lens = Spherical.from_fov(xi, fov, side / 2)
    distorted = reproject(picture, perspective, lens, (side, side))
    back = undistorted(distorted, lens)
    inside = circle(side, side / 2 - 2)
    error = (back - picture)[0, 0][inside].abs().max()
    assert error < (1e-5 if xi == 0 else 0.02), error
    if xi:  # the picture was indeed another one
        assert (distorted - picture)[0, 0][inside].abs().max() > 0.3
    assert not back[0, 0][~circle(side, side / 2 + 1)].any()


def test_a_view_keeps_the_lenss_field_of_view_up_to_the_limit():
    side, wide = 64, Polynomial([20.0], math.radians(95))
    picture = scene(side)
    limited = undistorted(picture, wide, max_fov=math.radians(100))
    narrow = Polynomial([20.0], math.radians(50))
    expected = reproject(
        picture, narrow, Perspective.from_fov(math.radians(100), side / 2), (side, side)
    )
    torch.testing.assert_close(limited, expected, rtol=0, atol=1e-5)
    assert (undistorted(picture, wide) - limited).abs().max() > 0.1  # 175° otherwise


def test_each_image_has_its_lens():
    picture = scene(64).expand(2, -1, -1, -1)
    lenses = Spherical.from_fov([0.1, 0.9], 2.0, 32.0, center=[[30.0, 31.5], [31.5, 33.0]])
    together = undistorted(picture, lenses)
    for k in range(2):
        torch.testing.assert_close(together[k : k + 1], undistorted(picture[:1], lenses[k]))
    one = undistorted(picture, lenses[:1])
    torch.testing.assert_close(one[0], together[0])
    assert not torch.allclose(one[1], together[1], atol=0.05)


def test_gradients_reach_the_lens_through_the_view():
    xi = torch.tensor([0.4], requires_grad=True)
    model = nano("swin_undis_nano")
    model(images(), Spherical(xi, 12.0, 1.0)).square().sum().backward()
    assert xi.grad.isfinite().all() and xi.grad.all()


# -- compilation and errors -----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["swin_nano", "swin_undis_nano"])
def test_compile_fullgraph(name):
    model = nano(name, depths=(1, 2), num_heads=(1, 2)).eval()
    x = images()
    with torch.no_grad():
        expected = model(x, LENS)
        got = torch.compile(model, fullgraph=True, backend="aot_eager")(x, LENS)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["swin_nano", "swin_undis_nano"])
def test_autocast_and_empty_batches(name):
    model = nano(name).eval()
    x = images()
    with torch.no_grad():
        expected = model(x, LENS)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            half = model(x, LENS)
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), expected, rtol=0.1, atol=0.05)
    assert model(images(0), LENS[:0]).shape == (0, 10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(image_size=33), r"patch_size must divide image_size = \(33, 33\), got 2"),
        (dict(image_size=36), r"stage 1: window \(4, 4\) must divide the map, \(18, 18\)"),
        (dict(image_size=24), r"stage 2: window \(4, 4\) must divide the map, \(6, 6\)"),
        (dict(depths=(2, 2)), "depths and num_heads must pair up"),
        (dict(num_heads=(5, 5, 5)), "num_heads must divide"),
        (dict(drop_path_rate=1.0), "drop path must be"),
        (dict(std=0.0), "std must be positive"),
    ],
)
def test_constructor_errors(options, message):
    with pytest.raises(ValueError, match=message):
        nano(**options)


def test_call_errors():
    model = nano()
    with pytest.raises(ValueError, match=r"image_size, \(H, W\) = \(32, 32\), got \(32, 40\)"):
        model(images(2, 32, 40))
    with pytest.raises(ValueError, match="images must have 3 channels, got 1"):
        model(images()[:, :1])
    with pytest.raises(TypeError, match="images must be a tensor, got list"):
        model([1])
    undis = nano("swin_undis_nano")
    with pytest.raises(TypeError, match=r"lens must be a darswin.lens.Lens, got NoneType"):
        undis(images(), None)
    with pytest.raises(ValueError, match="one lens or one an image, 3, got 2"):
        undis(images(3), LENS)
    for wrong in (0.0, math.pi):
        with pytest.raises(ValueError, match=r"max_fov must be in \(0, π\)"):
            nano("swin_undis_nano", max_fov=wrong)
