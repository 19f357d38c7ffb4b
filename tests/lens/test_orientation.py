"""Lenses of rotated pictures."""

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from helpers import exif_of, refused
from hypothesis import given
from PIL import ExifTags, Image, ImageOps

from darswin.cli import lens as cli
from darswin.lens import BrownConrady, Equidistant, Fisheye624, KannalaBrandt, Mei, save
from darswin.lens.orientation import in_upright_picture, rotated, stored_size, upright
from darswin.viz import plot

f64 = torch.float64
SIZE = (5, 7)


def from_stored(points: torch.Tensor, orientation: int) -> torch.Tensor:
    """Places (..., 2) in the upright picture of stored places, by Pillow's pixels."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.uint8)
    image = Image.fromarray(np.stack((x, y, y), -1))
    image.getexif()[ExifTags.Base.Orientation] = orientation
    # (H, W, 2): the stored x and y of each pixel of the picture that Pillow makes upright.
    went = torch.from_numpy(np.asarray(ImageOps.exif_transpose(image))[..., :2].astype(float))
    height, width = went.shape[:2]
    corner, right, down = went[0, 0], went[0, 1] - went[0, 0], went[1, 0] - went[0, 0]
    last = corner + (width - 1) * right + (height - 1) * down
    assert torch.equal(went[height - 1, width - 1], last)
    return (points - corner) @ torch.linalg.inv(torch.stack((right, down)))


terms = st.floats(-0.02, 0.02)
lenses = st.builds(
    lambda model, center, affine, p, s: model(
        **({"xi": torch.tensor(0.8, dtype=f64)} if model is Mei else {}),
        focal=torch.tensor(2.0, dtype=f64), radial=[0.01, -0.002], theta_max=1.1, center=center,
        affine=affine, tangential=p, prism=s, image_size=SIZE,
    ),
    st.sampled_from([KannalaBrandt, Fisheye624, Mei, BrownConrady]),
    st.none() | st.tuples(st.floats(0, 6), st.floats(0, 4)),
    st.sampled_from([None, [[1.0, 0.1], [-0.05, 0.9]]]),
    st.none() | st.tuples(terms, terms),
    st.none() | st.tuples(terms, terms, terms, terms),
)  # fmt: skip


@given(lenses, st.integers(1, 8), st.floats(0.01, 1.1), st.floats(-3.1, 3.1))
def test_a_ray_lands_where_its_pixel_went(lens, orientation, theta, azimuth):
    oriented = upright(lens, orientation)
    assert stored_size(tuple(oriented.image_size[0].int().tolist()), orientation) == SIZE
    direction = torch.tensor([[np.cos(azimuth), np.sin(azimuth)]], dtype=f64)
    turn = from_stored(direction, orientation) - from_stored(torch.zeros(2, dtype=f64), orientation)
    theta = torch.tensor([theta], dtype=f64)
    expected = from_stored(lens.pixels(theta, direction), orientation)
    torch.testing.assert_close(oriented.pixels(theta, turn), expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_a_lens_is_shown_in_the_picture_that_exif_turns(tmp_path, monkeypatch, orientation):
    lens = Equidistant(20.0, theta_max=1.3, center=(40.0, 20.0), image_size=(48, 64))
    save(lens, tmp_path / "lens.json")
    Image.new("RGB", (64, 48)).save(tmp_path / "p.jpg", exif=exif_of(orientation))
    drawn = []
    monkeypatch.setattr(plot, "draw_lens", lambda picture, lens, *_: drawn.append((picture, lens)))
    monkeypatch.setattr(plot, "save_figure", lambda *_: None)
    cli.show(str(tmp_path / "lens.json"), str(tmp_path / "p.jpg"))
    ((picture, seen),) = drawn
    assert picture.shape[:2] == ((64, 48) if orientation == 6 else (48, 64))
    assert seen.to(torch.float32).same_as(upright(lens, orientation).to(torch.float32))


def test_a_calibration_fits_the_stored_picture_or_else_the_upright_one():
    lens = Equidistant(20.0, theta_max=1.3, center=(40.0, 20.0), image_size=(48, 64))
    assert in_upright_picture(lens, (64, 48), 6).center.tolist() == [[27.0, 40.0]]
    assert in_upright_picture(lens, (48, 64), 3).center.tolist() == [[23.0, 27.0]]
    assert in_upright_picture(lens, (24, 32), 3).center.tolist() == [[11.25, 13.25]]
    assert torch.equal(in_upright_picture(lens, (48, 64), 6).center, lens.center)
    said = r"has 50 × 50 px .* \(as stored; its EXIF orientation is 8"
    refused(said, in_upright_picture, lens, (50, 50), 8)
    refused("orientation must be 1 to 8, got 9", upright, lens, 9)
    refused("needs an image_size", upright, Equidistant(20.0), 6)
    refused("takes one lens, got 2", rotated, Equidistant([9.0, 8.0], image_size=SIZE), 0.1)
    refused("image_size", rotated, Equidistant(9.0), 0.1)


@given(lenses, st.floats(-3.2, 3.2), st.floats(0.01, 1.1), st.floats(-3.1, 3.1))
def test_a_ray_lands_where_its_pixel_was_turned_to(lens, angle, theta, azimuth):
    after, matrix = rotated(lens, angle)
    place = lens.project_rays(theta, azimuth) @ matrix[:, :2].T + matrix[:, 2]
    torch.testing.assert_close(after.project_rays(theta, azimuth + angle), place)
    if lens.affine is None:  # then lengths stay the same
        torch.testing.assert_close(matrix[:, :2] @ matrix[:, :2].T, torch.eye(2, dtype=f64))
