from pathlib import Path

import peers
import pytest
from matplotlib.text import Text

from darswin.bench import plot
from darswin.bench.record import Record

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


@pytest.fixture
def drawn(monkeypatch):
    """What is drawn: by the panels' titles, the dots of each row by name."""
    figures = []
    monkeypatch.setattr("darswin.viz.plot.save_figure", lambda figure, path: figures.append(figure))

    def read():
        panels = {}
        for axes in figures[-1].axes:
            dots = {
                line.get_label(): dict(zip(line.get_ydata(), line.get_xdata(), strict=True))
                for line in axes.lines
                if not line.get_label().startswith("_")
            }
            if dots:
                panels[axes.get_title()] = dots
        return panels

    return read


def test_models(record, drawn, tmp_path):
    plot.draw_models(record, tmp_path / "models.png")
    panels = drawn()
    assert list(panels) == ["inference, float32", "training, float32"]
    dots = panels["inference, float32"]
    assert dots["darswin"] == pytest.approx({0: 80, 1: 50})
    assert dots["matrix products alone"] == pytest.approx({0: 8 / 0.09})
    assert panels["training, float32"] == {"darswin": pytest.approx({0: 8 / 0.3})}


def test_peers(operators, drawn, tmp_path):
    peers.draw_peers(Record({}, operators), tmp_path / "peers.png")
    assert drawn() == {
        "polar_sample\nforward": {"slow": {0: 5.0}, "fast": {0: 1.5}},
        "another\nforward": {"peer": {0: 1.0}},
    }


@pytest.mark.parametrize("suite", ["attention", "model"])
def test_the_pictures_of_the_records_can_be_read(suite, tmp_path, monkeypatch):
    """At the width of a page, 740 px, text is at least 8 pt high, the page is not endless, and the
    legend lies inside."""
    record = Record.load(next(RESULTS.glob(f"{suite}--*-avx512.json")))
    figures = []
    monkeypatch.setattr("darswin.viz.plot.save_figure", lambda figure, path: figures.append(figure))
    (plot.draw_models if suite == "model" else peers.draw_peers)(record, tmp_path / "a.png")
    (figure,) = figures
    width, height = figure.get_size_inches() * 120
    assert height <= 1200
    figure.draw_without_rendering()
    legend = figure.legends[0].get_window_extent()
    assert legend.x0 >= 0 and legend.x1 <= figure.bbox.width
    texts = [text for text in figure.findobj(Text) if text.get_text()]
    assert min(text.get_fontsize() for text in texts) * 120 / 72 * 740 / width * 72 / 96 >= 8
