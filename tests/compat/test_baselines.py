"""The baselines' outputs, from fixtures computed with their own implementations."""

import pytest
import torch
from helpers import fixture, refused, stored
from safetensors.torch import save_file

from darswin.compat import load_dat, load_official, load_timm_swin

BASELINES = {"timm_swin": load_timm_swin, "dat_v1": load_dat}


def baseline(name):
    return *stored(name), BASELINES[name]


@pytest.mark.parametrize("name", BASELINES)
def test_baselines_equal_their_originals(name):
    tensors, state, load = baseline(name)
    model = load(state)
    assert not model.training
    with torch.no_grad():
        logits = model(tensors["images"], None)
        assert (logits - tensors["logits"]).abs().max() <= 1e-5
        if name == "timm_swin":
            sevens = {
                k: v.new_zeros(169, v.shape[1]) if "table" in k else v for k, v in state.items()
            }
            refused("give image_size, which is 64 here", load, sevens)
            wide = load(state, image_size=(64, 128))
            assert wide(torch.cat([tensors["images"]] * 2, 3)).shape == (2, 10)
        if "out.features" in tensors:
            features = model.forward_features(tensors["images"], None)
            assert (features - tensors["out.features"]).abs().max() <= 1e-5


@pytest.mark.parametrize("name", [*BASELINES, "official"])
def test_weights_from_files_and_without_a_head(name, tmp_path):
    official = (*fixture("angular")[:2], load_official)
    tensors, state, load = official if name == "official" else baseline(name)
    expected = load(state).state_dict()
    save_file(state, tmp_path / "model.safetensors")
    torch.save(state, tmp_path / "model.pt")
    torch.save({"model": state, "epoch": 325}, tmp_path / "model.pth")
    for suffix in (".safetensors", ".pt", ".pth"):
        loaded = load(tmp_path / f"model{suffix}").state_dict()
        assert loaded.keys() == expected.keys()
        assert all(torch.equal(loaded[key], expected[key]) for key in expected)
    if name != "official":
        headless = load({k: v for k, v in state.items() if "head" not in k})
        assert headless(tensors["images"]).shape == (2, headless.num_features)


@pytest.mark.parametrize("name", BASELINES)
def test_other_state_dicts_are_no_baselines(name):
    _, state, load = baseline(name)
    (other,) = BASELINES.keys() - {name}
    lacking = {k: v for k, v in state.items() if "norm1" not in k and "layer_norms.0" not in k}
    for wrong in ({}, baseline(other)[1], lacking):
        refused("not a state dict of", load, wrong)
