"""The contract of networks: however a network runs, its results are the same.

A table of models × lenses × ways to run them: sampled elsewhere, optimized, in a file without
torch, in 8 bits, in a graph.
"""

import numpy as np
import pytest
import torch
from frame_samples import (
    MEAN,
    ROUND,
    STD,
    model_of,
    network_of,
    quantized_of,
    random_frame,
    size_of,
)
from helpers import product, slow_but
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from darswin import create_model, frames, list_models, optimize
from darswin.deploy import camera
from darswin.deploy.export import export_onnx
from darswin.lens import Equidistant, Mei
from darswin.models import Encoder, LensAdapter
from darswin.models.adapter import adapted
from darswin.models.base import Model
from darswin.views import make_view

LENSES = {  # with the number of channels of the frames
    "round": (Equidistant.from_fov(2.8, 30.0), 3),
    "grey": (ROUND, 1),
    "general": (
        Mei(
            2.35,
            80.0,
            [0.032, 2.4],
            1.7,
            [40.3, 33.1],
            tangential=[6e-3, -3.5e-3],
            affine=[[1.0, 0.02], [0.0, 0.9]],
        ),
        3,
    ),
}
FAMILIES = sorted({name.rpartition("_")[0] for name in list_models()})
UNETS = [name for name in FAMILIES if "unet" in name and name != "conv_unet"]
CLASSIFIERS = [name for name in FAMILIES if "unet" not in name]
# A network of ours behind an adapter, and one of a stranger.
ADAPTERS = [("swin", "mercator"), ("swin", "tiles"), ("conv_unet", "square"),
            ("strange", "square"), ("strange", "perspective"), ("strange", "polar")]  # fmt: skip
CASES = [
    *((name, {}) for name in FAMILIES),
    *((name, dict(num_classes=0)) for name in CLASSIFIERS),
    *((name, dict(features_only=True)) for name in CLASSIFIERS),
    ("darswin_a", dict(features_only=True, out_indices=(0, 2), output_fmt="NCHW")),
    ("swin", dict(features_only=True, out_indices=1)),
    *((name, dict(task="distance")) for name in FAMILIES if "unet" in name),
    *((name, dict(skip_width=0, places=False, rays=False)) for name in UNETS),
    ("swin", dict(view=dict(name="perspective", reach=1.4))),
    ("conv_unet", dict(rays=False, widths=(3, 5))),
    ("conv_unet", dict(view=dict(name="mercator", size=(30, 50)), task="distance")),
    ("swin_unet", dict(view="square", task="distance")),
    ("swin_unet", dict(view="perspective", places=False)),
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


def made(family, channels=3, **options):
    """A model of a row of the table."""
    if family != "adapter":
        return model_of(family, channels, **options)
    name, view, size = options["network"], options["view"], 32
    if name == "strange":
        layers = nn.Conv2d(channels, 4, 3, padding=1), nn.GELU(), nn.Conv2d(4, 5, 2, 2)
        network: nn.Module = nn.Sequential(*layers)
    else:
        own = dict(rays=False) if name == "conv_unet" else options.get("options", {})
        network = model_of(name, channels, **own)
    given = dict(zip(("mean", "std"), (MEAN, STD) if channels == 3 else (0.4, 0.2), strict=True))
    output = options.get("output", "pixels")
    return LensAdapter(network, view=make_view(view, size, **given), output=output).eval()


def classifies(model):
    return isinstance(adapted(model), Encoder) and model.num_classes > 0


def maps_of(result):
    return result if isinstance(result, list) else [result]


def assert_close(found, expected, of=1e-5):
    """Equal up to this part of the largest number."""
    for one, other in zip(maps_of(found), maps_of(expected), strict=True):
        torch.testing.assert_close(one, other, rtol=of, atol=of * other.abs().max().item())


def ways(model, frame, lens):
    """The ways to run a model in Python."""
    size, images = size_of(model), torch.from_numpy(frame)[None]
    prepared = model.prepare(lens, size)
    sampled = model.sample(images, prepared)
    yield model.run(images, prepared)
    yield model.run_sampled(sampled, prepared, images)
    if model.view.uses_lens:
        read = torch.from_numpy(frames.Sampler(camera.plan(model, lens, size))(frame))
        # 1e-4 px, where neighbours differ by at most 1 / STD: the model's places are of float32.
        torch.testing.assert_close(read.reshape(sampled.shape), sampled, rtol=0, atol=1e-3)
    else:
        with pytest.raises(ValueError, match="takes images as they are: it needs no plan"):
            camera.plan(model, lens, size)
    if isinstance(adapted(model), Model):
        fast = optimize(model)
        yield fast(images, lens)
        yield fast.run_sampled(sampled, fast.prepare(lens, size), images)
        yield optimize(model, lens=lens)(images)


def by_file(model, lens, frame, folder):
    """The results of a file, as tensors with the batch."""
    network = network_of(model, folder, lens)
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


@torch.no_grad()
def check(case, lens, channels, folder):
    family, options = case
    model = made(family, channels, **options)
    frame = random_frame(*size_of(model), channels)
    expected = model(torch.from_numpy(frame)[None], lens)
    for found in ways(model, frame, lens):
        assert isinstance(found, list) == isinstance(expected, list)
        assert_close(found, expected)
    if isinstance(adapted(model), Model) and model.view.count == 1:
        found = by_file(model, lens, frame, folder)
        assert isinstance(found, list) == isinstance(expected, list)
        assert_close(found, finished(model, expected))


# Under the sanitizers, each network and each lens once.
ROWS = [
    pytest.param(*row.values, marks=[*row.marks, *[pytest.mark.unsanitized for _ in row.marks]])
    for row in product(CASES, LENSES)
]


@pytest.mark.parametrize(("case", "lens"), ROWS, ids=str)
def test_a_network_gives_the_same_however_it_runs(case, lens, tmp_path):
    check(case, *LENSES[lens], tmp_path)


@pytest.mark.slow
@pytest.mark.unsanitized
@pytest.mark.parametrize("family", FAMILIES)
def test_so_do_the_large_sizes(family, tmp_path):
    check((family, dict(size="small")), *LENSES["round"], tmp_path)


@torch.no_grad()
@pytest.mark.parametrize(
    ("family", "view"),
    [*((name, None) for name in [*CLASSIFIERS, *UNETS, "maps"]), ("swin", "mercator")], ids=str,
)  # fmt: skip
def test_so_it_does_in_8_bits(family, view, tmp_path):
    network = model_of(features_only=True) if family == "maps" else model_of(family)
    model, whole = quantized_of(network), network
    if view is not None:
        model, whole = (
            LensAdapter(one, view=make_view(view, 32, mean=MEAN, std=STD)).eval()
            for one in (model, whole)
        )
    frame = random_frame(*size_of(model), 3, seed=7)
    images = torch.from_numpy(frame)[None]
    expected = finished(whole, whole(images, ROUND))
    direct = optimize(model, torch.int8)
    polar = "darswin" in family or family == "maps"
    found = [finished(model, direct(images, ROUND)), by_file(model, ROUND, frame, tmp_path)]
    # A view is sampled by another operator: a rounding may fall to the other side.
    assert_close(found[1], found[0], 1e-5 if polar else 0.05)
    for result in found:
        for one, other in zip(maps_of(result), maps_of(expected), strict=True):
            assert 1e-5 < (one - other).abs().max() / other.abs().max() < 0.5


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


@pytest.mark.unsanitized
@torch.inference_mode()
@pytest.mark.parametrize(
    "name",
    slow_but([name for name in list_models() if name.startswith("darswin")],
             "darswin_a_nano", "darswin_unet_ra_nano"),
)  # fmt: skip
def test_an_optimized_model_leaves_the_threads_of_torch_asleep(name):
    # They stay awake for milliseconds after each operator, and would compete with our threads.
    model, images = create_model(name, num_classes=5).eval(), torch.rand(1, 3, 70, 80)
    fast = optimize(model, lens=ROUND)
    fast(images)  # prepares the lens
    with Computations() as computed:
        fast(images)
    assert computed.names == []


# Each block of a graph takes seconds. These have a shifted window, and a block after a merge.
SHORT = dict(depths=(2, 1), num_heads=(1, 2))
SHORTER = dict.fromkeys([*CLASSIFIERS, *UNETS], SHORT) | {
    "dat": dict(SHORT, blocks=("LD", "D"), groups=(1, 1)),
    "adapter": dict(options=SHORT),
    "conv_unet": {},
}


@pytest.mark.slow
@pytest.mark.unsanitized
@torch.no_grad()
@pytest.mark.parametrize(
    "case",
    [*((name, {}) for name in FAMILIES),
     *((name, dict(features_only=True)) for name in CLASSIFIERS),
     *(("adapter", dict(network=name, view=view)) for name, view in ADAPTERS)], ids=str,
)  # fmt: skip
def test_graphs_from_frames_and_from_tokens_are_the_same(case, tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    family, options = case
    model = made(family, **options, **SHORTER[family])
    size = size_of(model)
    frame = torch.from_numpy(random_frame(*size, 3))[None]
    expected = model(frame, ROUND)
    tokens = model.sample(frame, model.prepare(ROUND, size))
    for input in ("images", "tokens"):
        path = tmp_path / f"{input}.onnx"
        export_onnx(model, path, frame, ROUND, fixed_lens=True, input=input)
        session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
        given = dict(images=frame.numpy(), tokens=tokens.numpy())
        taken = {of.name: given[of.name] for of in session.get_inputs()}
        alone = input == "images" or not model.refines_with_images
        assert input in taken and (len(taken) == 1) == alone
        found = [torch.from_numpy(array) for array in session.run(None, taken)]
        assert_close(found, expected, 1e-4)
