"""`darswin lens`."""

import contextlib
import io
import json
import math
import os
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers import ended, slow_but
from hypothesis import given
from hypothesis import strategies as st
from lens_examples import FILES, FRONT

from darswin.cli.main import main
from darswin.lens import Perspective, from_dict, to_dict
from darswin.views.registry import flat_views


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("front.json").write_text(json.dumps(to_dict(FRONT)))
    picture = np.random.default_rng(0).integers(256, size=(483, 640, 3), dtype=np.uint8)
    cv2.imwrite("front.png", picture)


@pytest.fixture
def lens(capsys):
    """Runs a command and returns what it prints."""

    def run(command):
        capsys.readouterr()
        main(["lens", *command.split()])
        return capsys.readouterr().out

    return run


@pytest.fixture
def shown(monkeypatch):
    """The arguments with which figures are drawn, which are not."""
    calls = []
    monkeypatch.setattr("darswin.viz.plot.draw_lens", lambda *arguments: calls.append(arguments))
    monkeypatch.setattr("darswin.viz.plot.save_figure", lambda figure, out: None)
    return calls


def test_show_writes_a_figure(lens):
    options = "--rings=4 --sectors=8 --samples=[3,2] --view=cylindrical --yaw_deg=20 --spacing=g"
    said = lens(f"show front.json front.png --out new/figure.png {options}")
    assert said == "new/figure.png\n"
    assert cv2.imread("new/figure.png").shape == (1680, 1200, 3)


def test_info_prints_what_the_lens_is(lens):
    said = lens("info front.json")
    assert "966 × 1280 px" in said and "350.4, -17.5" in said
    said = lens("info front.json --theta_max_deg=60 --rings=8")
    assert "60.00° (1.04720 rad)" in said and "for 8 × 64 tokens" in said


def test_convert_fits_and_writes(lens):
    said = lens("convert front.json kb.json --model KannalaBrandt")
    assert "KannalaBrandt up to 95.00°, at most" in said
    found, theta = from_dict(json.loads(Path("kb.json").read_text())), torch.linspace(0, 1.65, 20)
    assert type(found).__name__ == "KannalaBrandt"
    torch.testing.assert_close(found.project(theta), FRONT.project(theta), rtol=0, atol=0.5)
    lens("convert front.json kb.json")
    assert json.loads(Path("kb.json").read_text())["model"] == "Polynomial"


def test_how_far_corners_support_a_lens_is_kept_and_shown(lens, shown):
    Path("made.json").write_text(json.dumps(to_dict(FRONT) | {"supported": 1.25}))
    for command in (
        "convert made.json new.json", "convert made.json new.json --model KannalaBrandt",
        "crop made.json new.json --size 483,640",
    ):  # fmt: skip
        assert "; corners support it up to 71.62° of 95.00°" in lens(command)
        assert json.loads(Path("new.json").read_text())["supported"] == 1.25
    assert "corners" not in lens("convert made.json new.yaml --model KannalaBrandt")
    assert "corners" not in lens("convert new.yaml new.json")
    assert "supported" not in json.loads(Path("new.json").read_text())
    said = lens("info made.json")
    assert "supported       corners support it up to 71.62° of 95.00°\n" in said
    said = lens("info made.json --theta_max_deg 50")
    assert "corners support it up to 50.00° of 50.00°\n" in said
    assert "corners support" not in lens("info front.json")
    lens("show made.json front.png")
    lens("show front.json front.png")
    assert [call[-1] for call in shown] == [1.25, None]


def test_a_box_beyond_the_picture_is_told(lens):
    for box, told in (("0,160,966,966", False), ("100,200,900,900", True), ("-1,0,9,9", True)):
        said = lens(f"crop front.json out.json --box={box}")
        assert ("beyond the picture of 966 × 1280 px" in said) == told


def test_radians_in_place_of_degrees_are_told(shown, capsys):
    main(["lens", "show", "front.json", "front.png", "--fov_deg", "1.5"])
    assert "--fov_deg 1.5 is a narrow view; 1.5 rad would be 85.94°" in capsys.readouterr().err


def test_cameras_of_a_file_are_listed(lens):
    calib = FILES / "kalibr_tumvi.yaml"
    said = lens(f"info {calib}")
    assert "--camera" in said and "principal point" not in said
    assert re.search(r"^  cam0 +KannalaBrandt, 512 × 512 px \(H × W\), up to \d", said, re.M)
    assert re.search(r"^  cam1 ", said, re.M)
    said = lens(f"info {calib} --camera cam1")
    assert "cam1, of 2: cam0, cam1" in said and "principal point" in said


@pytest.mark.parametrize("view", slow_but(flat_views(), "panorama", "perspective", "square"))
def test_views_stay_small(lens, shown, view):
    """The equirectangular one of 0.01° asked for 92 GB."""
    yaw, pitch = (0, 0) if view == "square" else (20, -7.5)
    for size in ((483, 640), (1, 400), (400, 1)):
        Path("flat.json").write_text(json.dumps(to_dict(Perspective(100.0, 1.4, image_size=size))))
        cv2.imwrite("flat.png", np.zeros(size, np.uint8))
        for fov in ("null",) if view == "panorama" else ("1e-9", "20", "179", "null"):
            turn = f"--yaw_deg={yaw} --pitch_deg={pitch}"
            lens(f"show flat.json flat.png --view {view} {turn} --fov_deg {fov}")
    assert len(shown) == (3 if view == "panorama" else 12)
    for _, _, _, made, title, _ in shown:
        assert max(made.size) == 800 and f"yaw {yaw}°, pitch {pitch}°" in title


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_terminals_without_utf8(monkeypatch, encoding):
    terminal = io.TextIOWrapper(io.BytesIO(), encoding)
    monkeypatch.setattr(sys, "stdout", terminal)
    main(["lens", "info", "front.json"])
    terminal.flush()
    printed = terminal.buffer.getvalue().decode(encoding)
    plain = encoding == "ascii"
    size = "966 x 1280 px (H x W)" if plain else "966 × 1280 px (H × W)"
    assert f"image           {size}" in printed.splitlines() and "theta_max" in printed
    assert ("deg" in printed) == plain


def test_what_reads_may_stop_early(monkeypatch, capsys):
    """`darswin lens info … | head -1`."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        main(["lens", "info", "front.json"])
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
    st.tuples(st.sampled_from(["samples", "image_size", "up"]), LISTS),
    st.tuples(st.just("up"), st.sampled_from(["0,-1,0", "1e-320,0,0", "0,.nan,1", "1,1,-1e308"])),
    st.tuples(st.just("view"), st.sampled_from(flat_views())),
    st.tuples(st.just("spacing"), st.sampled_from(["theta", "tan", "g", "radius", "r"])),
    st.tuples(st.just("out"), st.sampled_from(["a.png", "a.foo", "a", "", "."])),
    st.tuples(st.just("coefficients"), st.sampled_from(["fisheye", "x"])),
)  # fmt: skip
EXTREMES = st.sampled_from([1e-300, 1e-30, 1e-9, 0.5, 1.0, 100.0, 1e30, 1e300])
LENSES = st.builds(
    dict.__or__,
    st.one_of(
        st.fixed_dictionaries({"model": st.just("Perspective"), "focal": EXTREMES}),
        st.fixed_dictionaries({"model": st.just("KannalaBrandt"), "focal": EXTREMES,
                               "radial": st.sampled_from([[0], [0.01], [1e300], [-1.0]])}),
        st.fixed_dictionaries({"model": st.just("Mei"), "focal": EXTREMES, "xi": EXTREMES,
                               "radial": st.just([0, 0])}),
    ),
    st.fixed_dictionaries(
        {"theta_max": st.sampled_from([1e-300, 1e-9, 0.1, 1.0, 1.5, 1.6, 3.14159])},
        optional={
            "center": st.sampled_from([[0, 0], [-100.0, 50.0], [1e300, -1e300]]),
            "affine": st.sampled_from([[[1, 0.1], [0, 0.5]], [[1e300, 0], [0, 1]],
                                       [[1, 0], [0, 1e-300]]]),
            "image_size": st.sampled_from([[30, 40], [1, 1]]),
        },
    ),
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

    def draw(image, lens, sampler, view, title, supported):
        assert math.prod(view.size) <= 800**2 and len(title) < 100
        assert sampler.rings * sampler.sectors * math.prod(sampler.samples) <= 2**22

    code, out, err = 0, io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setattr("darswin.viz.plot.draw_lens", draw)
        patch.setattr("darswin.viz.plot.save_figure", lambda figure, out: None)
        with contextlib.redirect_stderr(err):
            try:
                main(argv)
            except SystemExit as end:
                code = end.code
    lines = err.getvalue().splitlines()
    warned = [line for line in lines if ": it describes a picture of " in line]
    assert len(warned) <= (command == "show")
    said = len(lines) - len(warned)
    if code == 0:
        assert out.getvalue() and said == 0
    else:
        assert code == 2 and said == 1


def test_errors_show_names_of_files_as_they_are(capsys):
    """Names in a path are no parameters, even if they look like them."""
    folder = Path("camera=front") / "model='x' `camera` `image_size`"
    folder.mkdir(parents=True)
    (folder / "two.yaml").write_text((FILES / "kalibr_tumvi.yaml").read_text())
    for argv, said in (
        (["lens", "info", str(folder / "none.json")], f"{folder}/none.json: there is no such file"),
        (["fit", "--run", "r", "--data.path", str(folder / "none")], f"no folder {folder}/none"),
        (["lens", "crop", str(folder / "two.yaml"), "o", "--size", "9,9"],
         "two.yaml: it has several cameras, choose one with --camera: 'cam0'"),
    ):  # fmt: skip
        assert said in ended(capsys, 2, main, argv).err
