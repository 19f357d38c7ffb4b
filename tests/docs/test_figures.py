"""The text of all figures on README and the pages can be read on a phone."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from figures import on_a_phone
from helpers import slow_but
from matplotlib.figure import Figure
from PIL import Image
from rigs import rig, true_lens

from darswin import PolarView, create_model
from darswin.calibrate import calibrate
from darswin.lens import Equidistant
from darswin.views import make_view
from darswin.viz import plot
from darswin.viz.calibration import draw_calibration
from darswin.viz.pixels import draw_predictions

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / part) for part in ("docs", "examples", "studies")]

import dense_pictures  # noqa: E402
import dense_tables  # noqa: E402
import digits  # noqa: E402
import fill  # noqa: E402
import learned_tables  # noqa: E402
import lens  # noqa: E402
import levels  # noqa: E402
import pretrained_tables  # noqa: E402
import rig_axes  # noqa: E402
import sizes_tables  # noqa: E402
import tables  # noqa: E402
import views  # noqa: E402

SHOWN = sorted(
    {
        (page.parent / name).resolve()
        for page in fill.PAGES
        for name in re.findall(r"!\[[^]]*\]\(([^)]+\.png)\)", page.read_text())
    }
)
PICTURE, LABELS = np.zeros((96, 128, 3), np.uint8), np.zeros((96, 128), np.int64)
METRES = np.geomspace(0.5, 40, LABELS.size).reshape(LABELS.shape)
WIDE = Equidistant(40.0, theta_max=1.6, image_size=LABELS.shape)
STUDIED = ("DarSwin-Unet RA", "Swin-Unet", "LensAdapter(Swin-Unet)", "U-Net with rays")


def record(path: str) -> dict:
    return json.loads((ROOT / path).read_text())


def draw_lens() -> Figure:
    sampler = PolarView(rings=16, sectors=64, samples=(10, 10))
    return plot.draw_lens(
        PICTURE, WIDE, sampler, make_view("perspective", (60, 80), fov=1.9), "a view"
    )


def draw_calibrated() -> Figure:
    made = rig(true_lens("KannalaBrandt", 190, LABELS.shape), 8, noise=0.05)
    found = calibrate(made.corners, made.board, made.size)
    return draw_calibration(found, found.lens, lambda name: PICTURE)


def draw_demo() -> Figure:
    sampler = create_model("darswin_a_nano", spacing="tan").view
    accuracy = record("docs/accuracy.json")["accuracy"]
    return digits.draw(accuracy, np.zeros((8, 8), np.float32), sampler)


def draw_dense_curves(path: Path) -> None:
    found = record("studies/results/dense.json")
    dense_tables.draw_curves(found["cells"], found["trivial"], path)


def draw_dense_pictures(path: Path) -> None:
    rows = ["picture", "truth", *STUDIED]
    dense_pictures.draw_columns({n: [PICTURE] * 6 for n in dense_pictures.SHOWN}, rows, path)


def draw_detections(path: Path) -> None:
    box, one, zero = np.array([[300.0, 300, 700, 700]]), np.ones(1), np.zeros(1, int)
    found = pretrained_tables.Found(box, one, labels=zero, visible=one, cut=zero, view=zero)
    pretrained_tables.draw_found([(PICTURE, [found] * 3)] * 2, path)


# Each returns a figure, or writes one to a path.
FIGURES: dict[str, Callable[[Path], Figure | None]] = {
    "calibration": lambda path: draw_calibrated(),
    "demo": lambda path: draw_demo(),
    "dense curves": draw_dense_curves,
    "dense pictures": draw_dense_pictures,
    "labels": lambda path: draw_predictions(
        [(PICTURE, LABELS, LABELS)], [f"class {k}" for k in "abcdef"]
    ),
    "learned lens": lambda path: learned_tables.draw(
        record("studies/results/learned_lens.json")["cameras"], path
    ),
    "lens": lambda path: draw_lens(),
    "levels": lambda path: levels.draw_levels(),
    "metres": lambda path: draw_predictions([(PICTURE, METRES, METRES)]),
    "polar": lambda path: lens.draw_polar_image(PICTURE, WIDE),
    "pretrained": lambda path: pretrained_tables.draw_scores(
        record("studies/results/pretrained.json")["tables"]["CenterNet, level"]["methods"], path
    ),
    "pretrained found": draw_detections,
    "rig axes": lambda path: rig_axes.draw_rigs(),
    "sizes": lambda path: sizes_tables.draw_scores(
        record("studies/results/sizes.json")["cells"], path
    ),
    "sizes pictures": sizes_tables.draw_pictures,
    "study": lambda path: tables.draw(record("studies/results/study--nano.json")["cells"], path),
    "views": lambda path: views.draw_views(),
}


@pytest.mark.parametrize("name", slow_but(FIGURES, "labels", "metres", "polar"))
def test_the_text_of_a_figure_is_large_enough(name, monkeypatch, tmp_path):
    written = []
    for module in (
        dense_pictures, dense_tables, learned_tables, pretrained_tables, sizes_tables, tables,
    ):  # fmt: skip
        monkeypatch.setattr(module, "save_figure", lambda figure, *_, **__: written.append(figure))
    figure = FIGURES[name](tmp_path / "figure.png") or written[0]
    assert on_a_phone(figure) >= 9


def test_the_figures_of_the_pages_have_the_width_that_their_text_is_made_for():
    """Text of `plot.TEXT` pt is 9 px high on a phone in figures of this width."""
    assert len(SHOWN) > 12 and {"accuracy", "lens", "levels", "polar"} <= {p.stem for p in SHOWN}
    for picture in SHOWN:
        with Image.open(picture) as drawn:
            assert drawn.width / drawn.info["dpi"][0] <= plot.WIDTH + 0.01, picture
