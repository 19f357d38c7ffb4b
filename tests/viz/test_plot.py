import math

import numpy as np
import pytest
import torch
from helpers import refused
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from darswin import PolarView
from darswin.lens import KannalaBrandt, Mei, Polynomial, Spherical
from darswin.views import make_view, turned
from darswin.viz.plot import (
    FORMATS,
    draw_accuracy,
    draw_curve,
    draw_grid,
    draw_lens,
    draw_polar,
    draw_samples,
    draw_view,
    figure_format,
    save_figure,
)

SAMPLER = PolarView(rings=4, sectors=8, samples=(3, 2), layout="image")
ROUND = Spherical.from_fov(0.4, 2.6, 16.0)
BENT = Mei(
    2.0, 40.0, (0.05, 1.5), 1.7, affine=[[1.0, 0.1], [0.0, 0.8]], tangential=(0.02, -0.03)
)  # fmt: skip


def drawn(draw, *arguments, **options) -> list[Axes]:
    """The axes of a figure after `draw`."""
    figure = Figure()
    draw(*arguments, axes=figure.subplots(), **options)
    return figure.axes


@pytest.mark.parametrize("lens", [ROUND, BENT], ids=["round", "bent"])
def test_draw_grid_shows_borders_and_samples(lens):
    size = (60, 80)
    (axes,) = drawn(draw_grid, np.zeros(size), lens, SAMPLER)
    rings, sectors = ([np.array(s) for s in c.get_segments()] for c in axes.collections)
    exact = lens.to(torch.float64)
    for k, ring in enumerate(rings):  # equal steps of θ
        theta, _ = exact.unproject_pixels(torch.from_numpy(ring), size)
        np.testing.assert_allclose(theta, k / 4 * exact.theta_max.item(), atol=1e-6)
    assert len(rings) == 5
    for k, sector in enumerate(sectors):
        _, azimuth = exact.unproject_pixels(torch.from_numpy(sector[1:]), size)
        off = torch.remainder(azimuth - k * math.pi / 4 + 1, 2 * math.pi) - 1
        assert off.abs().max() < 1e-6
    points = np.stack(axes.lines[0].get_data(), -1)
    theta, azimuth = exact.unproject_pixels(torch.from_numpy(points), size)
    expected = (np.arange(12) + 0.5) / 12 * exact.theta_max.item()
    np.testing.assert_allclose(np.sort(theta), np.repeat(expected, 16), atol=1e-6)
    turns = azimuth.numpy() % (2 * math.pi) / (2 * math.pi) * 16
    np.testing.assert_allclose(np.sort(turns), np.repeat(np.arange(16) + 0.5, 12), atol=1e-6)
    assert not drawn(draw_grid, np.zeros(size), lens, SAMPLER, samples=False)[0].lines
    refused("one lens, got 2", drawn, draw_grid, np.zeros(size), lens.expand(1)[[0, 0]], SAMPLER)


def test_draw_samples_is_a_part_of_the_grid():
    (axes,) = drawn(draw_samples, np.zeros((60, 80)), BENT, SAMPLER)
    assert np.diff(axes.get_xlim()) == pytest.approx(8) and np.diff(axes.get_ylim()) == [-6]
    x, y = BENT.project_rays(0.85, -math.pi / 4, (60, 80))[0].tolist()
    assert np.mean(axes.get_xlim()) == pytest.approx(x, abs=1e-3)
    assert np.mean(axes.get_ylim()) == pytest.approx(y, abs=1e-3)
    lens = ROUND.replace(center=torch.tensor([[-40.0, 300.0]]))  # outside the image
    (axes,) = drawn(draw_samples, np.zeros((60, 80)), lens, SAMPLER)
    assert axes.get_xlim() == (-0.5, 7.5) and axes.get_ylim() == (59.5, 53.5)


@pytest.mark.parametrize("shape", [(32, 32), (32, 32, 3)])
def test_draw_polar_is_what_the_layer_samples(shape):
    image = np.random.default_rng(0).integers(256, size=shape, dtype=np.uint8)
    for sampler in (SAMPLER, PolarView(4, 8, (3, 2), jitter=1.0, mean=0.5)):
        (axes,) = drawn(draw_polar, image, ROUND, sampler)
        channels = torch.from_numpy(np.atleast_3d(image)).permute(2, 0, 1)[None]
        expected = SAMPLER(channels, ROUND)[0].permute(1, 2, 0).expand(-1, -1, 3)
        np.testing.assert_allclose(axes.images[0].get_array()[..., :3], expected, atol=1e-5)


def test_it_is_hatched_where_there_is_no_picture():
    image = np.full((20, 60, 3), 200, np.uint8)
    lens = ROUND  # its circle is 32 px wide
    (axes,) = drawn(draw_polar, image, lens, SAMPLER)
    alpha = axes.images[0].get_array()[..., 3]
    grid = SAMPLER.grid(lens.to(torch.float64), (20, 60))
    down = np.abs(grid.radii[0].numpy()[:, None] * np.sin(grid.azimuths.numpy()))
    np.testing.assert_array_equal(alpha == 0, down > 10)  # the sensor ends 10 px from the middle
    assert axes.patch.get_hatch()
    (axes,) = drawn(draw_polar, np.zeros((40, 40)), lens, SAMPLER)
    assert (axes.images[0].get_array()[..., 3] == 1).all()
    latitude, longitude = torch.deg2rad(4.0 * torch.arange(90) - 4 * torch.tensor([[22], [44.5]]))
    y, x = torch.meshgrid(latitude[:45].double(), longitude.double(), indexing="ij")
    theta = torch.acos(y.cos() * x.cos())
    azimuth = torch.atan2(y.sin(), y.cos() * x.sin())
    place = lens.to(torch.float64).project_rays(theta, azimuth, (20, 60))
    seen = (theta <= lens.theta_max) & ((place[..., 1] - 9.5).abs() <= 10)
    # With several reads, a pixel is hatched if it reads nothing.
    for reads in (1, 3):
        size = (45 // reads, 90 // reads)
        view = make_view("equirectangular", size, fov=2 * math.pi, supersampling=reads)
        (axes,) = drawn(draw_view, image, lens, view)
        expected = seen.numpy().reshape(size[0], reads, size[1], reads).any((1, 3))
        np.testing.assert_array_equal(axes.images[0].get_array()[..., 3] == 255, expected)


@pytest.mark.parametrize("options", [{}, turned(0.7, -0.4), dict(up=(0.5, -1.0, 0.0))])
@pytest.mark.parametrize("fov", [0.6, 1.7])
def test_ticks_of_a_view_are_angles_from_its_middle(options, fov):
    lens, image = Polynomial([20.0, 1.0, 0.5], 1.7), np.zeros((48, 80), np.uint8)
    for name, place in (
        ("perspective", lambda angle: 20 / math.tan(fov / 2) * np.tan(angle)),
        ("equirectangular", lambda angle: 40 / fov * angle),
        ("stereographic", lambda angle: 20 / math.tan(fov / 4) * np.tan(angle / 2)),
        ("square", lambda angle: 20 / fov * 2 * angle),
    ):
        is_square = name == "square"
        view = make_view(name, (40, 40) if is_square else (30, 40), fov=fov,
                         **({} if is_square else options))  # fmt: skip
        (axes,) = drawn(draw_view, image, lens, view)
        for axis, half, sign in ((axes.xaxis, 19.5, 1), (axes.yaxis, view.size[0] / 2 - 0.5, -1)):
            shown = [float(text.get_text()[:-1]) for text in axis.get_ticklabels()]
            assert len(shown) >= 3 and 0 in shown
            expected = half + sign * place(np.radians(shown))
            np.testing.assert_allclose(axis.get_ticklocs(), expected, atol=0.05)
    with pytest.raises(ValueError, match="a view of one picture, got 5"):
        drawn(draw_view, image, lens, make_view("tiles", (20, 20)))


def test_draw_curve_shows_radius_density_and_the_ends_of_the_image():
    lens = Polynomial([20.0, 1.0, 0.5], 1.7, [45.0, 22.0])
    left, right = drawn(draw_curve, lens, (48, 80))
    degrees, radius = (np.array(values) for values in left.lines[0].get_data())
    theta = torch.deg2rad(torch.from_numpy(degrees)).float()
    np.testing.assert_allclose(radius, lens.project(theta), rtol=1e-5)
    along = right.lines[0].get_ydata()
    np.testing.assert_allclose(np.gradient(radius, degrees)[1:-1], along[1:-1], rtol=1e-3)
    angles = lens.side_angles((48, 80))[0].rad2deg().tolist()
    places = [line.get_xdata()[0] for line in left.lines[1:]]
    assert angles[0] > math.degrees(1.7) and places == pytest.approx(angles[1:])
    assert [line.get_linestyle() for line in left.lines[1:]] == [":", "--", ":"]
    assert len(drawn(draw_curve, lens)[0].lines) == 1
    lens = Polynomial([30.0, 0.0, -3.0])  # r rises up to 105°, 36 px
    assert drawn(draw_curve, lens, (400, 400))[0].get_xlabel() == "incident angle θ (°)"
    angle = f"{lens.side_angles((40, 40))[0, 0].rad2deg():.0f}°"  # lines at one place share a label
    said = f"dashed: left and right {angle}\ndotted: top and bottom {angle}"
    assert drawn(draw_curve, lens, (40, 40))[0].get_xlabel().endswith(said)
    top, right, bottom = (f"{angle:.0f}°" for angle in angles[1:])
    said = f"dotted: top {top}, bottom {bottom}\ndashed: right {right}"
    assert left.get_xlabel().endswith(said) and not left.texts  # a text would cross the curves


def test_draw_lens_has_all_panels_and_a_circle_where_corners_end():
    image, lens = np.zeros((48, 64, 3), np.uint8), KannalaBrandt(20.0, [0.01], 1.7)
    view, around = make_view("perspective", (6, 8), fov=1.0), torch.linspace(0, 2 * math.pi, 361)
    for supported, count in ((None, 0), (1.2, 1), (1.71, 0)):
        figure = draw_lens(image, lens, SAMPLER, view, "ahead", supported)
        assert len(figure.axes) == 6  # five panels, and the second scale of the curve
        partition = figure.axes[0]
        circles = [line for line in partition.lines if line.get_color() == "magenta"]
        assert len(circles) == count == partition.get_title().count("last corners, 68.8°")
        for line in circles:
            expected = lens.project_rays(1.2, around, (48, 64))
            torch.testing.assert_close(torch.tensor(line.get_xydata()).float(), expected)
    figure.draw_without_rendering()


@pytest.mark.parametrize(("ending", "format_"), FORMATS.items())
def test_figures_are_saved_in_the_format_of_their_ending(ending, format_, tmp_path):
    heads = {"png": b"\x89PNG", "jpeg": b"\xff\xd8\xff", "webp": b"RIFF", "tiff": b"II*\0",
             "pdf": b"%PDF", "svg": b"<?xml"}  # fmt: skip
    path = tmp_path / f"lens{ending.upper()}"
    save_figure(Figure(figsize=(1, 1)), path)
    assert path.read_bytes().startswith(heads[format_])


def test_a_palette_makes_a_png_small_and_keeps_its_size(tmp_path):
    figure = Figure(figsize=(2, 1))
    figure.subplots().imshow(np.random.default_rng(0).random((9, 9)))
    for name, colors in (("all.png", None), ("few.png", 16)):
        save_figure(figure, tmp_path / name, colors=colors)
    large, small = (Image.open(tmp_path / name) for name in ("all.png", "few.png"))
    assert small.mode == "P" and len(small.getcolors()) <= 16
    assert small.size == large.size and small.info["dpi"] == large.info["dpi"]
    with pytest.raises(ValueError, match=r"only a .png has a palette of colors, got '.*few.jpg'"):
        save_figure(figure, tmp_path / "few.jpg", colors=16)


@pytest.mark.parametrize("name", ["lens.gif", "lens", "lens.", "png", "a.png/b"])
def test_other_endings_are_refused(name):
    refused(rf"must end in one of \.png, .*, got '{name}'", figure_format, name)


def test_accuracy_of_each_model():
    models = {"a": [1, 2, 3], "b": [3, 2, 1]}
    (axes,) = drawn(draw_accuracy, [0.0, 0.5, 1.0], models, (0.2, 0.35))
    assert [list(line.get_ydata()) for line in axes.lines] == [[1, 2, 3], [3, 2, 1]]
    # Of several seeds it shows the mean and the span.
    (axes,) = drawn(draw_accuracy, [0.0, 1.0], {"a": [[1, 2], [3, 8]]}, None)
    assert list(axes.lines[0].get_ydata()) == [2, 5]
    (band,) = axes.collections
    assert band.get_datalim(axes.transData).get_points().tolist() == [[0, 1], [1, 8]]
