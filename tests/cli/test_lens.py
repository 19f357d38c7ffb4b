import contextlib
import io
import json
import math
import os
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from darswin.cli import lens as cli
from darswin.cli.main import main
from darswin.lens import Mei, Perspective, Polynomial, Spherical, from_dict, to_dict
from darswin.viz import plot
from darswin.viz.report import (
    best_spacing,
    describe,
    largest_offset,
    outside_share,
    patches,
    pixels_per_degree,
)

FRONT = Polynomial(
    [350.4, -17.5, 27.5, -2.4], math.radians(95), [641.3, 486.1],
    image_size=(966, 1280),
)  # fmt: skip
MEI = Mei(
    2.35, 1390.0, (0.032, 2.4),
    math.radians(102), (708.5, 697.0), image_size=(1400, 1400),
    tangential=(6e-4, -3.5e-4),
)  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "front.json").write_text(json.dumps(to_dict(FRONT)))
    picture = np.random.default_rng(0).integers(256, size=(483, 640, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "front.png"), picture)
    return tmp_path


def test_show_writes_a_figure(folder, capsys):
    calib, picture = str(folder / "front.json"), str(folder / "front.png")
    out = folder / "new" / "figure.png"
    main(["lens", "show", calib, picture, "--out", str(out), "--rings=4", "--sectors=8",
          "--samples=[3,2]", "--view=cylindrical", "--yaw_deg=20", "--spacing=g"])  # fmt: skip
    assert capsys.readouterr().out == f"{out}\n"
    assert cv2.imread(str(out)).shape == (1080, 1800, 3)


def test_show_takes_a_picture_of_the_same_shape_only(folder):
    calib = str(folder / "front.json")
    cv2.imwrite(str(folder / "square.png"), np.zeros((400, 400, 3), np.uint8))
    with pytest.raises(SystemExit, match="pictures of 966×1280 px, and 400×400 is"):
        main(["lens", "show", calib, str(folder / "square.png")])
    with pytest.raises(SystemExit, match=r"^darswin: cannot read none.png: No such file[^(]*$"):
        main(["lens", "show", calib, "none.png"])


def test_info_prints_what_the_lens_is(folder, capsys):
    main(["lens", "info", str(folder / "front.json")])
    printed = capsys.readouterr().out
    assert "1280 × 966 px" in printed and "350.4, -17.5" in printed
    main(["lens", "info", str(folder / "front.json"), "--theta_max_deg=60", "--rings=8"])
    printed = capsys.readouterr().out
    assert "60.00° (1.04720 rad)" in printed and "of 8 × 64 tokens" in printed


def test_convert_fits_and_writes(folder, capsys):
    out = folder / "kb.json"
    main(["lens", "convert", str(folder / "front.json"), str(out), "--model", "KannalaBrandt"])
    printed = capsys.readouterr().out
    fitted = json.loads(out.read_text())
    assert fitted["model"] == "KannalaBrandt" and "KannalaBrandt up to 95.00°, at most" in printed
    lens = from_dict(fitted)
    theta = torch.linspace(0, math.radians(95), 20)
    torch.testing.assert_close(lens.project(theta), FRONT.project(theta), rtol=0, atol=0.5)
    main(["lens", "convert", str(folder / "front.json"), str(out)])
    assert json.loads(out.read_text())["model"] == "Polynomial"


def test_errors_are_one_line(folder):
    with pytest.raises(SystemExit, match=r"^darswin: [^\n]*$"):
        main(["lens", "info", str(folder / "none.json")])
    (folder / "wrong.json").write_text('{"model": "Spherical"}')
    with pytest.raises(SystemExit, match=r"^darswin: [^\n]*$"):
        main(["lens", "info", str(folder / "wrong.json")])
    with pytest.raises(SystemExit, match=r"^darswin: [^\n]*model[^\n]*$"):
        main(["lens", "convert", str(folder / "front.json"), "out.json", "--model", "Sfera"])


def refusal(capsys, *arguments):
    """The one line with which a command refuses its arguments, with exit code 2."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    assert end.value.code == 2 and not printed.out
    (line,) = printed.err.splitlines()
    return line


@pytest.mark.parametrize(
    "options, said",
    [
        (["--fov_deg", "0"], "--fov_deg must be above 0° and below 180° in .* perspective, got 0"),
        (["--fov_deg=180"], "--fov_deg must be above 0° and below 180° .*, got 180"),
        (["--view=cylindrical", "--fov_deg=361"], "at most 360° in a view that is cylindrical"),
        (["--fov_deg=wide"], "--fov_deg must be a number, got wide"),
        (["--yaw_deg=inf"], "--yaw_deg must be a finite number of degrees, got inf"),
        (["--theta_max_deg=0"], "--theta_max_deg must be above 0° and at most 180°, got 0"),
        (["--rings=100000000"], "--rings must be from 1 to 1024, got 100000000"),
        (["--sectors=0"], "--sectors must be from 1 to 4096, got 0"),
        (["--samples=200,200"], "must be at most 4194304 samples, got 40960000"),
        (["--samples", "10"], r"--samples must be 2 whole numbers, such as 10,10, got \[10\]"),
        (["--view=fish"], "--view must be one of perspective, cylindrical, equirectangular, got"),
        (["--out=lens.gif"], r"must end in one of \.png, \.jpg, .*, got 'lens.gif'"),
        (["--out=lens"], "must end in one of"),
        (["--wings=4"], "(?i)unrecognized arguments: --wings=4"),
    ],
)
def test_misuse_is_refused_before_any_work(folder, capsys, monkeypatch, options, said):
    def work(*arguments, **options):
        raise AssertionError("it was refused too late")

    monkeypatch.setattr(cli, "PolarSample", work)
    picture = folder / "front.png"
    line = refusal(capsys, "lens", "show", folder / "front.json", picture, *options)
    assert line.startswith("darswin") and re.search(said, line)


def test_a_picture_is_what_its_ending_says(folder):
    calib, picture, out = (str(folder / name) for name in ("front.json", "front.png", "a.jpg"))
    main(["lens", "show", calib, picture, "--out", out, "--rings=4", "--sectors=8"])
    assert (folder / "a.jpg").read_bytes().startswith(b"\xff\xd8\xff")
    assert cv2.imread(out).shape == (1080, 1800, 3)


@pytest.fixture
def drawn(monkeypatch):
    """What would be drawn: the sampler, the rays of the view and its title."""
    found = []
    monkeypatch.setattr(plot, "draw_lens", lambda image, lens, *rest: found.append(rest))
    monkeypatch.setattr(plot, "save_figure", lambda figure, out: None)
    return found


@pytest.mark.parametrize(
    "typed", [["3,2"], ["3", "2"], ["[3,2]"], ["[3, 2]"], ["[3,", "2]"], ["3,", "2"], ["(3,2)"]]
)
def test_lists_are_taken_as_people_type_them(folder, drawn, capsys, typed):
    calib, picture = str(folder / "front.json"), str(folder / "front.png")
    main(["lens", "show", "--samp", *typed, calib, picture])
    main(["lens", "show", calib, picture, "--samples=" + typed[0], *typed[1:], "--rings=4"])
    assert [sampler.spec.samples for sampler, *_ in drawn] == [(3, 2), (3, 2)]
    bare = Polynomial([300.0], 1.5)
    (folder / "bare.json").write_text(json.dumps(to_dict(bare)))
    main(["lens", "info", str(folder / "bare.json"), "--image_size", *typed])
    assert "2 × 3 px (width × height)" in capsys.readouterr().out


@pytest.mark.parametrize("view", ["perspective", "cylindrical", "equirectangular"])
@pytest.mark.parametrize("fov", [1e-9, 0.01, 20, 179, None])
@pytest.mark.parametrize("size", [(483, 640), (1, 400), (400, 1)])
def test_views_stay_small(folder, drawn, view, fov, size):
    """The equirectangular one of 0.01° asked for 92 GB."""
    lens = Perspective(100.0, 1.4, image_size=size)
    (folder / "flat.json").write_text(json.dumps(to_dict(lens)))
    cv2.imwrite(str(folder / "flat.png"), np.zeros(size, np.uint8))
    options = [] if fov is None else [f"--fov_deg={fov}"]
    main(["lens", "show", str(folder / "flat.json"), str(folder / "flat.png"), "--view", view,
          "--yaw_deg=20", "--pitch_deg=-7.5", *options])  # fmt: skip
    ((_, rays, title),) = drawn
    assert max(rays.shape[:2]) == 800 and "yaw 20°, pitch -7.5°" in title


def test_terminals_without_utf8(folder, monkeypatch, capsys):
    main(["lens", "info", str(folder / "front.json")])
    usual = capsys.readouterr().out
    for encoding in ("ascii", "latin-1", "cp1252"):
        terminal = io.TextIOWrapper(io.BytesIO(), encoding)
        monkeypatch.setattr(sys, "stdout", terminal)
        main(["lens", "info", str(folder / "front.json")])
        terminal.flush()
        printed = terminal.buffer.getvalue().decode(encoding)
        assert "theta_max" in printed and "350.4, -17.5" in printed
        if encoding == "ascii":
            assert "image           1280 x 966 px (width x height)" in printed.splitlines()
            assert printed.count("deg") == usual.count("°")


def test_what_reads_may_stop_early(folder, monkeypatch, capsys):
    """`darswin lens info … | head -1`."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        main(["lens", "info", str(folder / "front.json")])
    assert not capsys.readouterr().err


NUMBERS = st.sampled_from(
    ["0", "1", "-1", "3", "64", "100000", "9" * 40, "9" * 5000, "1e-300", "1e300", "0.01", "90",
     "179.9", "360", ".nan", ".inf", "-.inf", "x", "", "null", "[1]", "{}", "'", "1:30", "\ud800"]
)  # fmt: skip
LISTS = st.sampled_from(
    ["3,2", "3 2", "[3, 2]", "3", "1,2,3", "0,1", "-1,4", "1e9,2", "", "[", "x,y", "nan,1",
     "9999999999999999999999,1", "4096,4096", "[[1,2],[3,4]]"]
)  # fmt: skip
OPTIONS = st.one_of(
    st.tuples(st.sampled_from(["rings", "sectors", "fov_deg", "yaw_deg", "pitch_deg", "foo",
                               "theta_max_deg", "camera"]), NUMBERS),
    st.tuples(st.sampled_from(["samples", "image_size"]), LISTS),
    st.tuples(st.just("view"), st.sampled_from(["perspective", "cylindrical", "equirectangular"])),
    st.tuples(st.just("spacing"), st.sampled_from(["theta", "tan", "g", "radius", "r"])),
    st.tuples(st.just("out"), st.sampled_from(["a.png", "a.foo", "a", "", "."])),
    st.tuples(st.just("coefficients"), st.sampled_from(["fisheye", "x"])),
)  # fmt: skip
EXTREMES = st.sampled_from([1e-300, 1e-30, 1e-9, 0.5, 1.0, 100.0, 1e30, 1e300])
LENSES = st.builds(
    lambda model, center, affine, size, theta: {**model, "theta_max": theta} | {
        name: value for name, value in (("center", center), ("affine", affine),
                                        ("image_size", size)) if value is not None},
    st.one_of(
        st.builds(lambda f: {"model": "Perspective", "focal": f}, EXTREMES),
        st.builds(lambda f, k: {"model": "KannalaBrandt", "focal": f, "radial": [k]},
                  EXTREMES, st.sampled_from([0, 0.01, 1e300, -1.0])),
        st.builds(lambda f, xi: {"model": "Mei", "focal": f, "xi": xi, "radial": [0, 0]},
                  EXTREMES, EXTREMES),
    ),
    st.sampled_from([None, [0, 0], [-100.0, 50.0], [1e300, -1e300]]),
    st.sampled_from([None, [[1, 0.1], [0, 0.5]], [[1e300, 0], [0, 1]], [[1, 0], [0, 1e-300]]]),
    st.sampled_from([None, [30, 40], [30, 40], [1, 1]]),
    st.sampled_from([1e-300, 1e-9, 0.1, 1.0, 1.5, 1.6, 3.14159]),
)  # fmt: skip


@given(st.sampled_from(["show", "info"]), LENSES, st.lists(OPTIONS, max_size=3), st.booleans())
def test_any_command_line_ends_with_an_answer_or_a_sentence(
    tmp_path_factory, command, lens, options, apart
):
    folder = tmp_path_factory.getbasetemp() / "any"
    folder.mkdir(exist_ok=True)
    (folder / "lens.json").write_text(json.dumps(lens))
    cv2.imwrite(str(folder / "black.png"), np.zeros((30, 40), np.uint8))
    argv = ["lens", command, str(folder / "lens.json")]
    argv += [str(folder / "black.png")] * (command == "show")
    for name, value in options:
        argv += [f"--{name}", *value.split()] if apart else [f"--{name}={value}"]

    def draw(image, lens, sampler, rays, title):
        assert rays.shape[0] * rays.shape[1] <= 800**2 and len(title) < 100
        assert sampler.spec.rings * sampler.spec.sectors * math.prod(sampler.spec.samples) <= 2**22

    code, out, err = 0, io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setattr(plot, "draw_lens", draw)
        patch.setattr(plot, "save_figure", lambda figure, out: None)
        with contextlib.redirect_stderr(err):
            try:
                main(argv)
            except SystemExit as end:
                code = end.code
    if code == 0:
        assert out.getvalue() and not err.getvalue()
    else:
        assert code == 2 and len(err.getvalue().splitlines()) == 1


def test_it_does_not_need_lightning(folder):
    script = (
        "import sys\n"
        "for name in ('lightning', 'torchmetrics', 'tensorboard', 'sklearn'):\n"
        "    sys.modules[name] = None\n"
        "from darswin.__main__ import main\n"
        f"main(['lens', 'info', {str(folder / 'front.json')!r}])\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_pixels_per_degree_are_those_between_neighbours():
    lens = MEI.to(torch.float64)
    theta = torch.tensor([0.0, 0.5, 1.7], dtype=torch.float64)
    along, around = pixels_per_degree(lens, theta)
    step = math.radians(1e-4)
    torch.testing.assert_close(
        along, (lens.project(theta + step) - lens.project(theta - step)) / 2e-4, rtol=1e-5, atol=0
    )
    # Two rays that are a small angle apart on a cone of half angle θ.
    torch.testing.assert_close(around[0], along[0])
    apart = lens.project(theta)[1:] * step / (torch.sin(theta[1:]) * step * 180 / math.pi)
    torch.testing.assert_close(around[1:], apart)


def test_field_of_view_and_sides():
    text = describe(FRONT)
    sides = FRONT.to(torch.float64).side_angles()[0].rad2deg().tolist()
    assert f"{sides[0] + sides[2]:.2f}° across, {sides[1] + sides[3]:.2f}° down" in text
    for side, angle in zip(("left", "top", "right", "bottom"), sides, strict=True):
        assert f"{side} {angle:.2f}°" in text
    assert "between the corners" in text
    assert "the lens ends before the corners" in describe(MEI)
    with pytest.raises(ValueError, match="needs the image_size"):
        describe(Spherical(0.5, 100.0))
    assert "640 × 480 px" in describe(Spherical(0.5, 100.0), (480, 640))


def test_a_principal_point_outside_the_sensor():
    """A part of an image to the right of the principal point."""
    lens = Perspective(100.0, 1.2, center=[-100.5, 49.5], image_size=(100, 100))
    text = describe(lens)
    # The part begins 45° to the right of the axis.
    across = math.degrees(math.atan(2.0)) - 45
    assert f"{across:.2f}° across, 53.13° down, on the row and the column" in text
    assert "left -45.00°" in text and "are integers), outside the sensor" in text
    assert "outside the sensor" not in describe(FRONT)


def test_how_much_is_outside_the_sensor():
    lens = Perspective(100.0, math.atan(0.5), image_size=(100, 100))  # a circle in a square
    assert outside_share(lens.to(torch.float64), (100, 100)) == 0
    # Half of each circle's radii end in the upper half.
    half = lens.replace(center=torch.tensor([[49.5, -0.5]]))
    assert outside_share(half.to(torch.float64), (100, 100)) == pytest.approx(0.5, abs=0.01)
    assert "50.0% of the samples up to θ_max" in describe(half)
    assert "left: the lens ends before" in describe(Polynomial([30.0, 0.0, -3.0], 1.0), (99, 99))


def test_tangential_size():
    assert largest_offset(FRONT) == 0 and "tangential" not in describe(FRONT)
    theta = MEI.theta_max
    azimuth = torch.linspace(0, 2 * math.pi, 721)
    radial = MEI.replace(tangential=None)
    apart = MEI.project_rays(theta, azimuth) - radial.project_rays(theta, azimuth)
    largest = apart.norm(dim=-1).max().item()
    assert largest_offset(MEI) == pytest.approx(largest, rel=1e-3)
    assert f"{largest:.2f} px at most, by tangential" in describe(MEI)


def test_spacings():
    text = describe(FRONT)
    assert "tan θ ends at 90°" in text
    narrow = Spherical.from_fov(0.5, 2.0, 100.0, image_size=(200, 200))
    assert "tan θ ends" not in describe(narrow)
    # Equal steps of the radius: the areas of the rings are as 1, 3, 5, …
    found = patches(narrow, "radius", 16, 64)
    assert found.ratio == pytest.approx(31, rel=1e-3)
    assert found.width == pytest.approx((100 / 16, 100 / 16), rel=1e-3)
    assert found.area[0] == pytest.approx(math.pi * (100 / 16) ** 2 / 64, rel=1e-3)
    ratios = {s: patches(narrow, s, 16, 64).ratio for s in ("theta", "tan", "g")}
    assert best_spacing(narrow, 16, 64) == min(ratios, key=ratios.get)
    halved = narrow.replace(affine=torch.tensor([[[1.0, 0.0], [0.0, 0.5]]]))
    assert patches(halved, "theta", 16, 64).area[0] == pytest.approx(
        patches(narrow, "theta", 16, 64).area[0] / 2
    )


@pytest.mark.parametrize("focal", [1e-300, 1e-200, 1e200, 1e300])
def test_lengths_whose_squares_are_no_numbers(focal):
    usual, extreme = (Perspective(torch.tensor(f, dtype=torch.float64), 1.0) for f in (1.0, focal))
    for spacing in ("theta", "tan", "g", "radius"):
        ratio = patches(usual, spacing, 16, 64).ratio
        assert patches(extreme, spacing, 16, 64).ratio == pytest.approx(ratio, rel=1e-6)
    assert describe(extreme, (100, 100))
