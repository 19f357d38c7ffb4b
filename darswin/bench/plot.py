"""Pictures of what was measured. Only drawing needs matplotlib."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from darswin.bench.record import Record
from darswin.bench.timing import COMPILED, FIXED_LENS, MATMULS, OURS, REFERENCE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_peers(record: Record, path: Path) -> None:
    """Draws the peers' times over ours at one thread."""
    from darswin.viz.plot import save_figure

    bars: dict[str, dict[str, float]] = {}
    for t in record.timings:
        if t.threads == 1 and not t.name.startswith(OURS):
            case = f"{t.subject}, {t.setting}, batch {t.batch}, {t.mode}"
            bars.setdefault(case, {})[t.name] = t.ratio
    names = list(dict.fromkeys(name for group in bars.values() for name in group))
    figure, axes = _grouped_bars(bars, names)
    axes.axvline(1, color="black", lw=1)
    axes.set_xlabel("time of the peer / time of darswin, 1 thread")
    save_figure(figure, path)


def draw_models(record: Record, path: Path) -> None:
    """Draws the images a second of all candidates at all threads."""
    from darswin.viz.plot import save_figure

    threads = max(t.threads for t in record.timings)
    bars: dict[str, dict[str, float]] = {}
    for t in record.timings:
        if t.threads == threads:
            bars.setdefault(f"{t.mode}, batch {t.batch}", {})[t.name] = t.batch / t.median
    found = {t.name for t in record.timings}
    names = [n for n in (OURS, FIXED_LENS, REFERENCE, COMPILED, MATMULS) if n in found]
    figure, axes = _grouped_bars(bars, names)
    axes.set_xlabel(f"images a second, {record.timings[0].subject}, {threads} threads")
    save_figure(figure, path)


def _grouped_bars(
    bars: Mapping[str, Mapping[str, float]], names: Sequence[str]
) -> tuple["Figure", "Axes"]:
    """A group of bars a case, in it a bar a name; `MATMULS` is pale."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1.5 + 0.3 * len(bars)), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(names)
    for index, name in enumerate(names):
        lengths = {k: group[name] for k, group in enumerate(bars.values()) if name in group}
        places = [k + index * width for k in lengths]
        color = "0.8" if name == MATMULS else None
        axes.barh(places, list(lengths.values()), width, label=name, color=color)
    axes.set_yticks([k + 0.4 for k in range(len(bars))], list(bars))
    axes.tick_params(axis="y", labelsize=7)
    axes.invert_yaxis()
    axes.margins(y=0.005)
    axes.legend(fontsize=8)
    return figure, axes
