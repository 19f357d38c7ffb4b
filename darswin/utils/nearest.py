"""The known names that are most like a given one, for errors."""

import difflib
import re
from collections.abc import Iterable

LONGEST = 64  # characters that are compared


def nearest(given: str, names: Iterable[str], count: int = 1, alike: float = 0.75) -> list[str]:
    """At most `count` of the names, the most similar first. Their similarity, or that of their
    beginnings, of at most 1, is `alike` or more; capitals and small letters are the same."""
    given, names = given[:LONGEST].lower(), list(names)
    beginnings = {name[: len(given) + 1].lower(): name for name in names}
    known = beginnings | {name.lower(): name for name in names}
    found = difflib.get_close_matches(given, known, 2 * count, alike)
    return list(dict.fromkeys(known[name] for name in found))[:count]


def did_you_mean(given: str, names: Iterable[str], count: int = 1, alike: float = 0.75) -> str:
    """The end of a sentence about an unknown name: "; did you mean Mei?", or "." if no name is
    similar. Arguments: see `nearest`."""
    found = nearest(given, names, count, alike)
    return f"; did you mean {' or '.join(found)}?" if found else "."


def add_meant(error: TypeError, names: Iterable[str]) -> None:
    """Adds the name that was probably meant to an error about an unknown keyword."""
    text = str(error).partition(". Did you mean")[0]  # which Python adds from 3.13 on
    if found := re.search(r"unexpected keyword argument '(\w+)'", text):
        error.args = (text + did_you_mean(found[1], names),)
