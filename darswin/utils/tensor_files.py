"""Safetensors files with a digest of their content, which is checked when they are read."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from darswin.utils.files import check_is_file, replace_file

_DIGEST = "sha256"  # the key of the digest in the metadata


def write_tensors(
    path: str | os.PathLike, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]
) -> None:
    """Writes tensors of the CPU and texts to a file. An older file is replaced in one step."""
    digest = _digest(tensors, metadata)
    replace_file(path, save(dict(tensors), {**metadata, _DIGEST: digest}))


# What to say of files of other programs, by their endings.
_OTHERS = dict.fromkeys((".pt", ".pth", ".ckpt", ".bin"), "it is a checkpoint of torch, which may "
    "run code: load its weights into a model in Python, and write that with save_model") | {
    ".onnx": "it is a network for darswin.frames.Network or --network"}  # fmt: skip


def read_tensors(path: str | os.PathLike) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a file and its metadata.

    Files of other programs have no digest and are not checked.

    Raises:
        ValueError: the file is no safetensors file, or its content is not what was written.
    """
    with _opened(path) as file:
        metadata = file.metadata() or {}
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    digest = metadata.pop(_DIGEST, None)
    if digest is not None and digest != _digest(tensors, metadata):
        raise ValueError(f"{path} is damaged: its content has another SHA-256 than when written")
    return tensors, metadata


def read_metadata(path: str | os.PathLike) -> dict[str, str]:
    """The metadata of a file. The tensors are neither read nor checked."""
    with _opened(path) as file:
        return file.metadata() or {}


@contextmanager
def _opened(path: str | os.PathLike) -> Iterator[Any]:
    check_is_file(path)
    with open(path, "rb"):
        pass  # the errors of `safe_open` do not name a folder
    try:
        with safe_open(path, "pt") as file:
            yield file
    except SafetensorError as error:
        suffix = os.path.splitext(path)[1]
        advice = _OTHERS.get(suffix, f"it is no safetensors file, or damaged ({error})")
        raise ValueError(f"{path} cannot be read as safetensors: {advice}") from error


def _digest(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """The SHA-256 of the texts, and of the name, type, shape and bytes of each tensor."""
    content = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name, tensor in sorted(tensors.items()):
        kind = [name, str(tensor.dtype), list(tensor.shape)]
        content.update(json.dumps(kind).encode())
        content.update(tensor.detach().reshape(-1).view(torch.uint8).numpy().data)
    return content.hexdigest()
