"""The tables and figures of the pretrained study, made from its record."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from pretrained_methods import LEVEL_METHODS, SLICED, SURE, Found, detect, merged
from pretrained_pictures import detector_of
from pretrained_scenes import COCO, SIZE, WIDE, Shot
from pretrained_scores import ZONES
from records import machine, markdown, write

from darswin.viz.plot import TEXT, page_figure, save_figure

NOT_RUN = "Not run yet: `make study-pretrained`."
# Differences that the page shows, first minus second.
PAIRS = (
    ("mercator", "raw"),
    ("mercator", "equirectangular"),
    ("mercator", "cylindrical"),
    ("mercator", "stereographic"),
    ("mercator", "concentric square"),
    ("mercator, 1024²", "raw, 1024²"),
    ("tiles: 5", "mercator"),
    ("tiles: 5", "mercator, 1024²"),
    ("tiles: 5", "raw, 1024²"),
    ("tiles: 5", "tiles: 4"),
    ("tiles: 9", "tiles: 5"),
    ("tiles: 9, and mercator", "tiles: 9"),
    ("tiles: 5", "tiles: 5, wrong lens"),
    ("mercator", "mercator, wrong lens"),
    ("panorama", "raw"),
    ("panorama", "equirectangular, in the camera's frame"),
    ("ring of 6 tiles", "panorama"),
    ("ring of 6 tiles", "ring of 6 tiles, level with the picture"),
    ("ring of 6 tiles", "tiles: 5"),
)
# The same for slices.
SLICED_PAIRS = (
    ("slices: 4", "mercator"),
    ("slices: 4, and raw", "mercator"),
    ("slices: 4, and raw", "raw, 1024²"),
    ("tiles: 4", "slices: 4"),
    ("tiles: 5", "slices: 4, and raw"),
    ("tiles: 4, and mercator", "slices: 4, and raw"),
    ("tiles: 9", "slices: 9"),
    ("tiles: 9", "slices: 9 of 410²"),
    ("tiles: 9, and mercator", "slices: 9, and raw"),
    ("panorama", "slices: 4, and raw"),
    ("ring of 6 tiles", "slices: 4, and raw"),
    ("ring of 6 tiles", "slices: 9"),
    ("slices: 4, and raw", "tiles: 5, wrong lens"),
    ("slices: 4, and raw", "ring of 6 tiles, wrong lens"),
    ("raw, 1024²", "tiles: 5, wrong lens"),
)
SHOWN = {
    "raw": "raw",
    "mercator": "Mercator, one run",
    "tiles: 4, and mercator": "Mercator and 4 tiles",
}
# The views in the table of the page on views, and their methods.
VIEWS = {
    'the picture, `"none"`': "raw",
    '`"perspective"` of 120°': "rectified, 120°",
    '`"square"`': "concentric square",
    **{f'`"{view}"`': view for view in ("stereographic", "cylindrical", "equirectangular")},
    '`"mercator"`': "mercator",
    '`"tiles:5"`': "tiles: 5",
    '`"tiles:9"`': "tiles: 9",
}
# The methods in the tables of zones, lenses and times; the record has all.
MAIN = (
    "raw", "mercator", "raw, 1024²", "mercator, 1024²", "tiles: 4", "tiles: 5", "tiles: 9",
    "tiles: 9, and mercator", "mercator, wrong lens", "tiles: 5, wrong lens",
)  # fmt: skip
SPLITS = {
    "level": "CenterNet, level",
    "small": "CenterNet, small",
    "down": "CenterNet, down",
    "perspective": "CenterNet, perspective",
    "people": "CenterNet, people",
    "second": "NanoDet, level",
}
# Those in the picture: they alone are without limits on copies (CC0).
PANORAMAS = ("city", 0.0), ("interior", 0.0)


def publish(record: dict, out: Path, folder: Path) -> None:
    """Writes a record, with the machine and versions, and draws its figures."""
    record = {key: value for key, value in record.items() if key != "machine"}
    write(folder / "pretrained.json", machine=machine(), **record)
    draw_scores(record["tables"][SPLITS["level"]]["methods"], folder / "pretrained.png")
    draw_found(found_in_panoramas(out), folder / "pretrained_found.png")


def draw_scores(methods: dict, path: Path) -> None:
    """Draws the mAP of each method with its interval."""
    figure = page_figure(6)
    axes = figure.subplots()
    places = np.arange(len(methods))
    values = np.array([of["map"] for of in methods.values()])
    ends = np.array([of["map_interval"] for of in methods.values()])
    errors = np.stack((values - ends[:, 0], ends[:, 1] - values)).clip(0)
    for runs, label in ((1, "one run of the network"), (99, "several runs")):
        chosen = np.array([(of["runs"] == 1) == (runs == 1) for of in methods.values()])
        axes.errorbar(values[chosen], places[chosen], xerr=errors[:, chosen], fmt="o", label=label)
    axes.set_yticks(places, list(methods))
    axes.set(xlabel="mAP@0.5", ylim=(len(methods) - 0.5, -0.5))
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="lower right")
    save_figure(figure, path, colors=256)


Row = tuple[np.ndarray, list[Found]]  # a picture, and what is found in each of the ways `SHOWN`


def found_in_panoramas(out: Path) -> list[Row]:
    """What the detector finds in panoramas, in each of the ways `SHOWN`."""
    detector, rows = detector_of(out, "CenterNet"), []
    for panorama, yaw in PANORAMAS:
        shot = Shot(detector.files, WIDE[2], panorama, yaw)
        picture = shot.render()
        rows.append((picture, [
            merged([detect(look, shot, picture, detector) for look in LEVEL_METHODS[name]])
            for name in SHOWN
        ]))  # fmt: skip
    return rows


def draw_found(rows: list[Row], path: Path) -> None:
    """Draws detections with high scores."""
    figure = page_figure(4.4)
    panels = figure.subplots(len(rows), len(SHOWN), squeeze=False)
    for line, (picture, ways) in zip(panels, rows, strict=True):
        for axes, found, title in zip(line, ways, SHOWN.values(), strict=True):
            axes.imshow(cv2.resize(picture, (512, 512), interpolation=cv2.INTER_AREA))
            axes.set(xticks=[], yticks=[])
            if picture is rows[0][0]:
                axes.set_title(title, fontsize=TEXT)
            best = np.argsort(-found.scores)[: (found.scores >= SURE).sum()]
            named: set[int] = set()  # the best box of each class has its name
            for box, label in zip(found.boxes[best], found.labels[best], strict=True):
                text = "" if label in named else COCO[label]
                # Names of neighbours are in turns above and below their boxes.
                add_box(axes, box * (512 / SIZE), text, below=len(named) % 2 == 1)
                named.add(label)
    save_figure(figure, path, colors=256)


def add_box(axes: Axes, box: np.ndarray, text: str, *, below: bool) -> None:
    x, y, right, lower = box
    axes.add_patch(Rectangle((x, y), right - x, lower - y, fill=False, ec="lime", lw=1.2))
    place, side = (lower + 5, "top") if below else (y - 5, "bottom")
    axes.text(x, place, text, color="lime", fontsize=TEXT, va=side, clip_on=True)


# -- tables -----------------------------------------------------------------------------------


def percent(value: float | None) -> str:
    return "—" if value is None else f"{value:.2f}".removeprefix("0")


def with_interval(value: float, ends: list[float]) -> str:
    return f"{value:.3f} [{ends[0]:.2f}, {ends[1]:.2f}]"


def split_table(found: dict) -> str:
    """A row for each method of a split."""
    flat = "flat_recall" in found
    heads = ["", "runs", "mAP@0.5", "recall", "precision", "false/picture"]
    heads += ["found/flat", "same as flat"] if flat else []
    rows = []
    for name, of in found["methods"].items():
        row = [
            name,
            str(of["runs"]),
            with_interval(of["map"], of["map_interval"]),
            with_interval(of["recall"], of["recall_interval"]),
            f"{of['precision']:.2f}",
            f"{of['false']:.1f}",
        ]
        rows.append(row + ([percent(of["of_flat"]), percent(of["same_as_flat"])] if flat else []))
    return markdown(heads, rows)


def zones_table(methods: dict) -> str:
    """The recall of each method by the angle from the axis."""
    heads = ["recall at θ", *(f"{low}–{high}°" for low, high in ZONES)]
    return markdown(heads, [[name, *map(percent, of["zones"])] for name, of in methods.items()])


def main_methods(record: dict) -> dict:
    methods = record["tables"][SPLITS["level"]]["methods"]
    return {name: methods[name] for name in MAIN if name in methods}


def lenses_table(record: dict) -> str:
    """The mAP of the main methods through each lens."""
    methods = main_methods(record)
    lenses = list(next(iter(methods.values()))["lenses"])
    rows = [
        [name, *(f"{of['lenses'][lens]:.3f}" for lens in lenses)] for name, of in methods.items()
    ]
    return markdown(["mAP@0.5", *lenses], rows)


def views_table(methods: dict) -> str:
    """The mAP of each view, also with four times the pixels where it was measured."""

    def shown(name: str) -> str:
        return percent(methods[name]["map"]) if name in methods else ""

    rows = [[view, shown(name), shown(f"{name}, 1024²")] for view, name in VIEWS.items()]
    return markdown(["view", "of 512×512 px", "of 1024×1024 px"], rows)


def pairs_table(pairs: list[dict]) -> str:
    """The differences of pairs of methods on the same pictures."""
    rows = []
    for of in pairs:
        row = [f"{of['first']} − {of['second']}"]
        for name in ("map", "recall"):
            low, high = of[f"{name}_interval"]
            row.append(f"{of[name]:+.3f} [{low:+.2f}, {high:+.2f}]")
        rows.append([*row, "/".join(map(str, of["only"]))])
    return markdown(["", "mAP@0.5", "recall", "found by one only"], rows)


def crops_table(record: dict) -> str:
    """How often the classifier answers as for the flat picture."""
    heads = ["crop of", "same answer", *(f"{low}–{high}°" for low, high in ZONES)]
    rows = [
        [name, with_interval(of["same"], of["interval"]), *map(percent, of["zones"])]
        for name, of in record["crops"]["crops"].items()
    ]
    return markdown(heads, rows)


def speed_table(record: dict) -> str:
    """The times of one picture."""
    if "speed" not in record:
        return "Not measured yet: `python studies/pretrained.py --speed`."
    runs = record["tables"][SPLITS["level"]]["methods"]
    rows = [
        [name, str(runs[name]["runs"]), f"{of['whole']:.0f}",
         "—" if name.startswith("raw") else f"{of['sampling']:.1f}", f"{of['merging']:.1f}"]
        for name, of in record["speed"].items() if name in MAIN
    ]  # fmt: skip
    return markdown(["ms", "runs", "whole", "of that sampling", "merging"], rows)


def facts(record: dict) -> str:
    """How many scenes and objects each split has."""
    names = {
        "level": "objects of 15° to 50°",
        "small": "objects of 5° to 15°",
        "down": "a camera that looks down",
        "perspective": "a perspective lens of 90°",
        "people": "people in a video",
        "second": "objects of 15° to 50°, NanoDet",
    }
    rows = []
    for split, name in names.items():
        of = record["tables"][SPLITS[split]]
        flat = of.get("flat_recall")
        rows.append([name, str(of["scenes"]), str(of["things"]), percent(flat)])
    return markdown(["", "pictures", "objects", "recall in flat pictures"], rows)


def tables(record: dict | None) -> dict[str, str]:
    """The tables and figures by the name of their place in a page, or a line without a record."""

    def of_slices(make: Callable[[dict], str], split: str) -> Callable[[dict], str]:
        """A table of slices, if the record has them, without the methods of the split's own."""

        def shown(record: dict) -> dict:
            found, known = record["slices"][split], record["tables"][SPLITS[split]]["methods"]
            new = {name: of for name, of in found["methods"].items() if name not in known}
            return {**found, "methods": new}

        return lambda record: make(shown(record)) if "slices" in record else NOT_RUN

    made: dict[str, Callable[[dict], str]] = {
        "facts": facts, "lenses": lenses_table, "crops": crops_table, "speed": speed_table,
        "zones": lambda record: zones_table(main_methods(record)),
        "views": lambda record: views_table(record["tables"][SPLITS["level"]]["methods"]),
        **{split: lambda record, of=split: split_table(record["tables"][SPLITS[of]])
           for split in SPLITS},
        **{f"{split} pairs": lambda record, of=split: pairs_table(record["pairs"][SPLITS[of]])
           for split in ("level", "down")},
        **{f"slices {split}": of_slices(split_table, split) for split in SLICED},
        **{f"slices {split} pairs": of_slices(lambda of: pairs_table(of["pairs"]), split)
           for split in SLICED},
        "slices zones": of_slices(lambda of: zones_table(of["methods"]), "level"),
        "scores": lambda record: "![Scores of all methods](../studies/results/pretrained.png)",
        "found": lambda record: "![Detections](../studies/results/pretrained_found.png)",
    }  # fmt: skip
    return {
        f"pretrained {name}": NOT_RUN if record is None else make(record)
        for name, make in made.items()
    }
