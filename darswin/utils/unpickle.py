"""Reading files of `torch.save` without executing code in them."""

import os
import pickle
import re
from collections import OrderedDict
from typing import Any
from zipfile import BadZipFile, ZipFile

import torch

from darswin.utils.files import check_is_file

# The authors' checkpoints contain a configuration of the class CfgNode, a dict of the package yacs.
# It is replaced by an OrderedDict, which torch's restricted unpickler can fill.
_STAND_INS: list[Any] = [(OrderedDict, "yacs.config.CfgNode")]

# For an entry with this flag of MS-DOS, torch reads nothing and returns uninitialized memory.
_DOS_FOLDER = 0x10


def read_pickle(path: str | os.PathLike, map_location: Any = "cpu") -> object:
    """Reads a file of `torch.save`.

    Raises:
        ValueError: the file holds more than tensors and plain values, or a checksum in it is wrong.
            Files in the format before torch 1.6 have no checksums.
    """
    check_is_file(path)
    try:
        _check_sums(path)
        with torch.serialization.safe_globals(_STAND_INS):
            return torch.load(path, map_location=map_location, weights_only=True)
    except Exception as error:  # other files fail in many ways
        if (
            isinstance(error, OSError) and error.filename
        ):  # errors of cut-off archives have no file name
            raise
        found = re.search(r"GLOBAL (\S+)", str(error))
        if not isinstance(error, pickle.UnpicklingError) or not found:
            why = f": {error}" if isinstance(error, BadZipFile) else ""
            raise ValueError(f"{path} cannot be read as a checkpoint{why}") from error
        # Torch's own message would advise weights_only=False, which executes code.
        raise ValueError(
            f"{path} is refused, and nothing in it was executed: it refers to {found[1]}, which no "
            "state dict needs"
        ) from None


def _check_sums(path: str | os.PathLike) -> None:
    """Compares a zip file with the checksums in it, which torch ignores."""
    with open(path, "rb") as file:
        if file.read(4) != b"PK\3\4":  # torch too decides by these bytes
            return
        with ZipFile(file) as archive:
            if (name := archive.testzip()) is not None:
                raise BadZipFile(f"the checksum of {name} is wrong")
            for entry in archive.infolist():
                if entry.external_attr & _DOS_FOLDER and entry.file_size:
                    raise BadZipFile(f"{entry.filename} is marked as a folder")
