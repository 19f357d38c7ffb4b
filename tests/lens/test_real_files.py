"""Files as strangers have them: their names, spellings, sizes and ends."""

import gc
import json
import math
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers import changed
from lens_examples import assert_projects, loads

from darswin.cli.main import main
from darswin.lens import EnhancedUnified, load, load_all

FILES = Path(__file__).parent / "files"
f64 = torch.float64

COLMAP = "".join(f"{i} SIMPLE_FISHEYE 640 480 {100 * i} 320 240\n" for i in (1, 2, 5, 7))


# -- which camera -------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [1, 2, 5, 7])
def test_a_camera_that_is_called_by_a_number_is_that_one(camera, tmp_path, capsys):
    path = tmp_path / "cameras.txt"
    path.write_text(COLMAP)
    assert load(path, camera=str(camera)).focal.item() == 100 * camera
    assert load(path, camera=camera).focal.item() == 100 * camera
    assert load(path, camera=str(camera), image_size=(480, 640)).focal.item() == 100 * camera
    main(["lens", "info", str(path), "--camera", str(camera)])
    printed = capsys.readouterr().out
    assert f"focal         {100 * camera}\n" in printed
    assert f"camera          {camera}, of 4: 1, 2, 5, 7\n" in printed
    assert "COLMAP, with the centre of the upper left pixel at (0.5, 0.5)\n" in printed


@pytest.mark.parametrize("camera", ["0", "3", 3, "-1", "4", True, 1.0])
def test_where_names_are_numbers_a_number_is_a_name(camera):
    with pytest.raises(ValueError, match="camera must be one of '1', '2', '5', '7', got"):
        loads(COLMAP, camera=camera)


def test_a_number_chooses_among_cameras_of_other_names(capsys):
    path = FILES / "kalibr_tumvi.yaml"
    focal = load(path, camera="cam1").focal.item()
    assert load(path, camera="1").focal.item() == load(path, camera=1).focal.item() == focal
    assert load(path, camera="1", image_size=(512, 512)).focal.item() == focal
    main(["lens", "info", str(path), "--camera=1"])
    assert "camera          cam1, of 2: cam0, cam1\n" in capsys.readouterr().out
    with pytest.raises(ValueError, match="one of 'cam0', 'cam1', or its number, got '2'"):
        load(path, camera="2")


def test_another_camera_is_not_taken_for_one_that_lacks_something():
    text = FILES.joinpath("kalibr_tumvi.yaml").read_text().replace("camera_model", "model", 1)
    with pytest.raises(ValueError, match=r"cam0\.camera_model is missing"):
        loads(text)
    assert loads(text, camera="cam1").focal.item() == pytest.approx(190.44, abs=0.01)


# -- coefficients by any name -------------------------------------------------------------------

D = [-0.3, 0.1, 0.001, -0.002, 0.01]
BASE = dict(width=640, height=480, K=[500.0, 0, 320, 0, 510, 240, 0, 0, 1])


@pytest.mark.parametrize(
    "key",
    ["D", "d", "distortion_coefficients", "distortion_coefs", "distortion_coeffs", "distCoeffs",
     "distCoefs", "dist_coeff", "distCoeff", "dist", "distortion", "coeffs", "coefficients",
     "Distortion_Parameters", "distortion_params", "camera_distortion",
     "cameraDistortionCoefficients"],
)  # fmt: skip
@pytest.mark.parametrize("model", [dict(distortion_model="plumb_bob"), dict(fisheye_model=0), {}])
def test_coefficients_are_read_by_all_their_names(key, model):
    lens = loads(json.dumps(BASE | model | {key: D}), dtype=f64)
    assert lens.radial.tolist() == [[-0.3, 0.1, 0.01]]
    assert lens.tangential.tolist() == [[0.001, -0.002]]


@pytest.mark.parametrize("layout", [np.ravel, np.atleast_2d, lambda d: np.atleast_2d(d).T])
@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
def test_coefficients_of_any_layout(layout, suffix, tmp_path):
    storage = cv2.FileStorage(str(tmp_path / f"c.{suffix}"), cv2.FILE_STORAGE_WRITE)
    storage.write("K", np.reshape(BASE["K"], (3, 3)))
    storage.write("D", layout(np.array(D)))
    storage.release()
    lens = load(tmp_path / f"c.{suffix}", image_size=(480, 640), dtype=f64)
    assert len(lens) == 1 and lens.radial.tolist() == [[-0.3, 0.1, 0.01]]
    nested = layout(np.array(D)).tolist()
    assert loads(json.dumps(BASE | {"D": nested}), dtype=f64).radial.tolist() == [[-0.3, 0.1, 0.01]]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        # A model, and no coefficients under any name.
        (dict(distortion_model="plumb_bob", lens_shape=D), "D is missing.*distortion_model, lens"),
        (dict(fisheye_model=1), r"D is missing; write D: \[\] if the camera has none.*fisheye_mod"),
        (dict(xi=1.2), "distortion_coefficients or D is missing"),
        # Coefficients that nobody reads.
        (dict(distortion_model="plumb_bob", D0=D), "must stand in one entry, .*got D0"),
        (dict(model="pinhole", k1=-0.3, k2=0.1), "must stand in one entry, .*got k1, k2"),
        (dict(D=D, my_distortion_x=[0.1]), "must stand in one entry, .*got my_distortion_x"),
        (dict(D=D, rational_coefs={"data": "0.1 0.2"}), "one entry, .*got rational_coefs"),
        (dict(D=D, dist_coeffs=D), "coefficients must stand in one entry, got D, dist_coeffs"),
        (dict(distortion={"k1": 0.1, "k2": 0.2}, fisheye=0), "distortion.data is missing"),
        (dict(fisheye=0, D="", ts=D), "D must be 0 or 4 or 5 or 8 or 12 or 14 finite numbers, got"),
        (dict(fisheye=0, D={"data": ""}, ts=D), "D.data must be 0 or 4 or 5 or .*, got None"),
        # Matrices that do not agree with themselves or each other.
        (dict(D={"rows": 1, "cols": 5, "data": D[:4]}, fisheye=0), "must be 1 × 5 numbers, got 4"),
        (dict(D=D, camera_matrix=[501.0, *BASE["K"][1:]]), "K and camera_matrix must be the same"),
    ],
)
def test_coefficients_are_never_left_out(entries, message):
    for model in (None, "pinhole"):
        with pytest.raises(ValueError, match=message):
            loads(json.dumps(BASE | entries), model=model)


def test_what_is_no_coefficient_may_stand_beside_them():
    others = dict(D=D, R=[1.0] * 9, P1=[1.0] * 12, R1=[1.0] * 9, board_distance=0.3, p=[1.0] * 12,
                  undistorted_size=[9, 9], distortion_model="plumb_bob", dist_note="none", d2=[],
                  avg_reprojection_error=0.3)  # fmt: skip
    assert loads(json.dumps(BASE | others)).radial.shape == (1, 3)
    # No coefficients: the file says so, or the user.
    assert type(loads(json.dumps(BASE | dict(D=[], fisheye=0)))).__name__ == "Perspective"
    assert type(loads(json.dumps(BASE), model="fisheye")).__name__ == "Equidistant"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (changed("woodscape.json", '"k4"', '"k5": 1.5, "k4"'), "order 4 has no place .*ic.k5$"),
        (changed("woodscape.json", "aspect_ratio", "aspect"), "no place for .*intrinsic.aspect$"),
        (changed("nerfstudio.json", '"k4": -0.0001', '"k_4": 0.1'), "k4 is missing beside k3"),
        (changed("nerfstudio.json", '"camera_m', '"k5": 0.1, "camera_m'), "OPENCV_FISHEYE .* k5$"),
        (changed("nerfstudio.json", '"camera_m', '"distortion_params": [0.1], "camera_m'),
         "has no place for the numbers of distortion_params$"),
        (changed("nerfstudio_frames.json", '"camera_m', '"is_fisheye": true, "camera_m'),
         "is_fisheye is true, and camera_model must not be OPENCV"),
        (changed("kalibr_ds.yaml", "distortion_coeffs: []", "distortion_coeffs: [0.1, 0.2, 0, 0]"),
         "none camera has no place for the numbers of cam0.distortion_coeffs"),
        (changed("camodocal_pinhole.yaml", "   p1:", "   k3: 0.1\n   p1:"), "no place .*ers.k3$"),
        (changed("camodocal_kb.yaml", "projection_p", "distortion_p:\n  k1: 0.1\nprojection_p"),
         "KANNALA_BRANDT has no place for the numbers of distortion_p$"),
        (changed("basalt.json", '"k4": 0.083', '"k4": 0.083, "k5": 0.1'), r"kb4 has no .*\.k5$"),
        # Twice there.
        (changed("kitti360_02.yaml", "   k2:", "   k1: 0.1\n   k2:"), "'k1' stands there twice"),
        (changed("woodscape.json", '"k2"', '"k1": 300.0, "k2"'), "'k1' stands there twice"),
        (changed("opencv_omnidir.xml", "<xi>", "<xi>1.1</xi><xi>"), "'xi' stands there twice"),
        (COLMAP + "2 SIMPLE_FISHEYE 640 480 400 320 240", "one camera '2', got two"),
    ],
)  # fmt: skip
def test_no_number_of_a_camera_is_left_out(text, message):
    with pytest.raises(ValueError, match=message):
        loads(text, camera="cam3" if "cam3" in message or "kb4" in message else None)


# -- formats that were refused ------------------------------------------------------------------


def test_what_ros2_topic_echo_prints():
    lens = load(FILES / "ros2_echo.yaml", dtype=f64)
    assert lens.image_size.tolist() == [[480, 640]] and lens.center.tolist() == [[317.8, 236.4]]
    assert lens.denominator.tolist() == [[0.548, -0.071, 0.029]]
    text = FILES.joinpath("ros2_echo.yaml").read_text()
    for end in ("", "\n---\n---\n\n", "...\n", "\r\n---\r\n"):
        assert loads(text + end, dtype=f64).radial.tolist() == lens.radial.tolist()
    with pytest.raises(ValueError, match="it is no YAML: line"):
        loads(text + text)


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
def test_a_calibration_with_its_image_points(suffix, tmp_path):
    path = tmp_path / f"c.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    points = np.random.default_rng(0).uniform(0, 1000, (60, 500, 2))
    storage.write("image_points", points.astype(np.float32).reshape(60, 1000))
    storage.write("camera_matrix", np.reshape(BASE["K"], (3, 3)))
    storage.write("distortion_coefficients", np.array([D]))
    storage.write("grid_points", points[:1])
    storage.release()
    assert path.stat().st_size > 600_000
    start = time.process_time()
    lens = load(path, image_size=(480, 640), dtype=f64)
    assert time.process_time() - start < 2 and lens.radial.tolist() == [[-0.3, 0.1, 0.01]]
    # As many numbers as coefficients are an error, not none.
    text = path.read_text().replace("image_points", "D").replace("distortion_coefficients", "x")
    with pytest.raises(ValueError, match="must be 0 or 4 or 5 or 8 or 12 or 14 finite numbers, go"):
        loads(text)


@pytest.mark.parametrize("k", [0.23, 0.001, 40.0, -0.2])
def test_colmaps_division_model(k):
    """Its inverse, p / (1 + k |p|²), is the definition; and COLMAP's own where it is installed."""
    lens = loads(f"1 DIVISION 640 480 300 310 320.5 240.5 {k}", dtype=f64)
    limit = 1 / math.sqrt(k) if k > 0 else 2.0  # of |p|
    radius = torch.linspace(0, min(limit, 2.0), 50, dtype=f64)[:-1]
    theta = torch.atan2(radius, 1 + k * radius**2)
    azimuth = torch.linspace(-3, 3, 49, dtype=f64)
    pixels = radius[:, None] * torch.stack((300 * azimuth.cos(), 310 * azimuth.sin()), -1)
    expected = pixels + torch.tensor([320.0, 240.0])
    whole = lens.with_theta_max(None)
    assert (theta <= whole.theta_limit + 2e-6).all()
    torch.testing.assert_close(whole.project_rays(theta, azimuth), expected, rtol=0, atol=1e-9)
    found, _ = whole.unproject_pixels(expected)
    torch.testing.assert_close(found, theta, rtol=0, atol=1e-12)
    if k > 0:
        assert whole.theta_limit.item() == pytest.approx(math.atan(0.5 / math.sqrt(k)), abs=2e-6)
        assert whole.unproject(torch.tensor([300 * limit * 1.01], dtype=f64)).isnan().all()


@pytest.mark.parametrize("alpha", [0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("beta", [-0.3, -50.0, -1e-3])
@pytest.mark.parametrize("dtype", [torch.float32, f64])
def test_enhanced_unified_with_a_beta_below_0(alpha, beta, dtype):
    lens = EnhancedUnified(torch.tensor(alpha, dtype=dtype), beta, 300.0)
    theta = lens.theta_limit * torch.linspace(0, 1, 200, dtype=dtype)
    radius = lens.project(theta)
    assert radius.isfinite().all() and (radius.diff() > 0).all()
    torch.testing.assert_close(lens.unproject(radius), theta)
    if alpha < 1:  # where √(β sin² θ + cos² θ) is 0
        end = 300 / ((1 - alpha) * math.sqrt(-beta))
        assert lens.unproject(torch.tensor([1.01, 2.0, 100.0], dtype=dtype) * end).isnan().all()


def test_colmaps_brown_conrady_is_opencvs_model():
    text = "1 BROWN_CONRADY 640 480 500 320.5 240.5 -0.05 0.01 -0.003 0.001 -0.002"
    lens = loads(text, dtype=f64)
    rng = np.random.default_rng(0)
    points = np.append(rng.uniform(-0.4, 0.4, (100, 2)), np.ones((100, 1)), 1)
    matrix = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    d = np.array([-0.05, 0.01, 0.001, -0.002, -0.003])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, d)
    assert_projects(lens, points, expected[:, 0])


# -- OCamCalib's two polynomials ----------------------------------------------------------------

# Direct and inverse polynomials, and image sizes. The inverse ones are fitted to the direct ones by
# least squares, as the toolbox does, and miss by up to 0.01 px.
FITTED = [
    ("-2.210000e+02 0 1.850000e-03 -3.600000e-06 1.420000e-08",
     "320.321696 164.783531 -14.771348 31.623465 8.044023 -1.452569 13.685554 -1.071077 -9.709705 "
     "2.309502 5.628928 1.507985", "480 752"),
    ("-5.420000e+02 0 8.200000e-04 -4.400000e-07 5.900000e-10",
     "800.485893 477.158493 8.713002 61.028784 37.611285 2.129263 5.951466 15.005939 7.768372 "
     "1.164425", "1080 1920"),
    ("-2.580000e+02 0 1.840000e-03 -2.700000e-06 5.300000e-09",
     "400.469064 260.688736 6.197710 16.182514 25.866755 6.881237 -3.294447 4.692043 3.560401 "
     "-0.809067 0.180399 0.945170 0.288907", "720 1280"),
]  # fmt: skip


def ocam(direct, inverse, size):
    lines = [f"{len(p.split())} {p}" for p in (direct, inverse)]
    height, width = map(int, size.split())
    return "\n".join([*lines, f"{height / 2} {width / 2}", "1 0 0", size])


@pytest.mark.parametrize(("direct", "inverse", "size"), FITTED)
def test_ocamcalibs_polynomials_are_held_against_each_other(direct, inverse, size):
    lens = loads(ocam(direct, inverse, size), dtype=f64)
    assert lens.project(0.0).abs().item() < 0.02
    for wrong in (0, 1, 5):
        words = inverse.split()
        words[wrong] = str(10 * float(words[wrong]))
        with pytest.raises(ValueError, match="inverse polynomial must give back the direct one's"):
            loads(ocam(direct, " ".join(words), size))
        words = direct.split()
        words[0 if wrong == 0 else 2] += "1"  # a digit to the exponent
        with pytest.raises(ValueError, match=r"inverse polynomial must give back|such that a₀"):
            loads(ocam(" ".join(words), inverse, size))


def test_an_inverse_that_leaves_the_middle_of_the_image_out():
    """Fitted to radii from 127 px on: -40 px at θ = 0. Without it the direct polynomial holds."""
    direct = "-2.530000e+02 0 1.620000e-03 -1.550000e-06 3.900000e-09"
    inverse = ("395.543775 260.322718 17.811437 23.778806 21.331835 7.443123 0.823603 2.526589 "
               "3.870006 2.855098 -1.470720 -1.989770 1.083557 1.023780")  # fmt: skip
    with pytest.raises(ValueError, match=r"got -39\.96.* for 0 px; the file without the inverse"):
        loads(ocam(direct, inverse, "960 1280"))
    lines = ocam(direct, inverse, "960 1280").splitlines()
    assert type(loads("\n".join([lines[0], *lines[2:]]))).__name__ == "OCam"


def test_scaramuzzas_polynomials_too():
    text = changed("camodocal_scaramuzza.yaml", "SCARAMUZZA", "scaramuzza")
    assert type(loads(text)).__name__ == "OCamInverse"  # as LF-VIO's files write it
    with pytest.raises(ValueError, match="inverse polynomial must give back"):
        loads(text.replace("p1: 505.8", "p1: 5058."))
    with pytest.raises(ValueError, match=r"SCARAMUZZA has no place for the numbers of inverse$"):
        loads(text.replace("inv_poly_parameters", "inverse"))


# -- files that took long -----------------------------------------------------------------------

FRAME = {"fl_x": 800.0, "fl_y": 800.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}


def frames(count, **shared):
    entries = [{"file_path": f"{i}.png"} | FRAME | {"fl_x": 800.0 + i % 9} for i in range(count)]
    return json.dumps({"frames": entries} | shared)


@pytest.fixture
def frozen():
    """What other tests left in memory is not looked through for garbage meanwhile."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.mark.parametrize(
    ("text", "camera", "message"),
    [
        ({"model": "Polynomial", "coefficients": [1.0] * 20_000}, None, "at most 64 numbers, got"),
        ({"model": "OCam", "coefficients": [-1.0] * 65_000}, None, "at most 64 numbers, got 65000"),
        ({"model": "KannalaBrandt", "focal": 300, "radial": [0.1] * 20_000}, None, "at most 64 n"),
        (frames(9_000), "8888.png", None),
        (frames(9_000), None, "several cameras"),
        (frames(120_000), None, "1 to 10000 cameras, got 120000"),
        (frames(120_000, **FRAME), None, None),
    ],
)  # fmt: skip
def test_no_file_takes_long(text, camera, message, threads, frozen):
    text = text if isinstance(text, str) else json.dumps(text)
    threads(1)  # others, waiting, would count
    start = time.process_time()
    if message is None:
        assert loads(text, camera=camera).focal.item() == (805 if camera else 800)
    else:
        with pytest.raises(ValueError, match=message):
            loads(text, camera=camera)
    assert time.process_time() - start < 2


def test_a_thousand_cameras_take_no_longer_than_some(tmp_path, threads):
    threads(1)  # others, waiting, would count
    rows = [f"{i} OPENCV_FISHEYE 640 480 {300 + i / 10} 310 320 240 0.01 -0.002 0.0003 -0.0001\n"
            for i in range(1, 1001)]  # fmt: skip
    path = tmp_path / "cameras.txt"
    path.write_text("".join(rows))
    start = time.process_time()
    lenses = load_all(path, dtype=f64)
    assert time.process_time() - start < 2
    for camera in ("1", "500", "1000"):
        alone = load(path, camera=camera, dtype=f64)
        for name in alone._names():
            together = getattr(lenses[camera], name)
            torch.testing.assert_close(together, getattr(alone, name), rtol=1e-12, atol=0)
    # The first bad one is named, soon too.
    rows[700] = rows[700].replace("0.01 ", "-9e9 ")
    rows[900] = rows[900].replace("310", "1e-300")
    path.write_text("".join(rows))
    start = time.process_time()
    with pytest.raises(ValueError, match=r"COLMAP calibration .*: camera '(701|901)': "):
        load_all(path)
    assert time.process_time() - start < 2
    assert load(path, camera="5").focal.item() == pytest.approx(300.5)
