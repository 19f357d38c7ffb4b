"""Fills the README's tables from the results of the benchmarks and of the study: `make readme`.

In a benchmark's table "a / b" is at one and at two threads, and a ratio is the time of what one
would write without the operator, over ours.
"""

import json
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "studies")]

from darswin.bench import report  # noqa: E402

README = ROOT / "README.md"
RESULTS = ROOT / "benchmarks" / "results"

SAMPLING_PEERS = ("F.grid_sample", "F.grid_sample + permute", "cv2.remap")
EMBED_PEERS = ("F.grid_sample + permute + F.linear", "F.linear alone")


def load(name: str) -> list[dict]:
    return json.loads((RESULTS / name).read_text())["results"]


def both(rows: list[dict], value) -> str:
    """The value of each number of threads, "a / b"; empty where there is none."""
    found = [value(row) for row in sorted(rows, key=lambda row: row["threads"])]
    return " / ".join(found)


def ratio(row: dict) -> str:
    return f"{row['ratio']:.1f}×"


def milliseconds(row: dict) -> str:
    return f"{1e3 * row['median']:.2f}"


def peers_table(results: list[dict], operator: str, peers: tuple[str, ...]) -> str:
    """A row a case and mode, a column a peer."""
    rows = [r for r in results if r["operator"] == operator]
    lines = [f"| `{operator}` | ours (ms) | {' | '.join(peers)} |", "|---" * (len(peers) + 2) + "|"]
    for case, mode in dict.fromkeys((r["case"], r["mode"]) for r in rows):
        found = {}
        for row in rows:
            if (row["case"], row["mode"]) == (case, mode):
                found.setdefault(row["name"], []).append(row)
        if not any(peer in found for peer in peers):
            continue
        cells = [both(found.get(peer, []), ratio) for peer in peers]
        ours = both(found["darswin"], milliseconds)
        lines.append(f"| {case}, {mode} | {ours} | {' | '.join(cells)} |")
    return "\n".join(lines)


def drop_in_line(results: list[dict]) -> str:
    """How much faster the README's own call is than what it replaces."""
    found = [
        row
        for row in results
        if (row["operator"], row["mode"]) == ("polar_sample", "forward, layout image")
        and row["name"] == "F.grid_sample"
    ]
    cases = ", ".join(dict.fromkeys(row["case"] for row in found))
    low, high = (end(row["ratio"] for row in found) for end in (min, max))
    return f"{low:.1f} to {high:.1f} times as fast as `F.grid_sample`, this very call ({cases})."


def missed_table(*records: list[dict]) -> str:
    """Ratios that are below the bar that was set for them."""
    lines = ["| | ratio | bar |", "|---|---|---|"]
    for row in (row for results in records for row in results):
        if row["bar"] is not None and row["ratio"] < row["bar"]:
            threads = "1 thread" if row["threads"] == 1 else f"{row['threads']} threads"
            what = f"{row['operator']}, {row['case']}, {row['mode']}, {threads}: {row['name']}"
            lines.append(f"| {what} | {row['ratio']:.2f} | {row['bar']:.2f} |")
    return "\n".join(lines)


def demo_table(record: dict) -> str:
    """A row a model, a column a lens."""
    lines = [
        f"| ξ | {' | '.join(f'{xi:.1f}' for xi in record['xi'])} |",
        "|---" * (len(record["xi"]) + 1) + "|",
    ]
    for name, accuracy in record["accuracy"].items():
        lines.append(f"| {name} | {' | '.join(f'{value:.1f}' for value in accuracy)} |")
    return "\n".join(lines)


def attention_table(results: list[dict]) -> str:
    """A row a case; for each mode the best of all peers, and eager."""
    modes = {
        "forward": ("window_attention", "forward"),
        "forward+backward": ("window_attention", "forward+backward"),
        "forward+backward, bfloat16": ("window_attention, bfloat16", "forward+backward"),
    }
    head = " | ".join(f"{mode}: best peer | eager" for mode in modes)
    lines = [f"| `window_attention` | ours, forward (ms) | {head} |", "|---" * 8 + "|"]
    for case in dict.fromkeys(r["case"] for r in results):
        cells, times = [], ""
        for operator, mode in modes.values():
            rows = [
                r
                for r in results
                if (r["operator"], r["case"], r["mode"]) == (operator, case, mode)
            ]
            best = {}  # the fastest peer, by threads
            for row in sorted(rows, key=lambda r: -r["ratio"]):
                if "darswin" not in row["name"]:
                    best[row["threads"]] = row
            eager = [r for r in rows if r["name"] == "eager"]
            cells += [both(list(best.values()), ratio), both(eager, ratio)]
            times = times or both([r for r in rows if r["name"] == "darswin"], milliseconds)
        lines.append(f"| {case} | {times} | {' | '.join(cells)} |")
    return "\n".join(lines)


def training_table(report: dict) -> str:
    """A row a model: images a second in training and testing, and over the reference operators."""
    lines = [
        "| model | training (images/s) | over the reference | outside the model "
        "| testing (images/s) | over the reference |",
        "|---" * 6 + "|",
    ]
    for name, modes in report["models"].items():
        cells = []
        for mode in ("train", "test"):
            ours, theirs = (modes[mode][k] for k in ("darswin", "reference"))
            cells += [
                f"{ours['images_per_second']:.0f}",
                f"{ours['images_per_second'] / theirs['images_per_second']:.2f}×",
            ]
            if mode == "train":
                cells.append(f"{ours['outside']:.1%}")
        lines.append(f"| `{name}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def tables() -> dict[str, str]:
    """All tables, by the name of their place in the README."""
    import learned_tables
    import tables as study

    studies = ROOT / "studies" / "results"
    sampling, attention = load("sampling--avx512.json"), load("attention--avx512.json")
    training = json.loads((RESULTS / "training--micro.json").read_text())
    cells = json.loads((studies / "study--nano.json").read_text())["cells"]
    cameras = json.loads((studies / "learned_lens.json").read_text())["cameras"]
    model = report.Record.load(RESULTS / "model--avx512.json")
    return {
        "demo": demo_table(json.loads((ROOT / "docs" / "accuracy.json").read_text())),
        "drop-in": drop_in_line(sampling),
        "missed": missed_table(sampling, attention),
        "model": report.table(model),
        "model memory": report.memory_table(model),
        "sampling": peers_table(sampling, "polar_sample", SAMPLING_PEERS),
        "embedding": peers_table(sampling, "polar_embed", EMBED_PEERS),
        "attention": attention_table(attention),
        "training": training_table(training),
        **study.tables(cells),
        **learned_tables.tables(cameras),
    }


def placed(name: str, table: str) -> str:
    """A table between the marks of its place."""
    return f"<!-- table: {name} -->\n{table}\n<!-- end: {name} -->"


def main() -> None:
    text = README.read_text()
    for name, table in tables().items():
        before, rest = text.split(f"<!-- table: {name} -->")
        text = before + placed(name, table) + rest.split(f"<!-- end: {name} -->")[1]
    README.write_text(text)


if __name__ == "__main__":
    main()
