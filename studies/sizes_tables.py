"""The tables and figures of the sizes study, made from the results of its cells."""

import statistics
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from records import machine, markdown, write
from sizes_methods import METHODS
from sizes_scene import DISTANCES, LENSES, OWN, pictures
from tables import spread

from darswin.viz.plot import TEXT, add_legend, page_figure, save_figure

WRONG = {"angles × 0.8": 0.8, "angles × 1.25": 1.25}
SHUFFLED = "lenses shuffled"
NOT_RUN = "Not run yet: `make study-sizes`."


def collect(cells: list[dict], settings: dict) -> dict:
    """The record of a study."""
    order = list(METHODS)
    cells = sorted(cells, key=lambda cell: (order.index(cell["label"]), cell["seed"]))
    kept = [{k: v for k, v in cell.items() if k != "settings"} for cell in cells]
    return dict(settings=settings, cells=kept)


def publish(record: dict, folder: Path) -> None:
    """Writes a record, with the machine and versions, and draws its figures."""
    write(folder / "sizes.json", machine=machine(), **record)
    draw_scores(record["cells"], folder / "sizes.png")
    draw_pictures(folder / "sizes_pictures.png")


def runs_of(cells: list[dict]) -> dict[str, list[dict]]:
    """The results of the test sets of every seed, by label."""
    found = defaultdict(list)
    for cell in cells:
        found[cell["label"]].append(cell["sets"])
    return found


def draw_scores(cells: list[dict], path: Path) -> None:
    """Draws δ1 of each method on each set of true lenses. Dots are means of the seeds, and bars
    are their span."""
    found, names = runs_of(cells), [OWN, *LENSES]
    figure = page_figure(8)
    axes = figure.subplots()
    labels = [label for label in METHODS if label in found]
    for number, label in enumerate(labels):
        values = [[100 * run[name]["delta1"] for run in found[label]] for name in names]
        means = [statistics.mean(of) for of in values]
        ends = [[m - min(of), max(of) - m] for m, of in zip(means, values, strict=True)]
        places = np.arange(len(names)) + 0.8 * ((number + 0.5) / len(labels) - 0.5)
        shape = "o" if number < 10 else "s"  # there are ten colours
        axes.errorbar(
            means, places, xerr=np.transpose(ends), fmt=shape, ms=5, lw=1, label=label
        )  # fmt: skip
    axes.set_yticks(
        range(len(names)), ["its own\nlenses", *(n.replace("-", "-\n") for n in LENSES)]
    )
    axes.set(xlabel="δ1 (%)", ylim=(len(names) - 0.5, -0.5))
    for border in np.arange(len(names) - 1) + 0.5:
        axes.axhline(border, color="lightgray", lw=0.8)
    axes.grid(axis="x", alpha=0.3)
    add_legend(figure, axes.get_legend_handles_labels()[0])
    save_figure(figure, path, colors=256)


def draw_pictures(path: Path) -> None:
    """Draws a picture and its distances through each test lens."""
    names = [OWN, *LENSES]
    figure = page_figure(6)
    panels = figure.subplots(4, len(names) // 2).reshape(2, 2, -1)  # two lines of two rows
    for name, (upper, lower) in zip(names, panels.swapaxes(1, 2).reshape(-1, 2), strict=True):
        (image,), (distance,) = pictures(name, 1, 0, 1)
        upper.imshow(image)
        upper.set_title(name, fontsize=TEXT)
        shown = lower.imshow(
            np.where(distance > 0, distance.astype(float), np.nan), cmap="viridis",
            vmin=DISTANCES[0] - 0.5, vmax=DISTANCES[1],
        )  # fmt: skip
        for axes in (upper, lower):
            axes.set(xticks=[], yticks=[])
    figure.colorbar(shown, ax=figure.axes, label="distance, m", shrink=0.8)
    save_figure(figure, path, colors=256)


# -- tables -----------------------------------------------------------------------------------


def scores(record: dict, score: str, title: str) -> str:
    """A row for each method, and a column for each set of true lenses."""
    sets = {"its own lenses": OWN} | {name: name for name in LENSES}
    rows = [
        [label, *(_spread(runs, _mean([name], score)) for name in sets.values())]
        for label, runs in _in_order(record)
    ]
    return markdown([title, *sets], rows)


def losses(record: dict) -> str:
    """The points of δ1 that each method loses from its own lenses to others."""
    columns = {
        "100°": ["100°"],
        "140°": ["140°"],
        "190°": ["190°"],
        "perspective": ["perspective"],
        "other models": ["Kannala-Brandt", "double sphere", "equisolid"],
    }
    return _lost(record, columns)


def controls(record: dict) -> str:
    """The points of δ1 that each method loses with wrong lenses on the pictures of its own."""
    return _lost(record, {name: [name] for name in (*WRONG, SHUFFLED)})


def _lost(record: dict, columns: dict[str, list[str]]) -> str:
    own, rows = _mean([OWN], "delta1"), []
    for label, runs in _in_order(record):
        row = [label, _spread(runs, own)]
        for names in columns.values():
            other = _mean(names, "delta1")
            row.append(_spread(runs, lambda run, to=other: own(run) - to(run)))
        rows.append(row)
    return markdown(["", "δ1 on its own lenses (%)", *columns], rows)


def _in_order(record: dict) -> list[tuple[str, list[dict]]]:
    """The methods that have cells, with the results of their seeds."""
    found = runs_of(record["cells"])
    return [(label, found[label]) for label in METHODS if label in found]


def _mean(names: Sequence[str], score: str) -> Callable[[dict], float]:
    return lambda run: statistics.mean(run[name][score] for name in names)


def _spread(runs: list[dict], value: Callable[[dict], float]) -> str:
    return spread([100 * value(run) for run in runs])


def tables(record: dict | None) -> dict[str, str]:
    """The tables and figures by the name of their place in a page, or a line without a record."""
    names = ("scores", "errors", "losses", "controls", "curves", "pictures")
    if record is None:
        return {f"sizes {name}": NOT_RUN for name in names}
    made = (
        scores(record, "delta1", "δ1 (%)"),
        scores(record, "abs_rel", "AbsRel (%)"),
        losses(record),
        controls(record),
        "![Scores through the test lenses](../studies/results/sizes.png)",
        "![Pictures and distances through the test lenses](../studies/results/sizes_pictures.png)",
    )
    return {f"sizes {name}": table for name, table in zip(names, made, strict=True)}
