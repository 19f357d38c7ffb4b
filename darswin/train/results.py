"""Writes the results of a test as tables, CSV, JSON and a figure."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only

from darswin.train.pixel_metrics import BY_AREA
from darswin.train.task import TaskModule
from darswin.utils.files import replace_file
from darswin.viz.plot import save_figure

Table = Sequence[dict[str, Any]]

_IN_PERCENT = (
    "top1",
    "top1_low",
    "most_frequent",
    "top5",
    "miou",
    "accuracy",
    "iou",
    "recall",
    "delta1",
    "delta2",
    "delta3",
    "unanswered",
)
# Scores that only the files have.
_NOT_SHOWN = ("pixels", "sq_rel", "rmse_log", "delta2", "delta3", "to_deg", "top1_high")
_NOT_SHOWN_BY_AREA = (*_NOT_SHOWN, "rmse", "silog", "recall")


_TITLES = {
    "from_deg": "zone",
    "top1_low": "95 % interval",
    "most_frequent": "most frequent class (%)",
}


class WriteResults(Callback):
    """Prints the scores after a test and writes them to a folder.

    `test.csv` has a row for each test set, `test_classes.csv` a row for each class, and
    `test_zones.csv` a row for each zone of θ. `test.json` has all scores, and `test.png` is a
    figure. Names that end in `_sr` mark scores weighted by solid angle. `n` is the number of
    pictures.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)

    @rank_zero_only
    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Prints the tables and writes the files."""
        assert isinstance(pl_module, TaskModule)
        names = []
        for name, table in tables(pl_module.results).items():
            replace_file(self.folder / name, _csv(table))
            print(f"\n{_text(table)}")
            names.append(name)
        if no_better := _no_better(pl_module.results):
            print(f"\n{no_better}")
        report = dict(model=pl_module.card.model, results=pl_module.results)
        content = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
        replace_file(self.folder / "test.json", content)
        names.append("test.json")
        figure = pl_module.results_figure()
        if figure is not None:
            save_figure(figure, self.folder / "test.png")
            names.append("test.png")
        print(f"\n{self.folder}/{', '.join(names[:-1])} and {names[-1]}")


def tables(rows: Table) -> dict[str, Table]:
    """The tables of a test by the names of their files: test sets, classes and zones."""
    nested = ("per_class", "per_zone")
    found: dict[str, Table] = {
        "test.csv": [{key: v for key, v in row.items() if key not in nested} for row in rows],
        "test_classes.csv": [
            {"data": row["data"], "class": name} | scores
            for row in rows
            for name, scores in row.get("per_class", {}).items()
        ],
        "test_zones.csv": [
            {"data": row["data"]} | zone for row in rows for zone in row.get("per_zone", ())
        ],
    }
    return {name: table for name, table in found.items() if table}


def _csv(rows: Table) -> str:
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, rows[0].keys())
    writer.writeheader()
    writer.writerows(rows)
    return table.getvalue()


def _text(rows: Table) -> str:
    """A readable table: columns of words are flush left, and shares are in percent."""
    hidden = {*_NOT_SHOWN, *(f"{key}{BY_AREA}" for key in _NOT_SHOWN_BY_AREA)}
    if not any(row.get("unanswered") for row in rows):
        hidden.add("unanswered")
    columns = []
    for key in rows[0]:
        if key not in hidden:
            cells = [_title(key), *(_cell(key, row) for row in rows)]
            words = key in ("lenses", "data", "class", "from_deg")
            width = max(map(len, cells))
            columns.append([c.ljust(width) if words else c.rjust(width) for c in cells])
    return "\n".join("  ".join(line).rstrip() for line in zip(*columns, strict=True))


def _no_better(rows: Table) -> str | None:
    """A sentence on the test sets whose interval does not exclude always giving one answer."""
    tested = [row for row in rows if row.get("n") and "most_frequent" in row]
    found = [row["lenses"] for row in tested if row["top1_low"] <= row["most_frequent"]]
    if not found:
        return None
    where = "any test set" if len(found) == len(rows) else ", ".join(found)
    return (
        f"On {where}, the accuracy is not certainly above that of always answering the most "
        "frequent class."
    )


def _title(key: str) -> str:
    if key in _TITLES:
        return _TITLES[key]
    return f"{key} (%)" if key.removesuffix(BY_AREA) in _IN_PERCENT else key


def _cell(key: str, row: dict[str, Any]) -> str:
    value = row[key]
    if key == "from_deg":
        end = row["to_deg"]
        return f"≥ {value:g}°" if end is None else f"{value:g}–{end:g}°"
    if value is None:
        return "–"
    if key == "top1_low":
        return f"{100 * value:.1f}–{100 * row['top1_high']:.1f}"
    if not isinstance(value, float):
        return str(value)
    return f"{100 * value:.2f}" if key.removesuffix(BY_AREA) in _IN_PERCENT else f"{value:.4g}"
