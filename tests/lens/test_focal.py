"""Lenses that fill a circle."""

import math

import pytest
import torch
from lens_examples import example, f64

from darswin.lens import MODELS, Equidistant, Mei, Perspective, Polynomial, Spherical
from darswin.lens.ideal import FocalLens


def test_spherical_has_the_papers_focal_lengths():
    # The circle fills a 64 px image at a field of view of 174.63° (released data).
    xi = torch.tensor([0.0, 0.05, 0.2, 0.35, 0.5, 0.7, 0.93, 1.0], dtype=f64)
    lens = Spherical.from_fov(xi, 3.0479112779, 32.0)
    expected = [1.5, 3.102, 7.907, 12.712, 17.518, 23.925, 31.293, 33.535]
    torch.testing.assert_close(lens.focal, torch.tensor(expected, dtype=f64), rtol=0, atol=1e-3)
    torch.testing.assert_close(lens.r_max, torch.full((8,), 32.0, dtype=f64))


@pytest.mark.parametrize("name", [name for name, m in MODELS.items() if issubclass(m, FocalLens)])
def test_the_field_of_view_fills_the_circle(name):
    lens = example(name, torch.Generator().manual_seed(2))
    lens = lens.with_theta_max(0.9 * lens.theta_limit)
    names = [n for n in (*lens.parameters, *lens.optional) if n != "focal"]
    own = {n: getattr(lens, n) for n in names if getattr(lens, n) is not None}
    made = type(lens).from_fov(fov=2 * lens.theta_max, radius=37.0, **own)
    assert torch.equal(made.theta_max, lens.theta_max)
    torch.testing.assert_close(made.r_max, torch.full((4,), 37.0, dtype=f64))
    torch.testing.assert_close(made.focal, lens.focal * 37 / lens.r_max)


def test_arguments_of_a_lens_of_a_field_of_view():
    by_place = Mei.from_fov(0.5, 2.0, 30.0, [3.0, 4.0], radial=[0.1, 0.2], image_size=(60, 80))
    by_name = Mei.from_fov(xi=0.5, fov=2.0, radius=30.0, center=[3.0, 4.0], radial=[0.1, 0.2])
    assert repr(by_place.replace(image_size=None)) == repr(by_name)
    assert len(Spherical.from_fov([0.1, 0.2], 2.0, 30.0)) == 2
    assert len(Equidistant.from_fov([1, 2], 3)) == 2
    for wrong in (
        lambda: Spherical.from_fov(2.0, 30.0),
        lambda: Spherical.from_fov(0.5, 2.0, 30.0, None, 1.0),
        lambda: Spherical.from_fov(0.5, 2.0, 30.0, xi=0.5),
    ):
        with pytest.raises(
            TypeError, match=r"Spherical.from_fov\(xi, fov, radius, center=None, .*\): "
        ):
            wrong()
    with pytest.raises(TypeError, match="focal"):
        Spherical.from_fov(0.5, 2.0, 30.0, focal=3.0)
    with pytest.raises(TypeError, match="zeta"):
        Spherical.from_fov(0.5, 2.0, 30.0, zeta=3.0)
    with pytest.raises(ValueError, match="focal must be"):
        Perspective.from_fov(math.pi + 0.1, 10.0)
    assert not hasattr(Polynomial, "from_fov")
