"""Names in code font on the pages exist, and files on the page for contributors."""

import re
from pathlib import Path
from pydoc import locate

from darswin import lens

PAGE = Path(__file__).parents[2] / "docs" / "lenses.md"
# Of other programs.
THEIRS = {"cam2world", "world2cam", "radial_poly"}


def test_every_name_on_the_page_of_lenses_exists():
    text = re.sub(r"^```.*?^```$", "", PAGE.read_text(), flags=re.M | re.S)  # blocks are run
    text = re.sub(r"^    .*$", "", text, flags=re.M)
    known = {*lens.__all__, *dir(lens.Lens), "from_fov", "lens"}
    known |= {name for model in lens.MODELS.values() for name in (*model.declared, *model.common)}
    found = [
        re.match(r"(?:(?:darswin\.)?lens\.)?(\w+)", code) for code in re.findall("`(.+?)`", text)
    ]
    names = {match[1] for match in found if match} - {"darswin"}
    assert len(names) > 40 and not names - known - THEIRS
    assert names >= THEIRS  # remove what the page no longer has


def test_every_name_in_darswin_on_the_pages_exists():
    root, found = PAGE.parents[1], set()
    for page in (root / "README.md", *(root / "docs").rglob("*.md")):
        text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)  # blocks are run
        found |= set(re.findall(r"`(darswin(?:\.\w+)+)[`(]", text))
    assert len(found) > 30
    assert not [name for name in sorted(found) if locate(name) is None]


def test_every_file_on_the_page_for_contributors_exists():
    root = PAGE.parents[1]
    text = (root / "docs" / "contributing.md").read_text()
    # Not those that make writes, such as build/docs.
    folders = "benchmarks|csrc|darswin|docs|examples|studies|tests"
    found = set(re.findall(rf"`((?:{folders})/[\w./]+)`", text))
    files = {name for name in found if "NAME" not in name}
    assert len(files) > 20 and not [name for name in files if not (root / name).exists()]
