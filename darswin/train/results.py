"""What a test over lenses found, as a table, CSV, JSON and a picture."""

import csv
import io
import json
from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.utilities import rank_zero_only
from matplotlib.figure import Figure

from darswin.data.lens_distributions import LensDistribution, SphericalLenses, parse_lenses
from darswin.train.classification import Classification
from darswin.utils.files import replace_file
from darswin.viz.plot import draw_accuracy, save_figure


class WriteResults(Callback):
    """After a test: prints the accuracy for each distribution of lenses, and writes it to a folder.

    Files: `test.csv` and `test.json` with lenses, top1, top5 and loss, and `test.png`.
    """

    def __init__(self, folder: Path):
        self.folder = Path(folder)

    @rank_zero_only
    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Prints the table and writes the files."""
        if not isinstance(pl_module, Classification):
            raise TypeError(f"results are of Classification, got {type(pl_module).__name__}")
        rows = pl_module.results
        width = max(16, *(len(row["lenses"]) + 2 for row in rows))
        print(f"\n{'lenses':<{width}}{'top-1 (%)':>10}{'top-5 (%)':>10}{'loss':>10}")
        for row in rows:
            loss = "–" if row["loss"] is None else f"{row['loss']:.4f}"
            print(
                f"{row['lenses']:<{width}}{100 * row['top1']:>10.2f}{100 * row['top5']:>10.2f}"
                f"{loss:>10}"
            )
        warped = pl_module.trained.fit == "whole"
        trained_on = pl_module.data.train_lenses if warped else None
        write_results(self.folder, rows, pl_module.card.model, trained_on)
        print(f"\n{self.folder}/test.csv, test.json and test.png")


def write_results(
    folder: Path, rows: list[dict], name: str, trained_on: LensDistribution | None
) -> None:
    """The rows of a test as files; `trained_on` is the distribution that the picture shades, None
    where the lenses are those of cameras."""
    report = dict(model=name, results=rows)
    replace_file(
        folder / "test.json", json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    )
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, rows[0].keys())
    writer.writeheader()
    writer.writerows(rows)
    replace_file(folder / "test.csv", table.getvalue())
    save_figure(draw_results(rows, name, trained_on), folder / "test.png")


def draw_results(rows: list[dict], name: str, trained_on: LensDistribution | None) -> Figure:
    """A figure: accuracy against ξ where every distribution is one ξ, else bars."""
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    accuracy = [100 * row["top1"] for row in rows]
    lenses = [_distribution(row["lenses"]) for row in rows]
    of_one_xi = [
        lens for lens in lenses if isinstance(lens, SphericalLenses) and lens.low == lens.high
    ]
    if len(of_one_xi) == len(rows):
        shaded = trained_on if isinstance(trained_on, SphericalLenses) else None
        band = None if shaded is None else (shaded.low, shaded.high)
        draw_accuracy([lens.low for lens in of_one_xi], {name: accuracy}, band, axes=axes)
        axes.set_ylim(0, 100)
    else:
        axes.bar([row["lenses"] for row in rows], accuracy, label=name)
        axes.set(ylabel="accuracy (%)", ylim=(0, 100))
        axes.tick_params(axis="x", rotation=90)
        axes.legend()
    return figure


def _distribution(name: str) -> LensDistribution | None:
    """The distribution of a row; None where it is a camera's calibration."""
    try:
        return parse_lenses(name)
    except ValueError:
        return None
