import contextlib
import json
import math
import random
import re
import struct
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers import changed
from lens_examples import assert_projects, loads, points_around

from darswin import lens as lenses
from darswin.lens import MODELS, load, load_all, save, to_dict
from darswin.lens.files import colmap

FILES = Path(__file__).parent / "files"
f64 = torch.float64

DEGREES = (10, 30, 45, 60, 75, 85, 90, 95)
# r in px at these angles, computed from the models' formulas with 40 digits (mpmath).
VECTORS = {
    ("woodscape.json", None):
        (60.767, 182.438, 276.818, 376.441, 483.321, 559.477, 599.200, 640.089),
    ("synwoodscape.json", None):
        (59.860, 179.856, 272.829, 371.134, 477.444, 554.156, 594.590, 636.559),
    ("kitti360_02.yaml", None):
        (72.387, 216.575, 324.265, 432.268, 540.123, 609.270, 641.463, 670.895),
    ("kitti360_03.yaml", None):
        (75.418, 224.754, 335.049, 444.537, 552.149, 619.031, 649.031, 675.367),
    ("kalibr_tumvi.yaml", "cam0"):
        (33.336, 100.093, 150.289, 200.445, 249.862, 281.623, 296.876, 311.559),
    ("camodocal_kb.yaml", None):  # the same lens
        (33.336, 100.093, 150.289, 200.445, 249.862, 281.623, 296.876, 311.559),
    ("basalt.json", "cam0"):
        (34.619, 103.857, 155.807, 207.761, 259.431, 293.235, 309.708, 325.715),
    ("kalibr_fov.yaml", "cam1"):  # the same lens
        (34.619, 103.857, 155.807, 207.761, 259.431, 293.235, 309.708, 325.715),
    ("kalibr_ds.yaml", None):
        (73.511, 220.677, 331.414, 442.589, 553.504, 626.021, 661.234, 695.292),
    ("basalt.json", "cam1"):
        (74.461, 220.044, 322.610, 415.103, 492.213, 531.685, 546.924, 558.704),
    ("colmap.txt", None):
        (363.169, 1090.529, 1637.383, 2185.502, 2735.760, 3104.577, 3289.572, 3474.684),
    ("ocamcalib.txt", None):
        (50.691, 159.562, 253.543, 360.432, 478.438, 562.226, 605.753, 650.602),
    ("camodocal_scaramuzza.yaml", None):  # the same lens
        (50.691, 159.562, 253.543, 360.432, 478.438, 562.226, 605.753, 650.602),
}  # fmt: skip


@pytest.mark.parametrize(("name", "camera"), VECTORS)
def test_radii_of_calibrations(name, camera):
    lens = load(FILES / name, camera=camera, dtype=f64)
    theta = torch.deg2rad(torch.tensor(DEGREES, dtype=f64))
    expected = torch.tensor(VECTORS[name, camera], dtype=f64)
    torch.testing.assert_close(lens.project(theta), expected, rtol=0, atol=1e-3)


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
        # The row stands first, and C indices.
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
    """A file of OpenCV's own FileStorage; the notation is that of the suffix."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        storage.write(name, np.asarray(value, float) if isinstance(value, list) else value)
    storage.release()
    return path


K = [[421.3, 0.0, 643.1], [0.0, 420.9, 478.6], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
@pytest.mark.parametrize("alpha", [0.0, 0.003])
def test_opencv_fisheye(tmp_path, suffix, alpha):
    k = np.array(K)
    k[0, 1] = alpha * k[0, 0]
    d = [-0.021, 0.0043, -0.0012, 0.00008]
    path = write(tmp_path / f"c.{suffix}", K=k.tolist(), D=d, image_width=1280, image_height=960,
                 fisheye_model=1)  # fmt: skip
    lens = load(path, dtype=f64)
    points = points_around(1.5)
    expected, _ = cv2.fisheye.projectPoints(
        points[None], np.zeros(3), np.zeros(3), np.array(K), np.array(d), alpha=alpha
    )
    assert_projects(lens, points, expected[0])


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
@pytest.mark.parametrize(
    "d",
    [
        [-0.05, 0.012, 0.001, -0.002],
        [-0.05, 0.012, 0.001, -0.002, 0.003],
        [0.2, 0.05, 0.001, -0.002, 0.003, 0.25, 0.04, 0.002],
        [0.2, 0.05, 0.001, -0.002, 0.003, 0.25, 0.04, 0.002, 0.0005, -0.0004, 0.0003, -0.0002],
        [0.2, 0.05, 0, 0, 0.003, 0.25, 0.04, 0.002, 0.0005, -0.0004, 0.0003, -0.0002, 0, 0],
        [0.0, 0.0, 0.0, 0.0, 0.0],
    ],
    ids=["radtan", "plumb_bob", "rational", "thin_prism", "untilted", "none"],
)
def test_opencv_pinhole(tmp_path, suffix, d):
    path = write(tmp_path / f"c.{suffix}", camera_matrix=K, distortion_coefficients=d,
                 image_width=1280, image_height=960)  # fmt: skip
    lens = load(path, model="pinhole", dtype=f64)
    points = points_around(0.8)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.array(K), np.array(d))
    assert_projects(lens, points, expected[:, 0])
    assert lens.is_radial == (not any(d[2:4]) and not any(d[8:]))
    if not any(d):
        assert type(lens).__name__ == "Perspective"


def mei(points, xi, k1, k2, p1, p2, fx, fy, s, cx, cy):
    """Mei's model as its users write it: in x and y of the plane before the unit sphere's."""
    x, y, z = points.T
    x, y = x / (z + xi), y / (z + xi)
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return torch.from_numpy(np.stack((fx * xd + s * yd + cx, fy * yd + cy), -1))


@pytest.mark.parametrize(
    ("name", "theta_max", "parameters"),
    [
        ("kitti360_02.yaml", 1.7, (2.35, 0.032, 2.4, 6e-4, -3.5e-4, 1390.0, 1389.2, 0, 708.5,
                                   697.0)),
        ("kalibr_omni.yaml", 1.0, (0.9526, -0.18, 0.046, 0.0009, -0.0011, 690.4, 691.2, 0, 380.6,
                                   243.5)),
        ("opencv_omnidir.xml", 1.2, (1.2345, -0.22, 0.13, 0.0007, -0.0004, 980, 979, 1.5, 641,
                                     478)),
        ("camodocal_pinhole.yaml", 0.7, (0, -0.2751, 0.07133, -1.142e-4, 9.065e-5, 455.2, 453.9, 0,
                                         371.4, 236.2)),
    ],
)  # fmt: skip
def test_mei(name, theta_max, parameters):
    lens = load(FILES / name, dtype=f64)
    points = points_around(theta_max)
    assert_projects(lens, points, mei(points, *parameters))
    assert not lens.is_radial


def colmap_pixels(model, params, points):
    """As COLMAP's ImgFromCam, without its 0.5."""
    x, y, z = points.T
    single = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE",
                       "RADIAL_FISHEYE", "SIMPLE_DIVISION", "BROWN_CONRADY",
                       "SIMPLE_FISHEYE")  # fmt: skip
    fx, fy, cx, cy, *extra = params[:1] * 2 + params[1:] if single else params
    if "FISHEYE" in model:
        theta = np.arctan2(np.hypot(x, y), z)
        u, v = theta * x / np.hypot(x, y), theta * y / np.hypot(x, y)
    else:
        u, v = x / z, y / z
    r2 = u * u + v * v
    k, d, p, s = [], [], [0, 0], [0, 0, 0, 0]
    if model == "FULL_OPENCV":
        k, p, d = [*extra[:2], extra[4]], extra[2:4], extra[5:]
    elif model == "OPENCV":
        k, p = extra[:2], extra[2:]
    elif model == "BROWN_CONRADY":
        k, p = extra[:3], extra[3:]
    elif model == "THIN_PRISM_FISHEYE":
        k, p, s = [*extra[:2], *extra[4:6]], extra[2:4], [extra[6], 0, extra[7], 0]
    elif model == "RAD_TAN_THIN_PRISM_FISHEYE":
        radial = 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(extra[:6]))
        u, v = u * radial, v * radial
        r2, p, s = u * u + v * v, extra[7:5:-1], extra[8:]
    elif model == "FOV":
        radial = np.arctan(2 * np.sqrt(r2) * np.tan(extra[0] / 2)) / (np.sqrt(r2) * extra[0])
        u, v, r2 = u * radial, v * radial, 0 * r2
    elif model == "EUCM":
        alpha, beta = extra
        den = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
        u, v = x / den, y / den
    elif model in ("SIMPLE_DIVISION", "DIVISION"):
        den = (z + np.sqrt(z * z - 4 * (x * x + y * y) * extra[0])) / 2
        u, v = x / den, y / den
    else:
        k = extra
    radial = 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(k))
    radial = radial / (1 + sum(c * r2 ** (i + 1) for i, c in enumerate(d)))
    ud = u * radial + 2 * p[0] * u * v + p[1] * (r2 + 2 * u * u) + s[0] * r2 + s[1] * r2 * r2
    vd = v * radial + 2 * p[1] * u * v + p[0] * (r2 + 2 * v * v) + s[2] * r2 + s[3] * r2 * r2
    return torch.from_numpy(np.stack((fx * ud + cx, fy * vd + cy), -1))


def test_every_model_of_colmap():
    path = FILES / "colmap_all.txt"
    found = load_all(path, dtype=f64)
    rows = [line.split() for line in path.read_text().splitlines() if line[0] != "#"]
    assert list(found) == [row[0] for row in rows] and len(rows) == 18
    points = points_around(0.8)
    for lens, row in zip(found.values(), rows, strict=True):
        pixels = colmap_pixels(row[1], [float(p) for p in row[4:]], points) - 0.5
        assert_projects(lens, points, pixels)


def test_colmaps_rational_model_is_opencvs():
    lens = load(FILES / "colmap_all.txt", camera="7", dtype=f64)
    points = points_around(0.8)
    d = np.array([0.2, 0.05, 0.001, -0.002, 0.003, 0.25, 0.04, 0.002])
    k = np.array([[500.0, 0, 319.5], [0, 510, 239.5], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k, d)
    assert_projects(lens, points, expected[:, 0])


def test_basalts_radtan8_is_opencvs_rational_model():
    lens = load(FILES / "basalt.json", camera="cam4", dtype=f64)
    points = points_around(0.8)
    d = np.array([0.285, -0.031, -0.00041, 8.3e-05, 0.0142, 0.548, -0.071, 0.029])
    k = np.array([[274.4, 0, 317.8], [0, 274.9, 236.4], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k, d)
    assert_projects(lens, points, expected[:, 0])


def test_basalts_unified_model():
    lens = load(FILES / "basalt.json", camera=2, dtype=f64)
    points = points_around(1.3)
    x, y, z = points.T
    den = 0.6385 + (1 - 0.6385) * z
    expected = np.stack((204.6 * x / den + 258.3, 204.9 * y / den + 251.7), -1)
    assert_projects(lens, points, expected)


def test_ocamcalib_is_world2cam():
    """Its x is down (row) and its y to the right, its optical axis is -z."""
    lens = load(FILES / "ocamcalib.txt", dtype=f64)
    points = points_around(1.8)
    right, down, forward = points.T
    x, y, z = down, right, -forward
    norm = np.hypot(x, y)
    numbers = FILES.joinpath("ocamcalib.txt").read_text().splitlines()[6].split()[1:]
    rho = sum(float(c) * np.arctan(z / norm) ** i for i, c in enumerate(numbers))
    c, d, e, xc, yc = 0.9987, 0.00042, -0.00031, 715.2, 723.6
    x, y = x / norm * rho, y / norm * rho
    row, column = x * c + y * d + xc, x * e + y + yc
    assert_projects(lens, points, np.stack((column, row), -1))


def test_ocamcalib_without_an_inverse_polynomial():
    lines = FILES.joinpath("ocamcalib.txt").read_text().splitlines()
    lens = loads("\n".join(lines[:4] + lines[8:]), dtype=f64)
    assert type(lens).__name__ == "OCam"
    inverse = load(FILES / "ocamcalib.txt", dtype=f64)
    theta = torch.linspace(0.2, 1.5, 20, dtype=f64)
    torch.testing.assert_close(lens.project(theta), inverse.project(theta), rtol=0, atol=0.01)


def test_scaramuzzas_axis_may_point_either_way():
    text = FILES.joinpath("camodocal_scaramuzza.yaml").read_text()
    lens = loads(text, dtype=f64)
    theta, phi = torch.linspace(0, 1.8, 200, dtype=f64), torch.linspace(-31, 31, 200, dtype=f64)
    direct, inverse = (
        re.findall(r" p\d+: (\S+)", part) for part in text.split("inv_poly_parameters")
    )
    flipped = text
    for name, coefficients, sign in (
        ("\npoly_parameters", direct, lambda i: -1),
        ("inv_poly_parameters", inverse, lambda i: (-1) ** i),
    ):
        for i, c in enumerate(coefficients):
            start = flipped.index(name)
            place = flipped.index(f" p{i}: {c}", start)
            value = sign(i) * float(c)
            flipped = flipped[:place] + f" p{i}: {value!r}" + flipped[place + len(f" p{i}: {c}") :]
    other = loads(flipped, dtype=f64)
    assert float(re.search(r" p0: (\S+)", flipped)[1]) > 0
    torch.testing.assert_close(other.project_rays(theta, phi), lens.project_rays(theta, phi))
    # x = c x' + d y' + cx, y = e x' + y' + cy
    x, y = phi.cos() * lens.project(theta), phi.sin() * lens.project(theta)
    expected = (0.9987 * x + 0.00042 * y + 723.6, -0.00031 * x + y + 715.2)
    torch.testing.assert_close(lens.project_rays(theta, phi), torch.stack(expected, -1))


def test_woodscapes_aspect_ratio_stretches_the_rows():
    lens = load(FILES / "synwoodscape.json", dtype=f64)
    right, down = (lens.project_rays(1.2, phi)[0] - lens.center[0] for phi in (0, math.pi / 2))
    assert (down[1] / right[0]).item() == pytest.approx(1.0004, abs=1e-12)


def test_nerfstudios_opencv_has_four_k():
    text = json.dumps({"camera_model": "OPENCV", "fl_x": 500, "fl_y": 510, "cx": 320, "cy": 240,
                       "w": 640, "h": 480, "k1": 0.1, "k2": -0.05, "k3": 0.02, "k4": -0.003,
                       "p1": 0.001, "p2": -0.002})  # fmt: skip
    lens = loads(text, dtype=f64)
    points = points_around(0.6)
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r = x * x + y * y
    d = 1 + r * (0.1 + r * (-0.05 + r * (0.02 + r * -0.003)))
    u = x * d + 2 * 0.001 * x * y - 0.002 * (r + 2 * x * x)
    v = y * d - 2 * 0.002 * x * y + 0.001 * (r + 2 * y * y)
    expected = np.stack((500 * u + 319.5, 510 * v + 239.5), -1)
    assert_projects(lens, points, expected)


# -- what a file may leave open -----------------------------------------------------------------


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
    # An image that sees more than the lens: the lens's limit.
    lens = load(FILES / "opencv_fisheye.yaml", dtype=f64)
    text = FILES.joinpath("opencv_fisheye.yaml").read_text().replace("1280", "12800")
    wide = loads(text, dtype=f64)
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
    # The file's own size wins.
    assert load(FILES / "woodscape.json", image_size=(9, 9)).image_size.tolist() == [[966, 1280]]


def test_several_cameras(tmp_path):
    path = FILES / "kalibr_tumvi.yaml"
    with pytest.raises(ValueError, match=r"several cameras, choose one as camera=: 'cam0', 'cam1'"):
        load(path)
    assert load(path, camera="cam1").focal.item() == load(path, camera=1).focal.item()
    for wrong in ("cam2", 2, -1, 1.5):
        with pytest.raises(ValueError, match="camera must be one of 'cam0', 'cam1', or its number"):
            load(path, camera=wrong)
    assert list(load_all(path)) == ["cam0", "cam1"]
    # One camera for all frames; then two different ones among three frames.
    assert list(load_all(FILES / "nerfstudio.json")) == ["camera"]
    frames = load_all(FILES / "nerfstudio_frames.json")
    assert frames["images/1.png"] is frames["images/2.png"] and len(frames) == 3
    with pytest.raises(ValueError, match=r"several cameras.*'images/1.png', 'images/2.png'"):
        load(FILES / "nerfstudio_frames.json")
    same = json.loads(FILES.joinpath("nerfstudio_frames.json").read_text())
    same["frames"].pop()
    assert loads(json.dumps(same)).focal.item() == pytest.approx(851.2)
    # A stereo pair of OpenCV.
    pair = write(tmp_path / "s.yaml", M1=K, D1=[0.1, 0, 0, 0, 0], M2=K, D2=[0.2, 0, 0, 0, 0],
                 image_width=640, image_height=480)  # fmt: skip
    assert [lens.radial[0, 0].item() for lens in load_all(pair, dtype=f64).values()] == [0.1, 0.2]


@pytest.mark.parametrize(
    ("entries", "model"),
    [
        (dict(fisheye_model=1), "KannalaBrandt"),
        (dict(fisheye_model=0), "BrownConrady"),
        (dict(distortion_model="equidistant"), "KannalaBrandt"),
        (dict(distortion_model="plumb_bob"), "BrownConrady"),
        (dict(camera_model="fisheye"), "KannalaBrandt"),
        (dict(xi=1.1), "Mei"),
        (dict(xi=[[1.1]]), "Mei"),
        (dict(xi=1.1, model="fisheye"), "KannalaBrandt"),
    ],
)
def test_four_coefficients_need_a_word_about_their_model(tmp_path, entries, model):
    base = dict(K=K, D=[-0.021, 0.0043, 0.0012, 0.0008], image_width=1280, image_height=960)
    assert type(load(write(tmp_path / "c.yaml", **base, **entries))).__name__ == model
    path = write(tmp_path / "open.yaml", **base)
    with pytest.raises(ValueError, match=r"cv2.fisheye's .* or a pinhole's .*model=\"fisheye\""):
        load(path)
    for hint, name in (("fisheye", "KannalaBrandt"), ("pinhole", "BrownConrady")):
        assert type(load(path, model=hint)).__name__ == name
    with pytest.raises(ValueError, match="xi is missing"):
        load(path, model="omnidir")
    with pytest.raises(ValueError, match="model must be one of fisheye, pinhole, omnidir, got 'x'"):
        load(path, model="x")
    with pytest.raises(ValueError, match="its cameras say their model"):
        load(FILES / "woodscape.json", model="fisheye")


def test_ros_messages_and_notations_that_people_write():
    """As `rostopic echo` prints it; and nested lists."""
    text = ("height: 480\nwidth: 640\ndistortion_model: plumb_bob\nD: [0.1, 0.01, 0.0, 0.0, 0.0]\n"
            "K: [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]\n")  # fmt: skip
    lens = loads(text, dtype=f64)
    assert lens.center.tolist() == [[320, 240]] and lens.image_size.tolist() == [[480, 640]]
    text = '{"mtx": [[5e2, 0, 320], [0, 500, 240], [0, 0, 1]], "dist": [[0.1, 0.01, 0, 0, 0]], ' \
           '"img_size": [640, 480]}'  # fmt: skip
    torch.testing.assert_close(loads(text, dtype=f64).project(0.4), lens.project(0.4))


# -- the same lens elsewhere --------------------------------------------------------------------


@pytest.mark.parametrize("name", ["woodscape.json", "kitti360_02.yaml", "colmap.txt"])
def test_resized_and_cropped_lenses(name):
    lens = load(FILES / name, dtype=f64)
    theta = torch.linspace(0.1, 1, 9, dtype=f64) * lens.theta_max
    azimuth = torch.linspace(-3, 3, 9, dtype=f64)
    pixels = lens.project_rays(theta, azimuth)
    height, width = lens.image_size[0].tolist()
    smaller = lens.resized((round(height / 2), round(width / 4)))
    scale = torch.tensor([round(width / 4) / width, round(height / 2) / height], dtype=f64)
    torch.testing.assert_close(
        smaller.project_rays(theta, azimuth), (pixels + 0.5) * scale - 0.5, rtol=0, atol=1e-9
    )
    cropped = lens.cropped(100, 50, 300, 400)
    torch.testing.assert_close(
        cropped.project_rays(theta, azimuth), pixels - torch.tensor([50.0, 100.0], dtype=f64)
    )
    assert cropped.image_size.tolist() == [[300, 400]]


def lens_of(name, dtype):
    """A lens of each model, with a frame."""
    parameters = dict(
        focal=300.0, omega=0.9, xi=0.8, alpha=0.6, beta=1.1, angles=[0.0, 0.5, 1.2],
        radii=[0.0, 140.0, 400.0], slopes=[275.0, 330.0, 380.0],
        coefficients=[340.0, -32.0, 48.0, -7.2], radial=[0.01, -0.002],
        denominator=[0.02], tangential=[0.001, -0.002], prism=[0.0005, 0.0, 0.0002, 0.0],
    )  # fmt: skip
    if name == "OCam":
        parameters["coefficients"] = [-271.6972, 0.0, -2.741744e-6, 1.840940e-6]
    elif name == "OCamInverse":
        parameters["coefficients"] = [605.8, 505.9, 86.4, 0.0]
    model = MODELS[name]
    arguments = {key: parameters[key] for key in (*model.parameters, *model.optional)}
    arguments |= dict(center=[319.3, 240.1], affine=[[1.0, 0.01], [0.0, 1.02]])
    tensors = {key: torch.tensor(value, dtype=dtype) for key, value in arguments.items()}
    return model(**tensors, image_size=(480, 640))


@pytest.mark.parametrize("name", MODELS)
def test_save_and_load(name, tmp_path):
    for dtype in (torch.float32, f64):
        lens = lens_of(name, dtype)
        for used in (lens, lens.with_theta_max(lens.theta_max * 0.7)):
            save(used, tmp_path / "lens.json")
            found = load(tmp_path / "lens.json", dtype=dtype)
            assert type(found) is type(lens)
            for key in lens._names():
                torch.testing.assert_close(getattr(found, key), getattr(used, key), rtol=0, atol=0)
            other = torch.float32 if dtype == f64 else f64
            found = load(tmp_path / "lens.json", dtype=other)  # limits differ by rounding
            torch.testing.assert_close(found.theta_max, used.theta_max.to(other), rtol=0, atol=1e-4)


def test_save_takes_one_lens(tmp_path):
    with pytest.raises(ValueError, match="one lens, got 2"):
        save(lenses.Spherical([0.5, 0.6], 300.0), tmp_path / "lens.json")
    assert not list(tmp_path.iterdir())


def test_our_own_json_may_say_a_field_of_view():
    text = '{"model": "Spherical", "xi": 0.5, "fov": 2.8}'
    lens = loads(text, image_size=(40, 60))
    assert lens.r_max.item() == pytest.approx(20) and lens.theta_max.item() == pytest.approx(1.4)
    with pytest.raises(ValueError, match="needs the image_size"):
        loads(text)


# -- files that are wrong -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (changed("woodscape.json", '"k2": -17.5', '"k2": "abc"'),
         r"^WoodScape calibration .*f: intrinsic.k2 must be a finite number, got 'abc'$"),
        (changed("woodscape.json", '"k2": -17.5,', ""),
         "intrinsic.k2 is missing, it must be a finite number"),
        (changed("woodscape.json", "350.4", "0.0035"),
         r"intrinsic.k1 must be in pixels.*look|Kannala–Brandt coefficients \(OpenCV's fisheye\)"),
        (changed("woodscape.json", "radial_poly", "kb"), 'must be "radial_poly", got \'kb\''),
        (changed("woodscape.json", "966.0", "966.5"), "intrinsic.height must be a whole number"),
        (changed("woodscape.json", "966.0", "NaN"), "intrinsic.height must be .*, got nan"),
        (changed("woodscape.json", '"poly_order": 4', '"poly_order": 5'), "intrinsic.k5 is mi"),
        (changed("woodscape.json", "1280.0", "1280.0,,"), "it is no JSON: .*line 17"),
        (changed("kitti360_02.yaml", "MEI", "CATA"),
         "KITTI-360 .*: model_type must be one of MEI, KANNALA_BRANDT, PINHOLE, SCARAMUZZA, got"),
        (changed("kitti360_02.yaml", "   xi: ", "   x: "),
         "mirror_parameters.xi is missing, it must be a finite number"),
        (changed("kitti360_02.yaml", "2.3500000000000001e+00", "-2"), "xi must be finite and at l"),
        (changed("kitti360_02.yaml", "gamma1: 1.3900000000000000e+03", "gamma1: 0"),
         "projection_parameters.gamma1 must be a finite number above 0, got '0'"),
        (changed("kalibr_ds.yaml", "  intrinsics: [-0.21350274, ", "  intrinsics: ["),
         r"Kalibr .*: cam0.intrinsics must be 6 finite numbers, got \['0.578016'"),
        (changed("kalibr_ds.yaml", "distortion_model: none", "distortion_model: radtan"),
         "cam0.distortion_model must be one of none, got 'radtan'"),
        (changed("kalibr_ds.yaml", "camera_model: ds", "camera_model: dss"),
         "cam0.camera_model must be one of pinhole, omni, ds, eucm, got 'dss'"),
        (changed("kalibr_ds.yaml", "331.24405", "-3"), r"cam0.intrinsics\[2\] must be a focal"),
        (changed("kalibr_ds.yaml", "1080]", "abc]"), r"cam0.resolution\[1\] must be a whole"),
        (changed("ros_fisheye.yaml", "equidistant", "magic"),
         "ROS .*: distortion_model must be one of brownconrady,.*, got 'magic'; or give model="),
        (changed("ros_fisheye.yaml", "0.007163902584170265]", "0.009, 0.1]"),
         r"distortion_coefficients.data must be .* numbers, got 5"),
        (changed("opencv_fisheye.yaml", "4.2134e+02, ", "-1, "), r"camera_matrix must be \[fx"),
        (changed("opencv_fisheye.yaml", "fisheye_model: 1", "fisheye_model: 7"),
         "OpenCV .*: fisheye_model must be 0 or 1, got '7'"),
        (changed("opencv_fisheye.yaml", "image_height: 960", ""),
         "image_height is missing, it must be a whole number of pixels"),
        (changed("opencv_omnidir.xml", "</xi>", ""), "it is no XML: .*mismatched tag"),
        (changed("opencv_omnidir.xml", "1.2345", "abc"), "xi must be 1 finite numbers|xi.*'abc'"),
        (changed("ocamcalib.txt", "13 605", "12 605"),
         "OCamCalib .*: the inverse polynomial must be the number of its coefficients"),
        (changed("ocamcalib.txt", "1440 1440", ""), "OCamCalib .*: the center .* must be 2 num"),
        (changed("ocamcalib.txt", "1440 1440\n", "\n1 2\n3 4\n"), "it must have 5 lines of num"),
        (changed("ocamcalib.txt", "723.600000", "x"), r"the center .* must be 2 numbers, got 'x'"),
        (changed("colmap.txt", " 3008", ""), "COLMAP .*: camera '1', OPENCV_FISHEYE must have 8"),
        (changed("colmap.txt", "OPENCV_FISHEYE", "EQUIRECTANGULAR"), "model must be one of SIMP"),
        (changed("colmap.txt", "1504", "NaN"), "camera '1', cx must be a finite number, got 'NaN'"),
        (changed("nerfstudio.json", "OPENCV_FISHEYE", "EQUIRECTANGULAR"),
         "nerfstudio .*: camera_model must be one of SIMPLE_PINHOLE, .*, got 'EQUIRECTANGULAR'"),
        (changed("nerfstudio.json", '"fl_y": 852.9,', ""), "fl_y is missing"),
        (changed("nerfstudio_frames.json", '"fl_x": 612.0,', ""), r"frames\[2\].fl_x is missing"),
        (changed("basalt.json", '"eucm"', '"eucn"'),
         r"basalt .*: value0.intrinsics\[0\].camera_type must be one of ds, eucm, .*, got 'eucn'"),
        (changed("basalt.json", "[960, 960], ", ""), "value0.resolution must be 5 pairs of a"),
        (changed("basalt.json", '"k3": -0.214', '"k3": []'),
         r"value0.intrinsics\[3\].intrinsics.k3 must be a finite number, got \[\]"),
        (changed("ours.json", '"focal": 300.0,', ""), "darswin .*: focal is missing"),
        (changed("ours.json", '"radial"', '"k"'), "k is not of a KannalaBrandt lens, which has"),
        (changed("ours.json", "KannalaBrandt", "Kb"), '"model" must be one of .*, got \'Kb\''),
        (changed("ours.json", "1.01]]", "1.01, 2]]"), "affine must have rows of one length"),
        (changed("ours.json", "1.01]]", "0]]"), "affine must be invertible"),
        (changed("ours.json", "1.6", "3.3"), "theta_max must be at most 3.14"),
        ("{}", 'it must be of one of the formats .*"model" must be one of .*, got None'),
        ("a: 1", "it must be of one of the formats darswin, WoodScape"),
        ("[1, 2]", "it must be a mapping"),
        ("word", "it must be a mapping"),
        ("", "it must not be empty"),
        (" \n\t\n", "it must not be empty"),
        ("a: [1, 2", "it is no YAML: line 1: expected"),
        ("a: 1\n---\nb: 1", "it is no YAML"),
        ("a: \x00", "it is no YAML"),
        ('a: "\\UFFFFFFFF"', "it is no YAML"),
    ],
)  # fmt: skip
def test_errors_say_what_is_wrong(text, message, tmp_path):
    path = tmp_path / "f"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        load(path, camera=3 if "k3" in message else 0 if "basalt" in message else None)
    assert str(path) in str(error.value) and len(str(error.value)) < 1000


def test_paths(tmp_path):
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.json")
    with pytest.raises(ValueError, match="it must be a file"):
        load(tmp_path)
    with pytest.raises(ValueError, match="it must be a file"):
        load("/dev/zero")
    (tmp_path / "large").write_bytes(b" " * ((16 << 20) + 1))
    with pytest.raises(ValueError, match="at most 16 MiB"):
        load(tmp_path / "large")
    (tmp_path / "latin").write_bytes("name: caf\xe9".encode("latin-1"))
    with pytest.raises(ValueError, match=r"must be text in UTF-8: .* 0xe9"):
        load(tmp_path / "latin")
    marked = b"\xef\xbb\xbf" + FILES.joinpath("woodscape.json").read_bytes()
    (tmp_path / "marked").write_bytes(marked)
    assert load(tmp_path / "marked").r_max.item() > 600


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in pairwise("abcdefghij")
)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "nested"),
        ('{"a":' * 100_000, "nested"),
        ("a: " + "[" * 100_000, "nested"),
        ("a: " + "{b: " * 20_000, "nested"),
        ("<a>" * 50_000 + "</a>" * 50_000, "XML must be at most"),
        ("<a>" * 30_000 + "</a>" * 30_000, "XML must be at most 16 elements deep"),
        ("a: " + "1" * 300_000, "YAML must be at most 128 KiB"),
        (BOMB, "must be of one of the formats"),
        (BOMB + "model_type: MEI\nimage_height: *j\n", "image_height must be a whole number"),
        (BOMB + "K: *j\n", "K must be 9 finite numbers"),
        (BOMB + "camera_model: pinhole\ndistortion_model: none\nintrinsics: *j\n", "must be 4 fin"),
        ("a: &a [*a]\n", "it is no YAML"),
        ("a: &a {b: *a}\nK: *a\n", "it is no YAML"),
        ('<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "b">]><l><K>&a;</K></l>', "DOCTYPE"),
        ('<!DOCTYPE l SYSTEM "file:///etc/passwd"><l/>', "DOCTYPE"),
        ('{"K": ' + "9" * 5000 + "}", "it is no JSON"),
        ('{"intrinsic": {"model": "radial_poly", "k1": 1' + "0" * 400 + "}}", "k1 must be a fin"),
        ("K: !!python/object/apply:os.system ['touch pwned']\n", "K must be 9 finite numbers"),
        ("!!python/object/apply:os.system ['touch pwned']\n", "must be a mapping"),
        ("1 " * 1_000_000, "it must have 5 lines"),
        ("1 A\n" * 2_000_000, "a table must be at most 4096 KiB"),
        ("".join(f"{i} A\n" for i in range(9_000)), "camera '0', must be an id"),
        ("1 A\n" * 100_000, "there must be one camera '1', got two"),
        ("".join(f"{i} SIMPLE_PINHOLE 9 9 9 4 4\n" for i in range(20_000)), "to 10000 cameras"),
    ],
)  # fmt: skip
def test_hostile_files_end_soon_and_run_nothing(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message) as error:
        loads(text)
    assert len(str(error.value)) < 1000 and not list(tmp_path.iterdir())


# colmap_all.bin was written by pycolmap 4.2.1 from colmap_all.txt, but for BROWN_CONRADY, which it
# does not know.
def test_colmap_s_binary_file_has_the_cameras_of_its_text_file():
    binary, text = (load_all(FILES / f"colmap_all.{end}", dtype=f64) for end in ("bin", "txt"))
    assert text.keys() - binary.keys() == {"16"} and len(binary) == 17
    assert all(to_dict(binary[name]) == to_dict(text[name]) for name in binary)


def test_binary_files_that_are_wrong(tmp_path):
    whole, path = (FILES / "colmap_all.bin").read_bytes(), tmp_path / "cameras.bin"

    def said(data):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"calibration .*cameras\.bin") as error:
            load_all(path)
        return str(error.value)

    for length in range(8, len(whole)):
        assert "it must hold 17 cameras, but ends in number" in said(whole[:length])
    assert "it holds 3 bytes after its 17 cameras" in said(whole + b"abc")
    assert "cameras, got 4294967295" in said(b"\xff" * 4 + whole[4:])
    assert "to 16 (EUCM), got 17" in said(whole[:12] + bytes([17]) + whole[13:])
    # Any bytes give a lens or a sentence. Each file holds one camera: a camera at a time is what a
    # file of all is read as.
    alone, place = [], 8
    while place < len(whole):
        (model,) = struct.unpack_from("<i", whole, place + 4)
        end = place + 24 + 8 * len(colmap.MODELS[colmap.NUMBERED[model]][1].split())
        alone.append(struct.pack("<Q", 1) + whole[place:end])
        place = end
    assert len(alone) == 17
    random.seed(0)
    for _ in range(300):
        data = bytearray(random.choice(alone))
        data[random.randrange(len(data))] = random.randrange(256)
        path.write_bytes(data)
        with contextlib.suppress(ValueError):
            load_all(path)
