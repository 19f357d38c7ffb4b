"""Tables that are read bilinearly, against scipy."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from darswin.utils.tables import read_table


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("size", [(9, 13), (2, 2), (2, 40)])
def test_points_are_read_as_by_scipy(size, count):
    rng = np.random.default_rng(0)
    table = rng.normal(size=(*size, count))
    points = rng.uniform(-0.5, np.array(size[::-1]) - 0.5, (7, 30, 2))
    scipy = RegularGridInterpolator(
        tuple(map(np.arange, size)), table, bounds_error=False, fill_value=None
    )
    found = read_table(table, points)
    np.testing.assert_allclose(found, scipy(points[..., ::-1]), atol=1e-12)
    strided = np.zeros((*size, 2 * count))[..., ::2]
    strided[:] = table
    np.testing.assert_array_equal(read_table(strided, points), found)


def test_beyond_the_border_and_beside_nan_there_is_nothing():
    table = np.ones((4, 5, 2))
    table[0, 0] = np.nan
    outside = [[-0.51, 2], [2, 3.51], [np.nan, 1], [0.5, 0.5], [4.6, 1], [np.inf, 0]]
    assert np.isnan(read_table(table, np.array(outside))).all()
    inside = [[-0.5, 2], [2, 3.5], [4.5, 1]]
    np.testing.assert_allclose(read_table(table, np.array(inside)), 1)
    assert read_table(table, np.zeros((0, 2))).shape == (0, 2)
    # A table of one entry or one row is constant across.
    one, row = np.full((1, 1, 2), 3.0), np.arange(4.0).reshape(1, 4, 1)
    np.testing.assert_allclose(read_table(one, np.array([[0.2, -0.3]])), 3)
    np.testing.assert_allclose(read_table(row, np.array([[1.5, 0.4]])), [[1.5]])


@pytest.mark.parametrize("shape", [(3,), (5, 1), ()])
def test_points_have_two_coordinates(shape):
    with pytest.raises(ValueError, match=r"points must have shape \(..., 2\), got"):
        read_table(np.ones((4, 5, 2)), np.zeros(shape))
