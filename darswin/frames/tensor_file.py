"""Writes arrays and texts to files of the safetensors layout, see docs/reference/files.md.

csrc/core/tensor_file.cpp reads them.
"""

import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from darswin.utils.files import replace_file

_ENDING = ".safetensors"
_TYPES = {"u1": "U8", "u2": "U16", "i2": "I16", "i4": "I32", "i8": "I64", "f4": "F32", "f8": "F64"}
_LINE = 64  # long arrays begin at multiples of it
_MOST_BYTES, _MOST_HEADER = 2**31, 2**21


def check_name(path: str | os.PathLike) -> None:
    """ValueError unless the name of a file of arrays ends in ".safetensors"."""
    if Path(path).suffix != _ENDING:
        raise ValueError(f"the name of the file must end in {_ENDING}, got {os.fspath(path)!r}")


def write_tensors(
    path: str | os.PathLike, arrays: Mapping[str, np.ndarray], texts: Mapping[str, str]
) -> None:
    """Writes arrays and texts, completely or not at all.

    Raises:
        ValueError: the name has another ending, or the content is larger than a file may be.
        OSError: the file cannot be written.
    """
    check_name(path)
    header: dict[str, Any] = {"__metadata__": dict(texts)}
    data = bytearray()

    def add(name: str, array: np.ndarray) -> None:
        first = len(data)
        data.extend(array.tobytes())
        header[name] = dict(
            dtype=_TYPES[array.dtype.str[1:]], shape=array.shape, data_offsets=(first, len(data))
        )

    for name, array in arrays.items():
        if gap := -len(data) % (_LINE if array.nbytes >= _LINE else array.itemsize):
            add(f"padding.{len(header)}", np.zeros(gap, np.uint8))
        add(name, array)
    add("crc32", np.zeros(4, np.uint8))
    text = json.dumps(header, separators=(",", ":")).encode("ascii")
    text += b" " * (-(8 + len(text)) % _LINE)
    content = len(text).to_bytes(8, "little") + text + data[:-4]
    if len(text) > _MOST_HEADER or len(content) + 4 > _MOST_BYTES:
        raise ValueError(
            f"{os.fspath(path)} would have more than {_MOST_HEADER} bytes of names and texts, or "
            f"more than {_MOST_BYTES} bytes in all"
        )
    replace_file(path, content + zlib.crc32(content).to_bytes(4, "little"))
