"""Plots of measurements. Only drawing needs matplotlib."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from darswin.bench.record import Record
from darswin.bench.timing import COMPILED, FIXED_LENS, MATMULS, OURS, REFERENCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

WIDTH = 9  # inches: on a page of 740 px, text of 10 pt still has 8 pt

Rows = dict[str, dict[str, float]]  # by case, then by name
Panels = list[list[tuple[str, Rows]]]  # line by line, with their titles


def draw_models(record: Record, path: Path) -> None:
    """Draws the images per second of all candidates at all threads, by mode and batch size."""
    threads = max(t.threads for t in record.timings)
    panels: dict[str, Rows] = {}
    for t in record.timings:
        if t.threads == threads:
            rows = panels.setdefault(t.mode, {})
            rows.setdefault(f"batch {t.batch}", {})[t.name] = t.batch / t.median
    found = dict.fromkeys(t.name for t in record.timings)
    order = [OURS, FIXED_LENS, REFERENCE, COMPILED, MATMULS, *found]
    unit = f"images a second, {record.timings[0].subject}, {threads} threads"
    draw_panels(in_lines(panels, 2), sorted(found, key=order.index), unit, path)


def in_lines(panels: dict[str, Rows], count: int) -> Panels:
    items = list(panels.items())
    return [items[k : k + count] for k in range(0, len(items), count)]


def draw_panels(
    lines: Panels, names: Sequence[str], unit: str, path: Path, is_ratio: bool = False
) -> None:
    """Panels on one scale, which for ratios is logarithmic, with a line at 1."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    from darswin.viz.plot import save_figure

    heights = [max(len(rows) for _, rows in line) for line in lines]
    size = (WIDTH, 1.2 + sum(0.75 + 0.25 * height for height in heights))
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(
        len(lines), max(map(len, lines)), squeeze=False, sharex=True, height_ratios=heights
    )
    legend: dict[str, Line2D] = {}
    for line, beside in zip(lines, grid, strict=True):
        for (title, rows), axes in zip(line, beside, strict=False):
            legend |= _draw_rows(axes, rows, names)
            axes.set_title(title, fontsize="medium")
            axes.tick_params(labelbottom=True)
            if axes is not beside[0] and list(rows) == list(line[0][1]):
                axes.set_yticklabels([])
            if is_ratio:
                axes.axvline(1, color="black", lw=1)
        for axes in beside[len(line) :]:
            axes.set_axis_off()
    if is_ratio:
        grid[0, 0].set_xscale("log", base=2)
        for axes in grid.flat:
            axes.xaxis.set_major_locator(LogLocator(2, numticks=8))
            axes.xaxis.set_major_formatter("{x:g}×")
    else:
        grid[0, 0].set_xlim(left=0)
    figure.supxlabel(unit, fontsize="medium")
    _draw_legend([legend[name] for name in names if name in legend], figure)
    save_figure(figure, path)


def _draw_legend(handles: "list[Line2D]", figure: "Figure") -> None:
    """As many columns as fit beside each other, three at most where there are many names."""
    for columns in range(len(handles) if len(handles) < 5 else 3, 0, -1):
        legend = figure.legend(handles=handles, loc="outside upper center", ncols=columns)
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


def _draw_rows(axes: "Axes", rows: Rows, names: Sequence[str]) -> "dict[str, Line2D]":
    """A dot a name in each row, `MATMULS` pale; the dots by name."""
    drawn = {}
    for index, name in enumerate(names):
        dots = [(row[name], k) for k, row in enumerate(rows.values()) if name in row]
        if dots:
            color = "0.7" if name == MATMULS else f"C{index}"
            (drawn[name],) = axes.plot(*zip(*dots, strict=True), "o", ms=6, color=color, label=name)
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(alpha=0.3)
    return drawn
