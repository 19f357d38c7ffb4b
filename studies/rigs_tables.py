"""The tables of the study of rigs, made from its record."""

from collections.abc import Sequence
from pathlib import Path

from records import machine, markdown, write

NOT_RUN = "Not run yet: `make study-rigs`."
PARTS = ("all", "rim", "seams")
RIGHT = "right"
# The targets, set in advance; of the faces, those of 1024² with one ray a pixel.
SIDE, RIM, DIRECT, SEAM = 1024, 12.0, 3.0, 1.0  # px, dB, dB, dB
LABELS, PHANTOMS, MEAN, MOST = 0.999, 1e-4, 1e-4, 2e-3
APART, REPAIRED, RATIO, SPEED = 1.0, 0.1, 2.0, 4.0  # of 255, dB, times, times


def publish(record: dict, folder: Path) -> None:
    """Writes a record, with the machine and versions."""
    write(folder / "rigs.json", machine=machine(), **record)


def _parts(scores: dict) -> str:
    return " / ".join(f"{scores[part]:.1f}" for part in PARTS)


def _faces(row: dict) -> str:
    rays = f"{row['engine']} × {row['engine']}" if row["engine"] > 1 else "1"
    return f"{row['side']}², {rays}"


def colours(record: dict) -> str:
    """A row for the faces of each size and the rays of their pixels."""
    rows = [
        [_faces(row), *(_parts(row[way]) for way in ("nearest", "bilinear", "ours")),
         f"{row['reads']:.0f}"]
        for row in record["faces"]["rows"]
    ]  # fmt: skip
    header = ["faces, their rays a pixel", "nearest", "bilinear", "darswin", "reads a pixel"]
    return markdown(header, rows)


def direct(record: dict) -> str:
    """A column for each number of rays."""
    found = record["faces"]["direct"]
    header = ["rays a pixel", *(f"{k} × {k}" if k != "1" else k for k in found)]
    return markdown(header, [["direct rendering", *map(_parts, found.values())]])


def _with_labels(record: dict) -> list[dict]:
    return [row for row in record["faces"]["rows"] if "labels" in row]


def labels(record: dict) -> str:
    """A row for the faces of each size."""
    rows = []
    for row in _with_labels(record):
        of = row["labels"]
        shares = (f"{100 * of[part]:.2f}" for part in ("all", "plain"))
        rows.append([f"{row['side']}²", *shares, str(of["invented"])])
    header = ["faces", "all (%)", "farther than 1 px from an edge (%)", "labels from nowhere"]
    return markdown(header, rows)


def _distances(of: dict) -> list[str]:
    return [f"{1e4 * of['phantoms']:.1f}", f"{1e4 * of['mean']:.2f}", f"{1e4 * of['most']:.1f}"]


def distances(record: dict) -> str:
    """Two rows for the faces of each size."""
    rows = []
    for row in _with_labels(record):
        for name, way in (("darswin", "distances"), ("bilinear", "bilinear_distances")):
            rows.append([f"{row['side']}², {name}", *_distances(row[way])])
    return markdown(["faces", "phantoms", "mean error off edges", "99.9 % of errors below"], rows)


def two(record: dict) -> str:
    """A row a case."""
    rows = [
        [name, *(f"{of['all']:.1f} / {of['seam']:.1f}" for of in case["seams"].values()),
         f"{case['apart']:.1f}" if "apart" in case else "–", f"{case['disagreement']:.1f}"]
        for name, case in record["two"]["cases"].items()
    ]  # fmt: skip
    header = ["", "hard", "narrow", "wide", "difference at the seam", "in the overlap"]
    return markdown(header, rows)


def car(record: dict) -> str:
    """A row a rig."""
    rows = [
        [name, f"{case['psnr']:.1f}", f"{case['median'] + 0:.1f}", f"{case['most'] + 0:.1f}",
         *(f"{case[kind]:.1f}" for kind in ("disagreement", "middle", "bare", "ratio"))]
        for name, case in record["car"]["cases"].items()
    ]  # fmt: skip
    header = ["rig", "PSNR (dB)", "shift, median (cm)", "95 % (cm)", "difference, mean"]
    return markdown([*header, "median", "bare ground", "worst pair"], rows)


def seams(record: dict) -> str:
    """A column a seam."""
    of = record["car"]
    rows = [
        ["PSNR (dB)", *(f"{value:.1f}" for value in of["seams"].values())],
        ["reads a pixel", *(f"{value:.2f}" for value in of["reads"].values())],
    ]
    return markdown(["seam", *of["seams"]], rows)


def _times(of: dict, kind: str) -> str:
    return " / ".join(f"{1e3 * times[kind]:.1f}" for times in of["times"].values())


def _total(of: dict, threads: str) -> float:
    return of["times"][threads]["all"]


def speed(record: dict) -> str:
    """A row a way; "a / b" is at one and at two threads."""
    ways, rows = record["speed"]["ways"], []
    for name, of in ways.items():
        total = " / ".join(f"{_total(of, t):.2f}" for t in of["times"])
        over = " / ".join(f"{_total(of, t) / _total(ways['darswin'], t):.1f}" for t in of["times"])
        kinds = (_times(of, kind) for kind in ("colour", "label", "distance"))
        rows.append([name, *kinds, total, over])
    header = ["", "colour (ms)", "labels (ms)", "distances (ms)", "30 frames (s)", "× darswin's"]
    return markdown(header, rows)


def worth(record: dict) -> str:
    """A row a way: what its pictures are worth, and the time of its first ones."""
    rows = [
        [name, f"{of['psnr']:.1f}", f"{100 * of['labels']['all']:.2f}",
         *_distances(of["distances"])[:2], f"{of['first']:.1f}"]
        for name, of in record["speed"]["ways"].items()
    ]  # fmt: skip
    header = ["", "PSNR (dB)", "labels (%)", "phantoms", "mean error", "the first frame (s)"]
    return markdown(header, rows)


def targets(record: dict) -> str:
    """The targets, what was reached, and whether that is enough."""
    faces, two, car = record["faces"], record["two"], record["car"]
    row = next(row for row in faces["rows"] if (row["side"], row["engine"]) == (SIDE, 1))
    best = next(of for of in _with_labels(record) if of["side"] == SIDE)
    ours, of_4 = row["ours"], faces["direct"]["4"]
    found, cases = best["distances"], two["cases"]
    plain, repaired = cases["one centre"], cases["a gain of 0.9, `gain=True`"]
    lost = max(of["all"] - repaired["seams"][seam]["all"] for seam, of in plain["seams"].items())
    wrong = {name: of["ratio"] for name, of in car["cases"].items() if name != RIGHT}
    wrong = {name: ratio for name, ratio in wrong.items() if "0.5°" not in name}
    loops = {
        name: _total(of, "1") / _total(record["speed"]["ways"]["darswin"], "1")
        for name, of in record["speed"]["ways"].items() if "2 × 2" in name
    }  # fmt: skip
    rows: Sequence[tuple[str, str, str, bool]] = [
        ("rim over a bilinear read", f"≥ {RIM:.0f} dB",
         f"{ours['rim'] - row['bilinear']['rim']:.1f} dB",
         ours["rim"] - row["bilinear"]["rim"] >= RIM),
        ("rim under direct rendering with 4 × 4 rays", f"≤ {DIRECT:.0f} dB",
         f"{round(of_4['rim'] - ours['rim'], 1) + 0:.1f} dB", of_4["rim"] - ours["rim"] <= DIRECT),
        ("seams under the whole picture", f"≤ {SEAM:.0f} dB",
         f"{ours['all'] - ours['seams']:.1f} dB", ours["all"] - ours["seams"] <= SEAM),
        ("labels farther than 1 px from an edge", "100 %",
         f"{100 * best['labels']['plain']:.2f} %", best["labels"]["plain"] == 1),
        ("all labels", f"≥ {100 * LABELS:.1f} %", f"{100 * best['labels']['all']:.2f} %",
         best["labels"]["all"] >= LABELS),
        ("phantom distances", f"≤ {PHANTOMS:.0e}", f"{found['phantoms']:.0e}",
         found["phantoms"] <= PHANTOMS),
        ("errors of distances off edges, mean", f"≤ {MEAN:.0e}", f"{found['mean']:.0e}",
         found["mean"] <= MEAN),
        ("the same, 99.9 %", f"≤ {MOST:.0e}", f"{found['most']:.0e}", found["most"] <= MOST),
        ("two lenses: difference at the seam", f"≤ {APART:.0f} of 255", f"{plain['apart']:.1f}",
         plain["apart"] <= APART),
        ("two lenses: what a gain of 0.9 costs with `gain=True`", f"≤ {REPAIRED} dB",
         f"{lost + 0:.2f} dB", lost <= REPAIRED),
        *((f"car: {name}, difference of the worst pair", f"≥ {RATIO:.0f} × the right rig's",
           f"{ratio:.1f} ×", ratio >= RATIO) for name, ratio in wrong.items()),
        *((f"30 frames, one thread, against {name}", f"≥ {SPEED:.0f} ×", f"{ratio:.1f} ×",
           ratio >= SPEED) for name, ratio in loops.items()),
    ]  # fmt: skip
    body = [[what, goal, reached, "yes" if met else "**no**"] for what, goal, reached, met in rows]
    return markdown(["", "target", "reached", "met"], body)


TABLES = {
    "targets": targets, "colours": colours, "direct": direct, "labels": labels,
    "distances": distances, "two": two, "car": car, "seams": seams, "speed": speed, "worth": worth,
}  # fmt: skip


def tables(record: dict | None) -> dict[str, str]:
    """All tables, by the name of their place in the page."""
    return {f"rigs {name}": make(record) if record else NOT_RUN for name, make in TABLES.items()}
