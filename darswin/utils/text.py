"""Reading text files, with the byte order marks that editors of other systems write."""

import codecs
from pathlib import Path

_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}


def to_text(data: bytes) -> str:
    """The text of a file in UTF-8, or in UTF-16 with a byte order mark; line ends become "\\n".

    Raises:
        ValueError: the bytes are no such text.
    """
    encoding = next((name for mark, name in _MARKS.items() if data.startswith(mark)), "utf-8")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        raise ValueError(f"it must be text in UTF-8: {error}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_text(path: str | Path) -> str:
    """The text of a file, as `to_text` decodes it; the ValueError names the file."""
    try:
        return to_text(Path(path).read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
