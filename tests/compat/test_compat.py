"""Other implementations' outputs, from fixtures computed with them, and their files.

The fixtures of the released DarSwin were made on a CPU on which MKL takes its compatible path. Near
90° the float32 tangents of the released sampling differ between MKL's paths enough to move the
embedding by 3e-4, for the released code as for ours. So the comparison runs in a process with that
path chosen.
"""

import errno
import json
import os
import pickle
import shutil
import subprocess
import sys
import types
import warnings
from pathlib import Path

import pytest
import torch
from helpers import FIXTURES, fixture
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from darswin import DarSwin
from darswin.compat import (
    OfficialPolynomial,
    convert_checkpoint,
    load_dat,
    load_official,
    load_timm_swin,
    read_state,
)
from darswin.layers.attention import WindowAttention
from darswin.models.dat import DeformableAttention

NAMES = ("angular", "polar", "poly")


def differences(name) -> dict[str, float]:
    """Largest absolute difference from the released code, for each thing that a fixture holds."""
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
    # Patches in the released order: (azimuth, ring), and of them every 37th; the grid is that of
    # the transposed image.
    grid = model.patch_embed.sample.grid(lens, (64, 64))
    r, a = grid.radii[:, :, None], grid.azimuths
    xy = torch.stack((r * torch.sin(a), r * torch.cos(a)), -1) / 31.5
    patches = xy.reshape(-1, 16, 10, 64, 10, 2).permute(0, 3, 1, 2, 4, 5).reshape(-1, 1024, 100, 2)
    results["grid"] = (patches[:, ::37] - tensors["out.grid"]).abs().max().item()
    return results


@pytest.mark.parametrize("name", NAMES)
def test_equals_the_released_code_to_1e_4(name):
    code = f"import test_compat, json; print(json.dumps(test_compat.differences({name!r})))"
    path = [str(Path(__file__).parent), *sys.path]
    environment = dict(os.environ, MKL_CBWR="COMPATIBLE", PYTHONPATH=os.pathsep.join(path))
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    assert results.keys() == {
        "grid", "embed", "stage0", "stage1", "stage2", "stage3", "logits"
    }  # fmt: skip
    assert max(results.values()) <= 1e-4, results


@pytest.mark.parametrize("name", NAMES)
def test_logits_equal_with_any_maths_library(name):
    results = differences(name)
    assert results["logits"] <= 1e-5 and results["grid"] <= 5e-6, results


def test_every_part_of_the_compatibility_matters():
    # The same weights in the paper's model give other logits: the fixture can tell.
    tensors, state, lens = fixture("angular")
    official = load_official(state)
    paper = DarSwin(10, 3, 8, (2, 2, 2, 2), (1, 2, 4, 8), spacing="tan", placement="edges")
    values = official.state_dict()
    for key in ("stages.3.blocks.0", "stages.3.blocks.1"):
        for coefficient in ("a_phi", "b_phi"):
            name = f"{key}.attn.position_bias.{coefficient}"
            assert values[name].shape == (1, 8)  # one row where a window is the whole map
    paper.load_state_dict(values)
    with torch.no_grad():
        other = paper.eval()(tensors["images"], lens)
    assert (other - tensors["logits"]).abs().max() > 1e-2


def test_full_size_parameter_count():
    with torch.device("meta"):
        model = DarSwin(200, compat="official")
    assert sum(p.numel() for p in model.parameters()) == 48_977_864


def test_reads_files(tmp_path):
    _, state, _ = fixture("angular")
    expected = load_official(state).state_dict()
    save_file(state, tmp_path / "model.safetensors")
    torch.save(state, tmp_path / "model.pt")
    torch.save({"model": state, "epoch": 325, "max_accuracy": 92.8}, tmp_path / "checkpoint.pth")
    for name in ("model.safetensors", "model.pt", "checkpoint.pth"):
        for key, value in load_official(tmp_path / name).state_dict().items():
            assert torch.equal(value, expected[key]), key


def test_the_polar_model_is_the_papers_angular_encoding():
    _, state, _ = fixture("polar")
    model = load_official(state)
    assert model.position_bias == "angular" and model.compat == "official"
    assert model.stages[0].blocks[0].attn.position_bias.a_phi.shape == (16, 1)
    assert not model.training


def test_the_radial_models_weights_load_with_a_warning():
    donor = DarSwin(
        10, 3, 8, (2, 2, 2, 2), (1, 2, 4, 8), variant="RA", position_bias="polar", harmonics=4
    )
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


def test_other_state_dicts_are_refused():
    with pytest.raises(ValueError, match="not a state dict of a released DarSwin"):
        load_official({})
    with pytest.raises(ValueError, match="not a state dict of a released DarSwin"):
        load_official({"layers.0.blocks.0.norm1.weight": torch.zeros(8)})
    _, state, _ = fixture("angular")
    del state["norm.weight"]
    with pytest.raises(ValueError, match=r"norm\.weight"):
        load_official(state)


def test_official_polynomial():
    lens = OfficialPolynomial(torch.tensor([[0.5, 0.5, 0.5, 0.5], [1.0, 0.2, 0.0, 0.1]]), 32.0)
    theta = lens.theta_max[:, None] * torch.linspace(0, 1, 40)
    torch.testing.assert_close(lens.unproject(lens.project(theta)), theta, rtol=0, atol=3e-3)
    torch.testing.assert_close(lens.r_max, torch.full((2,), 32.0))
    assert OfficialPolynomial([7.7, 7.7, 7.7, 7.7], 32.0).theta_max > 30  # as in the released data
    with pytest.raises(ValueError, match="coefficients must be such that θ rises"):
        OfficialPolynomial([1.0, -3.0, 0.5, 3.0], 32.0)
    with pytest.raises(ValueError, match="radius must be greater than 0"):
        OfficialPolynomial([1.0, 0.0, 0.0, 0.0], 0.0)


def test_no_warning_for_models_that_run():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in NAMES:
            load_official(fixture(name)[1])


# -- Swin and DAT ---------------------------------------------------------------------------------

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


# -- pickled checkpoints --------------------------------------------------------------------------


class CfgNode(dict):
    """As yacs has it, as far as a pickle goes."""

    def __init__(self, *given):
        super().__init__(*given)
        self.__dict__["__immutable__"] = True


@pytest.fixture(params=["zip", "legacy"])
def checkpoint(request, tmp_path, monkeypatch):
    """What the authors' code saves. yacs is not needed to read it, so a module of that name is
    there only to write it."""
    weight = torch.nn.Parameter(torch.zeros(3))
    optimizer = torch.optim.AdamW([weight])
    weight.sum().backward()
    optimizer.step()
    model = CfgNode(dict(DROP_PATH_RATE=0.2, NAME="darswin"))
    content = dict(
        model=fixture("angular")[1],
        optimizer=optimizer.state_dict(),
        lr_scheduler={"base_values": [1.25e-4]},
        max_accuracy=92.8,
        scaler={"scale": 65536.0},
        epoch=325,
        config=CfgNode(dict(MODEL=model, BASE=[""], AUG=(1, None))),
    )
    target = tmp_path / "authors" / "checkpoint.pth"
    target.parent.mkdir()
    with monkeypatch.context() as patch:
        module = types.ModuleType("yacs.config")
        module.CfgNode = CfgNode
        patch.setattr(CfgNode, "__module__", "yacs.config")
        patch.setitem(sys.modules, "yacs", types.ModuleType("yacs"))
        patch.setitem(sys.modules, "yacs.config", module)
        torch.save(content, target, _use_new_zipfile_serialization=request.param == "zip")
    return target


def test_converts_the_authors_checkpoints(checkpoint, tmp_path):
    assert "yacs" not in sys.modules
    with pytest.raises(pickle.UnpicklingError, match=r"yacs\.config\.CfgNode"):
        torch.load(checkpoint, weights_only=True)  # torch alone does not
    target = tmp_path / "converted" / "model.safetensors"
    target.parent.mkdir()
    convert_checkpoint(checkpoint, target)
    tensors, state, lens = fixture("angular")
    written = load_file(target)
    assert written.keys() == state.keys()
    assert all(torch.equal(written[key], state[key]) for key in state)
    with safe_open(target, "pt") as file:
        config = json.loads(file.metadata()["config"])
    assert config == {
        "MODEL": {"DROP_PATH_RATE": 0.2, "NAME": "darswin"}, "BASE": [""], "AUG": [1, None],
    }  # fmt: skip
    assert list(target.parent.iterdir()) == [target]
    assert target.stat().st_mode & 0o777 == 0o666 & ~_umask()
    for file in (target, checkpoint):  # loaders read the checkpoint as well
        with torch.no_grad():
            logits = load_official(file)(tensors["images"], lens)
        assert (logits - tensors["logits"]).abs().max() <= 1e-5
    assert "yacs" not in sys.modules
    assert "yacs" not in str(torch.serialization.get_safe_globals())


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


class Hostile:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize(
    ("function", "name"),
    [
        (os.system, "posix.system"),
        (shutil.copyfile, "shutil.copyfile"),
        (eval, "eval"),
    ],
)
@pytest.mark.parametrize("entry", ["config", "model", "optimizer"])
def test_a_hostile_checkpoint_is_refused(function, name, entry, zipped, tmp_path):
    executed = tmp_path / "executed"
    arguments = {
        os.system: [f"touch {executed}"],
        shutil.copyfile: [__file__, str(executed)],
        eval: [f"open({str(executed)!r}, 'w')"],
    }[function]
    checkpoint = {"model": {"norm.weight": torch.zeros(3)}, entry: Hostile(function, *arguments)}
    source, target = tmp_path / "hostile.pth", tmp_path / "model.safetensors"
    torch.save(checkpoint, source, _use_new_zipfile_serialization=zipped)
    for read in (read_state, load_official, lambda path: convert_checkpoint(path, target)):
        with pytest.raises(ValueError, match=f"is refused, .* it asks for {name}, which"):
            read(source)
    assert list(tmp_path.iterdir()) == [source]
    torch.load(source, weights_only=False)  # it would have been
    assert executed.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"epoch": 3}, "holds no state dict"),
        ([torch.zeros(2)], "holds no state dict"),
        ({"model": [torch.zeros(2)]}, "holds no state dict"),
    ],
)
def test_checkpoints_without_weights(content, message, tmp_path):
    torch.save(content, tmp_path / "checkpoint.pth")
    with pytest.raises(ValueError, match=message):
        convert_checkpoint(tmp_path / "checkpoint.pth", tmp_path / "model.safetensors")
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\3\4" + bytes(100), b"\x80\2R."])
def test_files_that_are_no_checkpoints(content, tmp_path):
    (tmp_path / "checkpoint.pth").write_bytes(content)
    with pytest.raises(ValueError, match=r"checkpoint\.pth cannot be read as a checkpoint"):
        read_state(tmp_path / "checkpoint.pth")
    (tmp_path / "model.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.safetensors cannot be read as safetensors"):
        read_state(tmp_path / "model.safetensors")
    for name in ("another.pth", "another.safetensors"):
        with pytest.raises(FileNotFoundError):
            read_state(tmp_path / name)


def test_a_failed_conversion_leaves_the_target_as_it_was(tmp_path, monkeypatch):
    source, target = tmp_path / "checkpoint.pth", tmp_path / "model.safetensors"
    torch.save({"model": {"a": torch.ones(2)}}, source)
    target.write_bytes(b"before")

    def full(file):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"cannot write it.*No space left.*model\.safetensors"):
        convert_checkpoint(source, target)
    assert target.read_bytes() == b"before" and len(list(tmp_path.iterdir())) == 2


def test_weights_that_share_memory_or_stride_and_odd_configurations(tmp_path):
    weight = torch.arange(6.0).reshape(2, 3)
    source, target = tmp_path / "checkpoint.pth", tmp_path / "model.safetensors"
    model = {"a": weight, "b": weight, "c": weight.T, "d": torch.ones(2, dtype=torch.bfloat16)}
    torch.save({"model": model, "config": {"a set": {1, 2}}}, source)
    convert_checkpoint(source, target)
    written = load_file(target)
    assert all(torch.equal(written[key], value) for key, value in model.items())
    with safe_open(target, "pt") as file:
        assert "config" not in file.metadata()
