"""Weight files: reading, converting, and refusing hostile ones."""

import errno
import json
import os
import pickle
import shutil
import sys
import types
from unittest.mock import Mock

import pytest
import torch
from helpers import fixture, refused
from safetensors import safe_open
from safetensors.torch import load_file

from darswin.compat import load_official
from darswin.compat.checkpoint import convert_checkpoint, read_state


class CfgNode(dict):
    """A copy of yacs's class that is pickled in the same way."""

    def __init__(self, *given):
        super().__init__(*given)
        self.__dict__["__immutable__"] = True


@pytest.fixture(params=["zip", "legacy"])
def checkpoint(request, tmp_path, monkeypatch):
    """A checkpoint like those of the authors' code. A fake yacs exists only while it is written,
    because reading must not need yacs."""
    weight = torch.nn.Parameter(torch.zeros(3))
    optimizer = torch.optim.AdamW([weight])
    weight.sum().backward()
    optimizer.step()
    model = CfgNode(dict(DROP_PATH_RATE=0.2, NAME="darswin"))
    config = CfgNode(dict(MODEL=model, BASE=[""], AUG=(1, None)))
    content = dict(model=fixture("angular")[1], optimizer=optimizer.state_dict(), config=config)
    content |= dict(lr_scheduler={"base_values": [1.25e-4]}, max_accuracy=92.8, epoch=325)
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
        torch.load(checkpoint, weights_only=True)  # torch alone cannot read it
    target = tmp_path / "converted" / "model.safetensors"
    target.parent.mkdir()
    convert_checkpoint(checkpoint, target)
    tensors, state, lens = fixture("angular")
    written = load_file(target)
    assert written.keys() == state.keys()
    assert all(torch.equal(written[key], state[key]) for key in state)
    with safe_open(target, "pt") as file:
        config = json.loads(file.metadata()["config"])
    model = {"DROP_PATH_RATE": 0.2, "NAME": "darswin"}
    assert config == {"MODEL": model, "BASE": [""], "AUG": [1, None]}
    mask = os.umask(0)
    os.umask(mask)
    assert list(target.parent.iterdir()) == [target]
    assert target.stat().st_mode & 0o777 == 0o666 & ~mask
    for file in (target, checkpoint):  # `load_official` also reads the checkpoint itself
        with torch.no_grad():
            logits = load_official(file)(tensors["images"], lens)
        assert (logits - tensors["logits"]).abs().max() <= 1e-5
    assert "yacs" not in sys.modules
    assert "yacs" not in str(torch.serialization.get_safe_globals())


class Hostile:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("entry", ["config", "model", "optimizer"])
def test_a_hostile_checkpoint_is_refused(entry, zipped, tmp_path):
    source, target, executed = (tmp_path / name for name in ("a.pth", "a.safetensors", "executed"))
    for function, name, *arguments in (
        (os.system, "posix.system", f"touch '{executed}'"),
        (shutil.copyfile, "shutil.copyfile", __file__, str(executed)),
        (eval, "eval", f"open({str(executed)!r}, 'w')"),
    ):
        hostile = {"model": {"a": torch.zeros(3)}, entry: Hostile(function, *arguments)}
        torch.save(hostile, source, _use_new_zipfile_serialization=zipped)
        for read in (read_state, load_official, lambda path: convert_checkpoint(path, target)):
            refused(f"is refused, .* it refers to {name}, which", read, source)
        assert list(tmp_path.iterdir()) == [source]
        torch.load(source, weights_only=False)  # without the refusal, the code runs
        executed.unlink()


def test_files_that_are_no_checkpoints(tmp_path):
    source, target = tmp_path / "checkpoint.pth", tmp_path / "model.safetensors"
    for content in ({"epoch": 3}, [torch.zeros(2)], {"model": [torch.zeros(2)]}):
        torch.save(content, source)
        refused("has no state dict", convert_checkpoint, source, target)
        assert not target.exists()
    for content in (b"", b"no checkpoint", b"PK\3\4" + bytes(100), b"\x80\2R."):
        for path, message in ((source, "as a checkpoint"), (target, "as safetensors")):
            path.write_bytes(content)
            refused(f"{path.name} cannot be read {message}", read_state, path)
    for name in ("another.pth", "another.safetensors"):
        refused("another", read_state, tmp_path / name, error=FileNotFoundError)


def test_a_failed_conversion_leaves_the_target_as_it_was(tmp_path, monkeypatch):
    source, target = tmp_path / "checkpoint.pth", tmp_path / "model.safetensors"
    torch.save({"model": {"a": torch.ones(2)}}, source)
    target.write_bytes(b"before")

    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr(os, "fsync", full)
    said = r"cannot write the file.*No space left.*model\.safetensors"
    refused(said, convert_checkpoint, source, target, error=OSError)
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
