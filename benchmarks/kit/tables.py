"""Measurements as tables in Markdown; "a / b" means at one and at all threads."""

import math
from collections.abc import Iterable, Sequence

from kit.memory import Memory, compared
from kit.record import Record
from kit.start import Start
from kit.timing import (
    BY_TORCH,
    COMPILED,
    COMPILED_BFLOAT16,
    FIXED_LENS,
    FORWARD,
    MATMULS,
    OURS,
    OURS_FLOAT32,
    REFERENCE,
    Timing,
    threads_label,
)

BOTH = "\u00a0/\u00a0"  # at one and at all threads, on one line


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of cells."""
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def pivot(corner: str, cells: Iterable[tuple[str, str, str]]) -> str:
    """A table of cells, each with the names of its row and its column; the others are empty."""
    rows: dict[str, dict[str, str]] = {}
    columns: dict[str, None] = {}
    for row, column, cell in cells:
        rows.setdefault(row, {})[column] = cell
        columns[column] = None
    lines = ([name, *(row.get(column, "") for column in columns)] for name, row in rows.items())
    return markdown([corner, *columns], lines)


def by_case(timings: Iterable[Timing]) -> dict[tuple[str, int, str], dict[str, list[Timing]]]:
    """Groups timings by setting, batch and mode, then by name; fewest threads first."""
    found: dict[tuple[str, int, str], dict[str, list[Timing]]] = {}
    for t in sorted(timings, key=lambda t: t.threads or math.inf):  # `DEFAULT` last
        found.setdefault((t.setting, t.batch, t.mode), {}).setdefault(t.name, []).append(t)
    return found


def milliseconds(timings: Iterable[Timing], digits: int = 2) -> str:
    return BOTH.join(f"{1e3 * t.median:.{digits}f}" for t in timings)


def ratios(timings: Iterable[Timing], digits: int = 1) -> str:
    return BOTH.join(f"{t.ratio:.{digits}f}×" for t in timings)


def models_table(timings: Sequence[Timing]) -> str:
    """Images per second, the peers' times over ours, and latency at batch 1, by case."""
    peers = (FIXED_LENS, REFERENCE, COMPILED)
    rows = []
    for (_, batch, mode), found in by_case(timings).items():
        ours = found[OURS]
        latency = ours if mode.startswith("inference") and batch == 1 else []
        rows.append(
            [
                f"{mode}, batch {batch}",
                BOTH.join(f"{batch / t.median:.0f}" for t in ours),
                *(ratios(found.get(peer, ()), 2) for peer in peers),
                BOTH.join(f"{t.ratio:.0%}" for t in found.get(MATMULS, ())),
                milliseconds(latency, 1),
                BOTH.join(f"{1e3 * t.p99:.1f}" for t in latency if t.p99),
            ]
        )
    heads = [
        f"`{timings[0].subject}`, {timings[0].setting}", "images/s", *peers,
        "share of the roofline", "p50 (ms)", "p99 (ms)",
    ]  # fmt: skip
    return markdown(heads, rows)


def quantized_table(timings: Sequence[Timing]) -> str:
    """The times in other types over that with 8 bits: a row for each batch size."""
    peers = (OURS_FLOAT32, COMPILED, COMPILED_BFLOAT16)
    rows = [
        [f"batch {batch}", *(ratios(found.get(peer, ()), 2) for peer in peers)]
        for (_, batch, mode), found in by_case(timings).items()
        if mode == "inference, int8"
    ]
    return markdown(["over 8 bits", *peers], rows)


def paced_table(timings: Iterable[Timing]) -> str:
    """Frames at the pace of a camera: a row for each case and number of threads, a column for each
    candidate with p50, p99 and CPU time in ms."""
    return pivot("p50 / p99 / CPU time, ms", (_paced_cell(t) for t in timings if t.paced))


def _paced_cell(t: Timing) -> tuple[str, str, str]:
    assert t.p99 is not None and t.cpu is not None
    what = t.mode.partition(", ")[2]
    row = f"`{t.subject}`, {t.setting}, {what}, {threads_label(t.threads)}"
    times = (float(f"{1e3 * seconds:.3g}") for seconds in (t.median, t.p99, t.cpu))
    return row, t.name, " / ".join(f"{time:g}" for time in times)


def starts_table(starts: Iterable[Start]) -> str:
    """Seconds and memory of first answers: a row for each model, a column for each runtime."""
    return pivot(
        "first answer",
        (
            (f"`{x.subject}`", x.name, f"{x.seconds:.2f} s, {x.resident / 2**20:.0f} MB")
            for x in starts
        ),
    )


def memory_table(memory: Sequence[Memory]) -> str:
    """The peaks of resident memory, ours and the reference's."""
    found = compared(memory)
    rows = [[what, f"{a / 2**20:.0f}", f"{b / 2**20:.0f}", f"{a / b:.2f}"] for what, a, b in found]
    return markdown(["peak memory (MB)", OURS, REFERENCE, "ratio"], rows)


def steps_table(record: Record) -> str:
    """Training steps: our time, the others' times over it, and the peak memory of the batch itself
    over that with torch's products; a row for each model and batch."""
    peers = (BY_TORCH, REFERENCE, COMPILED)
    own = {(m.mode, m.batch, m.name): m.own for m in record.memory}
    rows = []
    for name in dict.fromkeys(t.subject for t in record.timings):
        for (_, batch, _), found in by_case(t for t in record.timings if t.subject == name).items():
            peaks = [own.get((name, batch, kind), 0) for kind in (OURS, BY_TORCH)]
            rows.append(
                [
                    f"`{name}`, batch {batch}",
                    milliseconds(found[OURS], 0),
                    *(ratios(found.get(peer, ()), 2) for peer in peers),
                    BOTH.join(f"{1 / t.ratio:.1f}" for t in found[FORWARD]),
                    f"{peaks[0] / peaks[1]:.2f}" if all(peaks) else "",
                ]
            )
    heads = ["step", "ours (ms)", *peers, "over optimized forwards", "memory"]
    return markdown(heads, rows)


def gpu_text(records: Sequence[dict]) -> str:
    """Sentences and a table on each record of `benchmarks/gpu.py`, or a sentence if none exists."""
    return "\n\n".join(map(_gpu_text, records)) or "No one has tried DarSwin itself on a GPU yet."


def _gpu_text(record: dict) -> str:
    head, states = record["machine"], [check["state"] for check in record["checks"]]
    passed, failed = states.count("passed"), states.count("FAILED")
    digits = (
        f"{name}, {min(rates.values()):.1f} to {max(rates.values()):.1f} %"
        for name, rates in record["accuracy"].items()
    )
    lines = [
        f"On one device ({head['device']}, torch {head['torch'].split('+')[0]}), {passed} checks "
        f"passed, {failed} failed and {len(states) - passed - failed} were left out.",
        *(f"Failed: {c['part']}, {c['name']}." for c in record["checks"] if c["state"] == "FAILED"),
    ]
    if record["accuracy"]:
        lines.append(f"Accuracy of the demo's networks, trained there: {'; '.join(digits)}.")
    peaks = {(m["mode"], m["batch"], m["name"]): m["peak"] for m in record["memory"]}
    cells = []
    for t in (Timing(**row) for row in record["timings"]):
        peak = peaks.get((f"{t.mode}, {t.setting}", t.batch, t.name))
        memory = "" if peak is None else f", {peak / 2**20:.0f} MB"
        row = f"`{t.subject}`, {t.setting}, batch {t.batch}, {t.mode}"
        cells.append((row, t.name, f"{t.batch / t.median:.0f}{memory}"))
    table = ["", pivot("images/s, peak memory", cells)] if cells else []
    return "\n".join([*lines, *table])


def roofline_lines(record: Record) -> list[str]:
    """Operations per second of the matrix products alone, and of the whole model."""
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
