"""Wrong, hostile and large files: an error in one sentence, with little work."""

import contextlib
import io
import json
import random
import zipfile
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
from helpers import changed, few_calls
from lens_examples import FILES, f64, file_text, flat, loads, message, opencv

from darswin.lens import load, load_all

K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
D = [-0.3, 0.1, 0.001, -0.002, 0.01]
FRAME = {"fl_x": 800.0, "fl_y": 800.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}
COLMAP = "".join(f"{i} SIMPLE_FISHEYE 640 480 {100 * i} 320 240\n" for i in (1, 2, 5, 7))
TUMVI = file_text("kalibr_tumvi.yaml")


# For each file: the replaced text, its replacement, and the words of the error.
CHANGED = {
    "woodscape.json": (
        ('"k2": -17.5', '"k2": "abc"', "intrinsic.k2 must be a finite number, got 'abc'"),
        ('"k2": -17.5,', "", "WoodScape calibration in a string: intrinsic.k2 is missing"),
        ("350.4", "0.0035", "intrinsic.k1 must be in pixels"),
        ("radial_poly", "kb", "must be one of radial_poly, got 'kb'"),
        ("966.0", "966.5", "intrinsic.height must be a whole number of pixels"),
        ("966.0", "NaN", "got nan"),
        ('"poly_order": 4', '"poly_order": 5', "intrinsic.k5 is missing"),
        ('"poly_order": 4', '"poly_order": 0', "intrinsic.poly_order must be 1 to 16"),
        ("1280.0", "1280.0,,", "line 17"),
        ('"k4"', '"k5": 1.5, "k4"', "does not use the numbers of intrinsic.k5"),
        ("aspect_ratio", "aspect", "does not use the numbers of intrinsic.aspect"),
        ('"k2"', '"k1": 300.0, "k2"', "'k1' appears twice"),
    ),
    "kitti360_02.yaml": (
        ("MEI", "CATA", "model_type must be one of MEI, KANNALA_BRANDT, PINHOLE, SCARAMUZZA"),
        ("   xi: ", "   x: ", "mirror_parameters.xi is missing"),
        ("2.3500000000000001e+00", "-2", "xi must be finite and at least 0"),
        ("gamma1: 1.3900000000000000e+03", "gamma1: 0", "gamma1 must be a finite number above 0"),
        ("   k2:", "   k1: 0.1\n   k2:", "'k1' appears twice"),
    ),
    "camodocal_pinhole.yaml": (
        ("   p1:", "   k3: 0.1\n   p1:", "numbers of distortion_parameters.k3"),
    ),
    "camodocal_kb.yaml": (("projection_p", "distortion_p:\n  k1: 0.1\nprojection_p",
                           "numbers of distortion_p"),),
    "camodocal_scaramuzza.yaml": (
        ("inv_poly_parameters", "inverse", "numbers of inverse"),
        ("p1: 505.8", "p1: 5058.", "inverse polynomial must undo"),
    ),
    "kalibr_ds.yaml": (
        ("  intrinsics: [-0.21350274, ", "  intrinsics: [", "cam0.intrinsics must be 6 finite"),
        ("distortion_model: none", "distortion_model: radtan", "must be one of none"),
        ("camera_model: ds", "camera_model: dss", "must be one of pinhole, omni, ds, eucm, got"),
        ("331.24405", "-3", "cam0.intrinsics[2] must be a focal length above 0"),
        ("1080]", "abc]", "cam0.resolution[1] must be a whole number"),
        ("distortion_coeffs: []", "distortion_coeffs: [0.1, 0.2, 0, 0]",
         "none camera does not use the numbers of cam0.distortion_coeffs"),
    ),
    "ros_fisheye.yaml": (
        ("equidistant", "magic", "got 'magic'; else choose with `coefficients` one of fisheye"),
        ("0.007163902584170265]", "0.009, 0.1]", "got 5"),
    ),
    "opencv_fisheye.yaml": (
        ("4.2134e+02, ", "-1, ", "camera_matrix must be [fx, skew, cx"),
        ("fisheye_model: 1", "fisheye_model: 7", "must be 0 or 1, got"),
        ("image_height: 960", "", "image_height is missing"),
    ),
    "opencv_omnidir.xml": (
        ("</xi>", "", "it is not valid XML: mismatched tag"),
        ("1.2345", "abc", "'abc'"),
        ("<xi>", "<xi>1.1</xi><xi>", "'xi' appears twice"),
    ),
    "ocamcalib.txt": (
        ("13 605", "12 605", "the inverse polynomial must begin with the number of"),
        ("1440 1440", "", "the center (row and column) must be 2 finite numbers"),
        ("1440 1440\n", "\n1 2\n3 4\n", "it must have 5 lines of numbers"),
        ("723.600000", "x", "the center (row and column)[1] must be a finite number, got 'x'"),
    ),
    "colmap.txt": (
        (" 3008", "", "camera '1', OPENCV_FISHEYE must have 8 parameters"),
        ("OPENCV_FISHEYE", "EQUI", "model must be one of SIMPLE_PINHOLE"),
        ("1504", "NaN", "camera '1', cx must be a finite number, got 'NaN'"),
    ),
    "nerfstudio.json": (
        ("OPENCV_FISHEYE", "EQUI", "camera_model must be one of"),
        ('"fl_y": 852.9,', "", "fl_y is missing"),
        ('"h": 1920, ', "", "h is missing"),
        ('"k4": -0.0001', '"k_4": 0.1', "k3 needs k4"),
        ('"camera_m', '"k5": 0.1, "camera_m', "numbers of k5"),
        ('"camera_m', '"distortion_params": [0.1], "camera_m', "numbers of distortion_params"),
    ),
    "nerfstudio_frames.json": (
        ('"fl_x": 612.0,', "", "frames[2].fl_x is missing"),
        ("images/2", "images/1", "frames[1].file_path appears twice"),
        ('"camera_m', '"is_fisheye": true, "camera_m', "is_fisheye is true, but camera_model is"),
    ),
    "basalt.json": (("[960, 960], ", "", "value0.resolution must be 5 pairs of a width"),),
    "ours.json": (
        ('"focal": 300.0,', "", "focal is missing"),
        ('"radial"', '"k"', "a KannalaBrandt lens has no k, only"),
        ("KannalaBrandt", "Kb", "unknown lens model 'Kb'. The models are"),
        ("1.01]]", "1.01, 2]]", "affine must have rows of equal length"),
        ("1.01]]", "0]]", "affine must be invertible"),
        ("1.6", "3.3", "theta_max must be at most 3.14"),
    ),
}  # fmt: skip
OPEN = "may belong to cv2.fisheye (k1 to k4) or to a pinhole (k1, k2, p1, p2)"
# A text, the words of its error, and options.
TEXTS = (
    (changed("basalt.json", '"eucm"', '"eucn"'),
     "value0.intrinsics[0].camera_type must be one of ds, eucm", dict(camera=0)),
    (changed("basalt.json", '"k3": -0.214', '"k3": []'),
     "value0.intrinsics[3].intrinsics.k3 must be a finite number, got []", dict(camera=3)),
    (changed("basalt.json", '"k4": 0.083', '"k4": 0.083, "k5": 0.1'), "kb4 does not use",
     dict(camera=3)),
    (TUMVI.replace("camera_model", "model", 1), "cam0.camera_model is missing", dict(camera=0)),
    (COLMAP + "2 SIMPLE_FISHEYE 640 480 400 320 240", "camera '2' appears twice"),
    ("{}", 'The formats are darswin, WoodScape'), ("[1, 2]", "it must be a mapping"),
    ("word", "it must be a mapping"), ("", "it must not be empty"), (" \n\t\n", "be empty"),
    ("a: [1, 2", "not valid YAML: line 1: expected"), ("a: 1\n---\nb: 1", "not valid YAML"),
    ("a: \x00", "it is not valid YAML"), ('a: "\\UFFFFFFFF"', "it is not valid YAML"),
    # The choice of the camera.
    (TUMVI, "several cameras, choose one with `camera`: 'cam0', 'cam1'"),
    *((TUMVI, "one of 'cam0', 'cam1', or its number", dict(camera=camera))
      for camera in ("cam2", 2, "2", -1, 1.5)),
    *((COLMAP, "camera must be one of '1', '2', '5', '7', got", dict(camera=camera))
      for camera in ("0", "3", 3, "-1", "4", True, 1.0)),
    # The choice of the model.
    (opencv(D=D[:4]), "the coefficients of D " + OPEN),
    (opencv(D=D[:4]), "xi is missing", dict(coefficients="omnidir")),
    (opencv(D=D[:4]), "`coefficients` must be one of fisheye, pinhole, omnidir",
     dict(coefficients="x")),
    (file_text("woodscape.json"), "the file names the models", dict(coefficients="fisheye")),
    (flat("k1", "k2"), "the coefficients of k1, k2 " + OPEN),
    (flat(), "a camera without coefficients " + OPEN),
    (flat("k1", "k2", "k3", "k4", model="pinhole"), "the pinhole model's denominator is"),
    (flat("k1", "k2", "k3", "k4", "p1", model="fisheye"), "fisheye model has no p1"),
    (flat("k1", "k2", "k3", "k4", "k5"), "the coefficients of k1, k2, k3, k4, k5 " + OPEN),
    (flat("k1", "k2", "k3", "k4", "D0"), "the fisheye model does not use the numbers of D0"),
    (flat("k1", "k2", "k3", "k4", fx=-1), "fx must be a finite number above 0, got -1"),
    (flat("k1", "k3", "k4", k2=None), "k2 must be a finite number, got None"),
    (flat("k1", "k2", model="magic"), "got 'magic'"),
    (flat("k1", "k2", xi="a"), "xi must be a finite number"),
    # The region of the sensor.
    (message((-1, 1)), "binning_x must be a whole number of pixels, 0 to"),
    (message((1, 1.5)), "binning_y must be a whole number of pixels, 0 to"),
    (message((1, 961)), "the binning of 1×961 pixels leaves none"),
    (message(roi=(5, 0, 0, 0)), "roi must be a part of the image of 1 pixel or more"),
    (message(roi=(0, 0, 1281, 9)), "1281×9 px at (0, 0)"),
    (message(roi=(-1, 0, 10, 9)), "roi.x_offset must be a whole number of pixels"),
    (message(roi=(0, 0, "a", 9)), "roi.width must be a whole number"),
    # Coefficients that are missing or have an unknown name are never ignored.
    *((text, said, dict(coefficients=model)) for model in (None, "pinhole") for text, said in (
        (opencv(distortion_model="plumb_bob", lens=D), "D is missing"),
        (opencv(fisheye_model=1), "write D: [] if the camera has none"),
        (opencv(xi=1.2), "distortion_coefficients or D is missing"),
        (opencv(distortion_model="plumb_bob", D0=D), "must be in one entry, such as"),
        (opencv(model="pinhole", k1=-0.3, k2=0.1), "got k1, k2"),
        (opencv(D=D, my_distortion_x=[0.1]), "got my_distortion_x"),
        (opencv(D=D, rational_coefs={"data": "0.1 0.2"}), "got rational_coefs"),
        (opencv(D=D, dist_coeffs=D), "must be in one entry, got D, dist_coeffs"),
        (opencv(distortion={"k1": 0.1, "k2": 0.2}, fisheye=0), "distortion.data is missing"),
        (opencv(fisheye=0, D="", ts=D), "D must be 0 or 4 or 5 or 8 or 12 or 14 finite numbers"),
        (opencv(fisheye=0, D={"data": ""}, ts=D), "D.data must be 0 or 4 or 5"),
        (opencv(fisheye=0, D=[*D, 0, 0, 0, 0, 0, 0, 0, 0.1, 0]), "tilted sensors"),
        (opencv(D={"rows": 1, "cols": 5, "data": D[:4]}, fisheye=0), "must be 1 × 5 numbers"),
        (opencv(D=D, camera_matrix=[501.0, *K[1:]]), "K and camera_matrix must be the same"),
    )),
)  # fmt: skip
CASES = [*TEXTS, *(
    (changed(name, old, new), said) for name, rows in CHANGED.items() for old, new, said in rows
)]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[1][-40:])
def test_errors_say_what_is_wrong(case):
    text, said, *options = case
    with pytest.raises(ValueError) as error:
        loads(text, **dict(*options))
    assert said in str(error.value) and "calibration in a string: " in str(error.value)
    assert len(str(error.value)) < 1000


def test_paths(tmp_path):
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.json")
    for path in (tmp_path, "/dev/zero"):
        with pytest.raises(ValueError, match="it must be a file"):
            load(path)
    (tmp_path / "large").write_bytes(b" " * ((16 << 20) + 1))
    with pytest.raises(ValueError, match=r"calibration /.*large: it must be at most 16 MiB"):
        load(tmp_path / "large")
    (tmp_path / "latin").write_bytes("name: caf\xe9".encode("latin-1"))
    with pytest.raises(ValueError, match=r"must be text in UTF-8: .* 0xe9"):
        load(tmp_path / "latin")
    marked = b"\xef\xbb\xbf" + FILES.joinpath("woodscape.json").read_bytes()
    (tmp_path / "marked").write_bytes(marked)
    assert load(tmp_path / "marked").r_max.item() > 600


# -- the two polynomials of OCamCalib -----------------------------------------------------------

DIRECT = "-2.210000e+02 0 1.850000e-03 -3.600000e-06 1.420000e-08"
# Fitted to the direct one by least squares, like in the toolbox, to 0.01 px.
INVERSE = ("320.321696 164.783531 -14.771348 31.623465 8.044023 -1.452569 13.685554 -1.071077 "
           "-9.709705 2.309502 5.628928 1.507985")  # fmt: skip


def ocam(direct, inverse):
    lines = [f"{len(p.split())} {p}" for p in (direct, inverse) if p]
    return "\n".join([*lines, "240 376", "1 0 0", "480 752"])


def test_ocamcalibs_polynomials_are_held_against_each_other():
    assert loads(ocam(DIRECT, INVERSE), dtype=f64).project(0.0).abs().item() < 0.02
    assert type(loads(ocam(DIRECT, ""))).__name__ == "OCam"
    lower = changed("camodocal_scaramuzza.yaml", "SCARAMUZZA", "scaramuzza")
    assert type(loads(lower)).__name__ == "OCamInverse"  # the spelling in LF-VIO's files
    for old, new in (("320.3", "3203"), ("320.3", "318.3"), ("164.7", "1647"), ("-1.45", "-14.5")):
        with pytest.raises(ValueError, match=r"must undo the direct one .* px for [\d.]+ px"):
            loads(ocam(DIRECT, INVERSE.replace(old, new)))
    for old, new in (("e+02", "e+021"), ("e-03", "e-031")):
        with pytest.raises(ValueError, match=r"must undo|such that a₀"):
            loads(ocam(DIRECT.replace(old, new), INVERSE))


# -- hostile and large files --------------------------------------------------------------------

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in pairwise("abcdefghij")
)  # fmt: skip


def frames(count, **shared):
    entries = [{"file_path": f"{i}.png"} | FRAME | {"fl_x": 800.0 + i % 9} for i in range(count)]
    return json.dumps({"frames": entries} | shared)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a":' * 100_000, "nested"),
        ("a: " + "[" * 100_000, "nested"),
        ("<a>" * 50_000 + "</a>" * 50_000, "XML must be at most 256 KiB"),
        ("<a>" * 30_000 + "</a>" * 30_000, "XML must be at most 16 elements deep"),
        ("a: " + "1" * 300_000, "YAML must be at most 128 KiB"),
        (BOMB, "The formats are"),
        (BOMB + "model_type: MEI\nmirror_parameters: {xi: 1}\nimage_height: *j\n",
         "image_height must be a whole number"),
        (BOMB + "K: *j\n", "K must be 9 finite numbers"),
        (BOMB + "camera_model: pinhole\ndistortion_model: none\nintrinsics: *j\n", "must be 4 fin"),
        ("a: &a [*a]\n", "it is not valid YAML"),
        ("a: &a {b: *a}\nK: *a\n", "it is not valid YAML"),
        ('<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "b">]><l><K>&a;</K></l>', "DOCTYPE"),
        ('<!DOCTYPE l SYSTEM "file:///etc/passwd"><l/>', "DOCTYPE"),
        ('{"K": ' + "9" * 5000 + "}", "it is not valid JSON"),
        ('{"intrinsic": {"model": "radial_poly", "poly_order": 1, "k1": 1' + "0" * 400 + "}}",
         "k1 must be a fin"),
        ("K: !!python/object/apply:os.system ['touch pwned']\n", "its entries are K, but expected"),
        ("K: !!python/object/apply:os.system ['touch pwned']\nD: []", "K must be 9 finite numbers"),
        ("!!python/object/apply:os.system ['touch pwned']\n", "must be a mapping"),
        ("1 " * 1_000_000, "it is a table of 1 lines, but a table must have 5 lines of numbers"),
        ("2 1 1\n" * 400_000, "it must have 5 lines"),
        ("".join(f"{i} A 9 9\n" for i in range(9_000)), "camera '0', model must be one of"),
        ("1 A\n" * 2_000_000, "a table must be at most 4096 KiB"),
        ("".join(f"{i} FOV\n" for i in range(9_000)), "camera '0', must have an id"),
        ("1 FOV\n" * 100_000, "camera '1' appears twice"),
        ("".join(f"{i} SIMPLE_PINHOLE 9 9 9 4 4\n" for i in range(20_000)), "to 10000 cameras"),
        (json.dumps({"model": "Polynomial", "coefficients": [1.0] * 20_000}), "at most 64 numbers"),
        (frames(9_000), "several cameras"),
        (frames(120_000), "1 to 10000 cameras, got 120000"),
    ],
)  # fmt: skip
def test_hostile_files_end_soon_and_run_nothing(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with few_calls(1_000_000), pytest.raises(ValueError, match=message) as error:
        loads(text)
    assert len(str(error.value)) < 1000 and not list(tmp_path.iterdir())


@pytest.mark.slow
def test_large_files_are_read_soon(tmp_path):
    with few_calls(3_000_000):
        assert loads(frames(9_000), camera="8888.png").focal.item() == 805
    with few_calls(3_000_000):
        assert loads(frames(120_000, **FRAME)).focal.item() == 800
    rows = [f"{i} OPENCV_FISHEYE 640 480 {300 + i / 10} 310 320 240 0.01 -0.002 0.0003 -0.0001\n"
            for i in range(1, 1001)]  # fmt: skip
    path = tmp_path / "cameras.txt"
    path.write_text("".join(rows))
    with few_calls(3_000_000):
        load_all(path)
    # The first bad camera is named, also with little work.
    rows[700] = rows[700].replace("310", "1e-300")
    path.write_text("".join(rows))
    with (
        few_calls(3_000_000),
        pytest.raises(ValueError, match=r"COLMAP calibration .*: camera '701': "),
    ):
        load_all(path)


def test_cameras_that_are_read_together_are_those_read_alone(tmp_path):
    rows = [f"{i} OPENCV_FISHEYE 640 480 {300 + i} 310 320 240 0.01 -0.002 0.0003 0\n"
            for i in range(9)]  # fmt: skip
    path = tmp_path / "cameras.txt"
    path.write_text("".join(rows))
    lenses = load_all(path, dtype=f64)
    for camera in ("0", "5", "8"):
        alone = load(path, camera=camera, dtype=f64)
        for name, value in alone._tensors().items():
            torch.testing.assert_close(getattr(lenses[camera], name), value, rtol=1e-12, atol=0)
    for bad in (6, 8):
        rows[bad] = rows[bad].replace("310", "1e-300")
    path.write_text("".join(rows))
    with pytest.raises(ValueError, match=r"COLMAP calibration .*: camera '6': "):
        load_all(path)
    assert load(path, camera="5").focal.item() == 305


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
def test_a_calibration_with_its_image_points(suffix, tmp_path):
    path = tmp_path / f"c.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    points = np.random.default_rng(0).uniform(0, 1000, (60, 1000)).astype(np.float32)
    storage.write("image_points", points)
    storage.write("camera_matrix", np.reshape(K, (3, 3)))
    storage.write("distortion_coefficients", np.array([D]))
    storage.release()
    assert path.stat().st_size > 600_000
    with few_calls(3_000_000):
        lens = load(path, image_size=(480, 640), dtype=f64)
    assert lens.radial.tolist() == [[-0.3, 0.1, 0.01]]
    # So many numbers as coefficients are an error.
    text = path.read_text().replace("image_points", "D").replace("distortion_coefficients", "x")
    with pytest.raises(ValueError, match="must be 0 or 4 or 5 or 8 or 12 or 14 finite numbers, go"):
        loads(text)


def test_binary_files_that_are_wrong(tmp_path):
    whole, path = (FILES / "colmap_all.bin").read_bytes(), tmp_path / "cameras.bin"

    def error_of(data):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"calibration .*cameras\.bin") as error:
            load_all(path)
        return str(error.value)

    for length in range(8, len(whole), 31):
        assert "it ends within camera" in error_of(whole[:length])
    assert "it has 3 extra bytes after its 17 cameras" in error_of(whole + b"abc")
    assert "cameras, got 4294967295" in error_of(b"\xff" * 4 + whole[4:])
    assert "to 16 (EUCM), got 17" in error_of(whole[:12] + bytes([17]) + whole[13:])
    random.seed(0)
    for _ in range(12):  # any bytes give a lens or an error
        data = bytearray(whole)
        data[random.randrange(len(data))] = random.randrange(256)
        path.write_bytes(data)
        with contextlib.suppress(ValueError):
            load(path, camera=random.choice([*range(1, 16), 17, 18]), theta_max=0.3)


def test_damaged_archives_are_refused_in_a_sentence(tmp_path):
    path, data = tmp_path / "calib.npz", io.BytesIO()
    np.savez(data, K=np.reshape(K, (3, 3)), D=D)
    rng = np.random.default_rng(0)
    for _ in range(30):
        broken = bytearray(data.getvalue())
        for place in rng.integers(4, len(broken), rng.integers(1, 4)):
            broken[place] = rng.integers(256)
        path.write_bytes(broken[: rng.integers(4, 2 * len(broken))])
        try:
            load(path)
        except ValueError as error:
            assert str(path) in str(error) and "\n" not in str(error)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "no array")
    with pytest.raises(ValueError, match=r"calib\.npz: it is a zip archive, but must be a cal"):
        load(path)


def test_arrays_of_objects_are_named(tmp_path):
    """They are not unpickled. One that should hold numbers is an error, others are left out."""
    path, shape = tmp_path / "calib.npz", dict(width=1280, height=960, fisheye_model=1)
    objects = np.array([[{"a": 1}]], dtype=object)
    numbers = dict(K=np.reshape(K, (3, 3)), D=np.array(D[:4]))
    for name in numbers:
        np.savez(path, **numbers | {name: numbers[name].astype(object)}, **shape)
        with pytest.raises(ValueError, match=rf"{name} must be .*, got \['dtype', 'object'\]"):
            load(path)
    np.savez(path, **numbers, rvecs=objects, notes=objects, **shape)
    assert load(path).radial.tolist() == [pytest.approx(D[:4])]
