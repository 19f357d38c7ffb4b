"""timm's habits, on every model and on what `optimize` makes of it.

timm's own Swin (1.0.31) was run beside ours for what is expected here: which maps, in which order,
normed or not, and what pruning leaves.
"""

import copy
import functools

import pytest
import torch
from helpers import FIXTURES
from safetensors.torch import load_file

from darswin import create_model, list_models, optimize
from darswin.compat import load_timm_swin
from darswin.lens import Spherical
from darswin.models.base import take_indices
from darswin.models.encoder import Encoder
from darswin.models.registry import model_class

ENCODERS = [name for name in list_models() if issubclass(model_class(name), Encoder)]
NANOS = [name for name in ENCODERS if name.endswith("nano")]


@functools.cache
def network(name):
    return create_model(name, num_classes=5, mean=0.5, std=0.2).eval()


def images_and_lens(model, count=2):
    height, width = model.image_size or (32, 32)
    return torch.randn(count, 3, height, width), Spherical.from_fov(0.4, 2.6, height / 2)


def ran(model, call):
    """The names of the stages that run in a call."""
    names = []
    hooks = [
        stage.register_forward_hook(lambda *_, name=name: names.append(f"stages.{name}"))
        for name, stage in model.stages.named_children()
    ]
    call()
    for hook in hooks:
        hook.remove()
    return names


@torch.no_grad()
@pytest.mark.parametrize("name", ENCODERS)
def test_what_a_model_says_of_its_stages_is_what_they_give(name):
    model = create_model(name, num_classes=5).eval()
    x, lens = images_and_lens(model, 1)
    info = model.feature_info
    found: dict[str, tuple[int, ...]] = {}
    for net in (model, optimize(model)):
        found.clear()
        for module in net.feature_info.module_name():
            net.get_submodule(module).register_forward_hook(
                lambda _, __, out, module=module: found.update({module: tuple(out.shape)})
            )
        maps = net.forward_intermediates(x, lens, intermediates_only=True)
        assert [tuple(m.shape) for m in maps] == [found[module] for module in info.module_name()]
        assert [m.shape[3] for m in maps] == info.channels() == net.feature_info.channels()
        assert [tuple(m.shape[1:3]) for m in maps] == info.get("map_size")
        assert net.num_features == net.head_hidden_size == info.channels(-1)
        assert (
            net.get_classifier()
            is net.head
            is net.get_submodule(model.pretrained_cfg["classifier"])
        )
        assert net.pretrained_cfg == model.pretrained_cfg
    # A map is as large as its images, or the samples of its grid, over the reduction.
    whole = model.image_size or [
        count * s for count, s in zip(info[0]["map_size"], model.spec.samples, strict=True)
    ]
    for (rows, columns), reduction in zip(info.get("map_size"), info.reduction(), strict=True):
        assert max(whole[0] // rows, whole[1] // columns) == reduction
    config = model.pretrained_cfg
    assert config["architecture"] == name and config["num_classes"] == 5
    assert config["input_size"] == (3, *(model.image_size or (64, 64)))
    assert config["fixed_input_size"] == (model.image_size is not None)
    assert model.get_submodule(config["first_conv"]) is model.patch_embed.proj


def test_accessors():
    info = network("darswin_a_nano").feature_info
    assert info.channels() == [24, 48, 96] and info.channels([0, 2]) == [24, 96]
    assert info.reduction() == [4, 16, 64] and info.module_name(-1) == "stages.2"
    assert network("darswin_ra_nano").feature_info.reduction() == [4, 8, 16]
    assert network("swin_nano").feature_info.reduction() == [2, 4, 8]
    assert create_model("darswin_a_micro").feature_info.get("map_size")[-1] == (16, 1)


@torch.no_grad()
@pytest.mark.parametrize("name", NANOS)
@pytest.mark.parametrize("optimized", [False, True])
@pytest.mark.parametrize(
    ("indices", "stages"),
    [(None, [0, 1, 2]), (1, [2]), ([0], [0]), ([1, 0], [0, 1]), ([-2, 1], [1]), ((0, -1), [0, 2])],
)
def test_the_intermediates_that_timm_gives(name, optimized, indices, stages):
    model = optimize(network(name)) if optimized else network(name)
    x, lens = images_and_lens(model)
    features, every = model.forward_intermediates(x, lens)
    assert torch.equal(features, model.forward_features(x, lens))
    assert torch.equal(features, model.norm(every[-1]))
    last, maps = model.forward_intermediates(x, lens, indices=indices)
    assert torch.equal(last, features) and len(maps) == len(stages)
    assert all(torch.equal(m, every[k]) for m, k in zip(maps, stages, strict=True))

    normed = model.forward_intermediates(
        x, lens, indices=indices, norm=True, intermediates_only=True
    )
    for got, k in zip(normed, stages, strict=True):
        assert torch.equal(got, features if k == 2 else every[k])
    last, maps = model.forward_intermediates(
        x, lens, indices=indices, stop_early=True, output_fmt="NCHW"
    )
    end = max(stages)
    assert torch.equal(last, features if end == 2 else every[end])
    for got, k in zip(maps, stages, strict=True):
        assert got.is_contiguous() and torch.equal(got, every[k].permute(0, 3, 1, 2))
    call = functools.partial(model.forward_intermediates, x, lens, indices=indices)
    assert ran(model, call) == ["stages.0", "stages.1", "stages.2"]
    early = functools.partial(call, stop_early=True, intermediates_only=True)
    assert ran(model, early) == ["stages.0", "stages.1", "stages.2"][: end + 1]


def test_wrong_arguments():
    model = network("darswin_a_nano")
    x, lens = images_and_lens(model)
    for wrong in (0, 4, -1, [3], [-4], []):
        with pytest.raises(ValueError, match="indices must name some of 3 stages"):
            model.forward_intermediates(x, lens, indices=wrong)
    with pytest.raises(ValueError, match="output_fmt must be 'NHWC' or 'NCHW', got 'NLC'"):
        model.forward_intermediates(x, lens, output_fmt="NLC")
    assert take_indices(4, 2) == [2, 3] and take_indices(4, (-1, 0)) == [3, 0]


def test_gradients_with_checkpointing_are_the_same():
    model = copy.deepcopy(network("darswin_a_nano"))
    x, lens = images_and_lens(model)
    grads = []
    for enable in (False, True):
        model.set_grad_checkpointing(enable)
        maps = model.forward_intermediates(x, lens, intermediates_only=True, stop_early=True)
        grads.append(torch.autograd.grad(sum(m.square().sum() for m in maps), stage_weights(model)))
    assert all(torch.equal(a, b) for a, b in zip(*grads, strict=True))


def stage_weights(model):
    return [p for name, p in model.named_parameters() if name.startswith("stages")]


@torch.no_grad()
def test_the_last_intermediate_of_timms_swin():
    tensors = load_file(FIXTURES / "timm_swin.safetensors")
    state = {k.removeprefix("state."): v for k, v in tensors.items() if k.startswith("state.")}
    model = load_timm_swin(state)
    (last,) = model.forward_intermediates(
        tensors["images"], indices=1, norm=True, intermediates_only=True
    )
    assert (last - tensors["out.features"]).abs().max() <= 1e-5


@torch.no_grad()
@pytest.mark.parametrize("name", NANOS)
def test_pruning(name):
    model = network(name)
    x, lens = images_and_lens(model)
    maps = model.forward_intermediates(x, lens, intermediates_only=True)
    pruned = copy.deepcopy(model)
    assert pruned.prune_intermediate_layers([0, -2]) == [0, 1]
    assert len(pruned.stages) == len(pruned.feature_info) == 2
    assert torch.equal(pruned.forward_features(x, lens), maps[1])
    assert pruned(x, lens).shape == (2, 48) and pruned.num_features == 48
    pruned.reset_classifier(7)
    assert pruned(x, lens).shape == (2, 7)
    short = optimize(pruned)
    torch.testing.assert_close(short.forward_features(x, lens), maps[1], atol=1e-5, rtol=1e-4)
    whole = copy.deepcopy(model)  # nothing is cut: the norm stays, and the head if asked
    assert whole.prune_intermediate_layers(1, prune_head=False) == [2]
    assert torch.equal(whole(x, lens), model(x, lens))
    whole.prune_intermediate_layers(prune_norm=True)
    assert torch.equal(whole.forward_features(x, lens), maps[2]) and whole.num_classes == 0
    with pytest.raises(TypeError, match="prune it first"):
        optimize(model).prune_intermediate_layers()
    assert model.num_classes == 5 and len(model.stages) == 3
