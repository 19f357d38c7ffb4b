"""What to say of a file that is no calibration of a known format."""

import difflib
import re
from collections.abc import Iterable, Sequence

from darswin.lens.base import MODELS
from darswin.lens.files.content import Content
from darswin.lens.files.fields import listed, short
from darswin.lens.files.format import Format

ALIKE = 0.75  # the similarity of two names, of at most 1
_MOST = 20  # entries that are compared


def unknown(content: Content, formats: Sequence[Format]) -> str:
    """What a file of an unknown format holds, and what was expected."""
    if isinstance(content, list):
        tables = " or ".join(format.keys for format in formats if format.is_table)
        return f"it is a table of {len(content)} lines, but a table must have {tables}"
    given = content.get("model")
    found = f"its entries are {listed(content) or 'none'}"
    if isinstance(given, str):
        nearest = _nearest(given, MODELS)
        return (
            f'{found}; in a darswin file, "model" must be one of {", ".join(sorted(MODELS))}, got '
            f"{short(given)}{f': is it {nearest}?' if nearest else ''}"
        )
    names = [str(name)[:64] for name in list(content)[:_MOST]]
    keys = {format.name: format.keys for format in formats if not format.is_table}

    def score(format: str) -> int:
        words = re.findall(r"\w+", keys[format])
        return sum(_nearest(name, words) is not None for name in names)

    best = max(keys, key=score)
    expected = keys[best] if score(best) else f'{keys["OpenCV"]}, or a "model" of darswin'
    return f"{found}, but expected are, for example, {expected}"


def _nearest(given: str, known: Iterable[str]) -> str | None:
    """The known name that is most like the given one, if any is."""
    names = {name.lower(): name for name in known}
    found = difflib.get_close_matches(given[:64].lower(), names, 1, ALIKE)
    return names[found[0]] if found else None
