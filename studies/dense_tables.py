"""The tables and figures of the dense study, made from the results of its cells."""

import itertools
import os
import statistics
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

from dense_cells import MODELS, STUDIED, TASKS, Cell
from dense_data import CAMERAS, SHUFFLED, SWEEP, WRONG, camera_set, xi_set
from dense_pictures import draw
from records import machine, markdown, write
from tables import spread

from darswin.viz.plot import TEXT, add_legend, page_figure, save_figure

SCORE = {"segmentation": "miou", "distance": "delta1"}
NAMES = {"miou": "mIoU", "delta1": "δ1"}
SHADED = {"wide": (0.0, 0.0), "low": (0.2, 0.35)}  # ξ of the training lenses
ALL_XI = [xi_set(xi) for xi in SWEEP]
BOUNDS = {"gravity": "gravity", "labels": "+ classes", "heights": "+ heights"}
DOCS = Path(__file__).parent.parent / "docs"  # the folder of the pages
TRIED = (
    *TASKS,
    "parts",
    "rays",
    "labels",
    "details",
    "sizes",
    "rim",
)  # the groups of single trainings
NOT_RUN = "Not run yet: `make study-dense`."


def collect(cells: list[dict], trivial: dict, bounds: dict, config: str, size: str) -> dict:
    """The record of a study."""
    cells = sorted(
        cells, key=lambda c: (c["task"], c["band"], c["label"], c["shuffled"], c["seed"])
    )
    kept = [{k: v for k, v in cell.items() if k != "given"} for cell in cells]
    cameras = list(CAMERAS)
    return dict(
        size=size, config=config, cameras=cameras, trivial=trivial, bounds=bounds, cells=kept
    )


def publish(record: dict, out: Path, folder: Path) -> None:
    """Writes a record, with the machine and versions if it has none, and draws its figures.

    Args:
        out: the folder of the cells; existing predictions in it are drawn.
    """
    write(folder / "dense.json", **(dict(machine=machine()) | record))
    draw_curves(record["cells"], record["trivial"], folder / "dense.png")
    for task in TASKS:
        keys = {label: Cell(label, "low", task).key for label in MODELS}
        runs = {label: out / record["size"] / key for label, key in keys.items()}
        runs = {label: run for label, run in runs.items() if (run / "shown.npz").exists()}
        if runs:
            draw(runs, out / "data", task, folder / f"dense_{task}.png")


def runs_of(cells: list[dict], task: str, shuffled: bool = False) -> dict[tuple, list[dict]]:
    """The results of the test sets of every seed, by label and band."""
    found = defaultdict(list)
    for cell in cells:
        if cell["task"] == task and cell["shuffled"] == shuffled:
            found[cell["label"], cell["band"]].append(cell["sets"])
    return found


def camera_sets(record: dict) -> list[str]:
    """The test sets of a record's cameras."""
    return [camera_set(name) for name in record["cameras"]]


def mean_of(sets: dict, names: Sequence[str], score: str) -> float:
    """The mean of a score over test sets."""
    return statistics.mean(sets[name][score] for name in names)


def draw_curves(cells: list[dict], trivial: dict, path: Path) -> None:
    """Draws mIoU and δ1 against ξ, in a panel for each task and training band. The training band is
    shaded. Lines are means over the seeds, bands are their span, and dots are the baseline that
    ignores the image."""
    pairs, xi = sorted(studied(cells), reverse=True), [float(name) for name in SWEEP]
    lines = -(-len(pairs) // 2)
    figure = page_figure(2.7 * lines)
    panels = figure.subplots(lines, 2, squeeze=False).flat[: len(pairs)]
    for axes, (task, band) in zip(panels, pairs, strict=True):
        found, score, (low, high) = runs_of(cells, task), SCORE[task], SHADED[band]
        if high > low:
            axes.axvspan(low, high, color="tab:pink", alpha=0.3, lw=0)
        for label in MODELS:
            runs = found.get((label, band))
            if runs:
                values = [[100 * run[name][score] for run in runs] for name in ALL_XI]
                (line,) = axes.plot(xi, list(map(statistics.mean, values)), label=label)
                ends = list(map(min, values)), list(map(max, values))
                axes.fill_between(xi, *ends, color=line.get_color(), alpha=0.2, lw=0)
        blind = [100 * trivial[task]["direction"][name][score] for name in ALL_XI]
        axes.plot(xi, blind, color="black", ls=":", label="by direction alone")
        axes.set_title(f'{task}, trained on "{band}"', fontsize=TEXT)
        axes.set_ylabel(f"{NAMES[score]} (%)")
        axes.set(xlim=(0, 1), xlabel="distortion ξ")
        axes.grid(alpha=0.3)
    add_legend(figure, max((axes.get_legend_handles_labels()[0] for axes in panels), key=len))
    save_figure(figure, path, colors=256)


# -- tables -----------------------------------------------------------------------------------


def over_lenses(record: dict, task: str, band: str) -> str:
    """A row for each model trained on a band: scores on its own lenses, on ξ and on the cameras."""
    score = SCORE[task]
    columns = {
        "its own lenses": [f"band-{band}"],
        "ξ = 0": [xi_set("0")],
        "ξ = 0.5": [xi_set("0.5")],
        "ξ = 1": [xi_set("1")],
        "all ξ": ALL_XI,
        "cameras": camera_sets(record),
    }
    rows = _model_rows(record, task, band, score, list(columns.values()))
    others = {f"by {name} alone": sets for name, sets in record["trivial"][task].items()}
    if task == "distance":
        bounds = record.get("bounds", {})  # older records have none
        others |= {f"{BOUNDS[name]}, known exactly": sets for name, sets in bounds.items()}
    for name, sets in others.items():
        rows.append([name, *(f"{100 * mean_of(sets, s, score):.1f}" for s in columns.values())])
    return markdown([f"{NAMES[score]} (%)", *columns], rows)


def over_cameras(record: dict, task: str, band: str) -> str:
    """A row for each model, and a column for each camera."""
    score, sets = SCORE[task], [[name] for name in camera_sets(record)]
    rows = _model_rows(record, task, band, score, sets)
    return markdown([f"{NAMES[score]} (%)", *record["cameras"]], rows)


def errors(record: dict, band: str) -> str:
    """AbsRel, with a row for each model."""
    cameras = camera_sets(record)
    sets = {"its own lenses": [f"band-{band}"], "all ξ": ALL_XI, "cameras": cameras}
    rows = _model_rows(record, "distance", band, "abs_rel", list(sets.values()))
    return markdown(["AbsRel (%)", *sets], rows)


def over_classes(record: dict, band: str) -> str:
    """The IoU of each class on the lenses of training, with a row for each model."""
    found, own = runs_of(record["cells"], "segmentation"), f"band-{band}"
    of_band = [runs for (_, trained_on), runs in found.items() if trained_on == band]
    classes = list(of_band[0][0][own]["iou"]) if of_band else []
    rows = [
        [
            label,
            *(
                _spread(found.get((label, band)), lambda run, c=name: run[own]["iou"][c] or 0)
                for name in classes
            ),
        ]
        for label in labels_of(record)
    ]
    return markdown(["IoU (%)", *classes], rows)


def over_zones(record: dict, task: str, band: str) -> str:
    """A row for each model, and a column for each zone of θ; means over the cameras."""
    found, score = runs_of(record["cells"], task), SCORE[task]
    cameras = camera_sets(record)
    zones = next(iter(found.values()))[0][cameras[0]]["zones"] if found else []
    ends = [f"{zone['to_deg']:g}°" if zone["to_deg"] else "the rim" for zone in zones]
    heads = [f"{z['from_deg']:g}° to {end}" for z, end in zip(zones, ends, strict=True)]

    def of_zone(number: int) -> Callable[[dict], float]:
        return lambda run: statistics.mean(run[name]["zones"][number][score] for name in cameras)

    rows = [
        [label, *(_spread(found.get((label, band)), of_zone(k)) for k in range(len(zones)))]
        for label in labels_of(record)
    ]
    return markdown([f"{NAMES[score]} (%)", *heads], rows)


def controls(record: dict, task: str, band: str) -> str:
    """The scores with wrong lenses."""
    cells = record["cells"]
    true, shuffled = runs_of(cells, task), runs_of(cells, task, shuffled=True)
    score, own = SCORE[task], f"band-{band}"
    told, tests = [xi_set(xi) for xi in WRONG], [f"wrong-{xi}" for xi in WRONG]
    rows = []
    for label in labels_of(record):
        runs = true.get((label, band))
        row = [label]
        for names in (told, tests, [own], [f"{SHUFFLED}-{own}"]):
            row.append(_spread(runs, lambda run, names=names: mean_of(run, names, score)))
        control = shuffled.get((label, band))
        row.append(_spread(control, lambda run: mean_of(run, [own], score)) if control else "–")
        rows.append(row)
    heads = [
        "ξ 0, 0.5, 1, true", "said to be 0.275", "own lenses, true", "shuffled in testing",
        "shuffled in training",
    ]  # fmt: skip
    return markdown([f"{NAMES[score]} (%)", *heads], rows)


def _model_rows(
    record: dict, task: str, band: str, score: str, columns: Sequence[Sequence[str]]
) -> list[list[str]]:
    found = runs_of(record["cells"], task)
    return [
        [
            label,
            *(
                _spread(found.get((label, band)), lambda run, s=sets: mean_of(run, s, score))
                for sets in columns
            ),
        ]
        for label in labels_of(record)
    ]


def studied(cells: list[dict]) -> list[tuple[str, str]]:
    """The tasks and bands with at least one cell."""
    there = {(cell["task"], cell["band"]) for cell in cells}
    return [pair for pair in STUDIED if pair in there]


def labels_of(record: dict) -> list[str]:
    """The models with at least one cell in a record."""
    there = {cell["label"] for cell in record["cells"]}
    return [label for label in MODELS if label in there]


def _spread(runs: list[dict] | None, value: Callable[[dict], float]) -> str:
    return spread([100 * value(run) for run in runs]) if runs else "not run"


def times(cells: list[dict]) -> str:
    """The duration of the cells, in seconds on one core or on a GPU that several cells share."""
    rows = []
    for device, task in itertools.product(sorted({cell["device"] for cell in cells}), TASKS):
        found = [c["seconds"] for c in cells if (c["device"], c["task"]) == (device, task)]
        if found:
            train, test = (statistics.mean(s[part] for s in found) for part in ("train", "test"))
            rows.append([device, task, str(len(found)), f"{train:.0f}", f"{test:.0f}"])
    return markdown(["device", "task", "cells", "training, s", "testing, s"], rows)


def trials(rows: list[dict], task: str) -> str:
    """Single trainings with other losses, parts and initial weights, tested on their own lenses."""
    found = [row for row in rows if row["task"] == task]
    classes = [*found[0].get("iou", ())]
    scores = dict(
        miou="mIoU", accuracy="accuracy", delta1="δ1", abs_rel="AbsRel",
        xi_half="δ1, ξ = 0.5", all_xi="mIoU, all ξ", cameras="mIoU, cameras",
        inside="up to 82.5°", beyond="beyond 82.5°",
    )  # fmt: skip
    kept = {key: name for key, name in scores.items() if key in found[0]}
    cells = [
        [row["model"], row["loss"], f"{row['views']:,}"]
        + [f"{100 * row[key]:.1f}" for key in kept]
        + [f"{100 * row['iou'][name]:.0f}" for name in classes]
        for row in found
    ]
    return markdown(
        ["model", "loss", "pictures", *(f"{name} (%)" for name in kept.values()), *classes], cells
    )


def tables(record: dict, folder: Path) -> dict[str, str]:
    """The tables and figures by the name of their place in a page."""
    made: dict[str, str] = {}
    for task, band in studied(record["cells"]):
        made |= _of_band(record, task, band)
    for name, file, text in (
        ("curves", "dense", "Scores over ξ"),
        *((f"pictures {task}", f"dense_{task}", "Predictions") for task in TASKS),
    ):
        path = folder / f"{file}.png"
        place = os.path.relpath(path, DOCS)
        made[f"dense {name}"] = f"![{text}]({place})" if path.exists() else NOT_RUN
    made["dense times"] = times(record["cells"])
    return made


def _of_band(record: dict, task: str, band: str) -> dict[str, str]:
    name = f"dense {task} {band}"
    kinds = {
        name: lambda record: over_lenses(record, task, band),
        f"{name} zones": lambda record: over_zones(record, task, band),
        f"{name} controls": lambda record: controls(record, task, band),
        f"{name} cameras": lambda record: over_cameras(record, task, band),
    }
    if task == "distance":
        kinds[f"{name} errors"] = lambda record: errors(record, band)
    else:
        kinds[f"{name} classes"] = lambda record: over_classes(record, band)
    return {name: made(record) for name, made in kinds.items()}
