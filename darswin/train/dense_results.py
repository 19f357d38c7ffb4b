"""What a test of predictions for each pixel found, as tables, CSV, JSON and a picture."""

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only

from darswin.train.dense import DenseTask
from darswin.train.pixel_metrics import BY_AREA
from darswin.utils.files import replace_file
from darswin.viz.dense import draw_predictions
from darswin.viz.plot import save_figure

_IN_PERCENT = ("miou", "accuracy", "iou", "recall", "delta1", "delta2", "delta3")
# They are in the files.
_NOT_SHOWN = ("pixels", "sq_rel", "rmse_log", "delta2", "delta3")
_NOT_SHOWN_BY_AREA = (*_NOT_SHOWN, "rmse", "silog", "recall")


class WriteDenseResults(Callback):
    """After a test: prints the scores of each set, class and zone, and writes them to a folder.

    Files: `test.csv` with a row for each set, `test_classes.csv` for each class of it,
    `test_zones.csv` for each zone of θ, `test.json` with all of it, and `test.png` with some of the
    pictures. Names that end in `_sr` are of scores weighted by solid angle.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)

    @rank_zero_only
    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Prints the tables and writes the files."""
        if not isinstance(pl_module, DenseTask):
            raise TypeError(f"results are of a dense task, got {type(pl_module).__name__}")
        names = write_dense_results(self.folder, pl_module.results, pl_module.card.model)
        if pl_module.samples:
            rows = [
                (sample.image, sample.target, sample.prediction) for sample in pl_module.samples
            ]
            card = pl_module.card
            save_figure(draw_predictions(rows, card.classes, card.colors), self.folder / "test.png")
            names.append("test.png")
        print(f"\n{self.folder}/{', '.join(names[:-1])} and {names[-1]}")


def write_dense_results(folder: Path, rows: Sequence[dict[str, Any]], name: str) -> list[str]:
    """The rows of a test as files and on stdout; gives the files' names."""
    nested = ("per_class", "per_zone")
    overall = [{key: v for key, v in row.items() if key not in nested} for row in rows]
    classes = [
        {"data": row["data"], "class": key} | scores
        for row in rows
        for key, scores in row["per_class"].items()
    ]
    zones = [{"data": row["data"]} | zone for row in rows for zone in row["per_zone"]]
    tables = {"test.csv": overall, "test_classes.csv": classes, "test_zones.csv": zones}
    written = []
    for file, table in tables.items():
        if table:
            replace_file(folder / file, _csv(table))
            print(f"\n{_text(table)}")
            written.append(file)
    report = dict(model=name, results=list(rows))
    replace_file(
        folder / "test.json", json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    )
    return [*written, "test.json"]


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, rows[0].keys())
    writer.writeheader()
    writer.writerows(rows)
    return table.getvalue()


def _text(rows: Sequence[dict[str, Any]]) -> str:
    """Rows as people read them: shares in percent, zones as a range, what is not known as –."""
    zoned = "from_deg" in rows[0]
    hidden = {*_NOT_SHOWN, *(f"{key}{BY_AREA}" for key in _NOT_SHOWN_BY_AREA)}
    shown = [key for key in rows[0] if key not in hidden | {"from_deg", "to_deg"}]
    lines = [[_title(key) for key in shown]] + [
        [_cell(key, row[key]) for key in shown] for row in rows
    ]
    if zoned:
        for line, zone in zip(lines, ["zone", *map(_zone, rows)], strict=True):
            line.insert(1, zone)
    words = sum(not isinstance(value, float | int) for value in rows[0].values()) or 1
    return "\n".join(_aligned(lines, max(words, 2 if zoned else 1)))


def _title(key: str) -> str:
    bare = key.removesuffix(BY_AREA)
    return f"{key} (%)" if bare in _IN_PERCENT else key


def _cell(key: str, value: Any) -> str:
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    return f"{100 * value:.2f}" if key.removesuffix(BY_AREA) in _IN_PERCENT else f"{value:.4g}"


def _zone(row: dict[str, Any]) -> str:
    if row["to_deg"] is None:
        return f"≥ {row['from_deg']:g}°"
    return f"{row['from_deg']:g}–{row['to_deg']:g}°"


def _aligned(lines: Sequence[Sequence[str]], words: int) -> Iterable[str]:
    """Lines in columns, the first `words` of them of text, flush left."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        cells = [
            cell.ljust(width) if k < words else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        yield "  ".join(cells).rstrip()
