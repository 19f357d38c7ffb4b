"""The record of `darswin bench`: as a file, a table, a plot, and against its bars."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from darswin.bench.memory import Memory
from darswin.bench.timing import COMPILED, ONE_LENS, OURS, PRODUCTS, REFERENCE, Timing
from darswin.utils.files import replace_file

# Of darswin_a_small on 64×64: the least that a peer's time over ours should be, at all threads.
BARS = {
    ("inference", "float32", 8, REFERENCE): 2.6,
    ("inference", "float32", 8, COMPILED): 2.2,
    ("inference", "float32", 8, PRODUCTS): 0.8,
    ("inference", "float32", 1, REFERENCE): 2.2,
    ("inference", "bfloat16", 8, REFERENCE): 1.35,
    ("inference", "bfloat16", 8, COMPILED): 1.1,
    ("training", "float32", 8, REFERENCE): 2.0,
    ("training", "bfloat16", 8, REFERENCE): 1.15,
}
MEMORY_BAR = 0.8  # the most that the peak of a training step should be of the reference's


@dataclass
class Record:
    """All that one run of `darswin bench` found.

    Args:
        machine: see `machine`. model, size: of the network and of its images, px.
        operations: of the products of one image, by name of the dtype.
        products: of `darswin.layers.linear.autotune_results`, as rows.
    """

    machine: dict
    model: str
    size: int
    operations: int
    timings: list[Timing]
    memory: list[Memory]
    products: list[dict]

    def save(self, path: Path) -> None:
        """Writes it as JSON."""
        replace_file(path, json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> "Record":
        """What `save` wrote."""
        content = json.loads(path.read_text())
        content["timings"] = [Timing(**t) for t in content["timings"]]
        content["memory"] = [Memory(**m) for m in content["memory"]]
        return cls(**content)

    def find(self, case: tuple, name: str) -> Timing | None:
        """The timing of a candidate in a case: (mode, dtype, batch, threads)."""
        return next((t for t in self.timings if t.case == case and t.name == name), None)

    def ratio(self, case: tuple, peer: str) -> float | None:
        """The peer's time over ours."""
        found = self.find(case, peer)
        return found.ratio if found else None


def table(record: Record) -> str:
    """Images a second, and the peers' times over ours, in Markdown; "a / b" at 1 / all threads."""
    threads = sorted({t.threads for t in record.timings})
    peers = (ONE_LENS, REFERENCE, COMPILED)
    heads = [
        f"`{record.model}`, {record.size}×{record.size}", "images/s", *peers, "share of the roof",
        "p50 (ms)", "p99 (ms)",
    ]  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for mode, dtype, batch in dict.fromkeys(t.case[:3] for t in record.timings):
        cases = [(mode, dtype, batch, count) for count in threads]
        ours = [t for case in cases if (t := record.find(case, OURS))]
        cells = [_both(f"{t.batch / t.median:.0f}" for t in ours)]
        for peer in peers:
            cells.append(_both(f"{r:.2f}×" for c in cases if (r := record.ratio(c, peer))))
        cells.append(_both(f"{r:.0%}" for c in cases if (r := record.ratio(c, PRODUCTS))))
        latency = mode == "inference" and batch == 1
        cells.append(_both(f"{1e3 * t.median:.1f}" for t in ours if latency))
        cells.append(_both(f"{1e3 * t.p99:.1f}" for t in ours if latency))
        lines.append(f"| {mode}, {dtype}, batch {batch} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _both(values) -> str:
    return " / ".join(values)


def memory_table(record: Record) -> str:
    """Peaks of resident memory, ours and the reference's, in Markdown."""
    lines = ["| peak memory (MB) | darswin | reference | ratio |", "|---" * 4 + "|"]
    for ours, theirs in _memory_pairs(record):
        what = f"{ours.mode}, {ours.dtype}, batch {ours.batch}"
        for name, kind in (("in all", "whole"), ("of the batch itself", "own")):
            a, b = (getattr(m, kind) for m in (ours, theirs))
            lines.append(f"| {what}, {name} | {a / 2**20:.0f} | {b / 2**20:.0f} | {a / b:.2f} |")
    return "\n".join(lines)


def _memory_pairs(record: Record) -> list[tuple[Memory, Memory]]:
    found = {(m.mode, m.dtype, m.batch, m.name): m for m in record.memory}
    cases = dict.fromkeys((m.mode, m.dtype, m.batch) for m in record.memory)
    return [(found[*case, OURS], found[*case, REFERENCE]) for case in cases]


def roof(record: Record) -> str:
    """What the products alone reach a second, and with the model around them."""
    lines = []
    for case in dict.fromkeys(t.case for t in record.timings if t.name == PRODUCTS):
        mode, dtype, batch, threads = case
        alone, ours = (
            1e-9 * record.operations * batch / record.find(case, name).median
            for name in (PRODUCTS, OURS)
        )
        lines.append(
            f"{mode}, {dtype}, batch {batch}, {threads} threads: products alone {alone:.0f} "
            f"GFLOP/s, the model {ours:.0f} ({record.ratio(case, PRODUCTS):.0%})"
        )
    return "\n".join(lines)


def products(record: Record) -> str:
    """Which way of each product was the fastest in training, and by how much."""
    lines = []
    for row in record.products:
        best, *others = row["seconds"].items()
        over = ", ".join(f"{name} {seconds / best[1]:.2f}×" for name, seconds in others)
        lines.append(
            f"{row['product']}, {row['rows']} rows, {row['in_features']} → {row['out_features']}, "
            f"{row['threads']} threads: {best[0]} {1e3 * best[1]:.2f} ms; {over}"
        )
    return "\n".join(lines)


def bar_lines(record: Record) -> list[str]:
    """Each ratio that has a bar, against it; the bars are for one model."""
    if (record.model, record.size) != ("darswin_a_small", 64):
        return []
    threads = max(t.threads for t in record.timings)
    lines = []
    for (mode, dtype, batch, peer), bar in BARS.items():
        ratio = record.ratio((mode, dtype, batch, threads), peer)
        if ratio is not None:
            what = f"{mode}, {dtype}, batch {batch}, over {peer}"
            lines.append(_against(what, ratio, bar, ratio >= bar))
    for ours, theirs in _memory_pairs(record):
        if ours.mode != "training":
            continue
        for name, kind in (("in all", "whole"), ("of the step itself", "own")):
            ratio = getattr(ours, kind) / getattr(theirs, kind)
            what = f"peak memory of a training step, {ours.dtype}, {name}"
            lines.append(_against(what, ratio, MEMORY_BAR, ratio <= MEMORY_BAR))
    return lines


def _against(what: str, ratio: float, bar: float, reached: bool) -> str:
    return f"{what}: {ratio:.2f} (bar {bar:.2f}){'' if reached else ' MISSED'}"


def plot(record: Record, path: Path) -> None:
    """Draws images a second of all candidates at all threads, a group of bars a case."""
    from matplotlib.figure import Figure  # which not everybody has

    from darswin.viz.plot import save_figure

    threads = max(t.threads for t in record.timings)
    rows = [t for t in record.timings if t.threads == threads]
    names = [n for n in (OURS, ONE_LENS, REFERENCE, COMPILED, PRODUCTS) if _named(rows, n)]
    cases = list(dict.fromkeys(t.case for t in rows))
    figure = Figure(figsize=(9, 1.5 + 0.6 * len(cases)), layout="constrained")
    axes = figure.subplots()
    for index, name in enumerate(names):
        found = {t.case: t.batch / t.median for t in _named(rows, name)}
        places = [cases.index(case) + 0.8 * index / len(names) for case in found]
        color = "0.8" if name == PRODUCTS else None
        axes.barh(places, found.values(), 0.8 / len(names), label=name, color=color)
    labels = [f"{mode}, {dtype}, batch {batch}" for mode, dtype, batch, _ in cases]
    axes.set_yticks([place + 0.4 for place in range(len(cases))], labels)
    axes.tick_params(axis="y", labelsize=8)
    axes.invert_yaxis()
    axes.set_xlabel(f"images a second, {record.model}, {threads} threads")
    axes.legend(fontsize=8)
    save_figure(figure, path)


def _named(rows: Sequence[Timing], name: str) -> list[Timing]:
    return [t for t in rows if t.name == name]
