"""The figure of a calibration."""

import dataclasses

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba
from rigs import rig, true_lens

from darswin.calibrate import calibrate
from darswin.viz.calibration import draw_calibration


@pytest.fixture(scope="module")
def made():
    """A calibration from corners, one of which is wrong and some of which are not seen."""
    seen = rig(true_lens("KannalaBrandt", 190, (480, 640)), 8, noise=0.1)
    seen.corners[2, 20] += 40.0
    return seen, calibrate(seen.corners, seen.board, seen.size, "KannalaBrandt")


def test_it_shows_corners_residuals_deviations_and_the_curve(made):
    seen, found = made
    figure = draw_calibration(found, found.lens)
    panels = {axes.get_title().split()[-1]: axes for axes in figure.axes if axes.get_title()}
    count = int(seen.corners.isfinite().all(-1).sum())
    (dots,) = panels["corners"].collections
    places = seen.corners[seen.corners.isfinite().all(-1)].numpy()
    np.testing.assert_allclose(dots.get_offsets(), places)
    theta = torch.rad2deg(found.theta[found.theta.isfinite()])
    np.testing.assert_allclose(dots.get_array(), theta)
    assert panels["corners"].get_title() == f"{count - 1} corners"
    (arrows,) = panels["px"].collections
    assert len(arrows.get_offsets()) == count
    red = (arrows.get_facecolor() == to_rgba("red")).all(1)
    np.testing.assert_allclose(arrows.get_offsets()[red], seen.corners[2, [20]])
    (shown,) = panels["projection"].images
    left, right, low, high = shown.get_extent()
    assert left == high == -0.5 and right >= 639.5 and low >= 479.5
    values = shown.get_array()
    middle = np.array(values.shape) // 2
    place = torch.tensor([[middle[1] + 0.5, middle[0] + 0.5]]).double() * 640 / 60 - 0.5
    assert values[tuple(middle)] == pytest.approx(found.uncertainty(place).item())
    curve = panels[type(found.lens).__name__].lines[0]
    radii = found.lens.project(torch.deg2rad(torch.as_tensor(curve.get_xdata())))
    np.testing.assert_allclose(curve.get_ydata(), radii, rtol=1e-6)


def test_a_smaller_theta_max_ends_the_curve_and_the_map(made):
    _, found = made
    figure = draw_calibration(found, found.lens.with_theta_max(1.0))
    (curve,) = (axes for axes in figure.axes if axes.get_xlabel().startswith("incident"))
    assert curve.get_xlim()[1] == pytest.approx(np.rad2deg(1.0))
    (shown,) = (image for axes in figure.axes for image in axes.images if axes.get_title())
    assert np.ma.getmaskarray(np.ma.masked_invalid(shown.get_array())).mean() > 0.5


def test_pictures_with_the_worst_corners_are_drawn(made):
    seen, found = made
    names, pictures = (
        [],
        np.random.default_rng(0).integers(256, size=(8, 480, 640, 3), dtype=np.uint8),
    )

    def read(name):
        names.append(name)
        return pictures[int(name.split()[1]) - 1]

    figure = draw_calibration(found, found.lens, read)
    farthest = found.residuals.norm(dim=-1).nan_to_num(0).amax(1)
    order = farthest.argsort(descending=True)[:3].tolist()
    assert names == [f"picture {k + 1}" for k in order] and order[0] == 2
    wholes, parts = (
        [axes for axes in figure.axes if text in axes.get_title()] for text in ("×", "px off")
    )
    assert len(wholes) == len(parts) == 3
    assert wholes[0].get_title().startswith("picture 3\n")
    assert parts[0].get_title().startswith("corner 21, 56.")
    for k, whole, part in zip(order, wholes, parts, strict=True):
        points = found.board @ found.rotations[k].T + found.translations[k]
        places = torch.stack((seen.corners[k], found.lens.project_points(points)))
        places = places[:, seen.corners[k].isfinite().all(-1)].numpy()
        for line, expected in zip(part.lines, places, strict=True):
            np.testing.assert_allclose(line.get_xydata(), expected, atol=1e-6)
        starts, ends = np.array(whole.collections[0].get_segments()).swapaxes(0, 1)
        times = float(whole.get_title().split()[-1])
        np.testing.assert_allclose(starts, places[0])
        np.testing.assert_allclose(ends - starts, times * (places[1] - places[0]), atol=1e-5)
        worst = np.linalg.norm(places[1] - places[0], axis=1).argmax()
        middle = np.mean([part.get_xlim(), part.get_ylim()], 1)
        np.testing.assert_allclose(middle, places[0, worst])
        for axes, shown in ((whole, places[0]), (part, places[:, worst])):
            x, y = (np.sort(limits) for limits in (axes.get_xlim(), axes.get_ylim()))
            assert ((shown > (x[0], y[0])) & (shown < (x[1], y[1]))).all()
            (image,) = axes.images
            left, right, bottom, top = (round(edge + 0.5) for edge in image.get_extent())
            np.testing.assert_array_equal(image.get_array(), pictures[k, top:bottom, left:right])
            assert left <= max(x[0], 0) and right > min(x[1], 639)
            assert top <= max(y[0], 0) and bottom > min(y[1], 479)


def test_names_of_pictures_are_drawn_as_they_are(made):
    _, found = made
    names = ["a/b/" + "long" * 9 + "_1$2$.png", "\udcff.png", *map(str, range(6))]
    found = dataclasses.replace(found, names=[names[(k + 6) % 8] for k in range(8)])
    figure = draw_calibration(found, found.lens, lambda name: np.zeros((480, 640, 3), np.uint8))
    figure.draw_without_rendering()
