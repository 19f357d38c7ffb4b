"""Reading what `torch.save` wrote, without executing anything in it."""

import os
import pickle
import re
from collections import OrderedDict
from typing import Any

import torch

# The authors' training code pickles its configuration, a dict subclass of yacs, into the file. A
# dict's pickle builds just as well another dict, and torch's restricted unpickler fills only those
# of Python.
_STAND_INS: list[Any] = [(OrderedDict, "yacs.config.CfgNode")]


def read_pickle(path: str | os.PathLike, map_location: Any = "cpu") -> object:
    """What `torch.save` wrote; ValueError where that is more than tensors and plain values."""
    try:
        with torch.serialization.safe_globals(_STAND_INS):
            return torch.load(path, map_location=map_location, weights_only=True)
    except Exception as error:  # a file that is no checkpoint may fail in any way
        if (
            isinstance(error, OSError) and error.filename
        ):  # a cut-off archive has an OSError of its own
            raise
        found = re.search(r"GLOBAL (\S+)", str(error))
        if not isinstance(error, pickle.UnpicklingError) or not found:
            raise ValueError(f"{path} cannot be read as a checkpoint") from error
        # Without torch's own message, which advises to load the file all the same.
        raise ValueError(
            f"{path} is refused, and nothing in it was executed: it asks for {found[1]}, which no "
            "state dict needs"
        ) from None
