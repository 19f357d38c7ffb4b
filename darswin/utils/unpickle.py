"""Reads files of `torch.save` without executing anything in them."""

import os
import pickle
import re
from collections import OrderedDict
from typing import Any

import torch

# The authors' checkpoints hold their configuration, pickled as a dict subclass of the package yacs.
# An OrderedDict takes its place: torch's restricted unpickler can fill that one.
_STAND_INS: list[Any] = [(OrderedDict, "yacs.config.CfgNode")]


def read_pickle(path: str | os.PathLike, map_location: Any = "cpu") -> object:
    """A file of `torch.save`; ValueError where it holds more than tensors and plain values."""
    try:
        with torch.serialization.safe_globals(_STAND_INS):
            return torch.load(path, map_location=map_location, weights_only=True)
    except Exception as error:  # a file that is no checkpoint may fail in any way
        if isinstance(error, OSError) and error.filename:  # cut-off archives name none
            raise
        found = re.search(r"GLOBAL (\S+)", str(error))
        if not isinstance(error, pickle.UnpicklingError) or not found:
            raise ValueError(f"{path} cannot be read as a checkpoint") from error
        # Torch's own message would advise to load the file with weights_only=False.
        raise ValueError(
            f"{path} is refused, and nothing in it was executed: it asks for {found[1]}, which no "
            "state dict needs"
        ) from None
