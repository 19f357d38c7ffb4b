"""The contract of networks: however a network runs, its results are the same.

A table of models × lenses × ways to run them: sampled elsewhere, optimized, saved and loaded, in a
file without torch, in 8 bits.
"""

import copy
import json
import math

import numpy as np
import pytest
import torch
from frame_samples import MEAN, ROUND, STD, model_of, network_of, random_frame, size_of
from helpers import network, products, refused, relative_error, slow, slow_but
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from darswin import create_model, frames, list_models, optimize
from darswin.deploy import camera
from darswin.deploy.quantize import quantize_model
from darswin.layers.quantized import quantized_layers
from darswin.lens import Equidistant, Mei, cat
from darswin.models import Encoder, LensAdapter, ModelCard, load_model, save_model
from darswin.models.adapter import adapted
from darswin.models.base import Model
from darswin.models.dat import DeformableAttention
from darswin.ops import use_reference
from darswin.views import make_view


def general(xi, theta_max):
    return Mei(
        xi, 80.0, [0.032, 2.4], theta_max, [40.3, 33.1], tangential=[6e-3, -3.5e-3],
        affine=[[1.0, 0.02], [0.0, 0.9]],
    )  # fmt: skip


LENSES = {  # of two images, with the number of their channels
    "round": (Equidistant.from_fov([2.8, 2.4], [30.0, 24.0]), 3),
    "grey": (Equidistant.from_fov([3.0, 2.2], 24.0), 1),
    "general": (cat([general(2.35, 1.7), general(2.0, 1.5)]), 3),
}
FAMILIES = sorted({name.rpartition("_")[0] for name in list_models()})
UNETS = [name for name in FAMILIES if "unet" in name and name != "conv_unet"]
CLASSIFIERS = [name for name in FAMILIES if "unet" not in name]
# A network of ours behind an adapter, and one of a stranger.
ADAPTERS = [("swin", "mercator"), ("swin", "tiles"), ("conv_unet", "square"),
            ("strange", "square"), ("strange", "perspective"), ("strange", "polar")]  # fmt: skip
CASES = [
    *((name, {}) for name in FAMILIES),
    ("official", {}),
    *((name, dict(num_classes=0)) for name in CLASSIFIERS),
    *((name, dict(features_only=True)) for name in CLASSIFIERS),
    ("darswin_a", dict(features_only=True, out_indices=(0, 2), output_fmt="NCHW")),
    ("swin", dict(features_only=True, out_indices=1)),
    *((name, dict(task="distance")) for name in FAMILIES if "unet" in name),
    *((name, dict(skip_width=0, places=False, rays=False)) for name in UNETS),
    ("swin", dict(view=dict(name="perspective", reach=1.4))),
    ("swin", dict(view=dict(name="square", spacing="g"))),
    ("conv_unet", dict(rays=False, widths=(3, 5))),
    ("conv_unet", dict(view=dict(name="mercator", size=(30, 50)), task="distance")),
    ("swin_unet", dict(view="square", task="distance")),
    ("swin_unet", dict(view="perspective", places=False)),
    ("swin_unet", dict(view="perspective", task="distance")),
    ("darswin_unet_ra", dict(rays=True, num_classes=3)),
    ("swin_unet", dict(view=dict(name="mercator", size=(64, 128)))),
    ("swin_unet", dict(view=dict(name="equirectangular", fov=2.8))),
    ("swin", dict(image_size=(24, 48), patch_size=3)),
    ("darswin_a", dict(periodic_bias=True, spacing="g")),
    ("dat", dict(image_size=(16, 40), window=(2, 5), blocks=("D", "LD", "DS"), groups=(1, 2, 4))),
    ("dat", dict(depths=(2, 1, 2), blocks=("DL", "D", "D"), groups=(1, 1, 1), offset_range=9.0)),
    *(("adapter", dict(network=name, view=view)) for name, view in ADAPTERS),
    ("adapter", dict(network="swin", view="mercator", output="view")),
]
OPTIONS = [
    ("darswin_a", dict(variant="RA", rings=8, sectors=16)),
    ("darswin_a", dict(position_bias="angular")),
    ("darswin_a", dict(position_bias="polar", harmonics=4)),
    ("darswin_a", dict(samples=(2, 5), jitter=0.0)),
    ("darswin_a", dict(sample_spacing="radius")),
    ("darswin_a", dict(spacing="radius")),
    ("darswin_a", dict(spacing="tan", placement="edges")),
    ("darswin_a", dict(spacing="g", window=(1, 8))),
    ("swin", dict(image_size=(16, 32), window=(2, 4))),
    ("dat", dict(image_size=(16, 32), blocks=("S", "LS", "D"), groups=(1, 1, 4))),
]
ONE = dict(embed_dim=6, depths=(1,), num_heads=(2,))
TWO = dict(embed_dim=6, depths=(1, 1), num_heads=(2, 1))
POLAR = dict(rings=2, sectors=8, samples=(2, 3), window=(1, 8))
A, RA = dict(ONE, **POLAR), dict(TWO, **POLAR, merges=((1, 2),))
UNUSUAL_SIZES = [
    ("darswin_a", dict(A, mlp_ratio=0.5)),
    ("darswin_a", dict(A, mlp_ratio=0.17)),  # one number in the MLP
    ("darswin_a", dict(A, depths=(0,))),
    ("darswin_ra", dict(RA, depths=(0, 1))),
    ("darswin_ra", dict(RA, depths=(2, 0))),
    ("darswin_a", dict(A, rings=1, samples=(1, 1))),
    ("darswin_a", dict(A, rings=4, sectors=1, window=(4, 1))),
    ("darswin_a", dict(A, window=(1, 1))),
    ("darswin_a", dict(A, num_heads=(6,))),  # of one number
    ("darswin_a", dict(A, embed_dim=1, num_heads=(1,))),
    ("darswin_ra", dict(RA, embed_dim=15, num_heads=(5, 3), mlp_ratio=2.7)),
    ("darswin_a", dict(A, position_bias="angular", harmonics=1)),
    ("darswin_a", dict(A, in_chans=2)),
    ("darswin_a", dict(A, num_classes=1)),
    ("darswin_a", dict(A, depths=(3,), drop_path_rate=0.9)),
    ("darswin_ra", dict(RA, features_only=True, output_fmt="NCHW")),
    ("darswin_ra", dict(RA, depths=(0, 1), features_only=True)),
    ("swin", dict(ONE, image_size=(8, 16), patch_size=1)),
    ("swin", dict(ONE, image_size=16, patch_size=16, mlp_ratio=0.5)),  # one patch
    ("swin", dict(ONE, view="perspective", image_size=16, depths=(0,))),
    ("dat", dict(ONE, image_size=16, blocks=("D",), groups=(2,), mlp_ratio=0.5)),
    ("dat", dict(TWO, image_size=16, depths=(0, 1), blocks=("D", "LD"), groups=(1, 1))),
    ("darswin_unet_a", dict(RA, depths=(0, 0), skip_width=1)),
    ("darswin_unet_ra", dict(A, depths=(0,), task="distance")),  # of one stage
    ("swin_unet", dict(TWO, image_size=16, patch_size=2, mlp_ratio=0.5)),
    ("conv_unet", dict(widths=(1,), rays=False)),
]


def made(family, channels=3, **options):
    """A model of a row of the table."""
    mean, std = (MEAN, STD) if channels == 3 else (0.4, 0.2)
    if family == "official":
        return network("official", in_chans=channels, mean=mean, std=std)
    if family != "adapter":
        return model_of(family, channels, **options)
    name, view, size = options["network"], options["view"], 32
    if name == "strange":
        layers = nn.Conv2d(channels, 4, 3, padding=1), nn.GELU(), nn.Conv2d(4, 5, 2, 2)
        within: nn.Module = nn.Sequential(*layers)
    else:
        within = model_of(name, channels, **(dict(rays=False) if name == "conv_unet" else {}))
    view = make_view(view, size, mean=mean, std=std)
    return LensAdapter(within, view=view, output=options.get("output", "pixels")).eval()


def maps_of(result):
    return result if isinstance(result, list) else [result]


def assert_close(found, expected, of=1e-5):
    """Equal up to this part of the largest number."""
    assert isinstance(found, list) == isinstance(expected, list)
    for one, other in zip(maps_of(found), maps_of(expected), strict=True):
        torch.testing.assert_close(one, other, rtol=of, atol=of * other.abs().max().item())


def images_of(model, channels=3, count=2):
    images = [random_frame(*size_of(model), channels, seed=k) for k in range(count)]
    return torch.from_numpy(np.stack(images))


def by_file(model, lens, frame, folder):
    """The results of a file, as tensors with the batch."""
    network, frame = network_of(model, folder, lens), frame.numpy()
    assert (*network.size, network.channels) == frame.shape
    found = network(frame)
    assert network.shapes == [one.shape for one in maps_of(found)]
    if network.channels == 1:
        for one, other in zip(maps_of(network(frame[..., 0])), maps_of(found), strict=True):
            np.testing.assert_array_equal(one, other)
    assert all(one.dtype == np.float32 for one in maps_of(found))
    several = [torch.from_numpy(one)[None] for one in maps_of(found)]
    return several if isinstance(found, list) else several[0]


def finished(model, result):
    """What a file finds instead of a result of its model."""
    classifies = isinstance(adapted(model), Encoder) and model.num_classes > 0
    return result.softmax(1) if classifies else result


def check_file(model, lens, frame, expected, folder, near=1e-5):
    if any(isinstance(part, DeformableAttention) for part in model.modules()):
        words = "DeformableAttention is no instruction"
        refused(words, network_of, model, folder, lens, error=TypeError)
    else:
        assert_close(by_file(model, lens, frame, folder), finished(model, expected), near)


def check_samples(model, images, lenses):
    """A model computes the same of pixels that were sampled already, also by a plan."""
    size = size_of(model)
    prepared, expected = model.prepare(lenses, size), model(images, lenses)
    assert_close(model.run(images, prepared), expected, 0)
    sampled = model.sample(images, prepared)
    assert sampled.dtype == torch.float32
    assert_close(model.run_sampled(sampled, prepared, images), expected)
    if not model.view.uses_lens:
        refused("takes images as they are: it needs no plan", camera.plan, model, lenses[0], size)
    elif images.shape[3] in (1, 3):  # a camera has as many channels
        sampled = model.sample(images[:1], model.prepare(lenses[0], size))
        sampler = frames.Sampler(camera.plan(model, lenses[0], size))
        read = torch.from_numpy(sampler(images[0].numpy()))
        # 1e-4 px, where neighbours differ by at most 1 / STD: the model's places are of float32.
        torch.testing.assert_close(read.reshape(sampled.shape), sampled, rtol=0, atol=1e-3)


def check_optimized(model, images, lenses):
    expected, fast = model(images, lenses), optimize(model)
    assert isinstance(fast, type(model)) and not isinstance(model, type(fast))
    assert fast.pretrained_cfg == model.pretrained_cfg and not fast.training
    assert_close(fast(images, lenses), expected)
    prepared = fast.prepare(lenses, size_of(model))
    assert_close(fast.run(images, prepared), fast(images, lenses), 0)
    sampled = fast.sample(images, prepared)
    assert_close(fast.run_sampled(sampled, prepared, images), expected)
    assert_close(optimize(model, lens=lenses[0])(images), model(images, lenses[0]))
    empty = maps_of(fast(images[:0], lenses[0]))
    assert [one.shape for one in empty] == [one[:0].shape for one in maps_of(expected)]


def check_saved(model, family, options, images, lenses, folder):
    options = dict(num_classes=model.num_classes, in_chans=model.in_chans) | options
    options |= dict(mean=model.mean, std=model.std)
    if family.startswith("swin_unet"):
        options = dict(image_size=64) | options
    card = ModelCard(f"{family}_nano", json.loads(json.dumps(options)), [], size=32)
    save_model(folder / "model.safetensors", model.state_dict(), card)
    loaded, read = load_model(folder / "model.safetensors")
    assert read == card and not loaded.training and type(loaded) is type(model)
    assert torch.equal(loaded(images, lenses), model(images, lenses))


@torch.no_grad()
def check(case, lenses, channels, folder):
    family, options = case
    if family == "official":  # it knows round lenses, and the field of view of image 0
        lenses = LENSES["round"][0][[0, 0]]
    channels = options.get("in_chans", channels)
    model = made(family, channels, **options)
    images = images_of(model, channels)
    check_samples(model, images, lenses)
    if not isinstance(adapted(model), Model):
        return
    # The program of a view of tiles takes one lens for all images.
    check_optimized(model, images, lenses if model.view.count == 1 else lenses[:1])
    if family not in ("adapter", "official") and not {"features_only", "size"} & options.keys():
        check_saved(model, family, options, images, lenses, folder)
    if model.view.count == 1 and channels in (1, 3):
        check_file(model, lenses[0], images[0], model(images[:1], lenses[0]), folder)


# Under the sanitizers, each network and each lens once, and not what differs in its outputs alone.
unsanitized = pytest.mark.unsanitized
OUTPUTS = {"num_classes", "features_only", "out_indices", "output_fmt"}


def rows(shift, *marks):
    """Each network with one of the lenses."""
    for k, case in enumerate(CASES):
        few = marks or (unsanitized if case[1] and case[1].keys() <= OUTPUTS else ())
        yield pytest.param(case, [*LENSES][(k + shift) % len(LENSES)], marks=few)


ROWS = [
    *rows(0),
    *rows(1, slow, unsanitized),
    *rows(2, slow, products, unsanitized),
    *(pytest.param(case, "round", marks=unsanitized) for case in OPTIONS),
    *(pytest.param(case, "round", marks=[slow, unsanitized]) for case in UNUSUAL_SIZES),
]


@pytest.mark.parametrize(("case", "lens"), ROWS, ids=str)
def test_a_network_gives_the_same_however_it_runs(case, lens, tmp_path):
    check(case, *LENSES[lens], tmp_path)


@pytest.mark.slow
@pytest.mark.unsanitized
@pytest.mark.parametrize("family", slow_but(FAMILIES, "darswin_unet_ra", marks=products))
def test_so_do_the_large_sizes(family, tmp_path):
    check((family, dict(size="small")), *LENSES["round"], tmp_path)


@pytest.mark.unsanitized
@pytest.mark.parametrize(
    "case", [*OPTIONS, *(pytest.param(case, marks=slow) for case in UNUSUAL_SIZES)], ids=str
)
def test_with_any_options_it_trains_agrees_with_the_reference_and_has_8_bits(case):
    family, options = case
    channels, lenses = options.get("in_chans", 3), LENSES["round"][0]
    model = made(family, channels, **options)
    images = images_of(model, channels)
    sum(one.square().sum() for one in maps_of(model.train()(images, lenses))).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
    with torch.no_grad():
        expected = model.eval()(images, lenses)
        with use_reference():
            assert_close(model(images, lenses), expected, 1e-4)
        if not any("blocks.0" in name or "reduction" in name for name, _ in model.named_modules()):
            with pytest.raises(ValueError, match="no part that could be quantized: no block"):
                quantize_model(model, [(images, lenses)])
            return
        quantized = quantize_model(model, [(images, lenses)], tolerance=math.inf)
        assert quantized_layers(quantized)
        fast, expected = (
            maps_of(net(images, lenses)) for net in (optimize(quantized, torch.int8), quantized)
        )
        assert max(map(relative_error, fast, expected)) < 0.05


IN_8_BITS = [
    *((name, {}) for name in CLASSIFIERS),
    *((name, dict(rings=8, sectors=16)) for name in ("darswin_unet_a", "darswin_unet_ra")),
    ("swin_unet", dict(image_size=32)),
    ("swin_unet", dict(image_size=32, view="square")),
    ("swin", dict(view="perspective")),
    ("darswin_a", dict(features_only=True)),
    ("adapter", dict(network="swin", view="mercator")),
]
ROWS_OF_8_BITS = [
    pytest.param(case, marks=[slow, unsanitized] if k % 4 else [])
    for k, case in enumerate(IN_8_BITS)
]


@torch.no_grad()
@pytest.mark.parametrize("case", ROWS_OF_8_BITS, ids=str)
def test_so_it_does_in_8_bits(case, tmp_path):
    family, options = case
    model = made(family, **options)
    images = images_of(model, count=8)
    lenses = Equidistant.from_fov(torch.linspace(2.2, 2.9, 8), 30.0)
    seen = model.sample(images, model.prepare(lenses, size_of(model)))
    batches = [(images, lenses) if family != "adapter" else (seen, lenses)]
    quantized, whole = copy.deepcopy(model), adapted(model)
    of_8_bits = quantize_model(whole, batches, tolerance=math.inf)
    if family == "adapter":
        quantized.network = of_8_bits
    else:
        quantized = of_8_bits
    layers = quantized_layers(of_8_bits)
    assert len(layers) >= 8 and not quantized_layers(whole)
    assert all(of_8_bits.get_submodule(name).weight.dtype == torch.int8 for name in layers)

    def flat(out):
        return torch.cat([one.flatten(1) for one in maps_of(out)], 1)

    want, got = flat(model(images, lenses)), flat(quantized(images, lenses))
    assert 0 < relative_error(got, want) < 0.15
    fast = optimize(quantized, torch.int8)
    # A rounding in float32 may move an activation by one step, and the layers after it let the
    # difference grow, up to the error of 8 bits itself. An image without such a step is equal.
    errors = (flat(fast(images, lenses)) - got).norm(dim=1) / got.norm(dim=1)
    assert errors.min() < 1e-5 and errors.max() < relative_error(got, want)
    fixed, expected = optimize(quantized, torch.int8, lens=lenses[0]), fast(images[:1], lenses[:1])
    assert_close(fixed(images[:1]), expected, 0)
    # A view is sampled by another operator: a rounding may fall to the other side.
    near = 1e-5 if "darswin" in family else 0.05
    check_file(quantized, lenses[0], images[0], expected, tmp_path, near)


class Computations(TorchDispatchMode):
    """Names the operators of torch that make new numbers."""

    def __init__(self):
        super().__init__()
        self.names = []

    def __torch_dispatch__(self, operator, types, arguments=(), keywords=None):
        result = operator(*arguments, **(keywords or {}))
        tensors = [x for x in arguments if isinstance(x, torch.Tensor)]
        if operator.namespace != "darswin" and isinstance(result, torch.Tensor):
            places = [x.untyped_storage().data_ptr() for x in tensors]
            if result.untyped_storage().data_ptr() not in places:
                self.names.append(str(operator))
        return result


ASLEEP = ("darswin_a_nano", "darswin_unet_ra_nano", "conv_unet_nano", "swin_nano")
LARGER = [name for name in list_models() if name.startswith("darswin") and name not in ASLEEP]


@pytest.mark.unsanitized
@torch.inference_mode()
@pytest.mark.parametrize("name", slow_but([*ASLEEP, *LARGER], *ASLEEP))
def test_an_optimized_model_leaves_the_threads_of_torch_asleep(name):
    # They stay awake for milliseconds after each operator, and would compete with our threads.
    model = create_model(name, num_classes=5).eval()
    fast, images = optimize(model, lens=ROUND), torch.rand(1, 3, *size_of(model))
    fast(images)  # prepares the lens
    with Computations() as computed:
        fast(images)
    assert computed.names == []
