"""The tables of README and the pages are those of the records, and the records show the point."""

import json
import re
import statistics
import sys
from functools import cache
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
from dense_tables import SCORE  # noqa: E402
from tables import points_lost  # noqa: E402

README = (ROOT / "README.md").read_text()


def page(name: str) -> str:
    return (ROOT / name).read_text()


@pytest.mark.slow
def test_the_readme_is_short_and_lines_fit():
    assert README.count("\n") <= 160 and max(map(len, README.splitlines())) < 120
    for path in fill.PAGES:
        for line in path.read_text().splitlines():
            assert len(line) < 120 or line.startswith("|"), (path, line)


@pytest.mark.slow
def test_sentences_are_short():
    for path in fill.PAGES:
        text = re.sub(r"^(`{3,}|:{3,})[^\n]*\n.*?^\1$", "\n\n", path.read_text(), flags=re.M | re.S)
        text = re.sub(r"^(?:\||#).*$", "", text, flags=re.M)  # tables and headings
        text = re.sub(r"^\s*(?:[-*]|\d+\.)\s", "\n\n", text, flags=re.M)
        for paragraph in re.split(r"\n\s*\n", text):
            for sentence in re.split(r"(?<=[.!?:;])\s+", paragraph):
                assert len(sentence.split()) <= 40, (path, sentence)


@pytest.mark.slow
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


@pytest.mark.slow
def test_the_drop_in_call_is_faster_than_what_it_replaces():
    for record in fill.records("sampling").values():
        calls = [
            t
            for t in record.timings
            if t.mode == "forward, layout image" and t.name == "F.grid_sample"
        ]
        assert len(calls) == 6 and min(t.ratio for t in calls) > 1


@pytest.mark.slow
def test_one_frame_is_faster_than_in_other_runtimes_but_for_conv_unet():
    (record,) = fill.records("one_frame").values()
    loops = [t for t in record.timings if not t.paced]
    in_float32 = [t for t in loops if t.batch == 1 and "float32" in t.mode]
    for peer, least in zip(fill.FRAME_PEERS, (1.05, 1.1, 1.05, 1.1), strict=True):
        found = [t for t in in_float32 if t.name == peer]
        assert len(found) == 10
        assert min(t.ratio for t in found if t.subject.startswith("darswin")) > least
    of_peers = [t for t in in_float32 if t.name in fill.FRAME_PEERS]
    lost = {(t.subject, t.name, t.threads) for t in of_peers if t.ratio < 1}
    openvino, package = (("conv_unet_nano", peer) for peer in fill.FRAME_PEERS[2:])
    assert lost == {(*openvino, 1), (*openvino, 2), (*package, 1)}


@pytest.mark.slow
def test_8_bits_win_in_all_cases_of_the_record():
    (record,) = fill.records("one_frame").values()
    ratios = [t.ratio for t in record.timings if t.name == "float32" and "int8" in t.mode]
    assert len(ratios) == 16 and min(ratios) > 1.2


def parameters(name: str, **options) -> int:
    with torch.device("meta"):
        return sum(p.numel() for p in create_model(name, **options).parameters())


@pytest.mark.slow
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


@cache
def record(name: str) -> dict:
    return json.loads(page(f"studies/results/{name}.json"))


@cache
def accuracy(label: str, level: str, xi: str) -> float:
    """Of the study on Fashion-MNIST, as all numbers here the mean of all seeds, in %."""
    cells = record("study--nano")["cells"]
    found = (c["accuracy"][xi] for c in cells if (c["label"], c["level"]) == (label, level))
    return statistics.mean(found)


def dense(task: str, label: str, band: str) -> float:
    """The score over all ξ."""
    runs = dense_tables.runs_of(record("dense")["cells"], task)[label, band]
    scores = (dense_tables.mean_of(run, dense_tables.ALL_XI, SCORE[task]) for run in runs)
    return 100 * statistics.mean(scores)


def near(label: str, name: str) -> float:
    """The δ1 of the sizes study."""
    runs = sizes_tables.runs_of(record("sizes")["cells"])[label]
    return 100 * statistics.mean(run[name]["delta1"] for run in runs)


def detected(of: str, table: str = "CenterNet, level", key: str = "map") -> float:
    return record("pretrained")["tables"][table]["methods"][of][key]


def mean_precision(of: str, table: str = "CenterNet, level", key: str = "map") -> str:
    return f"{detected(of, table, key):.2f}".removeprefix("0")


def sliced(of: str, split: str = "level") -> str:
    """The mAP of a method in the comparison with slices."""
    return f"{record('pretrained')['slices'][split]['methods'][of]['map']:.2f}".removeprefix("0")


def gain(first: str, second: str, split: str = "level", key: str = "map") -> str:
    """The difference of two methods there, with its interval."""
    pairs = record("pretrained")["slices"][split]["pairs"]
    (of,) = (of for of in pairs if (of["first"], of["second"]) == (first, second))
    value, *ends = (f"{v:.2f}".replace("-0.00", "0.00").replace("0.", ".").replace("-", "−")
                    for v in (of[key], *of[f"{key}_interval"]))  # fmt: skip
    return f"{'+' if of[key] >= 0.005 else ''}{value} [{ends[0]}, {ends[1]}]"


def front_page() -> list[str]:
    """What the README says of Fashion-MNIST, of dense tasks, and of when not to use darswin."""
    labels = "DarSwin-A", "Swin", augmented_label("DarSwin-A"), augmented_label("Swin")
    ours, swin, both, augmented = (
        [f"{accuracy(label, 'very low', xi):.0f} %" for xi in "01"] for label in labels
    )
    unets = [dense("segmentation", of, "low") for of in ("U-Net with rays", "DarSwin-Unet RA")]
    found = [
        t.ratio
        for t in next(iter(fill.records("sampling").values())).timings
        if (t.name, t.setting) == ("F.grid_sample", "1024×1024")
        and t.mode in ("forward", "forward, layout image")
    ]
    map_of = mean_precision
    return [
        f"it falls from {ours[0]} to {ours[1]}, and Swin from {swin[0]} to {swin[1]}.",
        f"a Swin reaches {augmented[1]} at ξ = 1 on Fashion-MNIST.",
        f"DarSwin reaches {ours[1]} without that, and {both[1]} with it.",
        "it reaches {:.0f} % mIoU, and DarSwin-Unet {:.0f} %.".format(*unets),
        f"it measures {near(POLAR, '100°'):.0f} % of the distances through 100°",
        f"raises this to {near(FIXED, '100°'):.0f} %. A",
        f"view has [{near('equirectangular', '100°'):.0f} %]",
        f"`polar_sample` is just {min(found):.1f} to {max(found):.1f} times as fast",
        f"has [{map_of('raw')} mAP](docs/study_pretrained.md) on the picture itself",
        f"{map_of('mercator')} on one Mercator view of as many pixels",
        f"and {map_of('tiles: 5')} on five tiles.",
    ]


ADAPTER, ABSOLUTE = "LensAdapter", "LensAdapter, absolute θ"
POLAR, FIXED = "DarSwin-Unet RA", "DarSwin-Unet RA, absolute θ"
DOWN = "CenterNet, down"
FLAT, SQUARE = "rectified, 120°", "concentric square"


def results_of_detectors() -> list[str]:
    map_of = mean_precision
    five, nine = (
        {key: f"{100 * detected(f'tiles: {count}', key=key):.0f} %"
         for key in ("of_flat", "same_as_flat")} for count in (5, 9)
    )  # fmt: skip
    return [
        f"a Mercator map finds {map_of('mercator')} mAP, the picture itself {map_of('raw')}.",
        f"stretched ({map_of('equirectangular')}), stereographic ones lean "
        f"({map_of('stereographic')})",
        f"does both ({map_of(SQUARE)}, less than raw). A cylinder has {map_of('cylindrical')}.",
        f"the picture itself has {map_of('raw, 1024²')} and a Mercator map "
        f"{map_of('mercator, 1024²')}.",
        f"Five tiles have {map_of('tiles: 5')} mAP. Their recall is "
        f"{map_of('tiles: 5', key='recall')}, against {map_of('mercator, 1024²', key='recall')}",
        f"4 tiles and a Mercator map, {map_of('tiles: 4, and mercator')}:",
        f"ten runs, have {map_of('tiles: 9, and mercator')}.",
        f"five find {five['of_flat']}",
        f"five tiles find {five['same_as_flat']} and nine {nine['same_as_flat']}",
        f"Rectified to 120°, the picture has {map_of(FLAT)} mAP",
        f"Rectified to 160°, it has {map_of('rectified, 160°')}.",
        f"without a view: {map_of('raw', DOWN)}. A panorama about gravity has "
        f"{map_of('panorama', DOWN)}",
        f"have {map_of('ring of 6 tiles', DOWN)}, and the same tiles level with the picture only "
        f"{map_of('ring of 6 tiles, level with the picture', DOWN)}.",
    ]


SLICES, ENLARGED = "slices: 4, and raw", "slices: 9 of 410²"
LARGE_RAW, WRONG = "raw, 1024²", "tiles: 5, wrong lens"


def results_of_slices() -> list[str]:
    ring = "ring of 6 tiles"
    return [
        f"Four tiles have {sliced('tiles: 4')} mAP and four slices {sliced('slices: 4')} "
        f"({gain('tiles: 4', 'slices: 4')}); nine tiles have {sliced('tiles: 9')} and nine slices "
        f"{sliced('slices: 9')} ({gain('tiles: 9', 'slices: 9')}).",
        f"Five tiles have {sliced('tiles: 5')} mAP, and four slices with the whole picture, sahi's "
        f"way, {sliced(SLICES)}: {gain('tiles: 5', SLICES)}, and "
        f"{gain('tiles: 5', SLICES, key='recall')} in recall.",
        f"better five runs: {gain('tiles: 4, and mercator', SLICES)}.",
        f"{sliced(SLICES)} against {sliced('mercator')}, with five runs",
        f"five tiles have {sliced('tiles: 5', 'small')} mAP, four slices with the whole "
        f"{sliced(SLICES, 'small')}.",
        f"have {sliced(ENLARGED, 'small')} against {sliced('tiles: 9', 'small')} of nine tiles: "
        f"{gain('tiles: 9', ENLARGED, 'small')}, not shown.",
        f"Five tiles have {sliced('tiles: 5', 'down')} mAP, six in a ring {sliced(ring, 'down')}, "
        f"and four slices with the whole {sliced(SLICES, 'down')}: "
        f"{gain('tiles: 5', SLICES, 'down')} and {gain(ring, SLICES, 'down')}. Nine slices have "
        f"{sliced('slices: 9', 'down')}, less than one panorama, {sliced('panorama', 'down')}.",
        f"{gain(SLICES, LARGE_RAW)} for level pictures, {gain(SLICES, LARGE_RAW, 'small')} for "
        f"small things and {gain(SLICES, LARGE_RAW, 'down')} down.",
        f"{gain(SLICES, LARGE_RAW, key='recall')} level and "
        f"{gain(SLICES, LARGE_RAW, 'down', 'recall')} down.",
        f"Slices have {gain(SLICES, WRONG)} mAP over five tiles by a wrong lens, and the picture "
        f"at 1024² has {gain(LARGE_RAW, WRONG)}.",
        f"these are {gain(SLICES, WRONG, 'small')} and {gain(SLICES, WRONG, 'down')} for slices, "
        f"and {gain(LARGE_RAW, WRONG, 'small')} and {gain(LARGE_RAW, WRONG, 'down')} for",
    ]


def answer_without_a_lens() -> list[str]:
    level, down = (
        [sliced(of, split) for of in (SLICES, LARGE_RAW, WRONG, "tiles: 5")]
        for split in ("level", "down")
    )
    return [
        f"have {level[0]} mAP, the picture at 1024² {level[1]}, and five tiles by a wrong lens "
        f"{level[2]}. With the true lens, five tiles have {level[3]}.",
        f"these are {down[0]}, {down[1]}, {down[2]} and {down[3]}.",
    ]


def table_of_views() -> list[str]:
    map_of = mean_precision
    large = {view: map_of(f"{view}, 1024²") for view in ("raw", "stereographic", "mercator")}
    assert map_of("stereographic") == map_of("cylindrical")
    assert map_of("equirectangular, 1024²") == large["stereographic"]
    return [
        f'| the picture, `"none"` | {map_of("raw")} | {large["raw"]} |',
        f'| `"perspective"` of 120° | {map_of(FLAT)} | |',
        f'| `"square"` | {map_of(SQUARE)} | |',
        f'| `"stereographic"`, `"cylindrical"` | {map_of("cylindrical")} | '
        f"{large['stereographic']} (stereographic) |",
        f'| `"equirectangular"` | {map_of("equirectangular")} | {large["stereographic"]} |',
        f'| `"mercator"` | {map_of("mercator")} | {large["mercator"]} |',
        f'| `"tiles"`, 5 / 9 | {map_of("tiles: 5")} / {map_of("tiles: 9")} | |',
        f"({map_of('ring of 6 tiles', DOWN)} against {map_of('tiles: 5', DOWN)} mAP in",
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sentences"),
    [
        ("README.md", front_page),
        ("docs/study_pretrained.md", results_of_detectors),
        ("docs/study_pretrained.md", results_of_slices),
        ("docs/answers.md", answer_without_a_lens),
        ("docs/explanation/views.md", table_of_views),
    ],
)
def test_pages_tell_what_was_measured(name, sentences):
    text = " ".join(page(name).split())
    assert not [sentence for sentence in sentences() if sentence not in text]


@pytest.mark.slow
def test_the_study_shows_its_point():
    for level, (low, high) in LEVELS.items():  # "within 1 point of DarSwin"
        seen = [xi for xi in SWEEP if low <= float(xi) <= high]
        scores = [
            statistics.mean(accuracy(label, level, xi) for xi in seen)
            for label in ("DarSwin-A", "Swin", "DAT", "Swin (undis)")
        ]
        assert len(seen) > 1 and abs(scores[0] - max(scores[1:])) < 1
    for other in ("Swin", "DAT"):
        for level, points in (("very low", 30), ("high", 5)):
            assert accuracy("DarSwin-A", level, "0.4") - accuracy(other, level, "0.4") > points
    for label, level in {(c["label"], c["level"]) for c in record("study--nano")["cells"]}:
        if label in ("Swin", "DAT", "Swin (undis)"):
            for xi in SWEEP:
                assert accuracy(label, level, xi) - accuracy("DarSwin-A", level, xi) <= 2


@pytest.mark.slow
def test_lens_knowledge_helps_those_who_augment():
    swin, undis = (
        [
            accuracy(augmented_label("DarSwin-A"), "very low", xi)
            - accuracy(augmented_label(other), "very low", xi)
            for xi in (*SWEEP, POLYNOMIAL)
        ]
        for other in ("Swin", "Swin (undis)")
    )
    assert min(swin + undis) > 0.4  # everywhere
    assert swin[0] > 25 and max(swin[4:] + undis[4:]) < 2.25


@pytest.mark.slow
def test_8_bits_lose_little():
    runs: dict[str, list] = {}
    for cell in record("int8")["cells"]:
        runs.setdefault(cell["label"], []).append(points_lost(cell))
    assert runs.keys() == set(MODELS) and {len(lost) for lost in runs.values()} == {3}
    over_all = [statistics.mean(x for lost in of for x in lost) for of in runs.values()]
    single = [x for of in runs.values() for lost in of for x in lost]
    assert max(over_all) <= 0.3 and max(single) <= 1


@pytest.mark.slow
def test_the_dense_study_shows_its_point():
    def scores(task: str, band: str) -> dict[str, int]:
        found = dense_tables.runs_of(record("dense")["cells"], task)
        labels = [label for label, trained_on in found if trained_on == band]
        assert max(labels, key=lambda of: dense(task, of, "low")) == "U-Net with rays"
        return {label: round(dense(task, label, band)) for label in labels}

    wide, measured = scores("segmentation", "wide"), scores("distance", "wide")
    assert (wide.pop("Swin-Unet"), wide.pop("Swin-Unet, Mercator")) == (32, 32)
    assert (wide.pop("U-Net, Mercator"), wide.pop("U-Net, equirectangular")) == (29, 24)
    assert len(wide) == 4 and set(wide.values()) == {39, 40}
    assert (measured.pop("Swin-Unet"), measured.pop("U-Net, Mercator")) == (15, 39)
    assert len(measured) == 6 and set(measured.values()) == {36, 37, 38}


@pytest.mark.slow
def test_the_sizes_study_shows_its_point():
    assert near("raw", "own") > 85 and near("raw", "100°") < 15
    assert near(ADAPTER, "own") - near(ADAPTER, "100°") > 70
    assert near(ABSOLUTE, "100°") - near(ADAPTER, "100°") > 70
    assert near(ABSOLUTE, "own") - near(ABSOLUTE, "100°") < 2.5
    for wrong in sizes_tables.WRONG:
        assert near(ABSOLUTE, "own") - near(ABSOLUTE, wrong) > 25
        assert abs(near(ADAPTER, "own") - near(ADAPTER, wrong)) < 0.1
        assert near(POLAR, "own") - near(POLAR, wrong) < 1
        assert near(FIXED, "own") - near(FIXED, wrong) > 10
    assert near(FIXED, "100°") - near(POLAR, "100°") > 30


@pytest.mark.slow
def test_the_study_of_pretrained_detectors_shows_its_point():
    assert detected("tiles: 6", key="of_flat") >= 1
    for tiles in ("tiles: 4 of 256²", "tiles: 5 of 224²"):
        assert detected(tiles) < detected("raw")
    assert detected("tiles: 5") - detected("tiles: 5, wrong lens") > 0.2
    rising = [detected(of, "NanoDet, level") for of in (SQUARE, "raw", "mercator", "tiles: 5")]
    assert rising == sorted(set(rising))


@pytest.mark.slow
def test_the_demo_shows_its_point():
    runs = json.loads(page("docs/accuracy.json"))["accuracy"]
    assert min(min(run) for run in runs["DarSwin-A"]) >= 92
    for other in ("without lens knowledge", "Swin"):
        for ours, theirs in zip(runs["DarSwin-A"], runs[other], strict=True):
            assert ours[-1] - theirs[-1] >= 15


@pytest.mark.slow
def test_the_table_of_resampling_is_computed():
    text = page("docs/explanation/dense.md")
    rows = re.findall(r"^\| (\d+) × (\d+) \| (.*) \|$", text, re.M)
    assert len(rows) == 4
    for rings, sectors, scores in rows:
        found = [
            f"{resampling.ceiling(size, int(rings), int(sectors), samples):.2f}"
            for size in (64, 256)
            for samples in (1, 4)
        ]
        assert scores.split(" | ") == found, (rings, sectors)


def rows_of(text: str) -> list[list[str]]:
    """The rows of the tables in a page, without their heads."""
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return [row for row in rows if row[0][0].isdigit()]


@pytest.mark.slow
def test_the_pixels_that_a_grid_reads_are_computed():
    large = page("docs/explanation/large.md")
    rows, sizes = rows_of(large), pixels_read.SIZES
    shares, errors = rows[: len(sizes)], rows[len(sizes) : 2 * len(sizes)]
    assert [row[0] for row in shares] == [row[0] for row in errors]
    for size, share, error in zip(sizes, shares, errors, strict=True):
        assert share == pixels_read.share_row(size) and error == pixels_read.noise_row(size)


@pytest.mark.slow
def test_large_noisy_pictures_are_better_reduced():
    rows = rows_of(page("docs/explanation/large.md"))[-len(pixels_read.DEVIATIONS) :]
    for noise, row in zip(pixels_read.DEVIATIONS, rows, strict=True):
        assert float(row[0]) == noise
        told = [float(share.removesuffix(" %")) for share in row[1:]]
        # Another CPU rounds in another way.
        assert pixels_read.accuracy(noise) == pytest.approx(told, abs=2)
    direct, reduced = told
    assert reduced - direct > 20
