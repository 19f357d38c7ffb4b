"""Pictures of what was measured. Only drawing needs matplotlib."""

from collections.abc import Sequence
from pathlib import Path

from darswin.bench.record import Record
from darswin.bench.timing import COMPILED, FIXED_LENS, MATMULS, OURS, REFERENCE

Bars = dict[str, dict[str, float]]  # by case, then by name


def draw_peers(record: Record, path: Path) -> None:
    """Draws the peers' times over ours at one thread."""
    bars: Bars = {}
    for t in record.timings:
        if t.threads == 1 and not t.name.startswith(OURS):
            case = f"{t.subject}, {t.setting}, batch {t.batch}, {t.mode}"
            bars.setdefault(case, {})[t.name] = t.ratio
    names = list(dict.fromkeys(name for group in bars.values() for name in group))
    _draw_bars(bars, names, "time of the peer / time of darswin, 1 thread", path, mark=1)


def draw_models(record: Record, path: Path) -> None:
    """Draws the images a second of all candidates at all threads."""
    threads = max(t.threads for t in record.timings)
    bars: Bars = {}
    for t in record.timings:
        if t.threads == threads:
            bars.setdefault(f"{t.mode}, batch {t.batch}", {})[t.name] = t.batch / t.median
    found = {t.name for t in record.timings}
    names = [n for n in (OURS, FIXED_LENS, REFERENCE, COMPILED, MATMULS) if n in found]
    _draw_bars(
        bars, names, f"images a second, {record.timings[0].subject}, {threads} threads", path
    )


def _draw_bars(
    bars: Bars, names: Sequence[str], xlabel: str, path: Path, mark: float | None = None
) -> None:
    """A group of bars a case, in it a bar a name, `MATMULS` pale; a line at `mark`."""
    from matplotlib.figure import Figure

    from darswin.viz.plot import save_figure

    figure = Figure(figsize=(9, 1.5 + 0.3 * len(bars)), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(names)
    for index, name in enumerate(names):
        lengths = {k: group[name] for k, group in enumerate(bars.values()) if name in group}
        places = [k + index * width for k in lengths]
        color = "0.8" if name == MATMULS else None
        axes.barh(places, list(lengths.values()), width, label=name, color=color)
    if mark is not None:
        axes.axvline(mark, color="black", lw=1)
    axes.set_yticks([k + 0.4 for k in range(len(bars))], list(bars))
    axes.tick_params(axis="y", labelsize=7)
    axes.invert_yaxis()
    axes.margins(y=0.005)
    axes.set_xlabel(xlabel)
    axes.legend(fontsize=8)
    save_figure(figure, path)
