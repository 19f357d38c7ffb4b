from pathlib import Path

import peers
import pytest
from figures import on_a_phone
from kit import plot
from kit.record import Record

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


@pytest.mark.slow
@pytest.mark.parametrize("picture", sorted(RESULTS.glob("*.png")), ids=lambda path: path.stem)
def test_the_pictures_of_the_records_can_be_read(picture, monkeypatch):
    """The text is large enough, the page is not endless, and the text lies inside."""
    record, figures = Record.load(picture.with_suffix(".json")), []
    monkeypatch.setattr("darswin.viz.plot.save_figure", lambda figure, _: figures.append(figure))
    (plot.draw_models if picture.stem.startswith("model") else peers.draw_peers)(record, picture)
    (figure,) = figures
    assert on_a_phone(figure) >= 9
    width, height = figure.get_size_inches()
    assert height <= 2.5 * width
    names = [name for axes in figure.axes for name in (axes.title, *axes.get_yticklabels())]
    for part in [*names, *figure.legends]:
        box = part.get_window_extent()
        assert box.x0 >= -2 and box.x1 <= figure.bbox.width + 2, part


def test_panels_beside_each_other_have_the_same_rows():
    same, other = {"a": {}, "b": {}}, {"a": {}}
    lines = plot.in_lines({"1": same, "2": other, "3": other, "4": other, "5": same, "6": same})
    assert [[title for title, _ in line] for line in lines] == [
        ["1"],
        ["2", "3"],
        ["4"],
        ["5", "6"],
    ]
