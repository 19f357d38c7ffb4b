"""Reading text and JSON files, with the byte order marks that editors of other systems write."""

import codecs
import json
import reprlib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_MARKS = {
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32",  # begins with the mark of UTF-16
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}


def to_text(data: bytes) -> str:
    """The text of a file in UTF-8, or in UTF-16 or UTF-32 with a byte order mark, without marks;
    line ends become "\\n".

    Raises:
        ValueError: the bytes are no such text.
    """
    encoding = next((name for mark, name in _MARKS.items() if data.startswith(mark)), "utf-8")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        raise ValueError(f"it must be text in UTF-8: {error}") from error
    if "\0" in text:
        raise ValueError(
            "it must be text in UTF-8, or in UTF-16 or UTF-32 with a byte order mark, but has NUL "
            "characters, as UTF-16 without a byte order mark"
        )
    text = text.lstrip("\ufeff")  # some programs add a mark to the one that is there
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_text(path: str | Path) -> str:
    """The text of a file, as `to_text` decodes it; the ValueError names the file."""
    try:
        return to_text(Path(path).read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def is_json_file(path: str | Path) -> bool:
    """Whether the suffix of a file is that of JSON, in any case."""
    return Path(path).suffix.lower() == ".json"


def parse_json(text: str) -> Any:
    """The content of JSON; ValueError if it is invalid, or if an object has a name twice."""
    return json.loads(text, object_pairs_hook=mapping)


def read_json(path: str | Path) -> Any:
    """The content of a JSON file, as `read_text` and `parse_json` read it; the ValueError names the
    file."""
    try:
        return parse_json(to_text(Path(path).read_bytes()))
    except ValueError as error:
        raise ValueError(f"{path} must be JSON: {error}") from error


def mapping(pairs: Iterable[tuple[Any, Any]]) -> dict[Any, Any]:
    """A mapping. Raises ValueError for two entries with the same name: parsers keep the last."""
    pairs = list(pairs)
    entries = dict(pairs)
    if len(entries) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        twice = next(name for name, count in counts.items() if count > 1)
        raise ValueError(f"{reprlib.repr(twice)} appears twice in one mapping")
    return entries
