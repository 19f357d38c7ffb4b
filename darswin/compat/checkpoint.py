"""State dicts and their files. Nothing in a file is ever executed."""

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from darswin.utils.tensor_files import read_tensors, write_tensors
from darswin.utils.unpickle import read_pickle

Source = str | os.PathLike | Mapping[str, Tensor]
Net = TypeVar("Net", bound=nn.Module)


def read_state(source: Source) -> dict[str, Tensor]:
    """The state dict from a file, or from the "model" entry of a checkpoint.

    Args:
        source: the path of a safetensors file or of a file that `torch.save` wrote, in the zip
            format or the older one; or a state dict. A pickle may contain tensors, plain values,
            containers, and the configuration in the authors' checkpoints.

    Raises:
        ValueError: the file is damaged, or contains other objects, which are not executed, or no
            tensors. Pickles in the older format have no checksum.
    """
    if isinstance(source, Mapping):
        return _model(source)
    path = Path(source)
    if path.suffix == ".safetensors":
        return read_tensors(path)[0]
    return _model(read_pickle(path), path)


def convert_checkpoint(source: str | os.PathLike, target: str | os.PathLike) -> None:
    """Writes the weights of a pickled checkpoint, such as the authors', to a safetensors file.

    A "config" entry becomes JSON in the metadata, if JSON can express it. All other entries, such
    as the optimizer's state, are left out. A failure leaves no incomplete file.

    Args:
        source: the path of the checkpoint, a file of `torch.save`.
        target: the path of the safetensors file.

    Raises:
        ValueError: the checkpoint is damaged, or contains other objects, which are not executed,
            or no tensors; or the target has another ending.
    """
    source = Path(source)
    if Path(target).suffix != ".safetensors":  # `read_state` tells files by it
        raise ValueError(f"the target must end in .safetensors, got {os.fspath(target)}")
    checkpoint = read_pickle(source)
    # The tensors are copied, because safetensors does not accept tensors that share memory.
    state = {
        name: value.clone(memory_format=torch.contiguous_format)
        for name, value in _model(checkpoint, source).items()
    }
    metadata = {"format": "pt"}
    if isinstance(checkpoint, Mapping):
        with contextlib.suppress(TypeError, ValueError, KeyError):
            metadata["config"] = json.dumps(checkpoint["config"])
    write_tensors(target, state, metadata)


def _model(checkpoint: object, path: Path | None = None) -> dict[str, Tensor]:
    state = checkpoint.get("model", checkpoint) if isinstance(checkpoint, Mapping) else None
    if not isinstance(state, Mapping) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ValueError(f"{path or 'source'} has no state dict at the top or under 'model'")
    return dict(state)


def load_as(
    name: str,
    source: Source,
    make: Callable[[Mapping[str, Tensor]], Net],
    convert: Callable[[str, Tensor, Net], tuple[str, Tensor]],
) -> Net:
    """Our model with the weights of another implementation, in eval mode.

    `make` creates the model from the state dict, and `convert` turns each key and tensor of the
    state dict into ours. ValueError if the state dict does not fit.
    """
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
    """The number of blocks per stage. `form` is a key of each block, {} for stage and block."""
    depths: list[int] = []
    while form.format(len(depths), 0) in state:
        depth = 1
        while form.format(len(depths), depth) in state:
            depth += 1
        depths.append(depth)
    if not depths:
        raise KeyError(form.format(0, 0))
    return depths
