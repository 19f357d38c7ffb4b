import pytest

from darswin.bench import plot
from darswin.bench.record import Record


@pytest.fixture
def drawn(monkeypatch):
    """What is drawn: the labels of the cases, and the lengths of the bars by name."""
    figures = []
    monkeypatch.setattr("darswin.viz.plot.save_figure", lambda figure, path: figures.append(figure))

    def read():
        (axes,) = figures[-1].axes
        cases = [label.get_text() for label in axes.get_yticklabels()]
        bars = {b.get_label(): [bar.get_width() for bar in b] for b in axes.containers}
        return cases, bars

    return read


def test_models(record, drawn, tmp_path):
    plot.draw_models(record, tmp_path / "models.png")
    cases, bars = drawn()
    assert cases[0] == "inference, float32, batch 8" and len(cases) == 3
    assert bars["darswin"] == pytest.approx([80, 50, 8 / 0.3])
    assert bars["matrix products alone"] == pytest.approx([8 / 0.09])


def test_peers(operators, drawn, tmp_path):
    plot.draw_peers(Record({}, operators), tmp_path / "peers.png")
    cases, bars = drawn()
    assert cases == [
        "polar_sample, 64×64, batch 8, forward",
        "another, 64×64, batch 8, forward",
    ]
    assert bars == {"slow": [5.0], "fast": [1.5], "peer": [1.0]}


def test_a_file(record, tmp_path):
    plot.draw_models(record, tmp_path / "models.png")
    assert (tmp_path / "models.png").read_bytes().startswith(b"\x89PNG")
