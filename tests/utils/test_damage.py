"""A damaged file of weights is an error or gives the same weights, whichever byte changed."""

import random
import re
from dataclasses import asdict

import pytest
import torch
from helpers import refused, slow_but
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from darswin.compat.checkpoint import convert_checkpoint, read_state
from darswin.models import ModelCard, load_model, save_model
from darswin.models.registry import pretrained_file
from darswin.models.saving import read_card
from darswin.train.runs import SafeCheckpointIO
from darswin.utils.tensor_files import read_metadata, read_tensors, write_tensors
from darswin.utils.unpickle import read_pickle

CARD = ModelCard(
    "conv_unet_nano", dict(num_classes=2, in_chans=1, widths=(2, 3)), ["a", "b"],
    task="segmentation",
)  # fmt: skip
TENSORS = {
    "a": torch.randn(3, 4), "b": torch.arange(70), "c": torch.randn(5, 2).bfloat16(),
    "d": torch.tensor([True, False]), "e": torch.tensor(2.0), "f": torch.zeros(0, 2),
    "g": torch.randn(3, dtype=torch.complex64),
}  # fmt: skip


def write_model(path):
    torch.manual_seed(0)
    save_model(path, CARD.create().state_dict(), CARD)


def read_model(path):
    model, card = load_model(path)
    return model.state_dict(), asdict(card)


def write_run(path):
    weights = {f"net.{name}": tensor for name, tensor in CARD.create().state_dict().items()}
    content = dict(state_dict=weights, darswin=asdict(CARD), epoch=3, loops={"a": [1, None]})
    SafeCheckpointIO().save_checkpoint(content, path)


def write_converted(path):
    torch.save({"model": TENSORS, "config": {"A": 1}}, path.with_suffix(".pth"))
    convert_checkpoint(path.with_suffix(".pth"), path)


KINDS = {
    "a model": ("m.safetensors", write_model, read_model),
    "a converted checkpoint": ("m.safetensors", write_converted, read_state),
    "a checkpoint": ("m.pth", lambda path: torch.save({"model": TENSORS}, path), read_state),
    "a checkpoint of a run": ("m.ckpt", write_run, SafeCheckpointIO().load_checkpoint),
}


def damaged(content, rng):
    """Copies with one flipped bit in each part of the file, more of them at both ends, and with cut
    ends."""
    size = len(content)
    parts = [*range(0, min(size, 2500), 16), *range(max(size - 2500, 0), size, 16)]
    for start in (*parts, *range(0, size, max(size // 300, 1))):
        changed = bytearray(content)
        changed[rng.randrange(start, min(start + max(size // 300, 8), size))] ^= 1 << rng.randrange(
            8
        )
        yield bytes(changed)
    for _ in range(60):
        yield content[: rng.randrange(size)]


def same(a, b):
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and a.shape == b.shape and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


@pytest.mark.parametrize("kind", slow_but(KINDS, "a checkpoint", "a converted checkpoint"))
def test_no_damage_changes_weights_silently(kind, tmp_path):
    name, write, read = KINDS[kind]
    path = tmp_path / name
    write(path)
    content, expected, refused, copies = path.read_bytes(), read(path), 0, 0
    for changed in damaged(content, random.Random(0)):
        copies += 1
        path.write_bytes(changed)
        try:
            found = read(path)
        except ValueError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
        else:
            assert same(found, expected)
    assert refused > 0.4 * copies  # others are between the parts of a zip file


def test_each_tensor_of_a_file_is_checked(tmp_path):
    path = tmp_path / "t.safetensors"
    write_tensors(path, TENSORS, {"x": "text"})
    found, metadata = read_tensors(path)
    assert same(found, TENSORS) and metadata == {"x": "text"}
    assert same(load_file(path), TENSORS)  # other programs read the file too
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    for name, tensor in TENSORS.items():
        if tensor.numel():
            changed = tensor.clone()
            changed.view(-1)[-1:] = 0 if name == "e" else changed.view(-1)[-1:].logical_not()
            save_file(TENSORS | {name: changed}, path, metadata)
            refused(r"t\.safetensors is damaged: .* another SHA-256", read_tensors, path)
    for others in (
        TENSORS | {"a": TENSORS["a"].view(4, 3)},
        TENSORS | {"a": TENSORS["a"].view(torch.int32)},
        {name: tensor for name, tensor in TENSORS.items() if name != "f"},
        TENSORS | {"more": torch.zeros(0)},
    ):
        save_file(others, path, metadata)
        refused("is damaged", read_tensors, path)
    save_file(TENSORS, path, metadata | {"x": "test"})
    assert read_metadata(path)["x"] == "test"  # without the tensors there is nothing to compare
    refused("is damaged", read_tensors, path)
    save_file(TENSORS, path, {"x": "test"})  # an older file
    assert same(read_tensors(path)[0], TENSORS)


def test_every_model_file_has_a_digest(tmp_path):
    run = tmp_path / "last.ckpt"
    write_run(run)
    write_converted(tmp_path / "c.safetensors")
    for path in (
        run.with_suffix(".safetensors"),
        tmp_path / "c.safetensors",
        pretrained_file("digits"),
    ):
        assert re.fullmatch("[0-9a-f]{64}", read_metadata(path)["sha256"]), path
    path, content = tmp_path / "d.safetensors", bytearray(pretrained_file("digits").read_bytes())
    content[-1000] ^= 64
    path.write_bytes(content)
    refused(r"d\.safetensors is damaged", load_model, path)
    assert read_card(path) == load_model("digits")[1]


def test_an_error_says_what_is_damaged(tmp_path):
    path = tmp_path / "m.pth"
    torch.save({"model": TENSORS}, path)
    content = path.read_bytes()
    place = content.index(TENSORS["b"].numpy().tobytes())
    path.write_bytes(content[: place + 3] + b"\x7f" + content[place + 4 :])
    assert torch.load(path)["model"]["b"][0] == 0x7F000000  # torch alone does not notice
    refused(r"m\.pth cannot .* the checksum of m/data/\d is wrong", read_pickle, path)


def test_an_entry_that_torch_would_not_read(tmp_path):
    """Torch returns uninitialized memory for an entry that is marked as a folder."""
    path = tmp_path / "m.pth"
    torch.save({"model": {"a": torch.ones(1000)}}, path)
    content = bytearray(path.read_bytes())
    entry = content.rindex(b"PK\1\2", 0, content.rindex(b"m/data/0"))
    content[entry + 38] |= 0x10
    path.write_bytes(content)
    refused(r"m\.pth cannot .* m/data/0 is marked as a folder", read_pickle, path)


@pytest.mark.parametrize("read", [read_tensors, read_metadata])
def test_a_folder_or_a_missing_file_is_named(read, tmp_path):
    refused(re.escape(str(tmp_path)), read, tmp_path, error=IsADirectoryError)
    refused("nothing", read, tmp_path / "nothing.safetensors", error=FileNotFoundError)
