"""The baselines' outputs, from fixtures computed with their own implementations."""

import pytest
import torch
from helpers import FIXTURES
from safetensors.torch import load_file, save_file

from darswin.compat import load_dat, load_timm_swin
from darswin.layers.transformer import WindowAttention
from darswin.models.dat import DeformableAttention

BASELINES = {"timm_swin": load_timm_swin, "dat_v1": load_dat}


def baseline(name):
    tensors = load_file(FIXTURES / f"{name}.safetensors")
    state = {k.removeprefix("state."): v for k, v in tensors.items() if k.startswith("state.")}
    return tensors, state, BASELINES[name]


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_equal_their_originals(name):
    tensors, state, load = baseline(name)
    model = load(state)
    assert not model.training
    with torch.no_grad():
        logits = model(tensors["images"], None)
        assert (logits - tensors["logits"]).abs().max() <= 1e-5
        if "out.features" in tensors:
            features = model.forward_features(tensors["images"], None)
            assert (features - tensors["out.features"]).abs().max() <= 1e-5


def without_shifts(model):
    for module in model.modules():
        if isinstance(module, WindowAttention):
            module.shift = (0, 0)


def with_tables_turned(model):
    for name, parameter in model.named_parameters():
        if name.endswith("position_bias.table"):
            parameter.data = parameter.data.transpose(1, 2)


def with_still_keys(model):
    for module in model.modules():
        if isinstance(module, DeformableAttention):
            module.offset_range = 0.0


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("timm_swin", without_shifts),
        ("timm_swin", with_tables_turned),
        ("dat_v1", without_shifts),
        ("dat_v1", with_tables_turned),
        ("dat_v1", with_still_keys),
    ],
)
def test_the_baselines_fixtures_can_tell(name, change):
    tensors, state, load = baseline(name)
    model = load(state)
    change(model)
    with torch.no_grad():
        assert (model(tensors["images"]) - tensors["logits"]).abs().max() > 1e-4


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_from_files_and_without_a_head(name, tmp_path):
    tensors, state, load = baseline(name)
    expected = load(state).state_dict()
    save_file(state, tmp_path / "model.safetensors")
    torch.save({"model": state}, tmp_path / "model.pth")
    for file in ("model.safetensors", "model.pth"):
        loaded = load(tmp_path / file).state_dict()
        assert loaded.keys() == expected.keys()
        assert all(torch.equal(loaded[key], expected[key]) for key in expected)
    headless = load({k: v for k, v in state.items() if "head" not in k})
    assert headless(tensors["images"]).shape == (2, headless.num_features)


@pytest.mark.parametrize("name", BASELINES)
def test_other_state_dicts_are_no_baselines(name):
    _, state, load = baseline(name)
    other = next(n for n in BASELINES if n != name)
    for wrong in ({}, baseline(other)[1], {k: v for k, v in state.items() if "norm1" not in k
                                           and "layer_norms.0" not in k}):  # fmt: skip
        with pytest.raises(ValueError, match="not a state dict of"):
            load(wrong)


def test_the_image_size_of_swin_is_an_option():
    tensors, state, load = baseline("timm_swin")
    wide = load(state, image_size=(64, 128))
    assert wide(torch.cat([tensors["images"]] * 2, 3)).shape == (2, 10)
