"""The README's code runs as it stands there."""

import re
import sys
from pathlib import Path

import torch

from darswin import create_model, lens, list_models

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


def parameters(name: str, **options) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in create_model(name, **options).parameters())


def test_parameter_counts_are_those_of_the_models():
    counted = re.search(r"with (\d+) classes:\n\n\| \| (.*) \|\n.*\n((?:\| `.*\n)+)", README)
    classes, sizes, rows = int(counted[1]), counted[2].split(" | "), counted[3].splitlines()
    told = set()
    for row in rows:
        names, *counts = row.strip("| ").split(" | ")
        for family in re.findall(r"`(\w+)_\*`", names):
            for size, count in zip(sizes, counts, strict=True):
                told.add(name := f"{family}_{size}")
                assert parameters(name, num_classes=classes) == int(count.replace(",", "")), name
    assert told == set(list_models())


def test_the_demos_model_is_as_large_as_it_says():
    (millions,) = re.findall(r"`darswin_a_nano` \(([\d.]+) M parameters", README)
    count = parameters("darswin_a_nano", num_classes=10, in_chans=1)
    assert round(count / 1e6, len(millions.partition(".")[2])) == float(millions)
