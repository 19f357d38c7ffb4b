import json
import shutil
from functools import partial

import pytest
import torch
from helpers import refused
from lens_pictures import CALIBRATIONS, WOODSCAPE

from darswin.data import Calibrations
from darswin.lens import Tabulated, from_dict, load, load_all
from darswin.lens.orientation import upright

SIZE = (121, 160)
SPHERICAL = {"model": "Spherical", "xi": 0.5, "focal": 60.0, "theta_max": 1.4}
TANGENTIAL = {"model": "KannalaBrandt", "focal": 60.0, "radial": [0.1], "tangential": [0.1, 0],
              "theta_max": 1.0}  # fmt: skip


@pytest.fixture
def root(tmp_path):
    """Three empty pictures in two folders, and calibrations beside them."""
    for name in ("a/0.png", "a/1.png", "b/c/2.png"):
        (tmp_path / "p" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "p" / name).touch()
    for name in ("woodscape.json", "opencv_stereo.json", "ocamcalib.txt", "kalibr_ds.yaml"):
        shutil.copy(CALIBRATIONS / name, tmp_path)
    return tmp_path / "p"


def listed(root, entries, name="lenses.json"):
    file = root.parent / name
    file.write_text(entries if isinstance(entries, str) else json.dumps(entries))
    return file


def same(one, other):
    assert str(one) == str(other)


def test_one_calibration_is_of_all_pictures(root):
    lenses = Calibrations(WOODSCAPE, root)
    expected = load(WOODSCAPE).in_picture(SIZE)
    for picture in (root / "a/0.png", root / "b/c/2.png", None, "elsewhere.png"):
        same(lenses.lens_of(picture, SIZE), expected)
    assert lenses.lens_of(None, SIZE) is lenses.lens_of(None, SIZE)  # read once
    assert lenses.cameras_of([None, root / "a/0.png"]).tolist() == [0, 0]
    same(lenses.lens_of(root / "a/0.png", SIZE[::-1], 6), upright(expected, 6))
    said = r"0\.png: the calibration is for 966 × 1280 .*woods"
    refused(said, lenses.lens_of, root / "a/0.png", (100, 100))


def test_a_camera_of_several(root):
    file = CALIBRATIONS / "colmap_all.txt"
    name = next(iter(load_all(file)))
    size = tuple(int(side) for side in load(file, camera=name).image_size[0])
    same(Calibrations(file, root, name).lens_of(None, size), load(file, camera=name))
    refused("several cameras, choose one", Calibrations, file, root)
    refused("camera must be one of", Calibrations, file, root, "none")


def test_coefficients_that_the_file_does_not_name(root):
    matrix = [421.3, 0, 643.1, 0, 420.9, 478.6, 0, 0, 1]
    content = dict(K=matrix, D=[-0.021, 0.0043, -0.0012, 0.00008], width=1280, height=960)
    file = listed(root, content, "kd.json")
    refused("the coefficients of D may be", Calibrations, file, root)
    for model in ("fisheye", "pinhole"):
        entry = {"file": "kd.json", "coefficients": model}
        for lenses in (
            Calibrations(file, root, coefficients=model),
            Calibrations(listed(root, {".": entry}), root),
            Calibrations(None, root, coefficients=model, files={root / "a/0.png": file}),
        ):
            same(lenses.lens_of(root / "a/0.png", (960, 1280)), load(file, coefficients=model))


def test_a_lens_as_json(root):
    lens = Calibrations(json.dumps(SPHERICAL), root).lens_of(None, SIZE)
    same(lens, from_dict(dict(SPHERICAL, center=[79.5, 60.0], image_size=SIZE)))
    wide = Calibrations('{"model": "Equidistant", "fov": 3.0}', root)
    assert wide.lens_of(None, (40, 60)).r_max.item() == pytest.approx(20)
    assert wide.lens_of(None, (80, 60)).r_max.item() == pytest.approx(30)


def test_the_most_specific_entry_counts(root):
    entries = {".": "woodscape.json", "a/": SPHERICAL, "a/1.png": {"file": "woodscape.json"}}
    pictures = [root / name for name in ("a/0.png", "a/1.png", "b/c/2.png")]
    lenses = Calibrations(listed(root, entries), root)
    assert len(lenses.cameras) == 2
    assert lenses.cameras_of([*pictures, None]).tolist() == [1, 0, 0, 0]
    own = listed(root, SPHERICAL, "own.json")
    lenses = Calibrations(listed(root, entries), root, files={pictures[2]: own})
    assert lenses.cameras_of([*pictures, None]).tolist() == [2, 1, 0, 1]
    assert lenses.camera_of(pictures[2]).calibration == str(own)


def test_lenses_of_several_models_are_curves(root):
    entries = {"a": "woodscape.json", "b/c": {"file": "kalibr_ds.yaml", "camera": "cam0"}}
    camera = load(CALIBRATIONS / "kalibr_ds.yaml", camera="cam0")
    size = tuple(int(side) for side in camera.image_size[0])
    lenses = Calibrations(listed(root, entries), root)
    lens = lenses.lens_of(root / "b/c/2.png", size)
    assert isinstance(lens, Tabulated) and isinstance(lenses.lens_alone(root / "a"), Tabulated)
    theta = torch.linspace(0, 0.95 * camera.theta_max.item(), 20)
    torch.testing.assert_close(lens.project(theta), camera.project(theta), rtol=1e-4, atol=1e-3)
    alone = Calibrations(listed(root, {".": "woodscape.json"}), root)
    assert not isinstance(alone.lens_of(root / "a/0.png", SIZE), Tabulated)


OTHER_PROGRAMS = r"calibration .*profile\.json: (?!.*must name a folder)"


@pytest.mark.parametrize(
    ("name", "entries", "message"),
    [
        *(("lenses.json", *row) for row in (
            ({}, "is empty"),
            ({"a": 3}, r'"a" must be a calibration file.*got 3'),
            ({"a": ["woodscape.json"]}, r'"a" must be a calibration file'),
            ({"a": {"camera": "1"}}, r'"a" must be a calibration file'),
            ({"a": {"model": "Fish"}}, r'in .*"a".*unknown lens model .Fish'),
            ({"a": {"model": "Spherical", "xi": 0.5}}, r'in .*"a".*focal'),
            ({"nowhere": "woodscape.json"}, r'"nowhere" must name a folder or a picture in .*p'),
            ({"../p/a": "woodscape.json"}, "must name a folder or a picture"),
            ({"/": "woodscape.json"}, "must name a folder or a picture"),
            ({"a": "woodscape.json", "a/": "woodscape.json"}, '"a/" occurs twice'),
            ({"a": "none.json"}, r'"a" .*none\.json, which is not a file'),
            ({"a": {"file": "opencv_stereo.json", "camera": "x"}}, "camera must be one of"),
            ("[]", "it must be a mapping"),
            ("{", "calibration"),
            ({"a": SPHERICAL, "b": TANGENTIAL}, r'in .*"b": cameras of several lens models'),
        )),
        # A list of cameras may have any name if a place or all calibrations exist.
        *(("my cameras.json", *row) for row in (
            ({"a": "none.json"}, r"none\.json, which is not a file"),
            ({"typo": "woodscape.json"}, '"typo" must name a folder'),
            ({"typo": SPHERICAL, "b": SPHERICAL}, '"typo" must name a folder'),
            ({".": "woodscape.json", "b": 3}, '"b" must be a calibration file'),
        )),
        # JSON files of other programs are no lists of cameras.
        *(("profile.json", content, OTHER_PROGRAMS) for content in (
            {"name": "A camera", "lens": "wide", "calibration": {"width": 3840}},
            {"camera": {"model": "GoPro", "focal_mm": 2.1}},
            {"camera": "none.json"},
            {"a": 3, "b": [1, 2]},
            {"x" * 5000: "y" * 5000, "\0": "\0"},
            {"images": [], "annotations": []},
        )),
    ],
)  # fmt: skip
def test_a_wrong_list_of_cameras_is_named(root, name, entries, message):
    file = listed(root, entries, name)
    refused(message, Calibrations, file, root, error=(ValueError, OSError))


@pytest.mark.parametrize(
    "entries", [{"a": "woodscape.json"}, {".": SPHERICAL}, {"a": SPHERICAL, "b": SPHERICAL}]
)
def test_a_list_of_cameras_may_have_any_name(root, entries):
    lenses = Calibrations(listed(root, entries, "my cameras.json"), root)
    assert lenses.camera_of(root / "a/0.png")


def test_what_has_no_lens(root):
    file = listed(root, {"a": "woodscape.json"})
    lenses = Calibrations(file, root)
    for picture in (root / "b/c/2.png", root.parent / "x.png", None):
        said = f"no lens for {picture or 'pictures without a file'}"
        refused(said, lenses.camera_of, picture)
    own = Calibrations(None, files={root / "a/0.png": WOODSCAPE})
    refused(r"1\.png has no lens", own.camera_of, root / "a/1.png")
    refused("none.json", Calibrations, root / "none.json", root, error=FileNotFoundError)
    for name, value in (("camera", "0"), ("coefficients", "fisheye")):
        said = rf'`{name}` is for one .*"file": …, "{name}"'
        refused(said, partial(Calibrations, file, root, **{name: value}))
    for lens in ("170", "-1.5", "60°", "90 deg", 170):
        said = f'`lens` {lens} is a number, .*"fov_deg": 170'
        refused(said, Calibrations, lens, root)
