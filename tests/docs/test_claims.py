"""The tables and numbers of README and the pages are those of the records, and the records show
the point."""

import json
import re
import statistics
import sys
from functools import cache
from itertools import product
from pathlib import Path

import pytest
import torch

from darswin import create_model, list_models
from darswin.data import LEVELS

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "docs"), str(ROOT / "studies")]

import dense_tables  # noqa: E402
import fill  # noqa: E402
import pixels_read  # noqa: E402
import resampling  # noqa: E402
import sizes_tables  # noqa: E402
from cells import MODELS, POLYNOMIAL, SWEEP, augmented_label  # noqa: E402
from tables import points_lost  # noqa: E402

# What the numbers of a paragraph are: `level mAP of raw | mercator`, where the second one is an mAP
# too. Nothing holds a plain number.
MARK = re.compile(r"\n *<!-- numbers: (.*?)\s-->", re.S)


def page(name: str) -> str:
    return (ROOT / name).read_text()


def test_pages_are_short_and_their_links_exist():
    readme = MARK.sub("", page("README.md"))
    assert readme.count("\n") <= 160 and max(map(len, readme.splitlines())) < 120
    for path in fill.PAGES:
        text = MARK.sub("", path.read_text())
        for target in re.findall(r"(?:\]\(|\]: |`[^`<]* <)([^)#>\s]+)[)#>]", text):
            assert target.startswith("http") or (path.parent / target).is_file(), (path, target)
        for line in text.splitlines():
            assert len(line) < 120 or line.startswith("|"), (path, line)
        text = re.sub(r"^(`{3,}|:{3,})[^\n]*\n.*?^\1$", "\n\n", text, flags=re.M | re.S)
        text = re.sub(r"^(?:\||#).*$", "", text, flags=re.M)  # tables and headings
        text = re.sub(r"^\s*(?:[-*]|\d+\.)\s", "\n\n", text, flags=re.M)
        for sentence in re.split(r"\n\s*\n|(?<=[.!?:;])\s+", text):
            assert len(sentence.split()) <= 40, (path, sentence)


def test_tables_are_those_of_the_results():
    tables = fill.tables()
    pages = {path: path.read_text() for path in fill.PAGES}
    places = [name for text in pages.values() for name in re.findall("<!-- table: (.*) -->", text)]
    assert sorted(places) == sorted(tables)  # each in one page
    for name, table in tables.items():
        assert any(fill.placed(name, table) in text for text in pages.values()), name
        assert "not run" not in table


# -- numbers in sentences -----------------------------------------------------------------------


@cache
def record(name: str) -> dict:
    return json.loads(page(f"studies/results/{name}.json"))


@cache
def accuracy(label: str, xi: str, level: str = "very low") -> float:
    """Of the study on Fashion-MNIST, as all numbers here the mean of all seeds, in %."""
    cells = record("study--nano")["cells"]
    runs = (c["accuracy"][xi] for c in cells if (c["label"], c["level"]) == (label, level))
    return statistics.mean(runs)


def dense(task: str, band: str, label: str) -> float:
    """The score over all ξ."""
    runs = dense_tables.runs_of(record("dense")["cells"], task)[label, band]
    score = dense_tables.SCORE[task]
    return 100 * statistics.mean(
        dense_tables.mean_of(run, dense_tables.ALL_XI, score) for run in runs
    )


def near(name: str, label: str) -> float:
    """The δ1 of the sizes study."""
    runs = sizes_tables.runs_of(record("sizes")["cells"])[label]
    return 100 * statistics.mean(run[name]["delta1"] for run in runs)


def detected(method: str, key: str = "map", table: str = "CenterNet, level") -> float:
    return record("pretrained")["tables"][table]["methods"][method][key]


def short(value: float) -> str:
    return f"{value:.2f}".replace("-0.00", "0.00").replace("0.", ".").replace("-", "−")


def gain(names: str, split: str, key: str) -> str:
    """The difference of two methods beside slices, with its interval."""
    pairs = record("pretrained")["slices"][split]["pairs"]
    (of,) = (of for of in pairs if f"{of['first']} − {of['second']}" == names)
    low, high = map(short, of[f"{key}_interval"])
    return f"{'+' if of[key] >= 0.005 else ''}{short(of[key])} [{low}, {high}]"


def percent(value: float) -> str:
    return f"{value:.0f} %"


SPLITS = ("level", "small", "down")
FORMS = {
    **{
        name: lambda of, k=level: percent(accuracy(*of.split(", ξ = "), k))
        for name, level in (("accuracy", "very low"), ("high accuracy", "high"))
    },
    "mIoU": lambda of: percent(dense("segmentation", "low", of)),
    "wide mIoU": lambda of: percent(dense("segmentation", "wide", of)),
    "wide δ1": lambda of: percent(dense("distance", "wide", of)),
    **{f"δ1 at {name}": lambda of, k=name: percent(near(k, of)) for name in ("own", "100°")},
    "recall": lambda of: short(detected(of, "recall")),
    "loss": lambda of: short(detected(of.split(" − ")[0]) - detected(of.split(" − ")[1])),
    "found/flat": lambda of: percent(100 * detected(of, "of_flat")),
    "same as flat": lambda of: percent(100 * detected(of, "same_as_flat")),
}
for split in SPLITS:
    FORMS |= {
        f"{split} mAP": lambda of, k=split: short(detected(of, table=f"CenterNet, {k}")),
        f"{split} sliced mAP": lambda of, k=split: short(
            record("pretrained")["slices"][k]["methods"][of]["map"]
        ),
        f"{split} gain": lambda of, k=split: gain(of, k, "map"),
        f"{split} recall gain": lambda of, k=split: gain(of, k, "recall"),
    }


def numbers(text: str) -> list[str]:
    """The shares in a text, as `.43`, `−.02` or `81 %`."""
    return re.findall(r"(?<![\d.])[+−]?\.\d\d(?!\d)|\d+ %", text)


MARKED = [
    pytest.param(re.split(r"\n\n|\n(?=- )", text[: mark.start()])[-1], mark[1], id=path.stem)
    for path in fill.PAGES
    for text in [path.read_text()]
    for mark in MARK.finditer(text)
]


@pytest.mark.slow
@pytest.mark.parametrize(("paragraph", "mark"), MARKED)
def test_paragraphs_tell_what_was_measured(paragraph, mark):
    form, told = None, []
    for item in " ".join(mark.split()).split(" | "):
        name, _, of = item.partition(" of ")
        form, of = (name, of) if name in FORMS else (form, item)
        told += numbers(of) if of[-1] in "%]" or of[0] == "." else numbers(FORMS[form](of))
    assert numbers(paragraph) == told


# -- the point of each record -------------------------------------------------------------------


@pytest.mark.slow
def test_speed():
    (sampling,), (frames,) = (fill.records(of).values() for of in ("sampling", "one_frame"))
    peer = [t for t in sampling.timings if t.name == "F.grid_sample"]
    drop_in = [t.ratio for t in peer if t.mode == "forward, layout image"]
    assert len(drop_in) == 6 and min(drop_in) > 1  # faster than what it replaces
    forward = ("forward", "forward, layout image")
    large = [t.ratio for t in peer if t.setting == "1024×1024" and t.mode in forward]
    told = f"`polar_sample` is just {min(large):.1f} to {max(large):.1f} times as fast"
    assert told in " ".join(page("README.md").split())
    loops = [t for t in frames.timings if not t.paced]
    int8 = [t.ratio for t in frames.timings if t.name == "float32" and "int8" in t.mode]
    assert len(int8) == 16 and min(int8) > 1.2
    lost = set()
    for peer, least in zip(fill.FRAME_PEERS, (1.05, 1.1, 1.05, 1.1), strict=True):
        found = [t for t in loops if (t.name, t.batch) == (peer, 1) and "float32" in t.mode]
        assert len(found) == 10
        assert min(t.ratio for t in found if t.subject.startswith("darswin")) > least
        lost |= {(t.subject, t.name, t.threads) for t in found if t.ratio < 1}
    openvino, package = (("conv_unet_nano", peer) for peer in fill.FRAME_PEERS[2:])
    assert lost == {(*openvino, 1), (*openvino, 2), (*package, 1)}


@pytest.mark.slow
def test_parameter_counts_are_those_of_the_models():
    counted = re.search(
        r"with (\d+) classes:\n\n\| \| (.*) \|\n.*\n((?:\| `.*\n)+)", page("docs/howto/use.md")
    )
    rows = [row.strip("| ").split(" | ") for row in counted[3].splitlines()]
    told = {
        f"{family}_{size}": int(count.replace(",", ""))
        for names, *counts in rows
        for family in re.findall(r"`(\w+)_\*`", names)
        for size, count in zip(counted[2].split(" | "), counts, strict=True)
    }
    with torch.device("meta"):
        models = {name: create_model(name, num_classes=int(counted[1])) for name in list_models()}
    assert told == {n: sum(p.numel() for p in of.parameters()) for n, of in models.items()}


@pytest.mark.slow
def test_the_study_shows_its_point():
    others, aside = ("Swin", "DAT", "Swin (undis)"), {}
    for level, (low, high) in LEVELS.items():
        ahead = {
            xi: accuracy("DarSwin-A", xi, level) - max(accuracy(of, xi, level) for of in others)
            for xi in SWEEP
        }
        assert min(ahead.values()) >= -2
        seen = [xi for xi in SWEEP if low <= float(xi) <= high]
        ours, *theirs = (
            statistics.mean(accuracy(of, xi, level) for xi in seen) for of in ("DarSwin-A", *others)
        )
        assert len(seen) > 1 and abs(ours - max(theirs)) < 1  # on the lenses of training
    for other in ("Swin", "Swin (undis)"):  # lens knowledge helps those who augment
        aside[other] = [
            accuracy(augmented_label("DarSwin-A"), xi) - accuracy(augmented_label(other), xi)
            for xi in (*SWEEP, POLYNOMIAL)
        ]
        assert min(aside[other]) > 0.4 and max(aside[other][4:]) < 2.25
    assert aside["Swin"][0] > 25
    runs = {label: [] for label in MODELS}
    for cell in record("int8")["cells"]:
        runs[cell["label"]].append(points_lost(cell))
    for lost in runs.values():  # with 8 bits
        assert len(lost) == 3 and max(map(max, lost)) <= 1
        assert statistics.mean(map(statistics.mean, lost)) <= 0.3


@pytest.mark.slow
def test_the_studies_of_wide_lenses_show_their_point():
    labels = {label for label, band in dense_tables.runs_of(record("dense")["cells"], "distance")}
    for task in ("segmentation", "distance"):
        assert max(labels, key=lambda of: dense(task, "low", of)) == "U-Net with rays"
    for wrong in sizes_tables.WRONG:
        adapter, absolute, polar, fixed = (
            near("own", of) - near(wrong, of)
            for label in ("LensAdapter", "DarSwin-Unet RA")
            for of in (label, f"{label}, absolute θ")
        )
        assert abs(adapter) < 0.1 and absolute > 25 and polar < 1 and fixed > 10
    assert detected("tiles: 6", "of_flat") >= 1
    assert max(map(detected, ("tiles: 4 of 256²", "tiles: 5 of 224²"))) < detected("mercator")
    ways = ("concentric square", "raw", "mercator", "tiles: 5")
    rising = [detected(of, table="NanoDet, level") for of in ways]
    assert rising == sorted(set(rising))
    ours, *others = json.loads(page("docs/accuracy.json"))["accuracy"].values()
    assert min(map(min, ours)) >= 92
    for runs in others:
        assert all(a[-1] - b[-1] >= 15 for a, b in zip(ours, runs, strict=True))


@pytest.mark.slow
def test_tables_of_the_method_are_computed():
    rows = re.findall(r"^\| (\d+) × (\d+) \| (.*) \|$", page("docs/explanation/dense.md"), re.M)
    assert len(rows) == 4
    for rings, sectors, scores in rows:
        found = [
            f"{resampling.ceiling(size, int(rings), int(sectors), samples):.2f}"
            for size, samples in product((64, 256), (1, 4))
        ]
        assert scores.split(" | ") == found, (rings, sectors)
    large = re.findall(r"^\| (\d.*) \|$", page("docs/explanation/large.md"), re.M)
    sizes, noises = pixels_read.SIZES, pixels_read.DEVIATIONS
    computed = [
        row_of(size) for row_of in (pixels_read.share_row, pixels_read.noise_row) for size in sizes
    ]
    assert large[: 2 * len(sizes)] == [" | ".join(row) for row in computed]
    for noise, row in zip(noises, large[-len(noises) :], strict=True):
        name, *told = row.removesuffix(" %").split(" | ")
        direct, reduced = (float(share.removesuffix(" %")) for share in told)
        # Another CPU rounds in another way.
        assert float(name) == noise
        assert pixels_read.accuracy(noise) == pytest.approx((direct, reduced), abs=2)
    assert reduced - direct > 20
