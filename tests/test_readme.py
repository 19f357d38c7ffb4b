"""The README's code runs as it stands there."""

import re
import sys
from pathlib import Path

import torch

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_python_blocks():
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert len(blocks) == 4
    scope = {}
    with torch.no_grad():
        for block in blocks:
            exec(block, scope)
    assert scope["logits"].shape == (2, 200)
    assert scope["features"].shape == (2, 16, 1, 768)
    assert scope["polar"].shape == (2, 3, 160, 640)


def test_pictures_and_links_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (ROOT / target).is_file(), target


def test_tables_are_those_of_the_results():
    sys.path.append(str(ROOT / "docs"))
    import readme

    for name, table in readme.tables().items():
        assert readme.placed(name, table) in README, name
        assert "not run" not in table
