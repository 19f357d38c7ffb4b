"""The figure of a calibration."""

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
    return seen, calibrate(seen.corners, seen.board, seen.size)


def test_it_shows_corners_residuals_deviations_and_the_curve(made):
    seen, found = made
    figure = draw_calibration(found, seen.corners.numpy(), found.lens)
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
    seen, found = made
    figure = draw_calibration(found, seen.corners.numpy(), found.lens.with_theta_max(1.0))
    (curve,) = (axes for axes in figure.axes if axes.get_xlabel().startswith("incident"))
    assert curve.get_xlim()[1] == pytest.approx(np.rad2deg(1.0))
    (shown,) = (image for axes in figure.axes for image in axes.images if axes.get_title())
    assert np.ma.getmaskarray(np.ma.masked_invalid(shown.get_array())).mean() > 0.5
