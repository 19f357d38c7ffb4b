"""What to say of a file that is no calibration of a known format."""

import re
from collections.abc import Sequence

from darswin.lens.base import unknown_model
from darswin.lens.files.content import Content
from darswin.lens.files.fields import listed
from darswin.lens.files.format import Format
from darswin.utils.nearest import nearest

_MOST = 20  # entries that are compared
# Other programs, entries that their files have, and the program whose format they can write.
PROGRAMS = (
    ("Metashape", {"projection", "f"}, "OpenCV"),
    ("Metashape", {"chunk"}, "OpenCV"),
    ("OpenMVG", {"sfm_data_version", "intrinsics"}, "COLMAP"),
    ("Meshroom", {"views", "intrinsics", "poses"}, "COLMAP"),
)


def unknown(content: Content, formats: Sequence[Format]) -> str:
    """What a file of an unknown format holds, and what was expected."""
    if isinstance(content, list):
        tables = " or ".join(format.keys for format in formats if format.is_table)
        return f"it is a table of {len(content)} lines, but a table must have {tables}"
    found = f"its entries are {listed(content) or 'none'}"
    for program, entries, other in PROGRAMS:
        if entries <= content.keys():
            return f"{found}, as in files of {program}: let it write the cameras for {other}"
    given = content.get("model")
    if isinstance(given, str):
        return f"{found}; in a darswin file, {unknown_model(given)}"
    names = [str(name) for name in list(content)[:_MOST]]
    keys = {format.name: format.keys for format in formats if not format.is_table}

    def score(format: str) -> int:
        words = re.findall(r"\w+", keys[format])
        return sum(bool(nearest(name, words)) for name in names)

    best = max(keys, key=score)
    expected = keys[best] if score(best) else f'{keys["OpenCV"]}, or a "model" of darswin'
    return f"{found}, but expected are, for example, {expected}"
