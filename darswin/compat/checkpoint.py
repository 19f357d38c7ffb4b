"""State dicts and the files that hold them. Nothing that a file says is ever executed."""

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from darswin.utils.files import replace_file
from darswin.utils.unpickle import read_pickle

Source = str | os.PathLike | Mapping[str, Tensor]


def read_state(source: Source) -> dict[str, Tensor]:
    """A state dict, from itself or from a file; a checkpoint's "model" entry is found.

    Args:
        source: safetensors, or what `torch.save` wrote, in its zip or its older format. A pickle
            may hold tensors, plain values and containers, and the configuration of the authors'
            checkpoints.

    Raises:
        ValueError: a file with something else in it, which is not executed, or without tensors.
    """
    if isinstance(source, Mapping):
        return _model(source)
    path = Path(source)
    if path.suffix == ".safetensors":
        try:
            return load_file(path)
        except SafetensorError as error:
            raise ValueError(f"{path} cannot be read as safetensors: {error}") from error
    return _model(read_pickle(path), path)


def convert_checkpoint(source: str | os.PathLike, target: str | os.PathLike) -> None:
    """The weights of a pickled checkpoint, such as the authors publish, as a safetensors file.

    A "config" entry goes into the file's metadata as JSON, if it consists of what JSON has. Every
    other entry, such as the optimizer's, is left out. The target appears complete or not at all.

    Args:
        source: as `read_state`.

    Raises:
        ValueError: as `read_state`.
    """
    source = Path(source)
    checkpoint = read_pickle(source)
    # Copies: safetensors takes no tensors that share memory.
    state = {
        name: value.clone(memory_format=torch.contiguous_format)
        for name, value in _model(checkpoint, source).items()
    }
    metadata = {"format": "pt"}
    if isinstance(checkpoint, Mapping):
        with contextlib.suppress(TypeError, ValueError, KeyError):
            metadata["config"] = json.dumps(checkpoint["config"])
    replace_file(target, save(state, metadata))


def _model(checkpoint: object, path: Path | None = None) -> dict[str, Tensor]:
    state = checkpoint.get("model", checkpoint) if isinstance(checkpoint, Mapping) else None
    if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ValueError(f"{path or 'source'} holds no state dict, at the top or under 'model'")
    return dict(state)


@contextlib.contextmanager
def refused(what: str) -> Iterator[None]:
    """Within it, keys and shapes that are not those expected raise ValueError, naming `what`."""
    try:
        yield
    except (KeyError, IndexError) as error:
        raise ValueError(f"not a state dict of {what}: no key {error}") from error
    except RuntimeError as error:
        raise ValueError(f"not a state dict of {what}: {error}") from error


def count_blocks(state: Mapping[str, Tensor], form: str) -> list[int]:
    """The stages' numbers of blocks, from a key of each; KeyError where there is none.

    Args:
        form: the key, with {} for the stage and {} for the block.
    """
    depths: list[int] = []
    while form.format(len(depths), 0) in state:
        depth = 1
        while form.format(len(depths), depth) in state:
            depth += 1
        depths.append(depth)
    if not depths:
        raise KeyError(form.format(0, 0))
    return depths
