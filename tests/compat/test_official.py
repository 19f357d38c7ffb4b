"""The outputs of the released DarSwin, from fixtures computed with it.

The fixtures were made on a CPU on which MKL takes its compatible path. Near 90° the float32
tangents of the released sampling differ between the paths of MKL. This moves the embedding by 3e-4,
in the released code and in ours. So the comparison runs in a process that selects this path.
"""

import json
import os
import sys
import warnings
from pathlib import Path

import pytest
import torch
from helpers import fixture, output, refused

from darswin import DarSwin
from darswin.compat import OfficialDarSwin, OfficialPolynomial, load_official

NAMES = ("angular", "polar", "poly")


def differences(name) -> dict[str, float]:
    """The largest absolute difference from the released code, for each tensor of a fixture."""
    tensors, state, lens = fixture(name)
    model = load_official(state)
    found = {}
    model.patch_embed.register_forward_hook(lambda _m, _i, out: found.update(embed=out))
    for stage in (1, 2, 3):
        model.stages[stage].downsample.register_forward_hook(
            lambda _m, _i, out, key=f"stage{stage - 1}": found.update({key: out})
        )
    with torch.no_grad():
        found["logits"] = model(tensors["images"], lens)
        found["stage3"] = model.forward_intermediates(tensors["images"], lens)[1][-1]
    results = {}
    for key, value in found.items():
        expected = tensors[key if key == "logits" else f"out.{key}"]
        results[key] = (value.reshape(expected.shape) - expected).abs().max().item()
    # The fixture has every 37th patch, in the order (azimuth, ring), of the transposed image.
    grid = model.prepare(lens, (64, 64)).view.grid
    r, a = grid.radii[:, :, None], grid.azimuths
    xy = torch.stack((r * torch.sin(a), r * torch.cos(a)), -1) / 31.5
    patches = xy.reshape(-1, 16, 10, 64, 10, 2).permute(0, 3, 1, 2, 4, 5).reshape(-1, 1024, 100, 2)
    results["grid"] = (patches[:, ::37] - tensors["out.grid"]).abs().max().item()
    return results


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_equals_the_released_code_to_1e_4(name):
    code = f"import test_official, json; print(json.dumps(test_official.differences({name!r})))"
    path = [str(Path(__file__).parent), *sys.path]
    environment = dict(MKL_CBWR="COMPATIBLE", PYTHONPATH=os.pathsep.join(path))
    results = json.loads(output(sys.executable, "-c", code, env=environment))
    assert {*results} == {"grid", "embed", *(f"stage{k}" for k in range(4)), "logits"}
    assert max(results.values()) <= 1e-4, results


@pytest.mark.parametrize("name", NAMES)
def test_logits_equal_with_any_maths_library(name):
    with warnings.catch_warnings(action="error"):
        results = differences(name)
    assert results["logits"] <= 1e-5 and results["grid"] <= 5e-6, results


def test_the_radial_models_weights_load_with_a_warning():
    options = dict(variant="RA", position_bias="polar", harmonics=4)
    donor = DarSwin(10, 3, 8, (2, 2, 2, 2), (1, 2, 4, 8), **options)
    names = {"b_theta": "a_r", "a_theta": "b_r", "b_phi": "a_p", "a_phi": "b_p"}
    state = {}
    for key, value in donor.state_dict().items():
        for ours, theirs in names.items():
            key = key.replace(f"position_bias.{ours}", theirs)
        key = key.replace("patch_embed.proj", "patch_embed.mlp")
        if key.startswith("stages."):
            _, stage, rest = key.split(".", 2)
            key = f"layers.{int(stage) - rest.startswith('downsample')}.{rest}"
        state[key] = value
    with pytest.warns(UserWarning, match="released radial model does not run"):
        model = load_official(state)
    loaded, expected = model.state_dict(), donor.state_dict()
    assert loaded.keys() == expected.keys()
    weight = "stages.1.blocks.0.attn.position_bias.b_phi"
    assert torch.equal(loaded[weight], expected[weight])


def test_other_state_dicts_and_options_are_refused():
    _, state, _ = fixture("angular")
    del state["norm.weight"]
    for wrong, said in (
        ({}, "not a state dict of a released DarSwin"),
        ({"layers.0.blocks.0.norm1.weight": torch.zeros(8)}, "not a state dict of a released"),
        (state, r"norm\.weight"),
    ):
        refused(said, load_official, wrong)
    for option in (dict(variant="RA"), dict(merges=((1, 4), (4, 1)))):
        refused(next(iter(option)), OfficialDarSwin, **option, error=TypeError)


def test_official_polynomial():
    lens = OfficialPolynomial(torch.tensor([[0.5, 0.5, 0.5, 0.5], [1.0, 0.2, 0.0, 0.1]]), 32.0)
    theta = lens.theta_max[:, None] * torch.linspace(0, 1, 40)
    torch.testing.assert_close(lens.unproject(lens.project(theta)), theta, rtol=0, atol=3e-3)
    torch.testing.assert_close(lens.r_max, torch.full((2,), 32.0))
    assert OfficialPolynomial([7.7, 7.7, 7.7, 7.7], 32.0).theta_max > 30  # as in the released data
    said = "coefficients must be such that θ rises"
    refused(said, OfficialPolynomial, [1.0, -3.0, 0.5, 3.0], 32.0)
    refused("radius must be finite and above 0", OfficialPolynomial, [1.0, 0.0, 0.0, 0.0], 0.0)
