"""Lenses that do not fit their pictures are doubted; real ones and crops are not."""

import itertools
import json
import math
import re
import warnings

import pytest
import torch
from lens_examples import FILES, FISHEYE, FRONT, PLUMB_BOB, K, f64, flat, loads, message, opencv

from darswin.cli.main import main
from darswin.lens import (
    BrownConrady,
    Equidistant,
    ImplausibleLens,
    KannalaBrandt,
    Lens,
    Orthographic,
    Perspective,
    Spherical,
    Stereographic,
    load,
    load_all,
    save,
    to_dict,
)
from darswin.lens.files.load import Calibration
from darswin.lens.plausible import doubts
from darswin.views import make_view

H, W = 1080, 1920
F, CX, CY = 850.0, 965.0, 533.0  # px
PIXEL = 0.0031  # mm


def fisheye(fx=F, cx=CX, cy=CY, fy=None, size=(H, W), model=KannalaBrandt, radial=FISHEYE) -> Lens:
    affine = None if fy is None else [[1.0, 0.0], [0.0, fy / fx]]
    return model(fx, radial, None, [cx, cy], affine=affine, image_size=size)


def pinhole(*plane) -> Lens:
    lens = fisheye(*plane, model=BrownConrady, radial=[0.02, 0.001])
    return lens.with_theta_max(lens.side_angles().amax(1))


def scaled(unit):
    return F * unit, CX * unit, CY * unit


UNITS = {"mm": PIXEL, "cm": PIXEL / 10, "m": PIXEL / 1000, "inches": PIXEL / 25.4}
# The arguments of `fisheye` and `pinhole`, and a pattern of the doubt.
WRONG = [
    *(((F * unit,), rf"px per degree .*|circle .*; the focal length would fit .*\bin {name}\b")
      for name, unit in UNITS.items()),
    *((scaled(unit), rf"far from the middle; the lengths would fit .*\bin {name}\b")
      for name, unit in UNITS.items()),
    ((F / W,), "the focal length would fit .*normalised by the width"),
    ((F / H,), "the focal length would fit .*normalised by the height"),
    (scaled(1 / W), "the lengths would fit normalised by the width$"),
    (scaled(1 / H), "the lengths would fit normalised by the height$"),
    ((F / W, CX / W, CY / H, F / H), "the lengths would fit normalised by the width and height$"),
    ((F / W, CX / W - 0.5, CY / W - 0.5), "normalised by the width$"),  # the file's origin is ½
    ((F, 5.2, -6.1), r"\(5.2, -6.1\), far from the middle; it may be measured from the middle$"),
    (scaled(2), r"the principal point at \(1930, 1066\), far .* would fit 21\d\d × 38\d\d px"),
    (scaled(1 / 2), r"far from the middle; .* would fit 53\d × 95\d px .*, or the picture is a cr"),
    (scaled(1 / 4), r"far from the middle; .* would fit 2\d\d × 47\d px .*, or the picture is a c"),
    ((F, CX, CY, F, (W, H)), "; width and height seem to be swapped"),
    ((F, 640, 480, F, (1280, 960)), "; width and height seem to be swapped"),
    ((F, 640, 512, F, (1280, 1024)), "; width and height seem to be swapped"),
    ((F, 655, 500, F, (1280, 1024)), "; width and height seem to be swapped"),
    ((F, 0.503, 0.494), "; it may be normalised by the width and height or measured from the mid"),
    ((F, 0.503, 0.278), "; it may be normalised by the width or measured from the middle$"),
    ((F, 965, -2000), r"far from the middle, unless the picture is a crop"),
    ((1e8,), r"an image circle of 19\d+ px up to θ_max = 0.0005"),
]  # fmt: skip


@pytest.mark.parametrize("make", [fisheye, pinhole])
@pytest.mark.parametrize(("arguments", "pattern"), WRONG, ids=str)
def test_lengths_in_another_unit_are_doubted(make, arguments, pattern):
    lens = make(*arguments)
    (doubt,) = doubts(lens.with_theta_max(lens.side_angles().amax(1)))
    assert re.search(pattern, doubt) and re.match(r"a picture of \d+ × \d+ px \(H", doubt), doubt
    assert "\n" not in doubt and len(doubt) < 250


@pytest.mark.parametrize(("lens", "pattern"), [
    (Stereographic(2.8, image_size=(H, W)), "a θ_max of 180°; the focal .* in mm$"),
    (Orthographic(2.8, image_size=(H, W)), "circle of 5.6 px up to θ_max = 90°; .* in mm$"),
    (Spherical(0.9, 5.0, image_size=(H, W)), "; the focal length would fit in mm$"),
    (Equidistant(F, 0.029, image_size=(H, W)), r"θ_max = 1.66\d°; θ_max may be in another"),
    (Equidistant(3e4, 1.7, image_size=(H, W)), "an image circle of 102000 px up to θ_max"),
    (Perspective(F, 1.57, image_size=(H, W)), "a θ_max of 89.95°"),
    (KannalaBrandt(F, [2.0, -0.1, 3.0], 1.0, image_size=(H, W)), r"change \d\d-fold, as after"),
    (BrownConrady(F, [9.0], 0.9, image_size=(H, W)), r"change \d\d-fold, as after"),
    (Equidistant(2.1), "^0.037 px per degree, as if the lengths were in mm; they are in px$"),
])  # fmt: skip
def test_every_part_of_a_lens_is_held_against_its_picture(lens, pattern):
    assert re.search(pattern, doubts(lens)[0]), doubts(lens)[0]


def test_a_view_holds_a_lens_without_a_size_against_the_picture():
    view = make_view("mercator", (8, 8))
    with pytest.warns(ImplausibleLens, match="describes a picture of .* would fit in mm"):
        view.at(Equidistant(2.1, 1.5), (H, W))
    with warnings.catch_warnings(action="error"):
        view.at(Equidistant(F, 1.5), (H, W))


def genuine():
    """Lenses of examples and files, and crops and resizings of them."""
    for path in [*FILES.iterdir(), FILES.parents[2] / "examples" / "room.json"]:
        if path.name != "README.md":
            file = Calibration.read(path)
            for name in file.names:
                yield f"{path.name} {name}", file.lens(name, image_size=(960, 1280), dtype=f64)
    yield "front", FRONT
    for text in (flat("k1", "k2", "k3", "k4"), opencv(D=PLUMB_BOB), message()):
        yield text, loads(text, dtype=f64)
    yield "small circle", Equidistant(60.0, 1.7, image_size=(900, 1600))
    yield "two circles", KannalaBrandt(320.0, [0.01], 1.7, [480, 480], image_size=(960, 1920))
    yield "telephoto", Perspective(30_000.0, 0.04, image_size=(1080, 1920))
    yield "wide pinhole", Perspective(400.0, 1.2, image_size=(1080, 1920))


@pytest.mark.slow
def test_real_lenses_and_their_crops_are_not_doubted():
    lenses = dict(genuine())
    assert len(lenses) > 60
    for name, lens in lenses.items():
        height, width = (round(side) for side in lens.image_size[0].tolist())
        assert doubts(lens) == [""], (name, doubts(lens))
        assert doubts(lens.resized(0.05)) == [""], name
        for top, left, rows, columns in (
            (round(0.3 * height), 0, height - round(0.3 * height), width),
            (0, round(0.15 * width), height, round(0.6 * width)),
            (-height // 2, -width // 2, 2 * height, 2 * width),
        ):
            found = doubts(lens.cropped(top, left, rows, columns))
            assert found == [""] or name in ("small circle", "two circles"), (name, found)


RARE = {
    **{f"circle of {r} px beside the middle": Equidistant(
        r / 1.66, 1.66, [540, 300], image_size=(H, W)) for r in (500, 250)},
    **{f"one of four circles, {x} {y}": Equidistant(
        480 / 1.6, 1.6, [x, y], image_size=(2000, 2000))
       for x in (499.5, 1499.5) for y in (499.5, 1499.5)},
    "circle cut below": fisheye(700.0, 960, 1050),
    "circle cut at the left": fisheye(700.0, 60, 540),
    "shifted lens": pinhole(1500.0, 960, -20),
    "lens shifted to the right": pinhole(1500.0, 2000, 540),
    "wide pinhole": pinhole(150.0, 959.5, 539.5),
    "small circle in a large picture": fisheye(110.0, 1919.5, 1079.5, size=(2160, 3840)),
    **{f"telescope of {degrees}°": Perspective(
        W / math.radians(degrees), math.radians(degrees) / 2, image_size=(H, W))
       for degrees in (1, 0.5, 0.1, 0.03)},
    "almost square": fisheye(400.0, 530, 520, size=(1040, 1000)),
}  # fmt: skip


@pytest.mark.parametrize("name", RARE)
def test_rare_but_real_lenses_are_not_doubted(name):
    lens = RARE[name]
    assert doubts(lens) == [""]
    assert doubts(lens.with_theta_max(torch.minimum(lens.side_angles().amax(1), lens.theta_max)))


def test_any_numbers_get_a_doubt_of_one_line():
    extremes = (1e-300, 1e-30, 1e-3, 1.0, 1e30, 1e300)
    for focal, x, y, stretch in itertools.product(extremes, extremes, (-1.0, *extremes), extremes):
        affine, focal = [[stretch, 0.0], [0.0, 1.0]], torch.tensor(focal, dtype=f64)
        lens = Equidistant(focal, 1.0, [x, y], affine=affine, image_size=(480, 640))
        (doubt,) = doubts(lens)
        assert doubt.startswith("a picture of 480 × 640 px (H ") and len(doubt) < 300, doubt


def test_a_batch_is_doubted_lens_by_lens():
    lens = Equidistant([300.0, 0.9, 310.0], 1.6, image_size=(640, 640))
    assert [bool(doubt) for doubt in doubts(lens)] == [False, True, False]
    assert doubts(lens) == [doubts(lens[i])[0] for i in range(3)]
    assert doubts(Equidistant([30.0, 40.0])) == ["", ""]  # without a picture
    rows = torch.tensor([[200.0, 0.0], [50.0, 300.0]], requires_grad=True)
    assert len(doubts(Equidistant(torch.tensor(9.0), center=rows, image_size=(9, 9)))) == 2


def warned(read):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        read()
    assert all(issubclass(warning.category, ImplausibleLens) for warning in found)
    return [str(warning.message) for warning in found]


def in_mm(**entries):
    return opencv(K=[[1.3, 0, 643.1], [0, 1.3, 478.6], [0, 0, 1]], D=FISHEYE, **entries)


@pytest.mark.parametrize("given", [{}, {"theta_max": 0.3}, {"dtype": f64}], ids=str)
def test_loading_warns_once_in_one_line(tmp_path, given):
    path = tmp_path / "mm.json"
    path.write_text(in_mm(fisheye_model=1))
    for read in (load, load_all):
        (said,) = warned(lambda read=read: read(path, **given))
        assert said.startswith(f"OpenCV calibration {path}: it describes a picture of 960 × 1280")
        assert "the focal length would fit in mm" in said and "\n" not in said
    # The size may come from the caller, whose θ_max is not in doubt.
    path.write_text(re.sub('"(width|height)": [0-9]+, ', "", in_mm(fisheye_model=1)))
    (said,) = warned(lambda: load(path, **given))
    assert said.endswith(
        "describes 0.023 px per degree, as if the lengths were in mm; they are in px"
    )
    assert len(warned(lambda: load(path, image_size=(960, 1280), **given))) == 1
    path.write_text(opencv(D=FISHEYE, fisheye_model=1, rms_error=0.4))
    assert not warned(lambda: load(path, theta_max=0.01))
    for name in ("avg_reprojection_error", "RMS_error", "rms"):
        path.write_text(opencv(D=FISHEYE, fisheye_model=1, **{name: 7.25}))
        (said,) = warned(lambda: load(path, **given))
        assert said.endswith("with corners that its calibration missed by 7.25 px")


def test_many_cameras_give_one_warning(tmp_path, capsys):
    path = tmp_path / "cameras.txt"
    focals = (300, 1.1, 310, 1.2, 1.3)
    path.write_text("".join(f"{i} FOV 640 480 {f} {f} 320 240 0.9\n" for i, f in enumerate(focals)))
    (said,) = warned(lambda: load_all(path))
    assert "camera '1': it describes" in said and said.endswith("(and 2 more cameras)")
    assert not warned(lambda: load(path, camera=2)) and warned(lambda: load(path, camera=3))
    main(["lens", "info", str(path)])
    lines = re.findall("^ .*looks wrong.*$", capsys.readouterr().out, re.M)
    assert len(lines) == 3 and re.match("  1  .*; looks wrong: .* in mm", lines[0])


@pytest.mark.parametrize(("binning", "roi"), [
    ((0, 0), (101, 52, 640, 483)), ((2, 2), (0, 0, 300, 200)), ((3, 2), (900, 700, 380, 260)),
    ((2, 2), (0, 0, 0, 0)),
])  # fmt: skip
def test_the_region_of_a_message_is_a_crop(binning, roi):
    assert not warned(lambda: loads(message(binning, roi)))
    quarter = json.dumps([[value / 4 for value in row] for row in K[:2]] + [[0, 0, 1]])
    wrong = message(binning, roi).replace("k:", f"k: {quarter}\nold:")
    assert "far from the middle" in warned(lambda: loads(wrong))[0]


def test_lenses_made_in_python_and_their_crops_do_not_warn(tmp_path):
    def work():
        lens = Equidistant(1.9, 1.7, image_size=(H, W)).cropped(900, 900, 10, 10)
        lens.resized(2.0)
        save(lens, tmp_path / "lens.json")
        to_dict(lens)

    assert not warned(work) and warned(lambda: load(tmp_path / "lens.json"))


def test_the_command_line_says_what_looks_wrong(tmp_path, capsys):
    path = tmp_path / "mm.json"
    path.write_text(in_mm(fisheye_model=1))
    main(["lens", "info", str(path)])
    printed = capsys.readouterr()
    assert re.search("^looks wrong +a picture of .* would fit .*in mm", printed.out, re.M)
    assert not printed.err  # it is said once
    main(["lens", "convert", str(path), str(tmp_path / "out.json")])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("darswin: OpenCV calibration") and "would fit in mm" in line
