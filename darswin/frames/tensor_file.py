"""Arrays and texts in files of the safetensors layout, which docs/reference/files.md describes."""

import json
import math
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from darswin.utils.files import check_is_file, replace_file

_ENDING = ".safetensors"
_TYPES = {"U8": "u1", "I16": "<i2", "I32": "<i4", "I64": "<i8", "F32": "<f4", "F64": "<f8"}
_NAMES = {np.dtype(kind): name for name, kind in _TYPES.items()}
_LINE = 64  # long arrays begin at multiples of it
_MOST_BYTES, _MOST_HEADER, _MOST_AXES = 2**31, 2**21, 8
_WHOLE = 0x2144DF1C  # the CRC-32 of bytes that end in their own CRC-32


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
            dtype=_NAMES[array.dtype], shape=array.shape, data_offsets=(first, len(data))
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


def read_tensors(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The arrays and the texts of a file.

    Raises:
        ValueError: the file is damaged or of another kind.
        OSError: the file cannot be read.
    """
    check_is_file(path)
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if not 8 < size <= _MOST_BYTES:
            raise ValueError("it is too short or too long")
        data = bytearray(file.read(size))
    if data.startswith(b"PK\3\4"):
        raise ValueError("it comes from an older version of darswin: make the plan again")
    if zlib.crc32(data) != _WHOLE:
        raise ValueError("it is damaged, or of another kind")
    begin = 8 + int.from_bytes(data[:8], "little")
    if begin > min(len(data), 8 + _MOST_HEADER) or begin % 8:
        raise ValueError("its header has a wrong length")
    content, at = memoryview(data)[begin:], 0
    arrays: dict[str, np.ndarray] = {}
    try:
        header = json.loads(data[8:begin].decode("ascii"), object_pairs_hook=_unique)
        texts = header.pop("__metadata__", {})
        for text in texts.values():
            text.encode()  # half of a pair of surrogates is no character
        for name, entry in header.items():
            arrays[name] = _array(content, at, **entry)
            at += arrays[name].nbytes
        if at != len(content):
            raise ValueError("the arrays do not fill the file")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ValueError(f"its header is not as darswin writes it: {error}") from error
    return arrays, texts


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of JSON, whose names must differ."""
    if len(found := dict(pairs)) != len(pairs):
        raise ValueError("a name is there twice")
    return found


def _array(
    content: memoryview, at: int, *, dtype: str, shape: list[int], data_offsets: list[int]
) -> np.ndarray:
    """The array that begins at a place, where the one before it ended."""
    if not (isinstance(shape, list) and len(shape) <= _MOST_AXES):
        raise TypeError(f"a shape must have at most {_MOST_AXES} axes")
    for number in (*shape, *data_offsets):
        if type(number) is not int or not 0 <= number <= len(content):
            raise ValueError("a size or a place is out of range")
    kind = np.dtype(_TYPES[dtype])
    end = at + math.prod(shape) * kind.itemsize
    if data_offsets != [at, end] or end > len(content) or at % kind.itemsize:
        raise ValueError("an array does not lie where its shape and its type put it")
    return np.ndarray(shape, kind, content, at)
