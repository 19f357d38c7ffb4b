"""The tables and the figure of the study, made from the results of its cells."""

import statistics
from collections import defaultdict
from pathlib import Path

from cells import ABLATIONS, AUGMENTED, LEVELS, MODELS, POLYNOMIAL, SWEEP, augmented_label
from records import machine, markdown, write

from darswin.data.lens_distributions import LEVELS as RANGES
from darswin.viz.plot import add_legend, page_figure, save_figure

SHOWN = ("0", "0.2", "0.4", "0.6", "0.8", "1")  # some ξ of the sweep, in a table

# The paper's tables (DarSwin, ICCV 2023), by the training level.
PAPER_04 = {
    "DarSwin-A": (80.33, 92.61, 92.35, 91.39),
    "DAT": (57.5, 90.4, 88.5, 75.7),
    "Swin (undis)": (47.48, 91.52, 91.07, 87.34),
    "Swin": (33.94, 87.90, 78.7, 40.1),
}
PAPER_POLYNOMIAL = {
    "DarSwin-A": (82.7, 84.8, 78.4, 65.5),
    "DAT": (65.4, 85.9, 78.9, 63.8),
    "Swin (undis)": (85.9, 87.1, 71.3, 60.3),
    "Swin": (33.5, 70.2, 42.3, 25.6),
}
# The paper's ablations, by the test level.
PAPER_ABLATIONS = {
    "DarSwin-A": (83.43, 92.8, 91.5, 88.27),
    "polar position bias": (79.6, 92.0, 90.1, 85.4),
    "angular position bias": (81.47, 92.617, 91.11, 87.4),
    "S_r = 5": (81.81, 91.94, 90.0, 85.19),
    "S_r = 2": (78.9, 90.4, 87.9, 82.4),
    "DarSwin-RA": (79.7, 92.7, 90.3, 84.7),
    "no jitter": (81.5, 92.6, 91.16, 87.4),
    "uniform sampling": (82.4, 92.5, 91.2, 86.2),
    "no distortion-aware partition": (52.2, 91.3, 86.2, 75.5),
}


def collect(cells: list[dict], folder: Path, size: str) -> None:
    """Writes the results of a study, with the machine and versions, and draws its figure."""
    cells = sorted(cells, key=lambda c: (c["label"], c["level"], c["seed"]))
    write(folder / f"study--{size}.json", machine=machine(), size=size, cells=cells)
    draw(cells, folder / f"study--{size}.png")


def by_model(cells: list[dict]) -> dict[tuple[str, str], list[dict]]:
    """The accuracies of every seed, by label and training level."""
    found = defaultdict(list)
    for cell in cells:
        found[cell["label"], cell["level"]].append(cell["accuracy"])
    return found


def draw(cells: list[dict], path: Path) -> None:
    """Draws accuracy against ξ, in a panel for each training level. The range of the level is
    shaded. Lines are means over the seeds, and bands are their span."""
    found, xi = by_model(cells), [float(name) for name in SWEEP]
    figure = page_figure(5.4)
    for axes, level in zip(figure.subplots(2, 2, sharey=True).flat, LEVELS, strict=True):
        axes.axvspan(*RANGES[level], color="tab:pink", alpha=0.3, lw=0, label="seen in training")
        for label in MODELS:
            runs = found.get((label, level))
            if runs:
                values = [[run[name] for run in runs] for name in SWEEP]
                (line,) = axes.plot(xi, list(map(statistics.mean, values)), label=label)
                low, high = list(map(min, values)), list(map(max, values))
                axes.fill_between(xi, low, high, color=line.get_color(), alpha=0.2, lw=0)
        axes.set(
            title=f'trained on "{level}"', xlabel="distortion ξ", ylabel="accuracy (%)", xlim=(0, 1)
        )
        axes.label_outer()
        axes.grid(alpha=0.3)
    add_legend(figure, axes.get_legend_handles_labels()[0])
    save_figure(figure, path, colors=256)


def spread(values: list[float]) -> str:
    """The mean and, for several seeds, half of their span."""
    mean = f"{statistics.mean(values):.1f}"
    return mean if len(values) < 2 else f"{mean} ± {(max(values) - min(values)) / 2:.1f}"


def level_table(cells: list[dict], lenses: str, paper: dict) -> str:
    """A row for each model, a column for each training level; the paper's values in brackets."""
    found = by_model(cells)
    rows = []
    for label in MODELS:
        row = [label]
        for level, published in zip(LEVELS, paper[label], strict=True):
            runs = found.get((label, level))
            ours = spread([run[lenses] for run in runs]) if runs else "not run"
            row.append(f"{ours} ({published:.1f})")
        rows.append(row)
    return markdown(["trained on", *(f'"{level}"' for level in LEVELS)], rows)


def augmented_table(cells: list[dict]) -> str:
    """A row for each model without and with lens augmentation, a column for some of the lenses."""
    found = by_model(cells)
    rows = []
    for label in [*AUGMENTED, *map(augmented_label, AUGMENTED)]:
        runs = found.get((label, "very low"))
        if not runs:
            rows.append([label, *["not run"] * (len(SHOWN) + 2)])
            continue
        shown = [spread([run[name] for run in runs]) for name in (*SHOWN, POLYNOMIAL)]
        over_all = spread([statistics.mean(run[name] for name in SWEEP) for run in runs])
        rows.append([label, *shown, over_all])
    columns = [*(f"ξ = {name}" for name in SHOWN), POLYNOMIAL, "mean over ξ"]
    return markdown(["tested on", *columns], rows)


def ablation_table(cells: list[dict]) -> str:
    """A row for each variant trained on "low"; a column for each test level."""
    found = by_model(cells)
    rows = []
    for label in ("DarSwin-A", *ABLATIONS):
        published = PAPER_ABLATIONS.get(label)
        row = [label]
        for k, level in enumerate(LEVELS):
            runs = found.get((label, "low"))
            ours = spread([run[level] for run in runs]) if runs else "not run"
            row.append(ours + (f" ({published[k]:.1f})" if published else ""))
        rows.append(row)
    return markdown(["tested on", *(f'"{level}"' for level in LEVELS)], rows)


def points_lost(cell: dict) -> list[float]:
    """The loss of accuracy by 8 bits for a cell of `quantized.py`, at each ξ."""
    before, after = (cell["accuracy"][name] for name in ("float32", "int8"))
    return [before[xi] - after[xi] for xi in SWEEP]


def int8_table(cells: list[dict]) -> str:
    """A row for each model: its layers of 8 bits, its accuracy over all ξ, and its loss."""
    rows = []
    for label in MODELS:
        runs = [cell for cell in cells if cell["label"] == label]
        if not runs:
            rows.append([label, *["not run"] * 7])
            continue
        before, after = (
            statistics.mean(value for run in runs for value in run["accuracy"][name].values())
            for name in ("float32", "int8")
        )
        lost = [points_lost(run) for run in runs]
        of_means = max(statistics.mean(at) for at in zip(*lost, strict=True))
        changed = statistics.mean(value for run in runs for value in run["changed"].values())
        rows.append(
            [
                label,
                " of ".join(map(str, min(run["layers"] for run in runs))),
                *(f"{before:.2f}", f"{after:.2f}", f"{before - after:z.2f}", f"{of_means:z.2f}"),
                *(f"{max(map(max, lost)):z.1f}", f"{changed:.1f}"),
            ]
        )
    columns = [
        *("", "layers of 8 bits", "float32", "8 bits", "lost", "most at one ξ, mean of the seeds"),
        *("most at one ξ, one seed", "answers that change"),
    ]
    return markdown(columns, rows)


def tables(cells: list[dict]) -> dict[str, str]:
    """The tables by the name of their place in a page."""
    return {
        "xi-0.4": level_table(cells, "0.4", PAPER_04),
        "polynomial": level_table(cells, POLYNOMIAL, PAPER_POLYNOMIAL),
        "augmented": augmented_table(cells),
        "ablations": ablation_table(cells),
    }
