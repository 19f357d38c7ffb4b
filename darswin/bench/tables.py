"""Measurements as tables in Markdown; "a / b" is at one and at all threads."""

from collections.abc import Iterable, Mapping, Sequence

from darswin.bench.memory import Memory, compared
from darswin.bench.record import Record
from darswin.bench.timing import (
    COMPILED,
    COMPILED_BFLOAT16,
    FIXED_LENS,
    MATMULS,
    OURS,
    OURS_BFLOAT16,
    OURS_FLOAT32,
    REFERENCE,
    Timing,
)

BOTH = "\u00a0/\u00a0"  # at one and at all threads, on one line


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of cells."""
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def _by_case(timings: Iterable[Timing]) -> dict[tuple[str, int, str], dict[str, list[Timing]]]:
    """By setting, batch and mode, then by name: the timings, fewest threads first."""
    found: dict[tuple[str, int, str], dict[str, list[Timing]]] = {}
    for t in sorted(timings, key=lambda t: t.threads):
        found.setdefault((t.setting, t.batch, t.mode), {}).setdefault(t.name, []).append(t)
    return found


def _milliseconds(timings: Iterable[Timing], digits: int = 2) -> str:
    return BOTH.join(f"{1e3 * t.median:.{digits}f}" for t in timings)


def _ratios(timings: Iterable[Timing], digits: int = 1) -> str:
    return BOTH.join(f"{t.ratio:.{digits}f}×" for t in timings)


def peers_table(timings: Sequence[Timing], subject: str, peers: Sequence[str] = ()) -> str:
    """A row a case of an operator, a column a peer, all by default, with its time over ours."""
    chosen = [t for t in timings if t.subject == subject]
    peers = peers or [name for name in dict.fromkeys(t.name for t in chosen) if name != OURS]
    rows = []
    for (setting, batch, mode), found in _by_case(chosen).items():
        if not found.keys().isdisjoint(peers):
            ratios = [_ratios(found.get(peer, ())) for peer in peers]
            rows.append([f"{setting}, batch {batch}, {mode}", _milliseconds(found[OURS]), *ratios])
    return markdown([f"`{subject}`", "ours (ms)", *peers], rows)


def attention_table(timings: Sequence[Timing]) -> str:
    """A row a case; for each mode the peer that is the fastest, and eager attention."""
    columns = {
        "forward": ("window_attention", "forward"),
        "forward+backward": ("window_attention", "forward+backward"),
        "forward+backward, bfloat16": ("window_attention, bfloat16", "forward+backward"),
    }
    rows: dict[tuple[str, int], list[str]] = {}
    for subject, mode in columns.values():
        chosen = [t for t in timings if (t.subject, t.mode) == (subject, mode)]
        for (setting, batch, _), found in _by_case(chosen).items():
            # At each number of threads.
            peers = zip(*(found[n] for n in found if not n.startswith(OURS)), strict=True)
            best = [min(those, key=lambda t: t.ratio) for those in peers]
            row = rows.setdefault(
                (setting, batch), [f"{setting}, batch {batch}", _milliseconds(found[OURS])]
            )
            row += [_ratios(best), _ratios(found["eager"])]
    heads = [head for mode in columns for head in (f"{mode}: best peer", f"{mode}: eager")]
    return markdown(["`window_attention`", "ours, forward (ms)", *heads], rows.values())


def best_table(
    records: Mapping[str, Sequence[Timing]], rows: Iterable[tuple[str, str, str, int]]
) -> str:
    """A row for each (subject, mode, setting, batch), at all threads, and for each CPU its own
    columns: our time, and how much longer the fastest peer takes."""
    lines = [[f"`{name}`, {mode}, {setting}, batch {batch}"] for name, mode, setting, batch in rows]
    heads = [""]
    for cpu, timings in records.items():
        heads += [f"{cpu}: ours (ms)", "best peer"]
        for line, case in zip(lines, rows, strict=True):
            line += _best(timings, case)
    return markdown(heads, lines)


def _best(timings: Sequence[Timing], case: tuple[str, str, str, int]) -> list[str]:
    parts = (MATMULS, "F.linear alone")  # less work than ours: bounds, no peers
    chosen = [t for t in timings if (t.subject, t.mode, t.setting, t.batch) == case]
    if not chosen:
        return ["", ""]
    chosen = [t for t in chosen if t.threads == max(t.threads for t in chosen)]
    (ours,) = (t for t in chosen if t.name == OURS)
    peers = [t for t in chosen if t.name not in parts and not t.name.startswith(OURS)]
    best = min(peers, key=lambda t: t.ratio)
    time = f"{1e3 * ours.median:.2f}" if ours.median < 0.01 else f"{1e3 * ours.median:.0f}"
    return [time, f"{best.ratio:.1f}×"]


def missed_table(timings: Iterable[Timing]) -> str:
    """The ratios that are below their target."""
    missed = [t for t in timings if t.missed]
    rows = [[f"{t.label}: {t.name}", f"{t.ratio:.2f}", f"{t.target:.2f}"] for t in missed]
    return markdown(["", "ratio", "target"], rows)


def models_table(timings: Sequence[Timing]) -> str:
    """A row a case of a model: images a second, the peers' times over ours, latency at batch 1."""
    peers = (FIXED_LENS, REFERENCE, COMPILED)
    rows = []
    for (_, batch, mode), found in _by_case(timings).items():
        ours = found[OURS]
        latency = ours if mode.startswith("inference") and batch == 1 else []
        rows.append(
            [
                f"{mode}, batch {batch}",
                BOTH.join(f"{batch / t.median:.0f}" for t in ours),
                *(_ratios(found.get(peer, ()), 2) for peer in peers),
                BOTH.join(f"{t.ratio:.0%}" for t in found.get(MATMULS, ())),
                _milliseconds(latency, 1),
                BOTH.join(f"{1e3 * t.p99:.1f}" for t in latency if t.p99),
            ]
        )
    heads = [
        f"`{timings[0].subject}`, {timings[0].setting}", "images/s", *peers,
        "share of the roofline", "p50 (ms)", "p99 (ms)",
    ]  # fmt: skip
    return markdown(heads, rows)


def quantized_table(timings: Sequence[Timing]) -> str:
    """A row a batch: how much longer a model takes in other types than with 8 bits."""
    peers = (OURS_FLOAT32, OURS_BFLOAT16, COMPILED, COMPILED_BFLOAT16)
    rows = [
        [f"batch {batch}", *(_ratios(found.get(peer, ()), 2) for peer in peers)]
        for (_, batch, mode), found in _by_case(timings).items()
        if mode == "inference, int8"
    ]
    return markdown(["over 8 bits", *peers], rows)


def memory_table(memory: Sequence[Memory]) -> str:
    """Peaks of resident memory, ours and the reference's."""
    found = compared(memory)
    rows = [[what, f"{a / 2**20:.0f}", f"{b / 2**20:.0f}", f"{a / b:.2f}"] for what, a, b in found]
    return markdown(["peak memory (MB)", OURS, REFERENCE, "ratio"], rows)


def training_table(models: Mapping[str, Mapping]) -> str:
    """A row a model: images a second in training and testing, and over the reference operators."""
    rows = []
    for name, modes in models.items():
        cells = [f"`{name}`"]
        for mode in ("train", "test"):
            ours, theirs = modes[mode][OURS], modes[mode][REFERENCE]
            rate = ours["images_per_second"]
            cells += [f"{rate:.0f}", f"{rate / theirs['images_per_second']:.2f}×"]
            if mode == "train":
                cells.append(f"{ours['outside']:.1%}")
        rows.append(cells)
    heads = [
        "model", "training (images/s)", "over the reference", "outside the model",
        "testing (images/s)", "over the reference",
    ]  # fmt: skip
    return markdown(heads, rows)


def roofline_lines(record: Record) -> list[str]:
    """What the matrix products alone reach a second, and with the model around them."""
    ours = {t.label: t.median for t in record.timings if t.name == OURS}
    lines = []
    for t in record.timings:
        if t.name == MATMULS:
            # Backward takes two products for each of forward's.
            products = 3 if t.mode.startswith("training") else 1
            work = 1e-9 * record.operations * t.batch * products
            rates = f"{work / t.median:.0f} GFLOP/s, the model {work / ours[t.label]:.0f}"
            lines.append(f"{t.label}: {t.name} {rates} ({t.ratio:.0%})")
    return lines


def autotune_lines(autotune: Iterable[Mapping]) -> list[str]:
    """Which backend of each matrix product was the fastest in training, and by how much."""
    lines = []
    for row in autotune:
        best, *others = row["seconds"].items()
        over = ", ".join(f"{name} {seconds / best[1]:.2f}×" for name, seconds in others)
        lines.append(
            f"{row['product']}, {row['rows']} rows, {row['in_features']} → {row['out_features']}, "
            f"{row['threads']} threads: {best[0]} {1e3 * best[1]:.2f} ms; {over}"
        )
    return lines
