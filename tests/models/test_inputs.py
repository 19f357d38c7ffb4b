"""The images that models take: their normalization, their shapes and their devices."""

import warnings

import numpy as np
import pytest
import torch
from helpers import network, product, refused, side_of
from torch import nn

from darswin import PolarView, list_models, optimize
from darswin.deploy.export import export_program
from darswin.lens import Spherical
from darswin.models import LensAdapter
from darswin.ops import polar_sample

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Mean(nn.Module):
    """A network of an adapter."""

    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, 5, 3, padding=1)

    def forward(self, x):
        return self.conv(x).mean((2, 3))


def adapter(**options):
    return LensAdapter(Mean(), 32, **options).eval()


MODELS = {
    **{name: lambda name=name, **o: network(name, **o) for name in list_models() if "nano" in name},
    "official": lambda **o: network("official", **o),
    "features": lambda **o: network("darswin_a_nano", features_only=True, **o),
    "adapter": adapter,
}
models = pytest.mark.parametrize("kind", MODELS)


def made(kind, **options):
    """A model, uint8 images (2, 3, S, S) for it, and a lens."""
    side = side_of(kind)
    frames = torch.randint(256, (2, 3, side, side), dtype=torch.uint8)
    return MODELS[kind](**options), frames, Spherical.from_fov(0.5, 2.6, side / 2)


def total(out):
    return sum(t.float().sum() for t in out) if isinstance(out, list) else out.float().sum()


# -- normalization --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "statistics"), product(MODELS, [(MEAN, STD), (0.4, 0.2), (0.4, STD)])
)
def test_normalize_gives_what_the_model_makes_of_uint8(kind, statistics):
    mean, std = statistics
    model, frames, _ = made(kind, mean=mean, std=std)
    m, s = (torch.tensor(x, dtype=torch.float64).expand(3).view(3, 1, 1) for x in statistics)
    expected = (frames.double() / 255 - m) / s
    last = frames.permute(0, 2, 3, 1).contiguous()
    for images in (frames, last, frames / 255, frames.double() / 255, (frames / 255).bfloat16()):
        got = model.normalize(images)
        assert got.dtype == torch.float32 and got.shape == frames.shape
        coarse = 0.02 if images.dtype == torch.bfloat16 else 1e-5
        torch.testing.assert_close(got.double(), expected, rtol=0, atol=coarse)
    if kind != "adapter":
        assert model.to(torch.bfloat16).normalize(frames).dtype == torch.bfloat16


def test_normalize_refuses_what_it_cannot_take():
    model, frames, _ = made("darswin_a_nano")
    refused(
        r"in \[0, 1\], got values up to 2\d\d: divide them by 255", model.normalize, frames.float()
    )
    integers = r"floating point or uint8, got torch\.int64"
    refused(integers, model.normalize, frames.long(), error=TypeError)
    array = "images must be a tensor, got ndarray"
    refused(array, model.normalize, frames.numpy(), error=TypeError)
    refused("must have 3 channels, got 2", model.normalize, torch.rand(2, 2, 8, 8))
    unknown = "normalize needs a model with mean and std"
    refused(unknown, adapter().normalize, torch.rand(2, 3, 8, 8))
    assert model.normalize(torch.rand(0, 3, 8, 8)).shape == (0, 3, 8, 8)
    image = torch.rand(1, 3, 8, 8, requires_grad=True)
    model.normalize(image).sum().backward()
    assert image.grad.eq(1).all()


def told(call):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return [
        str(warning.message) for warning in caught if "taken as they are" in str(warning.message)
    ]


@torch.no_grad()
@pytest.mark.parametrize(
    ("kind", "dtype"), product(MODELS, [torch.float32, torch.float64, torch.bfloat16])
)
def test_a_model_tells_once_that_floats_are_no_pixels(kind, dtype):
    model, frames, lens = made(kind, mean=MEAN, std=STD)
    model = model.to(dtype)
    pixels = frames.to(dtype)
    (text,) = told(lambda: model(pixels, lens))
    assert "have values up to 25" in text and "model.normalize(images / 255)" in text
    assert not told(lambda: model(pixels, lens))
    other = MODELS[kind](mean=MEAN, std=STD).to(dtype)
    prepared = other.prepare(lens, tuple(frames.shape[2:]))
    for images in (frames, frames.to(dtype) / 255, other.normalize(frames)):
        assert not told(lambda images=images: other.run(images, prepared))
    assert len(told(lambda: other.run(pixels, prepared))) == 1


@pytest.mark.compiled
@torch.no_grad()
def test_only_the_first_calls_look_at_the_values():
    model, frames, lens = made("darswin_a_nano")
    for _ in range(3):
        model(frames / 255, lens)
    assert not told(lambda: model(frames.float(), lens))
    assert len(told(lambda: optimize(made("darswin_a_nano")[0])(frames.float(), lens))) == 1


@pytest.mark.slow
def test_graphs_and_gradients_do_not_see_the_look():
    model, frames, lens = made("darswin_a_nano")
    pixels = frames.float()
    compiled = torch.compile(model, fullgraph=True, backend="eager")
    assert not told(lambda: compiled(pixels, lens))
    assert model._looks == 3
    assert not told(lambda: export_program(model, pixels, lens))
    # In eager mode, these values are an error.
    torch.jit.trace(lambda x: model.normalize(x), pixels, check_trace=False)
    assert model._looks == 3
    grown = pixels.requires_grad_()
    assert len(told(lambda: total(model(grown, lens)).backward())) == 1
    assert grown.grad.isfinite().all()
    for odd in (torch.full((1, 3, 32, 32), torch.nan), torch.rand(0, 3, 32, 32)):
        assert not told(lambda odd=odd: made("darswin_a_nano")[0](odd, lens))
    meta = made("darswin_a_nano")[0].to("meta")
    assert not told(lambda: meta(pixels.detach().to("meta"), lens.to("meta")))


# -- shapes ---------------------------------------------------------------------------------------


@models
def test_channels_come_first_and_a_batch_before_them(kind):
    model, frames, lens = made(kind)
    channels_first, channels_last = frames / 255, frames.permute(0, 2, 3, 1) / 255
    for images, advice in (
        (channels_last[0], r"images\.permute\(2, 0, 1\)\[None\], with the channels first"),
        (channels_first[0], r"for one image, pass images\[None\]$"),
        (channels_first[0, 0], r"for one gray image, pass images\[None, None\]$"),
    ):
        refused(rf"must have shape \(B, C, H, W\), got .*{advice}", model, images, lens)
        refused(advice, model.run, images, None)
    if kind != "adapter":  # it knows its channels neither
        refused(r"come first: pass images\.permute\(0, 3, 1, 2\)", model, channels_last, lens)
        for frame in (frames[0], frames[0].permute(1, 2, 0)):
            refused(r"for one image, pass images\[None\]$", model, frame, lens)


@pytest.mark.parametrize("kind", ["layer", "adapter"])
def test_what_does_not_know_its_channels_finds_them_by_the_lens(kind):
    layer = adapter() if kind == "adapter" else PolarView(4, 8, (2, 2))
    images, lens = torch.rand(2, 24, 32, 3), Spherical(0.5, 9.0, 1.2, image_size=(24, 32))
    refused(r"of \(32, 3\); the channels come first: pass images\.perm", layer, images, lens)
    layer(images.permute(0, 3, 1, 2), lens)
    refused(r"resized, use lens\.resized\(\(12, 16\)\)", layer, torch.rand(2, 3, 12, 16), lens)


def test_operators_give_the_same_advice():
    radii, azimuths, center = torch.rand(1, 4), torch.rand(8), torch.zeros(1, 2)
    for shape, dtype, options, advice in (
        ((24, 32, 3), torch.float32, {}, r"image\.permute\(2, 0, 1\)\[None\]"),
        ((24, 32, 3), torch.float32, dict(channels_last=True), r"pass image\[None\]$"),
        ((24, 32, 3), torch.uint8, {}, r"pass image\[None\]$"),
        ((24, 32, 3), torch.uint8, dict(channels_last=False), r"image\.permute\(2, 0, 1\)\[None\]"),
        ((3, 24, 32), torch.float32, {}, r"pass image\[None\]$"),
        ((24, 32), torch.float32, {}, r"image\[None, None\]$"),
        ((1, 1, 3, 4, 5), torch.float32, {}, r"\(1, 1, 3, 4, 5\)$"),
    ):
        image = torch.zeros(shape, dtype=dtype)
        with pytest.raises(ValueError, match=rf"image must have shape .* got .*{advice}"):
            polar_sample(image, radii, azimuths, center, samples=(1, 1), **options)


# -- devices --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [kind for kind in MODELS if kind != "adapter"])
def test_images_are_on_the_device_of_the_model(kind):
    model, frames, lens = made(kind)
    message = r'{} must be on the device of the model, {}, got {}: pass {}\.to\("{}"\)'
    prepared = model.prepare(lens, tuple(frames.shape[2:]))
    sampled = model.sample(frames, prepared)
    for there, here in (("meta", "cpu"), ("cpu", "meta")):
        model = model.to_empty(device=there)
        for images in (frames.to(here), (frames / 255).to(here)):
            refused(message.format("images", there, here, "images", there), model, images, lens)
            refused("images must be on the device", model.run, images, prepared)
            refused("images must be on the device", model.normalize, images)
        given = sampled.to(here), prepared, frames.to(there)
        refused("must be on the device", model.run_sampled, *given)


# -- adapters -------------------------------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize(("mean", "std"), [(MEAN, STD), (0.4, 0.2), (np.array(MEAN), 0.2)])
def test_an_adapter_normalizes_uint8_as_it_is_told(mean, std):
    model, frames, lens = made("adapter", mean=mean, std=std)
    plain = LensAdapter(model.network, 32)
    expected = plain((frames / 255 - torch.tensor(mean).float().view(-1, 1, 1)) /
                     torch.tensor(std).view(-1, 1, 1), lens)  # fmt: skip
    for images in (frames, frames.permute(0, 2, 3, 1)):
        torch.testing.assert_close(model(images, lens), expected, rtol=1e-4, atol=1e-4)
        prepared = model.prepare(lens, (32, 32))
        sampled = model.sample(images, prepared)
        assert sampled.dtype == torch.float32
        torch.testing.assert_close(model.run_sampled(sampled, prepared), model(images, lens))
    with pytest.raises(TypeError, match=r"got torch\.uint8; with mean and std, an adapter takes"):
        plain(frames, lens)
    with pytest.raises(TypeError, match=r"must be in floating point, got torch\.int64$"):
        model(frames.long(), lens)
    assert not told(lambda: plain(frames.float(), lens))  # its network may expect such values


def test_wrong_statistics_of_an_adapter():
    for options, message in (
        (dict(mean=0.5), "mean and std must be given together, got 0.5 and None"),
        (dict(std=0.5), "mean and std must be given together, got None and 0.5"),
        (dict(mean=MEAN, std=(0.5, 0.5)), r"std must be one number or one per channel \(3\)"),
        (dict(mean=0.5, std=0.0), "std must be positive"),
        (dict(output="image"), "output must be 'pixels' or 'view', got 'image'"),
    ):
        refused(message, adapter, **options)
    gray = LensAdapter(nn.Identity(), 8, mean=MEAN, std=STD)
    with pytest.raises(ValueError, match=r"mean must be one number or one per channel \(1\)"):
        gray(torch.zeros(1, 1, 8, 8, dtype=torch.uint8), Spherical(0.5, 4.0, 1.2))


@torch.no_grad()
def test_an_adapter_can_leave_its_results_in_the_view():
    class Masks(nn.Module):
        def forward(self, x):
            return dict(masks=[x[:, :, ::2, ::2], x], label=x.mean((2, 3)))

    images, lens = torch.rand(2, 3, 40, 48), Spherical.from_fov(0.5, 2.6, 20.0)
    model = LensAdapter(Masks(), 32, output="view")
    prepared = model.prepare(lens, (40, 48))
    sampled = model.sample(images, prepared)
    for out in (model(images, lens), model.run_sampled(sampled, prepared)):
        assert torch.equal(out["masks"][1], sampled) and out["masks"][0].shape == (2, 3, 16, 16)
        assert torch.equal(out["label"], sampled.mean((2, 3)))
    pixels = LensAdapter(Masks(), 32)(images, lens)
    assert [tuple(mask.shape) for mask in pixels["masks"]] == [(2, 3, 40, 48)] * 2
    # The way back of the other adapter brings the map to the pixels.
    back = LensAdapter(nn.Identity(), 32)
    again = back.view.back(out["masks"][0], back.prepare(lens, (40, 48)).view)
    torch.testing.assert_close(again, pixels["masks"][0])
    assert "output='view'" in repr(model)
