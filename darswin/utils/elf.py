"""Compiled modules that a full disk or a broken copy cut off: loading one ends the process."""

import os
import struct

_LOADED, _NO_BITS = 1, 8  # types of segments, and of sections without bytes in the file


def check_whole(path: str | os.PathLike) -> None:
    """Raises ImportError for an ELF file of 64 bits that lacks bytes of its sections or segments.

    It reads the headers alone. Other files pass, such as those of macOS and Windows.
    """
    with open(path, "rb") as file:
        head, size = file.read(64), os.fstat(file.fileno()).st_size
        if head[:6] != b"\x7fELF\x02\x01":
            return
        try:
            segments_at, sections_at = struct.unpack_from("<2Q", head, 32)
            _, segments, _, sections = struct.unpack_from("<4H", head, 54)
            ends = [segments_at + 56 * segments, sections_at + 64 * sections]
            file.seek(segments_at)
            loaded = 0
            for kind, start, length in struct.iter_unpack("<I4xQ16xQ16x", file.read(56 * segments)):
                loaded += kind == _LOADED
                ends.append(start + length)
            file.seek(sections_at)
            table = [*struct.iter_unpack("<4xI16x2Q24x", file.read(64 * sections))]
            ends += [start + length for kind, start, length in table if kind != _NO_BITS]
            # A disk that was full may have left zeros in place of the tables.
            whole = max(ends) <= size and loaded and (not table or any(kind for kind, *_ in table))
        except struct.error:
            whole = False
    if not whole:
        raise ImportError(f"the file {os.fspath(path)} is cut off or damaged")
