"""The tables of README and the pages are those of the records, and the records show the point."""

import json
import re
import statistics
import sys
from pathlib import Path

import torch

from darswin import create_model, list_models

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "docs"), str(ROOT / "studies")]

import dense_tables  # noqa: E402
import fill  # noqa: E402
import resampling  # noqa: E402
from cells import MODELS, SWEEP  # noqa: E402
from dense_tables import SCORE  # noqa: E402
from tables import points_lost  # noqa: E402

README = (ROOT / "README.md").read_text()


def page(name: str) -> str:
    return (ROOT / name).read_text()


def test_the_readme_is_short_and_lines_fit():
    assert README.count("\n") <= 140 and max(map(len, README.splitlines())) < 120
    for path in fill.PAGES:
        for line in path.read_text().splitlines():
            assert len(line) < 120 or line.startswith("|"), (path, line)


def test_sentences_are_short():
    for path in fill.PAGES:
        text = re.sub(r"^(`{3,}|:{3,})[^\n]*\n.*?^\1$", "\n\n", path.read_text(), flags=re.M | re.S)
        text = re.sub(r"^(?:\||#).*$", "", text, flags=re.M)  # tables and headings
        text = re.sub(r"^\s*(?:[-*]|\d+\.)\s", "\n\n", text, flags=re.M)
        for paragraph in re.split(r"\n\s*\n", text):
            for sentence in re.split(r"(?<=[.!?:;])\s+", paragraph):
                assert len(sentence.split()) <= 40, (path, sentence)


def test_pictures_and_links_exist():
    for path in fill.PAGES:
        for target in re.findall(r"(?:\]\(|\]: |`[^`<]* <)([^)#>\s]+)[)#>]", path.read_text()):
            if not target.startswith("http"):
                assert (path.parent / target).is_file(), (path, target)


def test_tables_are_those_of_the_results():
    tables = fill.tables()
    pages = {path: path.read_text() for path in fill.PAGES}
    places = [name for text in pages.values() for name in re.findall("<!-- table: (.*) -->", text)]
    assert sorted(places) == sorted(tables)  # each in one page
    for name, table in tables.items():
        assert any(fill.placed(name, table) in text for text in pages.values()), name
        assert "not run" not in table


def test_the_drop_in_call_is_faster_than_what_it_replaces():
    for record in fill.records("sampling").values():
        calls = [
            t
            for t in record.timings
            if t.mode == "forward, layout image" and t.name == "F.grid_sample"
        ]
        assert len(calls) == 6 and min(t.ratio for t in calls) > 1


def test_one_frame_is_faster_than_in_other_runtimes():
    (record,) = fill.records("one_frame").values()
    for peer, least in (("eager model", 1.05), ("ONNX Runtime", 1.1), ("OpenVINO", 1.1)):
        in_float32 = [t for t in record.timings if t.batch == 1 and "float32" in t.mode]
        found = [t.ratio for t in in_float32 if t.name == peer]
        assert len(found) == 8 and min(found) > least
    in_8_bits = [t for t in record.timings if t.name == "float32" and "int8" in t.mode]
    assert len(in_8_bits) == 8 and min(t.ratio for t in in_8_bits) > 1.5


def parameters(name: str, **options) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in create_model(name, **options).parameters())


def test_parameter_counts_are_those_of_the_models():
    counted = re.search(
        r"with (\d+) classes:\n\n\| \| (.*) \|\n.*\n((?:\| `.*\n)+)", page("docs/howto/use.md")
    )
    classes, sizes, rows = int(counted[1]), counted[2].split(" | "), counted[3].splitlines()
    told = set()
    for row in rows:
        names, *counts = row.strip("| ").split(" | ")
        for family in re.findall(r"`(\w+)_\*`", names):
            for size, count in zip(sizes, counts, strict=True):
                told.add(name := f"{family}_{size}")
                assert parameters(name, num_classes=classes) == int(count.replace(",", "")), name
    assert told == set(list_models())


def test_the_study_shows_its_point():
    cells = json.loads((ROOT / "studies/results/study--nano.json").read_text())["cells"]
    runs: dict[tuple[str, str], list] = {}
    for cell in cells:
        runs.setdefault((cell["label"], cell["level"]), []).append(cell["accuracy"])

    def mean(label: str, level: str, xi: str) -> float:
        return statistics.mean(run[xi] for run in runs[label, level])

    for other in ("Swin", "DAT"):
        for level, points in (("very low", 30), ("high", 5)):
            assert mean("DarSwin-A", level, "0.4") - mean(other, level, "0.4") > points
    ahead = [
        mean(label, level, xi) - mean("DarSwin-A", level, xi)
        for label, level in runs
        if label in ("Swin", "DAT", "Swin (undis)")
        for xi in SWEEP
    ]
    assert max(ahead) <= 2


def test_8_bits_lose_little():
    record = json.loads((ROOT / "studies/results/int8.json").read_text())
    runs: dict[str, list] = {}
    for cell in record["cells"]:
        runs.setdefault(cell["label"], []).append(points_lost(cell))
    assert runs.keys() == set(MODELS) and {len(lost) for lost in runs.values()} == {3}
    over_all = [statistics.mean(x for lost in of for x in lost) for of in runs.values()]
    single = [x for of in runs.values() for lost in of for x in lost]
    assert max(over_all) <= 0.3 and max(single) <= 1


def test_the_dense_study_shows_its_point():
    record = json.loads((ROOT / "studies/results/dense.json").read_text())
    miou = {
        label: statistics.mean(
            dense_tables.mean_of(cell["sets"], dense_tables.ALL_XI, SCORE["segmentation"])
            for cell in record["cells"]
            if (cell["task"], cell["band"], cell["label"], cell["shuffled"])
            == ("segmentation", "wide", label, False)
        )
        for label in dense_tables.MODELS
    }
    assert max(miou, key=miou.__getitem__) == "DarSwin-Unet A"


def test_the_demo_shows_its_point():
    accuracy = json.loads((ROOT / "docs/accuracy.json").read_text())["accuracy"]
    assert min(min(run) for run in accuracy["DarSwin-A"]) >= 92
    for other in ("without lens knowledge", "Swin"):
        for ours, theirs in zip(accuracy["DarSwin-A"], accuracy[other], strict=True):
            assert ours[-1] - theirs[-1] >= 15


def test_the_table_of_resampling_is_computed():
    text = (ROOT / "docs/explanation/dense.md").read_text()
    rows = re.findall(r"^\| (\d+) × (\d+) \| (.*) \|$", text, re.M)
    assert len(rows) == 4
    for rings, sectors, scores in rows:
        found = [
            f"{resampling.ceiling(size, int(rings), int(sectors), samples):.2f}"
            for size in (64, 256)
            for samples in (1, 4)
        ]
        assert scores.split(" | ") == found, (rings, sectors)
