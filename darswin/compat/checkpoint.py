"""State dicts and the files that hold them. Nothing in a file is ever executed."""

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from darswin.utils.files import replace_file
from darswin.utils.unpickle import read_pickle

Source = str | os.PathLike | Mapping[str, Tensor]
Net = TypeVar("Net", bound=nn.Module)


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


def load_as(
    name: str,
    source: Source,
    make: Callable[[Mapping[str, Tensor]], Net],
    convert: Callable[[str, Tensor, Net], tuple[str, Tensor]],
) -> Net:
    """The model of another implementation's state dict, in eval mode: `make` makes it, and
    `convert` gives its own name and tensor for each. ValueError where they do not fit."""
    state = read_state(source)
    try:
        model = make(state)
        # The operator needs neither masks nor indices.
        kept = [key for key in state if not key.endswith(("attn_mask", "relative_position_index"))]
        model.load_state_dict(dict(convert(key, state[key], model) for key in kept))
    except (KeyError, IndexError) as error:
        raise ValueError(f"not a state dict of {name}: no key {error}") from error
    except RuntimeError as error:
        raise ValueError(f"not a state dict of {name}: {error}") from error
    return model.eval()


def count_blocks(state: Mapping[str, Tensor], form: str) -> list[int]:
    """The stages' numbers of blocks, from `form`, a key of each with {} for stage and block."""
    depths: list[int] = []
    while form.format(len(depths), 0) in state:
        depth = 1
        while form.format(len(depths), depth) in state:
            depth += 1
        depths.append(depth)
    if not depths:
        raise KeyError(form.format(0, 0))
    return depths
