import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from darswin import polar_grid
from darswin.lens import Spherical
from darswin.plot import draw_accuracy, draw_grid


def test_draw_grid_shows_borders_and_samples():
    grid = polar_grid(Spherical.from_fov(0.4, 2.6, 16.0), (32, 32), rings=4, sectors=8,
                      samples=(3, 2))  # fmt: skip
    figure, axes = plt.subplots()
    draw_grid(axes, np.zeros((32, 32)), grid, sectors=8)
    rings, sectors, points = axes.lines[:5], axes.lines[5:13], axes.lines[13]
    assert len(axes.lines) == 14
    radii = [np.hypot(*(np.array(line.get_data()) - 15.5)).max() for line in rings]
    np.testing.assert_allclose(radii, grid.borders[0].numpy(), atol=1e-4)
    assert len(sectors) == 8 and len(points.get_xdata()) == 4 * 3 * 8 * 2
    plt.close(figure)


def test_draw_accuracy_shows_each_model():
    figure, axes = plt.subplots()
    draw_accuracy(axes, [0.0, 0.5, 1.0], {"a": [1, 2, 3], "b": [3, 2, 1]}, (0.2, 0.35))
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["seen in training", "a", "b"]
    assert list(axes.lines[0].get_ydata()) == [1, 2, 3]
    plt.close(figure)
