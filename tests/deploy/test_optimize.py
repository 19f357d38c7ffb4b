"""What `optimize` makes of a model besides its results, which tests/models compares."""

import copy
import itertools
import math
import pickle

import pytest
import torch
from helpers import network, product, refused, relative_error

from darswin import create_model, optimize
from darswin.layers.position_bias import RelativeBias
from darswin.lens import Spherical, cat
from darswin.models.adapter import LensAdapter
from darswin.models.base import Model
from darswin.views import make_view

LENSES = Spherical.from_fov([0.2, 0.9], math.radians(160), 16.0)


@torch.no_grad()
@pytest.mark.parametrize(
    ("name", "lenses"),
    [*itertools.product(["darswin_a_nano", "swin_nano perspective"], [1, 200]),
     *(pytest.param("darswin_unet_a_nano", n, marks=pytest.mark.slow) for n in (1, 200))],
)  # fmt: skip
def test_large_batches_have_the_bits_of_small_ones(name, lenses):
    fast = optimize(network(name))  # a part of a batch has at most 170 images
    side = fast.image_size or (32, 32)
    images = torch.randn(200, 3, *side)
    lens = Spherical.from_fov(torch.linspace(0.1, 0.9, lenses), math.radians(160), side[0] / 2)
    got = fast(images, lens)
    for k in (0, 99, 100, 199):
        assert torch.equal(
            got[k : k + 1], fast(images[k : k + 1], lens[k : k + 1] if lenses > 1 else lens)
        )


@torch.no_grad()
@pytest.mark.parametrize("name", ["darswin_a_nano", "swin_nano perspective", "darswin_unet_a_nano"])
def test_a_fixed_lens_is_prepared_once_for_each_size(name, monkeypatch):
    model, lens = network(name, mean=0.5, std=0.25), LENSES[:1]
    fixed = optimize(model, lens=lens)
    sizes = [(32, 32)] if model.image_size else [(64, 80), (40, 36)]
    frames = [torch.randint(256, (1, *size, 3), dtype=torch.uint8) for size in sizes]
    want = [model(images, lens) for images in frames]
    for _ in range(2):
        for images, expected in zip(frames, want, strict=True):
            assert relative_error(fixed(images), expected) < 1e-5
        monkeypatch.setattr(RelativeBias, "table", None)
        monkeypatch.setattr(type(lens), "project", None)
    refused("call it without a lens", fixed, frames[0], lens)


def test_a_fixed_lens_refuses_images_of_another_size_than_its_own():
    camera = LENSES[:1].replace(image_size=torch.tensor([[32.0, 32.0]]))
    fast = optimize(network("darswin_a_nano"), lens=camera)
    assert fast(torch.rand(1, 3, 32, 32)).shape == (1, 5)
    refused(r"\(H, W\) = \(32, 32\)", fast, torch.rand(1, 3, 40, 32))


@torch.no_grad()
def test_each_lens_of_a_program_hides_its_own_pixels():
    model = network("swin_unet_nano square", task="distance")
    large, small = (Spherical.from_fov(0.5, math.radians(160), radius) for radius in (60.0, 20.0))
    images, fast = torch.randn(1, 3, 64, 64), optimize(model, strict=True)
    for lens in (large, small, large):
        want, got = model(images, lens), fast(images, lens)
        assert torch.equal(got == 0, want == 0) and relative_error(got, want) < 1e-5
    assert bool(model.prepare(large, (64, 64)).view.shown.all())
    both, images = cat([large, small]), torch.cat((images, images))
    assert relative_error(fast(images, both), model(images, both)) < 1e-5


@torch.no_grad()
@pytest.mark.parametrize("view", ["mercator", "tiles"])
def test_each_image_of_an_adapter_has_a_lens(view):
    model = LensAdapter(network("swin_nano"), size=32, view=view).eval()
    images, fast = torch.randn(2, 3, 32, 32), optimize(model, strict=True)
    for lens in (LENSES, LENSES[:1]):
        assert relative_error(fast(images, lens), model(images, lens)) < 1e-5


@torch.no_grad()
def test_a_program_is_tried_with_lenses_that_its_view_sees(monkeypatch):
    view = make_view("perspective", 64, fov=0.5, direction=(0.0, 0.0, -1.0))
    model = create_model("swin_nano", num_classes=5, view=view).eval()
    optimize(model, strict=True)
    monkeypatch.setattr("darswin.deploy.networks._FOVS", (2.0,))
    assert "layer by layer, because of its view" in repr(optimize(model))


def test_the_model_stays_as_it_is():
    model, images = network("darswin_a_nano").train(), torch.randn(2, 3, 32, 32)
    optimized = optimize(model)
    want = optimized(images, LENSES)
    assert model.training and not want.requires_grad
    model(images, LENSES).sum().backward()
    with torch.no_grad():
        for parameter in model.parameters():
            assert parameter.grad is not None
            parameter.add_(1.0)
    torch.testing.assert_close(optimized(images, LENSES), want)  # a copy, not a view


def test_what_cannot_be_optimized():
    model = network("darswin_a_nano")
    for wrong, options, kind, message in (
        (torch.nn.Linear(2, 2), {}, TypeError, "a LensAdapter of one, got Linear"),
        ("model", {}, TypeError, "a LensAdapter of one, got str"),
        (optimize(model), {}, TypeError, "got an optimized model"),
        (
            model,
            dict(dtype=torch.bfloat16),
            ValueError,
            "torch.float32 or torch.int8, got torch.bf",
        ),
        (model, dict(lens=LENSES), ValueError, "lens must be one lens"),
        (network("darswin_a_nano").to("meta"), {}, ValueError, "got a model on meta"),
    ):
        refused(message, optimize, wrong, error=kind, **options)


@torch.no_grad()
@pytest.mark.parametrize(
    ("name", "weights"),
    product(["darswin_a_nano", "swin_nano", "dat_nano", "conv_unet_nano", "swin_unet_nano",
             "darswin_unet_a_nano"], [torch.float64, torch.bfloat16]),
)  # fmt: skip
def test_weights_of_any_dtype(name, weights):
    model = network(name, mean=0.5, std=0.25).to(weights)
    side = model.image_size or (32, 32)
    frames = torch.randint(256, (2, 3, *side), dtype=torch.uint8)
    lens = Spherical.from_fov([0.2, 0.9], math.radians(160), side[0] / 2)
    want = model.double()(frames, lens)
    model.to(weights)  # without loss: the weights were of this dtype before
    exact = 1e-5 if weights == torch.float64 else 0.02  # images take the dtype of the weights
    fast = optimize(model)
    assert fast.dtype == weights
    for images in (frames, model.normalize(frames)):
        got = fast(images, lens)
        assert got.dtype == torch.float32 and relative_error(got, want) < exact
    with pytest.raises(TypeError, match=f"images must be uint8 or {weights}"):
        fast(torch.rand(2, 3, *side), lens)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("darswin_a_nano", dict(jitter=1.0, drop_path_rate=0.5)),
        ("swin_nano perspective", dict(drop_path_rate=0.5)),
        ("darswin_unet_a_nano", dict(jitter=1.0, task="distance")),
        ("swin_unet_nano square", dict(task="distance")),
        ("conv_unet_nano", dict(task="distance")),
    ],
)
def test_what_an_optimized_model_does_not_do(name, options):
    model = network(name, **options)
    images = torch.randn(1, 3, *(model.image_size or (32, 32)))
    lens = Spherical.from_fov(0.4, 2.6, images.shape[2] / 2)
    without_gradients = "has no gradients, but its images or its lens"
    for fast, arguments in ((optimize(model), (lens,)), (optimize(model, lens=lens), ())):
        expected = fast(images, *arguments)
        for action, message in (
            (copy.copy, "cannot be copied or pickled"),
            (copy.deepcopy, "cannot be copied or pickled"),
            (pickle.dumps, "cannot be copied or pickled"),
            (lambda model: model.state_dict(), "save the original model"),
            (lambda model: model.train(), "train the original model"),
            (lambda model: model.prune_intermediate_layers(), "prune the original model"),
            (lambda model: model.reset_classifier(3), "cannot be given a new head"),
        ):
            refused(message, action, fast, error=TypeError)
        for part in fast.modules():  # an encoder too, within another model
            if isinstance(part, Model):
                refused("save the original model", part.state_dict, error=TypeError)
        refused("must be on the CPU, as .*, got meta", fast, images.to("meta"), *arguments)
        leaf = images.clone().requires_grad_()
        refused(without_gradients, fast, leaf, *arguments, error=RuntimeError)
        with torch.no_grad():
            assert torch.equal(fast.eval()(leaf, *arguments), expected)
    fast, learned = optimize(model), lens.replace(focal=lens.focal.clone().requires_grad_())
    refused(without_gradients, fast, images, learned, error=RuntimeError)
    with torch.no_grad():
        assert torch.equal(fast(images, learned), fast(images, lens))
