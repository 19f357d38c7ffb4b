"""The README's code runs as it stands there."""

import re
import sys
from pathlib import Path

import torch

from darswin import lens

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_python_blocks(tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    monkeypatch.chdir(tmp_path)
    lens.save(lens.Equidistant(200.0, 1.5, image_size=(640, 640)), "calibration.json")
    scope, polar = {}, []
    for block in blocks:
        exec(block, scope)
        polar.append(scope.pop("polar", None))
    assert scope["logits"].shape == (2, 200)
    assert scope["features"].shape == (2, 16, 1, 768)
    polar = [image for image in polar if image is not None]
    assert len(polar) >= 4 and all(image.shape == (2, 3, 160, 640) for image in polar)
    torch.testing.assert_close(polar[0], polar[1], rtol=0, atol=1e-4)  # the drop-in and grid_sample


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
