import cv2
import numpy as np
import pytest

from darswin.viz.pixels import (
    _RIGHT,
    _WRONG,
    UNKNOWN,
    distance_image,
    distance_range,
    draw_boxes,
    draw_predictions,
    label_image,
    overlay,
    palette,
)
from darswin.viz.plot import save_figure


def lab(colors, protanopia=None):
    """CIELAB, as those see it who have no red or no green cones (Viénot, Brettel, Mollon 1999)."""
    linear = (np.array(colors) / 255) ** 2.2
    if protanopia is not None:
        weights = ([0.11238, 0.88762], [0.29275, 0.70725])[not protanopia]
        yellow = linear[:, :2] @ weights
        blue = linear[:, 2] + (linear[:, 0] - linear[:, 1]) * (0.00401, -0.02234)[not protanopia]
        linear = np.stack((yellow, yellow, blue), -1).clip(0, 1)
    srgb = (linear ** (1 / 2.2)).astype(np.float32)
    return cv2.cvtColor(srgb[None], cv2.COLOR_RGB2LAB)[0]


@pytest.mark.parametrize("count", [0, 1, 10, 25, 255])
def test_a_palette_has_different_colours_and_longer_ones_begin_alike(count):
    colors = palette(count)
    assert len({tuple(color) for color in colors} | {UNKNOWN}) == count + 1
    assert colors == palette(255)[:count]
    assert all(0 <= value <= 255 for color in colors for value in color)


@pytest.mark.parametrize(("protanopia", "least"), [(None, 20), (True, 9), (False, 9)])
def test_classes_are_told_apart_by_all_eyes(protanopia, least):
    """By a model of colour blindness that is not the palette's own."""
    seen = lab([*palette(12), UNKNOWN], protanopia)
    apart = np.linalg.norm(seen[:, None] - seen, axis=-1)
    assert apart[~np.eye(len(seen), dtype=bool)].min() > least


@pytest.mark.parametrize("dtype", [np.uint8, np.int64])
def test_a_label_has_the_colour_of_its_id(dtype):
    colors = [[1, 2, 3], [250, 0, 7]]
    labels = np.array([[0, 1, 255], [2, 1, 0]], dtype)
    picture = label_image(labels, colors)
    assert picture.dtype == np.uint8
    expected = [[colors[0], colors[1], UNKNOWN], [UNKNOWN, colors[1], colors[0]]]
    assert np.array_equal(picture, expected)
    assert np.array_equal(label_image(np.array([[-1]]), colors), [[UNKNOWN]])
    assert np.array_equal(label_image(labels, []), np.full((2, 3, 3), 128))


def test_distances_get_darker_by_their_logarithm():
    distance = np.geomspace(1, 100, 9)[None]
    picture = distance_image(distance, 1, 100)
    bright = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)[0, :, 0].astype(float)
    steps = np.diff(bright)
    assert (steps < 0).all() and steps.std() < 0.15 * -steps.mean()  # equal factors look equal
    ends = distance_image(np.array([[0.1, 1, 100, 1e6]]), 1, 100)[0]
    assert np.array_equal(ends[0], ends[1]) and np.array_equal(ends[2], ends[3])
    assert picture.shape == (1, 9, 3) and picture.dtype == np.uint8
    picture = distance_image(np.array([[0.0, -1, np.nan, np.inf, 5]], np.float32), 1, 10)[0]
    assert (picture[:4] == UNKNOWN).all() and not (picture[4] == UNKNOWN).all()


def test_the_range_of_distances_leaves_out_what_is_rare_and_unknown():
    distance = np.linspace(10, 20, 1000).reshape(10, 100)
    distance[0, 0], distance[0, 1], distance[0, 2:9] = 1e-3, 1e9, 0
    near, far = distance_range(distance)
    assert 10 < near < 10.5 and 19.5 < far < 20
    for same in (np.zeros((4, 4)), np.full((4, 4), 3.0)):
        near, far = distance_range(same)
        assert 0 < near < far
        distance_image(same, near, far)


def test_an_overlay_is_between_both():
    image, picture = np.full((2, 3, 3), 100, np.uint8), np.full((2, 3, 3), 200, np.uint8)
    where = np.array([[True, False, True], [False, False, True]])
    laid = overlay(image, picture, 0.25, where)
    assert (laid == np.where(where[..., None], 125, 100)).all() and laid.dtype == np.uint8
    assert (overlay(image[..., :1], picture) == 150).all()
    assert (overlay(image[..., 0], picture, 1.0) == 200).all()


def test_boxes_are_drawn_along_their_outermost_pixels():
    """The first one on top of others, and a text inside of the picture."""
    image = np.full((60, 80, 1), 100, np.uint8)
    boxes = np.array([[10, 30, 30, 50], [10, 20, 50, 50.0]])
    drawn = draw_boxes(image, boxes, ["", ""], [[255, 0, 0], [0, 0, 255]])
    assert drawn.shape == (60, 80, 3) and (image == 100).all()
    assert (drawn[49, 10:30] == [255, 0, 0]).all() and (drawn[30:50, [10, 29]] == [255, 0, 0]).all()
    assert (drawn[49, 30:50] == [0, 0, 255]).all() and (drawn[20:30, [10, 49]] == [0, 0, 255]).all()
    for beside in (drawn[50:], drawn[:, :10], drawn[:, 50:]):
        assert (beside == 100).all()
    with_text = draw_boxes(image, boxes[:1] - [[0, 30, 0, 30]], ["a"], [[255, 0, 0]])
    assert (with_text[1:14, 10:18].max(-1) < 60).any()  # letters
    assert (draw_boxes(image, np.zeros((0, 4)), [], []) == 100).all()


def shown(figure, row=0):
    return [axes.images[0].get_array() for axes in figure.axes[4 * row : 4 * row + 4]]


def test_predictions_of_labels_stand_beside_the_truth(tmp_path):
    truth = np.array([[0, 1], [1, 255]])
    prediction = np.array([[0, 1], [0, 1]])
    image = np.full((2, 2, 1), 7, np.uint8)
    colors = palette(2)
    rows = [(image, truth, prediction)] * 2
    figure = draw_predictions(rows, ["road", "sky"], colors)
    assert len(figure.axes) == 8
    for row in (0, 1):
        picture, of_truth, of_prediction, error = shown(figure, row)
        assert np.array_equal(picture, np.full((2, 2, 3), 7))
        assert np.array_equal(of_truth, label_image(truth, colors))
        assert np.array_equal(of_prediction, label_image(prediction, colors))
        assert np.array_equal(error, [[_RIGHT, _RIGHT], [_WRONG, UNKNOWN]])
        assert figure.axes[4 * row + 3].get_xlabel() == "67% right"
    save_figure(figure, tmp_path / "labels.png")
    assert cv2.imread(str(tmp_path / "labels.png")).std() > 20


@pytest.mark.slow
def test_many_classes_leave_the_pictures_their_size():
    truth, image = np.zeros((20, 20), np.int64), np.zeros((20, 20, 3), np.uint8)
    widths = []
    for count in (2, 40):
        figure = draw_predictions(
            [(image, truth, truth)], [f"a long name {k}" for k in range(count)]
        )
        figure.draw_without_rendering()
        widths.append(figure.axes[0].get_window_extent().width)
        legend = figure.legends[0].get_window_extent()
        assert legend.x0 >= 0 and legend.x1 <= figure.bbox.width and legend.y0 >= 0
    assert widths[1] == pytest.approx(widths[0], rel=0.05) and widths[0] > 130  # px


def test_predictions_of_distances_have_their_error(tmp_path):
    truth = np.linspace(1, 50, 600, dtype=np.float32).reshape(20, 30)
    prediction = truth * 1.25
    truth[0] = 0
    image = np.zeros((20, 30, 3), np.uint8)
    figure = draw_predictions([(image, truth, prediction)])
    _, of_truth, of_prediction, error = shown(figure)
    assert (error[0] == UNKNOWN).all() and (of_truth[0] == UNKNOWN).all()
    near, far = distance_range(truth)
    assert np.array_equal(of_prediction, distance_image(prediction, near, far))
    assert np.array_equal(of_truth, distance_image(truth, near, far))
    assert np.ptp(error[1:].reshape(-1, 3).astype(int), 0).max() <= 1  # it is the same everywhere
    assert figure.axes[3].get_xlabel() == "mean 25%"
    save_figure(figure, tmp_path / "distances.png")


def test_wrong_arguments():
    image, labels = np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), int)
    for call, message in (
        (lambda: palette(-1), "0 to 255 colours, got -1"),
        (lambda: palette(256), "0 to 255 colours, got 256"),
        (lambda: label_image(labels[0], palette(2)), r"\(H, W\), got \(2,\)"),
        (lambda: distance_image(labels, 2, 1), "0 < near < far must hold, got 2 and 1 m"),
        (lambda: overlay(image, image[:1]), "of one size"),
        (lambda: overlay(image, image, 2), "alpha"),
        (lambda: draw_predictions([]), "no predictions"),
        (lambda: draw_predictions([(image, labels, labels)]), "names of their classes"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(TypeError, match="integers, got float32"):
        label_image(np.zeros((2, 2), np.float32), palette(2))
    nothing = np.zeros((2, 2), np.float32)
    draw_predictions([(image, nothing, nothing + 1)])
