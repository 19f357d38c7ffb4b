"""Wrong, hostile and large calibrations: an error in one sentence, with little work."""

import json
from itertools import pairwise

import pytest
from helpers import changed, few_calls, refused
from lens_examples import (
    FISHEYE,
    FISHEYES,
    NGP,
    OTHER_CAMERAS,
    file_text,
    flat,
    instant_ngp,
    loads,
    message,
    opencv,
    sized,
)  # fmt: skip

from darswin.lens import from_dict, load_all

K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
D = [-0.3, 0.1, 0.001, -0.002, 0.01]
FRAME = {"fl_x": 800.0, "fl_y": 800.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}
COLMAP = "".join(f"{i} SIMPLE_FISHEYE 640 480 {100 * i} 320 240\n" for i in (1, 2, 5, 7))
TUMVI = file_text("kalibr_tumvi.yaml")

# For each file: its format, and the replaced text, its replacement, and the words of the error.
CHANGED = {
    "woodscape.json": ("WoodScape", (
        ('"k2": -17.5', '"k2": "abc"', "intrinsic.k2 must be a finite number, got 'abc'"),
        ('"k2": -17.5,', "", "string: intrinsic.k2 is missing"),
        ("350.4", "0.0035", "intrinsic.k1 must be in pixels"),
        ("radial_poly", "kb", "must be one of radial_poly, got 'kb'"),
        ("966.0", "966.5", "intrinsic.height must be a whole number of pixels"),
        ("966.0", "NaN", "got nan"),
        ('"poly_order": 4', '"poly_order": 5', "intrinsic.k5 is missing"),
        ('"poly_order": 4', '"poly_order": 0', "intrinsic.poly_order must be 1 to 16"),
        ('"k4"', '"k5": 1.5, "k4"', "does not use the numbers of intrinsic.k5"),
        ("aspect_ratio", "aspect", "does not use the numbers of intrinsic.aspect"),
    )),
    "kitti360_02.yaml": ("KITTI-360 or CamOdoCal", (
        ("MEI", "CATA", "model_type must be one of MEI, KANNALA_BRANDT, PINHOLE, SCARAMUZZA"),
        ("model_type: MEI", "", "model_type is missing"),
        ("   xi: ", "   x: ", "mirror_parameters.xi is missing"),
        ("2.3500000000000001e+00", "-2", "xi must be finite and at least 0"),
        ("gamma1: 1.3900000000000000e+03", "gamma1: 0", "gamma1 must be a finite number above 0"),
    )),
    "camodocal_pinhole.yaml": ("KITTI-360 or CamOdoCal", (
        ("   p1:", "   k3: 0.1\n   p1:", "numbers of distortion_parameters.k3"),
    )),
    "camodocal_kb.yaml": ("KITTI-360 or CamOdoCal", (
        ("projection_p", "distortion_p:\n  k1: 0.1\nprojection_p", "numbers of distortion_p"),
    )),
    "camodocal_scaramuzza.yaml": ("KITTI-360 or CamOdoCal", (
        ("inv_poly_parameters", "inverse", "numbers of inverse"),
        ("p1: 505.8", "p1: 5058.", "inverse polynomial must undo"),
    )),
    "kalibr_ds.yaml": ("Kalibr", (
        ("  intrinsics: [-0.21350274, ", "  intrinsics: [", "cam0.intrinsics must be 6 finite"),
        ("distortion_model: none", "distortion_model: radtan", "must be one of none"),
        ("camera_model: ds", "camera_model: dss", "must be one of pinhole, omni, ds, eucm, got"),
        ("331.24405", "-3", "cam0.intrinsics[2] must be a focal length above 0"),
        ("1080]", "abc]", "cam0.resolution[1] must be a whole number"),
        ("distortion_coeffs: []", "distortion_coeffs: [0.1, 0.2, 0, 0]",
         "none camera does not use the numbers of cam0.distortion_coeffs"),
    )),
    "ros_fisheye.yaml": ("ROS camera_info", (
        ("equidistant", "magic", "got 'magic'; else choose with `coefficients` one of fisheye"),
        ("0.007163902584170265]", "0.009, 0.1]", "got 5"),
        ("image_width: 1280", "", "image_width is missing"),
    )),
    "opencv_fisheye.yaml": ("OpenCV", (
        ("4.2134e+02, ", "-1, ", "camera_matrix must be [fx, skew, cx"),
        ("fisheye_model: 1", "fisheye_model: 7", "must be 0 or 1, got"),
        ("image_width: 1280", "", "image_width is missing"),
    )),
    "opencv_omnidir.xml": ("OpenCV", (("1.2345", "abc", "'abc'"),)),
    "ocamcalib.txt": ("OCamCalib", (
        ("13 605", "12 605", "the inverse polynomial must begin with the number of"),
        ("1440 1440", "", "the center (row and column) must be 2 finite numbers"),
        ("1440 1440\n", "\n1 2\n3 4\n", "it must have 5 lines of numbers"),
        ("723.600000", "x", "the center (row and column)[1] must be a finite number, got 'x'"),
        ("0.998700 0.000420", "", "the affine parameters"),
    )),
    "colmap.txt": ("COLMAP", (
        (" 3008", "", "camera '1', OPENCV_FISHEYE must have 8 parameters"),
        ("OPENCV_FISHEYE", "EQUI", "model must be one of SIMPLE_PINHOLE"),
        ("1504", "NaN", "camera '1', cx must be a finite number, got 'NaN'"),
    )),
    "nerfstudio.json": ("nerfstudio", (
        ("OPENCV_FISHEYE", "EQUI", "camera_model must be one of"),
        ('"fl_x": 851.2, ', "", "fl_x is missing"),
        ('"k4": -0.0001', '"k_4": 0.1', "k3 needs k4"),
        ('"camera_m', '"k5": 0.1, "camera_m', "numbers of k5"),
        ('"camera_m', '"distortion_params": [0.1], "camera_m', "numbers of distortion_params"),
    )),
    "nerfstudio_frames.json": ("nerfstudio", (
        ('"fl_x": 612.0,', "", "frames[2].fl_x is missing"),
        ("images/2", "images/1", "frames[1].file_path appears twice"),
        ('"camera_m', '"is_fisheye": true, "camera_m', "is_fisheye is true, but camera_model is"),
    )),
    "instant_ngp.json": ("nerfstudio", (
        ('"p1": 0.0', '"p1": 0.1', "does not use the numbers of p1"),
        ('"is_f', '"camera_model": "OPENCV", "is_f', "is_fisheye is true, but camera_model is OPE"),
    )),
    "basalt.json": ("basalt", (
        ("[960, 960], ", "", "value0.resolution must be 5 pairs of a width"),
    )),
    "ours.json": ("darswin", (
        ('"focal": 300.0,', "", "focal is missing"),
        ('"radial"', '"k"', "a KannalaBrandt lens has no k, only"),
        ("1.01]]", "1.01, 2]]", "affine must have rows of equal length"),
        ("1.01]]", "0]]", "affine must be invertible"),
        ("1.6", "3.3", "theta_max must be at most 3.14"),
    )),
}  # fmt: skip


def ours(model, **entries):
    return json.dumps(dict(model=model, image_size=[640, 640]) | entries)


def equidistant(**entries):
    return ours("Equidistant", focal=300.0, **entries)


def spherical(**entries):
    return ours("Spherical", xi=0.5, **entries)


OPEN = "may belong to cv2.fisheye (k1 to k4) or to a pinhole (k1, k2, p1, p2)"
FOUR = ("k1", "k2", "k3", "k4")
# A text, the words of its error, and options.
TEXTS = (
    (changed("basalt.json", '"eucm"', '"eucn"'),
     "value0.intrinsics[0].camera_type must be one of ds, eucm", dict(camera=0)),
    (changed("basalt.json", '"k3": -0.214', '"k3": []'),
     "value0.intrinsics[3].intrinsics.k3 must be a finite number, got []", dict(camera=3)),
    (changed("basalt.json", '"k4": 0.083', '"k4": 0.083, "k5": 0.1'), "kb4 camera does not use",
     dict(camera=3)),
    (changed("woodscape.json", "1280.0", "1280.0,,"), "line 17"),
    (changed("woodscape.json", '"k2"', '"k1": 300.0, "k2"'), "'k1' appears twice"),
    (changed("kitti360_02.yaml", "   k2:", "   k1: 0.1\n   k2:"), "'k1' appears twice"),
    (changed("opencv_omnidir.xml", "<xi>", "<xi>1.1</xi><xi>"), "'xi' appears twice"),
    (changed("opencv_omnidir.xml", "</xi>", ""), "it is not valid XML: mismatched tag"),
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
    (flat(*FOUR, model="pinhole"), "the pinhole model's denominator is"),
    (flat(*FOUR, "p1", model="fisheye"), "fisheye model has no p1"),
    (flat(*FOUR, "k5"), "the coefficients of k1, k2, k3, k4, k5 " + OPEN),
    (flat(*FOUR, "D0"), "the fisheye model does not use the numbers of D0"),
    (flat(*FOUR, fx=-1), "fx must be a finite number above 0, got -1"),
    (flat("k1", "k3", "k4", k2=None), "k2 must be a finite number, got None"),
    (flat("k1", "k2", xi="a"), "xi must be a finite number"),
    # The region of the sensor.
    (message((-1, 1)), "binning_x must be a whole number of pixels, 0 to"),
    (message((1, 1.5)), "binning_y must be a whole number of pixels, 0 to"),
    (message((1, 961)), "the binning of 1×961 pixels leaves none"),
    (message(roi=(5, 0, 0, 0)), "roi must be a part of the image of 1 pixel or more"),
    (message(roi=(0, 0, 1281, 9)), "9 × 1281 px (H × W) at x = 0, y = 0"),
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
    # The model is named before the count of its numbers; a missing number has no default.
    (opencv(distortion_model="fov", D=[0.9]), "distortion_model must be one of"),
    *((json.dumps({kind: dict(fx=300, fy=300, cx=9, cy=9, width=19, height=19, alpha=0.5, **more)}),
       said) for kind, more, said in (
        ("Ftheta", {}, "must be one of UCM, EUCM"), ("EUCM", {}, "EUCM.beta is missing"),
        ("UCM", dict(gamma=1), "a UCM camera does not use the numbers of UCM.gamma"))),
    (json.dumps(dict(cam_model="ATAN", cam_fx=0.5)), "cam_model must be one of Pinhole"),
    (json.dumps(dict(camera_angle_x=3.2, w=9, h=9)), "camera_angle_x must be above 0 and below"),
    ("".join(f"{i} 1 2 3 0 0 0 1\n" for i in range(5)), "a table of 5 lines of 8 words, but must"),
    # More coefficients than the model has, unless they are zeros.
    *((FISHEYES[name]([*FISHEYE, *others]), said) for others in ([1e-9], [0.001, 0])
      for name, said in {
        "ROS": "d must have 4 coefficients", "matrix": "D", "rows": "D must", "text": "dist_c",
        "Kalibr": "cam0.distortion_coeffs must be 4 finite numbers",
        "EuRoC": "distortion_coefficients must be 4 finite numbers",
        "by name": "the fisheye model has no k5",
        "CamOdoCal": "does not use the numbers of projection_parameters.k6",
        "nerfstudio": "does not use the numbers of k5",
        "basalt": "does not use the numbers of value0.intrinsics[0].intrinsics.k5"}.items()),
    *((FISHEYES[name]([*FISHEYE, other]), "finite number")
      for name in ("ROS", "Kalibr") for other in (None, "zero", False)),
    *((flat(model="kannala_brandt4", **{name: [*FISHEYE, 0.1]}),
       f"{name} must have 4 coefficients for the fisheye model")
      for name in ("coeffs", "D", "distortion_coefficients")),
    (message().replace("d:", "d: [0.1, 0.2, 0.3]\nold:"),
     "d must be 0 or 4 or 5 or 8 or 12 or 14 finite numbers"),
    (FISHEYES["Kalibr"]([*FISHEYE, 0.0]).replace("equidistant", "radtan"),
     "cam0.distortion_coeffs must be 4 finite numbers"),
    # The size of the image.
    (json.dumps(dict(K=K, D=[0.0] * 5)), "give a smaller theta_max, or the image_size"),
    *((sized(**entries), said) for entries, said in (
        (dict(image_size=[1280]), "image_size must be 2 or 3 finite numbers, got"),
        (dict(image_size=[1280.5, 960]), "image_size[0] must be a whole number of pixels"),
        (dict(shape=[960, 0]), "shape[1] must be a whole number of pixels"),
        (dict(shape=[960, 1280, 2]), "shape[2] must be 1, 3 or 4 channels, got 2"),
        (dict(image_size={"rows": 1, "cols": 3, "data": [1280, 960]}), "must be 1 × 3 numbers"),
        (dict(image_size={"width": 1280}), "image_size.height is missing"),
        (dict(image_width=[[1280, 1]], image_height=960), "image_width must be 1 finite numbers"),
        (dict(image_width=848, imageWidth=640, height=480),
         "image_width and imageWidth must be the"),
        (dict(img_size=[640, 480], image_size=[848, 480]),
         "img_size and image_size must be the same"),
        (dict(frame_size=[640, 480], frameSize=[848, 480]),
         "frame_size and frameSize must be the s"),
    )),
    (flat(*FOUR, Fx=300), "fx and Fx must be the same"),
    # Whether it is a fisheye, in a word.
    *((text, f"{name} must be 0 or 1, got ") for name in ("is_fisheye", "isFisheye", "fisheye")
      for value in ("maybe", 2, None, [1]) for text in (
        json.dumps({k: v for k, v in NGP.items() if k != "is_fisheye"} | {name: value}),
        opencv(D=FISHEYE, **{name: value}))),
    # Angles in our own JSON.
    (file_text("woodscape.json"), "WoodScape calibration in a string: theta_max must be at most",
     dict(theta_max=3.2)),
    ('{"model": "Spherical", "xi": 0.5, "fov": 2.8}', "needs the image_size"),
    (equidistant(theta_max_deg=95, theta_max=1.6), "theta_max and theta_max_deg must not both be"),
    (spherical(fov=2.9, fov_deg=170), "fov and fov_deg must not both be given"),
    (equidistant(theta_max=95), ("at most 3.142 rad ", "(theta_max_deg takes degrees)")),
    (spherical(fov=170), ("fov must be at most 6.283 rad ", "(fov_deg takes degrees)")),
    (equidistant(theta_max_deg=190), "theta_max_deg must be above 0 and at most 180 de"),
    (spherical(fov_deg="wide"), "fov_deg must be above 0 and at most 360 degrees, got 'wide'"),
    (spherical(fov_deg=170, theta_max_deg=80), "a Spherical lens has no theta_max_deg"),
    (spherical(fov_deg=170, focal=80), ("fov_deg takes the place of focal, ", "theta_max")),
    (equidistant(fov=1.7), ("fov takes the place of focal, ", "theta_max is half of fov")),
    (equidistant(supported=71), "supported must be above 0 and at most 3.142 rad, got 71"),
    (ours("Orthographic", fov_deg=200),
     ("fov_deg is 200, but fov must be at most 3.14", " rad (1", "°)")),
    (ours("Orthographic", focal=9, theta_max_deg=100),
     "theta_max_deg is 100, but theta_max must be at most 1.57"),
    (ours("Polynomial", coefficients=[300.0, 2.0], fov_deg=170),
     "a Polynomial lens has no fov_deg, only coefficients"),
)  # fmt: skip


def of_other_cameras():
    """Files of instant-ngp that name another camera, for all frames or inside the second one."""
    for is_fisheye in (None, True, False):
        for other in OTHER_CAMERAS:
            content = json.loads(instant_ngp(is_fisheye=is_fisheye))
            frame, off = content["frames"][0], dict.fromkeys(other, 0)
            name = next(name for name, value in other.items() if value)
            said = f"{name} names another camera than"
            yield json.dumps(content | other), f": {said} SIMPLE_PINHOLE"
            frames = [frame | off, frame | other | {"file_path": "2"}]
            yield json.dumps(content | dict(frames=frames)), f"frames[1].{said}", dict(camera="2")


CASES = [*TEXTS, *of_other_cameras(), *(
    (changed(name, old, new), (said, f"{form} calibration in a string: "))
    for name, (form, rows) in CHANGED.items() for old, new, said in rows
)]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: str(case[1])[-40:])
def test_errors_say_what_is_wrong(case):
    text, said, *options = case
    found = refused("calibration in a string: ", loads, text, **dict(*options))
    said = (said,) if isinstance(said, str) else said
    assert all(part in found for part in said) and len(found) < 1000


def test_dicts_are_refused_like_files():
    for entries, said in (
        (dict(fov_deg=170, fov=2.9), "fov and fov_deg must not both be given"),
        (dict(fov_deg="wide"), "fov_deg must be a number of degrees, got 'wide'"),
        (dict(fov_deg=400), "fov_deg is 400, but fov must be"),
        (dict(focal=9, theta_max_deg=190), "theta_max_deg is 190, but theta_max must be"),
    ):
        refused(said, from_dict, dict(model="Equidistant") | entries, (100, 100))


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in pairwise("abcdefghij")
)  # fmt: skip


def frames(count, **shared):
    entries = [{"file_path": f"{i}.png"} | FRAME | {"fl_x": 800.0 + i % 9} for i in range(count)]
    return json.dumps({"frames": entries} | shared)


@pytest.mark.parametrize(("text", "message"), [
    ('{"a":' * 100_000, "nested"),
    ("a: " + "[" * 100_000, "nested"),
    ("<a>" * 50_000 + "</a>" * 50_000, "XML must be at most 256 KiB"),
    ("<a>" * 30_000 + "</a>" * 30_000, "XML must be at most 16 elements deep"),
    ("a: " + "1" * 300_000, "YAML must be at most 128 KiB"),
    (BOMB, "The formats are"),
    (BOMB + "model_type: MEI\nmirror_parameters: {xi: 1}\nimage_height: *j\n",
     "image_height must be a whole number"),
    (BOMB + "Ks: *j\nis_fisheye: []\ndistortions: *j\nimage_sizes: *j", "must have as many"),
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
    ("1 " * 1_000_000, "a table of 1 lines of 1000000 words, but must have the lines of"),
    pytest.param("2 1 1\n" * 400_000, "it must have 5 lines", marks=pytest.mark.slow),
    ("".join(f"{i} A 9 9\n" for i in range(9_000)), "camera '0', model must be one of"),
    ("1 A\n" * 2_000_000, "a table must be at most 4096 KiB"),
    ("".join(f"{i} FOV\n" for i in range(9_000)), "camera '0', must have an id"),
    pytest.param("1 FOV\n" * 100_000, "camera '1' appears twice", marks=pytest.mark.slow),
    ("".join(f"{i} SIMPLE_PINHOLE 9 9 9 4 4\n" for i in range(20_000)), "to 10000 cameras"),
    (json.dumps({"model": "Polynomial", "coefficients": [1.0] * 20_000}), "at most 64 numbers"),
    (frames(9_000), "several cameras"),
    pytest.param(frames(120_000), "1 to 10000 cameras, got 120000", marks=pytest.mark.slow),
])  # fmt: skip
def test_hostile_files_end_soon_and_run_nothing(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with few_calls(1_000_000):
        found = refused(message, loads, text)
    assert len(found) < 1000 and not list(tmp_path.iterdir())


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
