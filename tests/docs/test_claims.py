"""What README and the pages say is what the records and the code say."""

import json
import re
import shlex
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
from cells import LEVELS, MODELS, SWEEP  # noqa: E402
from dense_tables import SCORE  # noqa: E402
from tables import points_lost  # noqa: E402

README = (ROOT / "README.md").read_text()


def page(name: str) -> str:
    return (ROOT / name).read_text()


def prose(name: str) -> str:
    """A page in one line."""
    return " ".join(page(name).split())


def test_the_readme_is_short_and_lines_fit():
    assert README.count("\n") <= 160 and max(map(len, README.splitlines())) < 120
    for path in fill.PAGES:
        for line in path.read_text().splitlines():
            assert len(line) < 120 or line.startswith("|"), (path, line)


def test_pictures_and_links_exist():
    for path in fill.PAGES:
        for target in re.findall(r"(?:\]\(|\]: |`[^`<]* <)([^)#>\s]+)[)#>]", path.read_text()):
            if not target.startswith("http"):
                assert (path.parent / target).is_file(), (path, target)


def test_what_contributors_are_sent_to_exists():
    text = (ROOT / "docs/contributing.md").read_text()
    places = set(re.findall(r"`((?:benchmarks|csrc|darswin|docs|studies|tests)/[^` ]*)`", text))
    assert len(places) > 30
    for place in places:
        assert "NAME" in place or (ROOT / place).exists(), place
    said = " ".join(re.findall(r"`make ([^`]*)`", text))
    targets = set(shlex.split(re.sub(r'[A-Z_]+=("[^"]*"|\S+)', "", said)))  # variables aside
    assert targets <= set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.M))


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


def test_what_is_said_of_cpus_is_in_their_records():
    found = {
        cpu: [
            t.ratio
            for t in record.timings
            if (t.subject, t.mode, t.setting, t.name)
            == ("polar_sample", "forward", "64×64", "F.grid_sample")
        ]
        for cpu, record in fill.records("sampling").items()
    }
    said = prose("docs/performance.md")
    for cpu, ratios in found.items():
        times = f"{min(ratios):.1f} to {max(ratios):.1f} times"
        assert re.search(f"{times} (?:as fast as by `F.grid_sample` )?on (?:the )?{cpu}", said), cpu
    for cpu, record in fill.records("model").items():
        case = ("inference, int8", 8, "darswin, bfloat16")
        ratios = [t.ratio for t in record.timings if (t.mode, t.batch, t.name) == case]
        if ratios:  # the record of Zen 5 has no 8 bits
            times = f"{min(ratios):.1f} to {max(ratios):.1f} times"
            assert re.search(f"{times} (?:as fast with 8 bits )?on (?:the )?{cpu}", said), (
                cpu,
                times,
            )


def test_what_is_said_of_the_study_is_in_its_record():
    cells = json.loads((ROOT / "studies/results/study--nano.json").read_text())["cells"]
    runs = {}
    for cell in cells:
        runs.setdefault((cell["label"], cell["level"]), []).append(cell["accuracy"])

    def mean(label: str, level: str, lenses: str) -> float:
        return statistics.mean(run[lenses] for run in runs[label, level])

    def span(values) -> str:
        low, high = (round(end(values)) for end in (min, max))
        return f"{low} to {high}"

    others = ("Swin", "DAT")
    kept = [round(mean("DarSwin-A", level, "0.4")) for level in ("very low", "high")]
    fell = [span([mean(o, level, "0.4") for o in others]) for level in ("very low", "high")]
    ends = [round(mean("DarSwin-A", "very low", xi)) for xi in ("0", "1")]
    undistorted = round(mean("Swin (undis)", "very low", "1"))
    first = {c["label"]: c["accuracy"] for c in cells if c["level"] == "low" and c["seed"] == 0}

    def cost(label: str) -> list[float]:
        return [first["DarSwin-A"][level] - first[label][level] for level in LEVELS]

    lost = [round(cost("no distortion-aware partition")[k]) for k in (0, -1)]
    samples = span(cost("S_r = 5") + cost("S_r = 2"))
    biases = span(cost("polar position bias") + cost("angular position bias"))
    for said in (
        f"DarSwin keeps {kept[0]} and {kept[1]} % while Swin and DAT fall to {fell[0]} "
        f"and {fell[1]} %",
        f"from {ends[0]} % at ξ = 0 to {ends[1]} % at ξ = 1, Swin and DAT to "
        + " or ".join(sorted({f"{mean(o, 'very low', '1'):.0f}" for o in others})),
        f"({undistorted} against {ends[1]} % at ξ = 1)",
        f"accuracy falls by {lost[0]} and {lost[1]} points at the ends",
        f"Fewer samples cost {samples} points, the other position biases {biases},",
    ):
        assert said in prose("docs/study.md"), said
    ahead = [
        mean(label, level, xi) - mean("DarSwin-A", level, xi)
        for label, level in runs
        if label in (*others, "Swin (undis)")
        for xi in SWEEP
    ]
    assert max(ahead) <= 2


def test_what_8_bits_lose_is_in_its_record():
    record = json.loads((ROOT / "studies/results/int8.json").read_text())
    runs: dict[str, list] = {}
    for cell in record["cells"]:
        assert cell["given"]["test_images"] == 1000
        runs.setdefault(cell["label"], []).append(points_lost(cell))
    assert runs.keys() == set(MODELS) and {len(lost) for lost in runs.values()} == {3}
    over_all = [statistics.mean(x for lost in of for x in lost) for of in runs.values()]
    of_means = [statistics.mean(at) for of in runs.values() for at in zip(*of, strict=True)]
    single = [x for of in runs.values() for lost in of for x in lost]
    assert max(over_all) <= 0.3 and max(of_means) <= 1 and max(single) <= 1
    changed = [x for cell in record["cells"] for x in cell["changed"].values()]
    for said in (
        f"no model's mean over all ξ and seeds moves by more than {max(map(abs, over_all)):.2f}",
        f"at any one ξ the mean of the seeds falls by {max(of_means):.1f} at most, and a single "
        f"model by {max(single):.1f}, {10 * max(single):.0f} of 1,000 pictures",
        f"{statistics.mean(changed):.1f} % of the answers change",
    ):
        assert said in prose("docs/study.md"), said
    assert f"{max(single):.1f} points at any distortion" in prose("docs/howto/speed.md")


def test_what_is_said_of_loading_is_in_its_record():
    loader = json.loads((ROOT / "benchmarks/results/training--micro.json").read_text())["loader"]
    one, beside, two = (
        round(loader[key]) for key in ("all", "1 worker processes", "2 worker processes")
    )
    said = f"One core makes {one} such images a second, one worker process beside the training "
    assert f"{said}{beside}, two {two}:" in prose("docs/performance.md")


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


def test_the_demo_shows_its_point():
    seeds = json.loads((ROOT / "docs/accuracy.json").read_text())["accuracy"]
    assert all(len(runs) == 2 for runs in seeds.values())
    assert min(min(run) for run in seeds["DarSwin-A"]) >= 92
    fell = {}
    for name in ("without lens knowledge", "Swin"):
        for ours, theirs in zip(seeds["DarSwin-A"], seeds[name], strict=True):
            assert ours[-1] - theirs[-1] >= 15
        fell[name] = statistics.mean(run[0] - run[-1] for run in seeds[name])
    words = f"falls by {fell['without lens knowledge']:.0f} points, and Swin by {fell['Swin']:.0f}"
    assert words in prose("README.md") and words in prose("docs/demo.md")


def test_the_demos_model_is_as_large_as_it_says():
    (millions,) = re.findall(r"`darswin_a_nano` \(([\d.]+) M parameters", page("docs/demo.md"))
    count = parameters("darswin_a_nano", num_classes=10, in_chans=1)
    assert round(count / 1e6, len(millions.partition(".")[2])) == float(millions)


def test_what_is_said_of_resampling_is_computed():
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
    bilinear, nearest, reached = resampling.four_nearest()
    said = f"a mean error of {nearest:.4f} by the four nearest and of {bilinear:.4f} bilinear"
    assert said in prose("docs/explanation/dense.md")
    assert f"{100 * reached:.0f} % of the samples reach any pixel" in prose(
        "docs/explanation/dense.md"
    )


def dense_record() -> dict:
    return json.loads((ROOT / "studies/results/dense.json").read_text())


def dense_scores() -> dict[tuple, dict[str, float]]:
    """The mean over the seeds of each test set's score, by task, band, model and control."""
    found: dict[tuple, list[dict]] = {}
    for cell in dense_record()["cells"]:
        key = cell["task"], cell["band"], cell["label"], cell["shuffled"]
        found.setdefault(key, []).append(cell["sets"])
    return {
        key: {n: 100 * statistics.mean(r[n][SCORE[key[0]]] for r in runs) for n in runs[0]}
        for key, runs in found.items()
    }


def test_what_is_said_of_the_dense_study():
    scores = dense_scores()

    def over(task, band, label, sets, shuffled=False):
        return statistics.mean(scores[task, band, label, shuffled][name] for name in sets)

    def all_xi(task, band):
        labels = dense_tables.MODELS
        return {label: over(task, band, label, dense_tables.ALL_XI) for label in labels}

    wide, low = all_xi("segmentation", "wide"), all_xi("segmentation", "low")
    far = all_xi("distance", "low")
    a, adapter, raw, undis = (
        "DarSwin-Unet A", "LensAdapter(Swin-Unet)", "Swin-Unet", "Swin-Unet (undis)",
    )  # fmt: skip
    blind = dense_record()["trivial"]
    without = {
        task: 100 * dense_tables.mean_of(of["direction"], dense_tables.ALL_XI, SCORE[task])
        for task, of in blind.items()
    }
    best_other = max(value for label, value in far.items() if "DarSwin" not in label)
    best = max(low, key=low.__getitem__)
    real = {
        label: over("segmentation", "low", label, dense_tables.camera_sets(dense_record()))
        for label in dense_tables.MODELS
    }
    others = min(value for label, value in real.items() if label != undis)
    for text in (
        f"{wide[a]:.0f} % over all ξ, `LensAdapter` {wide[adapter]:.0f}, Swin-Unet on the picture "
        f"as it is {wide[raw]:.0f}, and on the undistorted one {wide[undis]:.0f}. What one says of "
        f"a direction without looking has {without['segmentation']:.0f}",
        f"all seven lie between {min(low.values()):.0f} and {max(low.values()):.0f} %",
        f'"{best}" leads',
        f"{far[a]:.0f} % where the best of the others reaches {best_other:.0f}, but the median "
        f"distance of a direction has {without['distance']:.0f} too",
        f'mIoU of {real[undis]:.0f} % trained on "low", where all others have {others:.0f} and',
    ):
        assert text in prose("docs/study_dense.md"), text
    assert f"keeps {wide[a]:.0f} % mIoU" in prose("README.md")
    assert max(wide, key=wide.__getitem__) == a
    told = [
        (over(task, band, label, [f"xi-{xi}" for xi in ("0", "0.5", "1")]),
         over(task, band, label, [f"wrong-{xi}" for xi in ("0", "0.5", "1")]))
        for task, band in dense_tables.STUDIED
        for label in ("DarSwin-Unet A", "DarSwin-Unet RA")
    ]  # fmt: skip
    costs = max(true - wrong for true, wrong in told)
    assert f"costs the polar models at most {costs:.1f} points" in prose("docs/study_dense.md")
    spans = []
    for label in dense_tables.MODELS:
        runs = dense_tables.runs_of(dense_record()["cells"], "segmentation")[label, "low"]
        seeds = [100 * dense_tables.mean_of(run, dense_tables.ALL_XI, "miou") for run in runs]
        spans.append(max(seeds) - min(seeds))
        assert len(seeds) == 2
    assert max(low.values()) - min(low.values()) <= max(spans)
    learned = max(
        abs(over(task, band, a, [f"band-{band}"]) - over(task, band, a, [f"band-{band}"], True))
        for task, band in dense_tables.STUDIED
    )
    assert f"changes DarSwin-Unet A's score by at most {learned:.1f} points" in prose(
        "docs/study_dense.md"
    )
