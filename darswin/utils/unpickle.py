"""Reading files of `torch.save` without executing code in them."""

import os
import pickle
import re
from collections import OrderedDict
from typing import Any

import torch

from darswin.utils.files import check_is_file

# The authors' checkpoints contain a configuration of the class CfgNode, a dict of the package yacs.
# It is replaced by an OrderedDict, which torch's restricted unpickler can fill.
_STAND_INS: list[Any] = [(OrderedDict, "yacs.config.CfgNode")]


def read_pickle(path: str | os.PathLike, map_location: Any = "cpu") -> object:
    """Reads a file of `torch.save`; ValueError if it holds more than tensors and plain values."""
    check_is_file(path)
    try:
        with torch.serialization.safe_globals(_STAND_INS):
            return torch.load(path, map_location=map_location, weights_only=True)
    except Exception as error:  # other files fail in many ways
        if (
            isinstance(error, OSError) and error.filename
        ):  # errors of cut-off archives have no file name
            raise
        found = re.search(r"GLOBAL (\S+)", str(error))
        if not isinstance(error, pickle.UnpicklingError) or not found:
            raise ValueError(f"{path} cannot be read as a checkpoint") from error
        # Torch's own message would advise weights_only=False, which executes code.
        raise ValueError(
            f"{path} is refused, and nothing in it was executed: it refers to {found[1]}, which no "
            "state dict needs"
        ) from None
