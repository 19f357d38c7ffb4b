"""Calibration files against other implementations: OpenCV, COLMAP and formulas written here."""

import json
import math
import re

import cv2
import numpy as np
import pytest
import torch
from helpers import changed, refused
from lens_examples import (
    CALIBRATIONS,
    DEGREES,
    FILES,
    FISHEYE,
    PLUMB_BOB,
    RATIONAL,
    K,
    assert_projects,
    double,
    f64,
    file_text,
    loads,
    message,
    points_around,
    write_opencv,
)  # fmt: skip

from darswin.lens import EnhancedUnified, load, load_all, to_dict


@pytest.mark.parametrize(("name", "camera"), CALIBRATIONS)
def test_radii_of_calibrations_to_a_thousandth_of_a_pixel(name, camera):
    lens = load(FILES / name, camera=camera, dtype=f64)
    expected = double(*CALIBRATIONS[name, camera])
    torch.testing.assert_close(lens.project(DEGREES.deg2rad()), expected, rtol=0, atol=1e-3)


def fisheye(points, d, alpha):
    zero, k, d = np.zeros(3), np.array(K), np.array(d)
    return cv2.fisheye.projectPoints(points[None], zero, zero, k, d, alpha=alpha)[0][0]


def pinhole(points, d, k=K):
    zero = np.zeros(3)
    return cv2.projectPoints(points, zero, zero, np.array(k), np.array(d))[0][:, 0]


@pytest.mark.parametrize(("suffix", "alpha"), [("yaml", 0.003), ("xml", 0.0), ("json", 0.003)])
def test_opencv_fisheye(tmp_path, suffix, alpha):
    k = np.array(K)
    k[0, 1] = alpha * k[0, 0]
    path = write_opencv(tmp_path / f"c.{suffix}", K=k.tolist(), D=FISHEYE, image_width=1280,
                 image_height=960, fisheye_model=1)  # fmt: skip
    points = points_around(1.4)
    assert_projects(load(path, dtype=f64), points, fisheye(points, FISHEYE, alpha))


@pytest.mark.parametrize(("suffix", "d"), [
    ("yaml", PLUMB_BOB[:4]), ("xml", PLUMB_BOB), ("json", RATIONAL),
    ("yaml", [*RATIONAL, 0.0005, -0.0004, 0.0003, -0.0002]),
    ("xml", [0.2, 0.05, 0, 0, 0.003, 0.25, 0.04, 0.002, 5e-4, -4e-4, 3e-4, -2e-4, 0, 0]),
    ("json", [0.0] * 5),
], ids=["radtan", "plumb_bob", "rational", "thin_prism", "untilted", "none"])  # fmt: skip
def test_opencv_pinhole(tmp_path, suffix, d):
    path = write_opencv(tmp_path / f"c.{suffix}", camera_matrix=K, distortion_coefficients=d,
                 image_width=1280, image_height=960)  # fmt: skip
    lens = load(path, coefficients="pinhole", dtype=f64)
    assert_projects(lens, points_around(0.7), pinhole(points_around(0.7), d))
    assert lens.is_radial == (not any(d[2:4]) and not any(d[8:]))
    assert any(d) or type(lens).__name__ == "Perspective"


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
    r2, factor = u * u + v * v, 1.0
    if model == "RAD_TAN_THIN_PRISM_FISHEYE":
        factor = 1 + sum(c * r2**i for i, c in enumerate(extra[:6], 1))
    elif model == "FOV":
        factor = np.arctan(2 * r2**0.5 * np.tan(extra[0] / 2)) / (r2**0.5 * extra[0])
    elif model == "EUCM":
        factor = z / (extra[0] * np.sqrt(extra[1] * (x * x + y * y) + z * z) + (1 - extra[0]) * z)
    elif "DIVISION" in model:
        factor = 2 * z / (z + np.sqrt(z * z - 4 * (x * x + y * y) * extra[0]))
    terms = {
        "FULL_OPENCV": lambda: dict(k=[*extra[:2], extra[4]], p=extra[2:4], d=extra[5:]),
        "OPENCV": lambda: dict(k=extra[:2], p=extra[2:]),
        "BROWN_CONRADY": lambda: dict(k=extra[:3], p=extra[3:]),
        "THIN_PRISM_FISHEYE": lambda: dict(
            k=[*extra[:2], *extra[4:6]], p=extra[2:4], s=[extra[6], 0, extra[7], 0]),
        "RAD_TAN_THIN_PRISM_FISHEYE": lambda: dict(p=extra[7:5:-1], s=extra[8:]),
    }.get(model, lambda: {} if isinstance(factor, np.ndarray) else dict(k=extra))()  # fmt: skip
    return distorted(u * factor, v * factor, plane, **terms)


@pytest.mark.slow
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
    """OCamCalib's world2cam by the direct polynomial: x points down, y to the right, and the
    optical axis is -z."""
    right, down, forward = points.T
    x, y, z = down, right, -forward
    norm = np.hypot(x, y)
    a0, a1, *rest = map(float, file_text("ocamcalib.txt").splitlines()[2].split()[1:])
    solved = [np.roots([*rest[::-1], a1 - slope, a0]) for slope in z / norm]
    rho = np.array(
        [roots[(abs(roots.imag) < 1e-6) & (roots.real > 0)].real.min() for roots in solved]
    )
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


DIRECT = "-2.210000e+02 0 1.850000e-03 -3.600000e-06 1.420000e-08"
# Fitted to the direct one by least squares, like in the toolbox, to 0.01 px.
INVERSE = ("320.321696 164.783531 -14.771348 31.623465 8.044023 -1.452569 13.685554 -1.071077 "
           "-9.709705 2.309502 5.628928 1.507985")  # fmt: skip


def ocam(direct, inverse):
    lines = [f"{len(p.split())} {p}" for p in (direct, inverse) if p]
    return "\n".join([*lines, "240 376", "1 0 0", "480 752"])


def test_ocamcalibs_polynomials_are_held_against_each_other():
    lower = changed("camodocal_scaramuzza.yaml", "SCARAMUZZA", "scaramuzza")
    assert type(loads(lower)).__name__ == "OCam"  # the spelling in LF-VIO's files
    # The direct one is the lens. Inverse ones of 32 powers are lost in float32, and those of the
    # toolbox are extrapolated before a corner.
    radius = np.linspace(0, 440, 3000)
    theta = np.arctan2(radius, -np.polyval([float(c) for c in DIRECT.split()][::-1], radius))
    rays = torch.tensor(theta[theta < 1.9])
    for powers, end in ((0, 440), (5, 440), (12, 400), (32, 440)):
        fit = theta[radius <= end] - math.pi / 2, radius[radius <= end]
        inverse = np.linalg.lstsq(np.vander(fit[0], powers, increasing=True), fit[1], 1e-15)[0]
        lens = loads(ocam(DIRECT, " ".join(f"{c:.6f}" for c in inverse))).with_theta_max(1.9)
        off = lens.project(rays.float()[None])[0].numpy() - radius[: len(rays)]
        assert np.abs(off).max() < 1e-3, powers
    for old, new in (("320.3", "3203"), ("320.3", "318.3"), ("164.7", "1647"), ("-1.45", "-14.5")):
        said = r"must undo the direct one .* px for [\d.]+ px"
        refused(said, loads, ocam(DIRECT, INVERSE.replace(old, new)))
    for old, new in (("e+02", "e+021"), ("e-03", "e-031")):
        refused(r"must undo|such that a₀", loads, ocam(DIRECT.replace(old, new), INVERSE))


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


@pytest.mark.parametrize(("binning", "roi"), [
    ((0, 0), (101, 52, 640, 483)), ((1, 1), (0, 0, 1280, 960)), ((2, 2), (0, 0, 1280, 960)),
    ((1, 4), (0, 0, 0, 0)), ((3, 2), (101, 52, 640, 483)),
])  # fmt: skip
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
