"""Plots of measurements. Only drawing needs matplotlib."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kit.record import Record
from kit.timing import COMPILED, FIXED_LENS, MATMULS, OURS, REFERENCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

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
    draw_panels(in_lines(panels), sorted(found, key=order.index), unit, path)


def in_lines(panels: dict[str, Rows]) -> Panels:
    """Two panels in a line if they have the same rows, so that one list of names serves both."""
    lines: Panels = []
    for title, rows in panels.items():
        if lines and len(lines[-1]) == 1 and list(lines[-1][0][1]) == list(rows):
            lines[-1].append((title, rows))
        else:
            lines.append([(title, rows)])
    return lines


def draw_panels(
    lines: Panels, names: Sequence[str], unit: str, path: Path, is_ratio: bool = False
) -> None:
    """Panels on one scale, which for ratios is logarithmic, with a line at 1."""
    from matplotlib.ticker import LogLocator

    from darswin.viz.plot import add_legend, page_figure, save_figure

    heights = [max(len(rows) for _, rows in line) for line in lines]
    figure = page_figure(0.6 + sum(0.75 + 0.25 * height for height in heights))
    grid = figure.subplots(
        len(lines), max(map(len, lines)), squeeze=False, sharex=True, height_ratios=heights
    )
    legend: dict[str, Line2D] = {}
    for line, beside in zip(lines, grid, strict=True):
        for (title, rows), axes in zip(line, beside, strict=False):
            legend |= _draw_rows(axes, rows, names)
            axes.set_title(title, fontsize="medium")
            axes.tick_params(labelbottom=True)
            if axes is not beside[0]:
                axes.set_yticklabels([])
            if is_ratio:
                axes.axvline(1, color="black", lw=1)
        for axes in beside[len(line) :]:
            axes.set_axis_off()
    if is_ratio:
        grid[0, 0].set_xscale("log", base=2)
        for axes in grid.flat:
            axes.xaxis.set_major_locator(LogLocator(2, numticks=5))
            axes.xaxis.set_major_formatter("{x:g}×")
    else:
        grid[0, 0].set_xlim(left=0)
    figure.supxlabel(unit, fontsize="medium")
    add_legend(figure, [legend[n] for n in names if n in legend], loc="outside upper center")
    save_figure(figure, path)


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
