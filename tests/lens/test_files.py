"""Calibration files against other implementations, and files with missing information."""

import json
import math
import re

import cv2
import numpy as np
import pytest
import torch
import yaml
from lens_examples import (
    CALIBRATIONS,
    DEGREES,
    FILES,
    FISHEYE,
    PLUMB_BOB,
    K,
    assert_projects,
    double,
    f64,
    file_text,
    flat,
    loads,
    message,
    opencv,
    points_around,
)

from darswin.lens import EnhancedUnified, load, load_all, to_dict

RATIONAL = [0.2, 0.05, 0.001, -0.002, 0.003, 0.25, 0.04, 0.002]
SIZE = dict(image_size=(960, 1280), dtype=f64)  # for a file without an image size


@pytest.mark.parametrize(("name", "camera"), CALIBRATIONS)
def test_radii_of_calibrations_to_a_thousandth_of_a_pixel(name, camera):
    lens = load(FILES / name, camera=camera, dtype=f64)
    expected = double(*CALIBRATIONS[name, camera])
    torch.testing.assert_close(lens.project(DEGREES.deg2rad()), expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "model", "center", "size"),
    [
        ("woodscape.json", "Polynomial", (640 + 1.8 - 0.5, 483 + 3.6 - 0.5), (966, 1280)),
        ("kitti360_02.yaml", "Mei", (708.5, 697.0), (1400, 1400)),
        ("camodocal_pinhole.yaml", "BrownConrady", (371.4, 236.2), (480, 752)),
        ("kalibr_ds.yaml", "DoubleSphere", (724.6, 533.8), (1080, 1440)),
        ("kalibr_omni.yaml", "Mei", (380.6, 243.5), (480, 752)),
        ("ros_plumb_bob.yaml", "BrownConrady", (312.054718, 236.418205), (480, 640)),
        ("ros_fisheye.yaml", "KannalaBrandt", (651.2074390184226, 355.4127760951834), (720, 1280)),
        ("opencv_fisheye.yaml", "KannalaBrandt", (643.12, 478.55), (960, 1280)),
        ("opencv_omnidir.xml", "Mei", (641.0, 478.0), (960, 1280)),
        # The row comes first, and indices begin at 0.
        ("ocamcalib.txt", "OCamInverse", (723.6, 715.2), (1440, 1440)),
        # The center of the upper left pixel is (0.5, 0.5).
        ("colmap.txt", "KannalaBrandt", (1504 - 0.5, 2048 - 0.5), (4096, 3008)),
        ("nerfstudio.json", "KannalaBrandt", (719.1 - 0.5, 962.3 - 0.5), (1920, 1440)),
        ("ours.json", "KannalaBrandt", (319.5, 241.0), (480, 640)),
    ],
)
def test_each_format_keeps_its_pixel_origin(name, model, center, size):
    lens = load(FILES / name, dtype=f64)
    assert type(lens).__name__ == model and len(lens) == 1
    assert lens.center.tolist() == [pytest.approx(center, abs=1e-12)]
    assert lens.image_size.tolist() == [list(size)]
    assert lens.theta_max.dtype == f64
    assert load(FILES / name).theta_max.dtype == torch.float32


# -- against other implementations -------------------------------------------------------------


def write(path, **entries):
    """A file written by OpenCV's FileStorage, in the notation of its suffix."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, np.asarray(value, float) if isinstance(value, list) else value)
    storage.release()
    return path


def fisheye(points, d, alpha):
    zero, k, d = np.zeros(3), np.array(K), np.array(d)
    return cv2.fisheye.projectPoints(points[None], zero, zero, k, d, alpha=alpha)[0][0]


def pinhole(points, d, k=K):
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, np.array(k), np.array(d))[0][:, 0]


def assert_pinhole(lens, d, k=K):
    assert_projects(lens, points_around(0.7), pinhole(points_around(0.7), d, k))


@pytest.mark.parametrize(("suffix", "alpha"), [("yaml", 0.003), ("xml", 0.0), ("json", 0.003)])
def test_opencv_fisheye(tmp_path, suffix, alpha):
    k = np.array(K)
    k[0, 1] = alpha * k[0, 0]
    path = write(tmp_path / f"c.{suffix}", K=k.tolist(), D=FISHEYE, image_width=1280,
                 image_height=960, fisheye_model=1)  # fmt: skip
    points = points_around(1.4)
    assert_projects(load(path, dtype=f64), points, fisheye(points, FISHEYE, alpha))


@pytest.mark.parametrize(
    ("suffix", "d"),
    [
        ("yaml", PLUMB_BOB[:4]),
        ("xml", PLUMB_BOB),
        ("json", RATIONAL),
        ("yaml", [*RATIONAL, 0.0005, -0.0004, 0.0003, -0.0002]),
        ("xml", [0.2, 0.05, 0, 0, 0.003, 0.25, 0.04, 0.002, 5e-4, -4e-4, 3e-4, -2e-4, 0, 0]),
        ("json", [0.0, 0.0, 0.0, 0.0, 0.0]),
    ],
    ids=["radtan", "plumb_bob", "rational", "thin_prism", "untilted", "none"],
)
def test_opencv_pinhole(tmp_path, suffix, d):
    path = write(tmp_path / f"c.{suffix}", camera_matrix=K, distortion_coefficients=d,
                 image_width=1280, image_height=960)  # fmt: skip
    lens = load(path, coefficients="pinhole", dtype=f64)
    assert_pinhole(lens, d)
    assert lens.is_radial == (not any(d[2:4]) and not any(d[8:]))
    if not any(d):
        assert type(lens).__name__ == "Perspective"


def distorted(u, v, plane, k=(), p=(0, 0), d=(), s=(0, 0, 0, 0), skew=0):
    """Pixels of points of a plane, by OpenCV's formula."""
    (fx, fy, cx, cy), r2 = plane, u * u + v * v
    radial = 1 + sum(c * r2**i for i, c in enumerate(k, 1))
    radial = radial / (1 + sum(c * r2**i for i, c in enumerate(d, 1)))
    ud = u * radial + 2 * p[0] * u * v + p[1] * (r2 + 2 * u * u) + s[0] * r2 + s[1] * r2 * r2
    vd = v * radial + 2 * p[1] * u * v + p[0] * (r2 + 2 * v * v) + s[2] * r2 + s[3] * r2 * r2
    return np.stack((fx * ud + skew * vd + cx, fy * vd + cy), -1)


def mei(xi, plane, k, p, skew=0):
    def pixels(points):
        x, y, z = points.T
        return distorted(x / (z + xi), y / (z + xi), plane, k, p, skew=skew)

    return pixels


def colmap_pixels(model, params, points):
    """COLMAP's ImgFromCam, in its pixel convention."""
    x, y, z = points.T
    single = model.startswith("SIMPLE") or model in ("RADIAL", "RADIAL_FISHEYE", "BROWN_CONRADY")
    params = params[:1] * 2 + params[1:] if single else params
    plane, extra = params[:4], params[4:]
    u, v = x / z, y / z
    if "FISHEYE" in model:
        theta = np.arctan2(np.hypot(x, y), z)
        u, v = theta * x / np.hypot(x, y), theta * y / np.hypot(x, y)
    terms = dict(k=extra)
    if model == "FULL_OPENCV":
        terms = dict(k=[*extra[:2], extra[4]], p=extra[2:4], d=extra[5:])
    elif model == "OPENCV":
        terms = dict(k=extra[:2], p=extra[2:])
    elif model == "BROWN_CONRADY":
        terms = dict(k=extra[:3], p=extra[3:])
    elif model == "THIN_PRISM_FISHEYE":
        terms = dict(k=[*extra[:2], *extra[4:6]], p=extra[2:4], s=[extra[6], 0, extra[7], 0])
    elif model == "RAD_TAN_THIN_PRISM_FISHEYE":
        radial = 1 + sum(c * (u * u + v * v) ** i for i, c in enumerate(extra[:6], 1))
        u, v, terms = u * radial, v * radial, dict(p=extra[7:5:-1], s=extra[8:])
    elif model == "FOV":
        r = np.hypot(u, v)
        radial = np.arctan(2 * r * np.tan(extra[0] / 2)) / (r * extra[0])
        u, v, terms = u * radial, v * radial, {}
    elif model == "EUCM":
        alpha, beta = extra
        den = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
        u, v, terms = x / den, y / den, {}
    elif "DIVISION" in model:
        den = (z + np.sqrt(z * z - 4 * (x * x + y * y) * extra[0])) / 2
        u, v, terms = x / den, y / den, {}
    return distorted(u, v, plane, **terms)


def test_every_model_of_colmap():
    path = FILES / "colmap_all.txt"
    found = load_all(path, theta_max=0.3, dtype=f64)
    rows = [line.split() for line in path.read_text().splitlines() if line[0] != "#"]
    assert list(found) == [row[0] for row in rows] and len(rows) == 18
    points = points_around(0.8)
    for lens, row in zip(found.values(), rows, strict=True):
        pixels = colmap_pixels(row[1], [float(p) for p in row[4:]], points) - 0.5
        assert_projects(lens, points, pixels)
    # pycolmap 4.2.1 wrote this file from the text; it does not know BROWN_CONRADY.
    binary = load_all(FILES / "colmap_all.bin", theta_max=0.3, dtype=f64)
    assert found.keys() - binary.keys() == {"16"} and len(binary) == 17
    assert all(to_dict(binary[name]) == to_dict(found[name]) for name in binary)


NERFSTUDIO = dict(camera_model="OPENCV", fl_x=500, fl_y=510, cx=320, cy=240, w=640, h=480, k1=0.1,
                  k2=-0.05, k3=0.02, k4=-0.003, p1=0.001, p2=-0.002)  # fmt: skip


def unified_pixels(points):
    """Pixels by basalt's ucm formula."""
    x, y, z = points.T
    den = 0.6385 + (1 - 0.6385) * z
    return np.stack((204.6 * x / den + 258.3, 204.9 * y / den + 251.7), -1)


def world2cam(points):
    """OCamCalib's world2cam: x points down, y to the right, and the optical axis is -z."""
    right, down, forward = points.T
    x, y, z = down, right, -forward
    norm = np.hypot(x, y)
    numbers = file_text("ocamcalib.txt").splitlines()[6].split()[1:]
    rho = sum(float(c) * np.arctan(z / norm) ** i for i, c in enumerate(numbers))
    x, y = x / norm * rho, y / norm * rho
    return np.stack((-0.00031 * x + y + 723.6, 0.9987 * x + 0.00042 * y + 715.2), -1)


@pytest.mark.parametrize(
    ("text", "camera", "theta_max", "pixels"),
    [
        (file_text("kitti360_02.yaml"), None, 1.7, mei(
            2.35, (1390.0, 1389.2, 708.5, 697.0), (0.032, 2.4), (6e-4, -3.5e-4))),
        (file_text("kalibr_omni.yaml"), None, 1.0, mei(
            0.9526, (690.4, 691.2, 380.6, 243.5), (-0.18, 0.046), (0.0009, -0.0011))),
        (file_text("opencv_omnidir.xml"), None, 1.2, mei(
            1.2345, (980, 979, 641, 478), (-0.22, 0.13), (0.0007, -0.0004), skew=1.5)),
        (file_text("camodocal_pinhole.yaml"), None, 0.7, mei(
            0, (455.2, 453.9, 371.4, 236.2), (-0.2751, 0.07133), (-1.142e-4, 9.065e-5))),
        (json.dumps(NERFSTUDIO), None, 0.6, mei(  # a pinhole camera with four radial terms
            0, (500, 510, 319.5, 239.5), (0.1, -0.05, 0.02, -0.003), (0.001, -0.002))),
        (file_text("colmap_all.txt"), "7", 0.8, lambda points: pinhole(
            points, RATIONAL, [[500, 0, 319.5], [0, 510.0, 239.5], [0, 0, 1]])),
        (file_text("basalt.json"), "cam4", 0.8, lambda points: pinhole(
            points, [0.285, -0.031, -0.00041, 8.3e-05, 0.0142, 0.548, -0.071, 0.029],
            [[274.4, 0, 317.8], [0, 274.9, 236.4], [0, 0, 1]])),
        (file_text("basalt.json"), 2, 1.3, unified_pixels),
        (file_text("ocamcalib.txt"), None, 1.8, world2cam),
    ],
    ids=["KITTI-360", "omni", "omnidir", "PINHOLE", "nerfstudio", "COLMAP", "radtan8", "ucm",
         "OCamCalib"],
)  # fmt: skip
def test_other_models(text, camera, theta_max, pixels):
    points = points_around(theta_max)
    assert_projects(loads(text, camera=camera, dtype=f64), points, pixels(points))


def test_ocamcalib_without_an_inverse_polynomial():
    lines = file_text("ocamcalib.txt").splitlines()
    lens = loads("\n".join(lines[:4] + lines[8:]), dtype=f64)
    assert type(lens).__name__ == "OCam"
    inverse = load(FILES / "ocamcalib.txt", dtype=f64)
    theta = torch.linspace(0.2, 1.5, 20, dtype=f64)
    torch.testing.assert_close(lens.project(theta), inverse.project(theta), rtol=0, atol=0.01)


def test_scaramuzzas_axis_may_point_either_way():
    text = file_text("camodocal_scaramuzza.yaml")
    lens = loads(text, dtype=f64)
    theta, phi = torch.linspace(0, 1.79, 200, dtype=f64), torch.linspace(-31, 31, 200, dtype=f64)
    direct, inverse = text.split("inv_poly_parameters")
    direct = re.sub(r"( p\d+:) (\S+)", lambda m: f"{m[1]} {-float(m[2])}", direct)
    inverse = re.sub(
        r" p(\d+): (\S+)", lambda m: f" p{m[1]}: {(-1) ** int(m[1]) * float(m[2])}", inverse
    )
    other = loads(f"{direct}inv_poly_parameters{inverse}", dtype=f64)
    torch.testing.assert_close(other.project_rays(theta, phi), lens.project_rays(theta, phi))
    # x = c x' + d y' + cx, y = e x' + y' + cy
    x, y = phi.cos() * lens.project(theta), phi.sin() * lens.project(theta)
    expected = (0.9987 * x + 0.00042 * y + 723.6, -0.00031 * x + y + 715.2)
    torch.testing.assert_close(lens.project_rays(theta, phi), torch.stack(expected, -1))


def test_woodscapes_aspect_ratio_stretches_the_rows():
    lens = load(FILES / "synwoodscape.json", dtype=f64)
    right, down = (lens.project_rays(1.2, phi)[0] - lens.center[0] for phi in (0, math.pi / 2))
    assert (down[1] / right[0]).item() == pytest.approx(1.0004, abs=1e-12)


@pytest.mark.parametrize("alpha", [0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("beta", [-0.3, -50.0, -1e-3])
@pytest.mark.parametrize("dtype", [torch.float32, f64])
def test_enhanced_unified_with_a_beta_below_0(alpha, beta, dtype):
    """COLMAP's division model has such a β, and α = ½."""
    lens = EnhancedUnified(torch.tensor(alpha, dtype=dtype), beta, 300.0)
    assert lens.theta_limit.item() == pytest.approx(math.atan((-beta) ** -0.5), abs=2e-6)
    theta = lens.theta_limit * torch.linspace(0, 1, 200, dtype=dtype)
    radius = lens.project(theta)
    assert radius.isfinite().all() and (radius.diff() > 0).all()
    torch.testing.assert_close(lens.unproject(radius), theta)
    if alpha < 1:  # where √(β sin² θ + cos² θ) is 0
        end = 300 / ((1 - alpha) * math.sqrt(-beta))
        assert lens.unproject(torch.tensor([1.01, 2.0, 100.0], dtype=dtype) * end).isnan().all()


# -- files of other tools and short scripts -----------------------------------------------------

RADTAN = dict(model="BrownConrady", radial=[-0.22, 0.05], tangential=[0.001, -0.002])
PLUMB = dict(RADTAN, radial=[-0.22, 0.05, 0.003], image_size=[960, 1280], center=[643.1, 478.6])
KB = dict(model="KannalaBrandt", radial=FISHEYE, image_size=[960, 1280])
EUROC = """sensor_type: camera
T_BS:
  cols: 2
  rows: 1
  data: [1.0, 0.1]
rate_hz: 20
resolution: [1280, 960]
camera_model: pinhole
intrinsics: [421.3, 420.9, 643.1, 478.6] #fu, fv, cu, cv
distortion_model: {}
distortion_coefficients: [-0.22, 0.05, 0.001, -0.002]
"""
NAMES = ("D", "d", "distortion_coefficients", "distortion_coefs", "distCoeffs", "dist_coeff",
         "dist", "distortion", "coeffs", "coefficients", "Distortion_Parameters",
         "distortion_params", "camera_distortion", "cameraDistortionCoefficients")  # fmt: skip
# Entries that are not coefficients may be present too.
BESIDE = dict(R=[1.0] * 9, P1=[1.0] * 12, R1=[1.0] * 9, board_distance=0.3, p=[1.0] * 12,
              undistorted_size=[9, 9], distortion_model="plumb_bob", dist_note="none", d2=[],
              avg_reprojection_error=0.3, D_std_dev=[0.1] * 5)  # fmt: skip


def fisheye_or_pinhole(**entries):
    """Four coefficients, whose model depends on the other entries."""
    return opencv(D=FISHEYE, **entries)


ROS2 = file_text("ros2_echo.yaml")
ECHOED = dict(image_size=[480, 640], center=[317.8, 236.4], denominator=[0.548, -0.071, 0.029])
PINHOLE = dict(model="BrownConrady", radial=FISHEYE[:2], tangential=FISHEYE[2:])
EIGHT = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
DIVIDED = dict(radial=[0.2, 0.05, 0.003], denominator=[0.25, 0.04, 0.002])


@pytest.mark.parametrize(
    ("text", "options", "expected"),
    [
        *((EUROC.format(word), {}, RADTAN | dict(image_size=[960, 1280]))
          for word in ("radial-tangential", "radial_tangential", "radtan")),
        (opencv(distortion_model="radial-tangential", D=PLUMB_BOB[:4]), {}, RADTAN),
        *((opencv(**{name: PLUMB_BOB}), {}, PLUMB) for name in NAMES),
        *((opencv(D=PLUMB_BOB, **says), {}, PLUMB)
          for says in (dict(distortion_model="plumb_bob"), dict(fisheye=0))),
        *((opencv(D=layout), {}, PLUMB) for layout in ([PLUMB_BOB], [[d] for d in PLUMB_BOB])),
        (opencv(D=PLUMB_BOB, **BESIDE), {}, PLUMB),
        # From NumPy scripts, and from the output of `rostopic echo` and `ros2 topic echo`.
        (json.dumps(dict(mtx=K, dist=[PLUMB_BOB], img_size=[1280, 960])), {}, PLUMB),
        (f"height: 960\nwidth: 1280\ndistortion_model: plumb_bob\nD: {PLUMB_BOB}\n"
         f"K: {K[0] + K[1] + K[2]}\n", {}, PLUMB),
        *((ROS2 + end, {}, ECHOED) for end in ("", "\n---\n---\n\n", "...\n", "\r\n---\r\n")),
        (file_text("kalibr_fov.yaml").replace("0.92", "0"), dict(camera="cam0"),
         dict(model="Perspective", center=[255.5, 254.5])),
        # A θ_max beyond the limit by rounding.
        ('{"model": "Equidistant", "focal": 300, "theta_max": 3.14159265}', {},
         dict(model="Equidistant", focal=300.0)),
        # The choice of the model.
        (opencv(D=[], fisheye=0), {}, dict(model="Perspective")),
        (opencv(), dict(coefficients="fisheye"), dict(model="Equidistant")),
        (fisheye_or_pinhole(), dict(coefficients="fisheye"), KB),
        (fisheye_or_pinhole(), dict(coefficients="pinhole"), PINHOLE),
        (fisheye_or_pinhole(fisheye_model=1), {}, KB),
        (fisheye_or_pinhole(fisheye_model=0), {}, PINHOLE),
        (fisheye_or_pinhole(distortion_model="equidistant"), {}, KB),
        (fisheye_or_pinhole(distortion_model="plumb_bob"), {}, PINHOLE),
        (fisheye_or_pinhole(camera_model="fisheye"), {}, KB),
        (fisheye_or_pinhole(xi=1.1), {}, PINHOLE | dict(model="Mei", xi=1.1)),
        (fisheye_or_pinhole(xi=[[1.1]]), {}, PINHOLE | dict(model="Mei", xi=1.1)),
        (fisheye_or_pinhole(xi=1.1, model="fisheye"), {}, KB),
        # Single numbers.
        (flat("k1", "k2", "k3", "k4"), {}, KB | {"center": [643.1, 478.6], "focal": 421.3}),
        (yaml.safe_dump(json.loads(flat("k1", "k2", "k3", "k4"))), {}, KB),
        (flat("k1", "k2", "k3", model="fisheye"), {}, KB | dict(radial=[*FISHEYE[:3], 0.0])),
        (flat("k1", "k2", "p1", "p2"), {}, PINHOLE | dict(radial=[*FISHEYE[:2], 0.0])),
        (flat(**dict(zip(EIGHT, RATIONAL, strict=True))), {}, DIVIDED),
        (flat("k1", "k2", "p1", "p2", fy=421.3, skew=421.3), {}, {"affine": [[1, 1], [0, 1]]}),
        (flat("k1", "k2", "p1", "p2", xi=1.1), {}, PINHOLE | dict(model="Mei", xi=1.1)),
    ],
)  # fmt: skip
def test_what_is_read(text, options, expected):
    described = to_dict(loads(text, dtype=f64, **options))
    assert described | expected == described


def test_two_messages_are_no_file():
    with pytest.raises(ValueError, match="it is not valid YAML: line"):
        loads(ROS2 + ROS2)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_of_numpy(save, tmp_path):
    path = tmp_path / "calib.npz"
    points = np.random.default_rng(0).normal(
        size=(20, 5000, 3)
    )  # megabytes that do not belong to the lens
    rvecs = np.array([np.zeros(3), np.zeros(2)], dtype=object)  # never unpickled
    save(path, mtx=np.array(K), dist=np.array([PLUMB_BOB]), DIM=np.array([1280, 960]), ret=0.31,
         objpoints=points, rvecs=rvecs)  # fmt: skip
    described = to_dict(load(path, dtype=f64))
    assert described | PLUMB == described
    save(path, cameraMatrix=np.array(K), distCoeffs=np.array(FISHEYE)[:, None])
    assert load(path, coefficients="fisheye", dtype=f64).radial.tolist() == [FISHEYE]
    save(path, K=K, D=np.array(PLUMB_BOB, dtype=object))
    with pytest.raises(ValueError, match=r"D must be 0 or 4 or .*dtype', 'object'"):
        load(path)


@pytest.mark.parametrize(
    ("binning", "roi"),
    [((0, 0), (101, 52, 640, 483)), ((1, 1), (0, 0, 1280, 960)), ((2, 2), (0, 0, 1280, 960)),
     ((1, 4), (0, 0, 0, 0)), ((3, 2), (101, 52, 640, 483))],
)  # fmt: skip
def test_binned_regions_show_what_the_sensor_sees(binning, roi):
    whole = loads(message(), dtype=f64)
    lens = loads(message(binning, roi), dtype=f64).with_theta_max(None)
    left, top, width, height = roi if any(roi) else (0, 0, 1280, 960)
    across, down = (max(side, 1) for side in binning)
    assert lens.image_size.tolist() == [[height // down, width // across]]
    points = torch.as_tensor(points_around(0.7))
    # A pixel of the image covers several of the sensor, and its center is their middle.
    sensor = whole.with_theta_max(None).project_points(points) - torch.tensor([left, top])
    expected = (sensor + 0.5) / torch.tensor([across, down], dtype=f64) - 0.5
    torch.testing.assert_close(lens.project_points(points), expected, rtol=0, atol=1e-9)


# -- missing information ------------------------------------------------------------------------


def test_theta_max_is_the_widest_side():
    for name in ("woodscape.json", "kitti360_02.yaml", "ros_plumb_bob.yaml"):
        lens = load(FILES / name, dtype=f64)
        sides = lens.with_theta_max(None).side_angles()
        assert lens.theta_max.item() == sides.max().item() < lens.theta_limit.item()
    assert math.degrees(load(FILES / "woodscape.json").theta_max) == pytest.approx(95.206, abs=0.01)
    assert load(FILES / "woodscape.json", theta_max=1.2).theta_max.item() == pytest.approx(1.2)
    with pytest.raises(ValueError, match=r"WoodScape calibration .*theta_max must be at most"):
        load(FILES / "woodscape.json", theta_max=3.2)
    assert load(FILES / "ours.json").theta_max.item() == pytest.approx(1.6)
    # For an image larger than the image circle, θ_max is the limit.
    lens = load(FILES / "opencv_fisheye.yaml", dtype=f64)
    wide = loads(file_text("opencv_fisheye.yaml").replace("1280", "12800"), dtype=f64)
    assert wide.theta_max.item() == wide.theta_limit.item() > lens.theta_max.item()


def test_without_an_image_size(tmp_path):
    fisheye = write(tmp_path / "f.yaml", K=K, D=[-0.021, 0.0043, -0.0012, 0.0001], fisheye=1)
    lens = load(fisheye, dtype=f64)
    assert lens.image_size is None and lens.theta_max.item() == lens.theta_limit.item()
    sized = load(fisheye, image_size=(960, 1280), dtype=f64)
    assert sized.image_size.tolist() == [[960, 1280]]
    assert sized.theta_max.item() == sized.side_angles().max().item() < lens.theta_max.item()
    pinhole = write(tmp_path / "p.yaml", K=K, D=[0.0] * 5)
    with pytest.raises(ValueError, match="give a smaller theta_max, or the image_size"):
        load(pinhole)
    assert load(pinhole, theta_max=1.0).theta_max.item() == pytest.approx(1.0)
    assert load(pinhole, image_size=(960, 1280)).r_max.item() == pytest.approx(643.6, abs=0.5)
    # The file's own size takes precedence.
    assert load(FILES / "woodscape.json", image_size=(9, 9)).image_size.tolist() == [[966, 1280]]


def test_several_cameras(tmp_path):
    path = FILES / "kalibr_tumvi.yaml"
    focal = load(path, camera="cam1").focal.item()
    assert load(path, camera="1").focal.item() == load(path, camera=1).focal.item() == focal
    assert list(load_all(path)) == ["cam0", "cam1"]
    # One camera for all frames; then two different ones among three frames.
    assert list(load_all(FILES / "nerfstudio.json")) == ["camera"]
    frames = load_all(FILES / "nerfstudio_frames.json")
    assert frames["images/1.png"] is frames["images/2.png"] and len(frames) == 3
    same = json.loads(file_text("nerfstudio_frames.json"))
    same["frames"].pop()
    assert loads(json.dumps(same)).focal.item() == pytest.approx(851.2)
    # A stereo pair of OpenCV.
    pair = write(tmp_path / "s.yaml", M1=K, D1=[0.1, 0, 0, 0, 0], M2=K, D2=[0.2, 0, 0, 0, 0],
                 image_width=640, image_height=480)  # fmt: skip
    assert [lens.radial[0, 0].item() for lens in load_all(pair, dtype=f64).values()] == [0.1, 0.2]
    assert load(FILES / "basalt.json", camera="cam4").image_size.tolist() == [[480, 640]]
    # If the names are numbers, a number is a name.
    colmap = "".join(f"{i} SIMPLE_FISHEYE 640 480 {100 * i} 320 240\n" for i in (1, 2, 5, 7))
    for name in (1, 2, 5, 7, "1", "2", "5", "7"):
        assert loads(colmap, camera=name).focal.item() == 100 * int(name)
    # A camera with a missing entry is an error only if it is read.
    text = file_text("kalibr_tumvi.yaml").replace("camera_model", "model", 1)
    assert loads(text, camera="cam1").focal.item() == focal


def test_our_own_json_may_say_a_field_of_view():
    text = '{"model": "Spherical", "xi": 0.5, "fov": 2.8}'
    lens = loads(text, image_size=(40, 60))
    assert lens.r_max.item() == pytest.approx(20) and lens.theta_max.item() == pytest.approx(1.4)
    with pytest.raises(ValueError, match="needs the image_size"):
        loads(text)
