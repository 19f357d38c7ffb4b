"""One contract of the seam between lenses and networks, for every model that has a name, for every
backbone, and for a network behind an adapter: whoever samples the frame, the result is the same."""

import numpy as np
import pytest
import torch
from helpers import side_of
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from darswin import create_model, frames, list_models, optimize
from darswin.deploy import camera
from darswin.deploy.export import export_onnx
from darswin.lens import Spherical
from darswin.models import LensAdapter
from darswin.models.encoder import Encoder
from darswin.models.registry import has_image_size, model_class

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
NORMALIZED = dict(mean=MEAN, std=STD)
ENCODERS = [name for name in list_models() if issubclass(model_class(name), Encoder)]
OPTIONS = {
    "backbone": dict(features_only=True),
    "grey": dict(in_chans=1, mean=0.4, std=0.2),
    "grey backbone": dict(features_only=True, in_chans=1, mean=0.4, std=0.2),
    "distance": dict(task="distance"),
    "mercator": dict(view="mercator", size=(40, 30)),
    "equirectangular": dict(view=dict(name="equirectangular", fov=2.8)),
    "perspective": dict(view="perspective", task="distance"),
}
CASES = [
    *list_models(),
    *(f"{name} backbone" for name in ENCODERS),
    *(f"adapter {view}" for view in ("square", "perspective", "polar")),
]
# Other pixels and views of the smallest models.
MORE = [
    *(f"{name} grey" for name in list_models() if name.endswith("nano")),
    *(f"{name} grey backbone" for name in ENCODERS if name.endswith("nano")),
    "darswin_unet_a_nano distance",
    "swin_unet_nano perspective",
    "conv_unet_nano mercator",
    "swin_unet_nano equirectangular",
]


def cost(case):
    """Marks the larger sizes of a model as slow: they differ from the smaller in numbers alone."""
    large = "nano" not in case and "adapter" not in case
    return pytest.param(case, marks=[pytest.mark.slow] if large else [])


def made(case):
    """A model in eval mode, a frame of uint8, and its lens."""
    torch.manual_seed(0)
    kind, _, rest = case.partition(" ")
    height, width, channels = side_of(case), side_of(case) + 10, 3
    if kind == "adapter":
        network = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.GELU(), nn.Conv2d(4, 5, 2, 2))
        model: nn.Module = LensAdapter(network, 24, view=rest, **NORMALIZED)
    else:
        options = NORMALIZED | OPTIONS.get(rest, {})
        if "features_only" not in options:
            options |= dict(num_classes=5)
        if has_image_size(kind):
            width = height
            options |= dict(image_size=height)
        model = create_model(kind, **options)
        channels = options.get("in_chans", 3)
    frame = torch.randint(256, (1, height, width, channels), dtype=torch.uint8)
    return model.eval(), frame, Spherical.from_fov(0.5, 2.6, height / 2)


def assert_same(found, expected, tolerance):
    """Compares results, relative to the largest number of each."""
    found, expected = ([x] if isinstance(x, torch.Tensor) else x for x in (found, expected))
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance * b.abs().max().item())


@torch.no_grad()
@pytest.mark.parametrize("case", list(map(cost, CASES + MORE)))
def test_it_does_not_matter_who_samples_the_frame(case):
    model, frame, lens = made(case)
    size = tuple(frame.shape[1:3])
    prepared = model.prepare(lens, size)
    sampled, result = model.sample(frame, prepared), model(frame, lens)
    assert_same(model.run_sampled(sampled, prepared, frame), result, 1e-5)
    if not model.view.uses_lens:
        with pytest.raises(ValueError, match="takes images as they are: it needs no plan"):
            camera.plan(model, lens, size)
    else:
        read = frames.Sampler(camera.plan(model, lens, size))(frame[0].numpy())
        np.testing.assert_allclose(read, sampled[0].numpy(), rtol=1e-4, atol=1e-4)
    if not isinstance(model, LensAdapter):
        fast = optimize(model)
        assert_same(fast(frame, lens), result, 1e-4)
        assert_same(fast.run_sampled(sampled, fast.prepare(lens, size), frame), result, 1e-4)


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


@pytest.mark.parametrize(
    "case", list(map(cost, (case for case in CASES if case.startswith("darswin"))))
)
def test_an_optimized_model_leaves_the_thsupersampling_of_torch_asleep(case):
    # They stay awake for milliseconds after each operator, and would compete with our threads.
    model, frame, lens = made(case)
    images = (frame.permute(0, 3, 1, 2) / 255.0).contiguous()
    fast = optimize(model, lens=lens)
    with torch.inference_mode():
        fast(images)  # prepares the lens
        with Computations() as computed:
            fast(images)
    assert computed.names == []


@pytest.mark.slow
@torch.no_grad()
@pytest.mark.parametrize(
    "case", [case for case in CASES if "nano" in case or case.startswith("adapter")]
)
def test_graphs_from_frames_and_from_tokens_are_the_same(case, tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    model, frame, lens = made(case)
    tokens = model.sample(frame, model.prepare(lens, tuple(frame.shape[1:3])))
    results = []
    for input in ("images", "tokens"):
        path = tmp_path / f"{input}.onnx"
        export_onnx(model, path, frame, lens, fixed_lens=True, input=input)
        session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
        given = dict(images=frame.numpy(), tokens=tokens.numpy())
        taken = {of.name: given[of.name] for of in session.get_inputs()}
        assert (input in taken) and (input == "images" or not model.refines_with_images) == (
            len(taken) == 1
        )
        results.append([torch.from_numpy(array) for array in session.run(None, taken)])
    assert_same(*results, 1e-4)
    expected = model(frame, lens)
    assert_same(results[0], [expected] if isinstance(expected, torch.Tensor) else expected, 1e-4)
