"""Files as other tools and short scripts write them."""

import io
import json
import zipfile

import cv2
import numpy as np
import pytest
import torch
import yaml
from lens_examples import assert_projects, loads, points_around

from darswin.lens import KannalaBrandt, load

f64 = torch.float64
SIZE = dict(image_size=(960, 1280), dtype=f64)  # where a file does not say it
K = np.array([[421.3, 0.0, 643.1], [0.0, 420.9, 478.6], [0.0, 0.0, 1.0]])
FISHEYE = [-0.021, 0.0043, -0.0012, 0.00008]
PLUMB_BOB = [-0.22, 0.05, 0.001, -0.002, 0.003]


def fisheye(points):
    zero = np.zeros(3)
    return cv2.fisheye.projectPoints(points[None], zero, zero, K, np.array(FISHEYE))[0][0]


def pinhole(points, d):
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(d))[0][:, 0]


def assert_fisheye(lens):
    points = points_around(1.4)
    assert_projects(lens, points, fisheye(points))


def assert_pinhole(lens, d):
    points = points_around(0.7)
    assert_projects(lens, points, pinhole(points, d))


# -- OpenCV's interactive calibration ------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["xml", "yaml", "json"])
def test_opencvs_interactive_calibration(suffix, tmp_path):
    path = tmp_path / f"cameraParameters.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibrationDate", "Mon 02 Feb 2026 10:00:00")
    storage.write("framesCount", 17)
    storage.startWriteStruct("cameraResolution", cv2.FILE_NODE_SEQ)
    for side in (1280, 960):
        storage.write("", side)
    storage.endWriteStruct()
    storage.write("camera_matrix", K)
    storage.write("camera_matrix_std_dev", np.array([[0.5], [0.5], [0.8], [0.7]]))
    storage.write("distortion_coefficients", np.array(PLUMB_BOB))
    storage.write("distortion_coefficients_std_dev", np.full((5, 1), 1e-3))
    storage.write("avg_reprojection_error", 0.31)
    storage.release()
    lens = load(path, dtype=f64)
    assert_pinhole(lens, PLUMB_BOB)
    assert lens.image_size.tolist() == [[960, 1280]]


# -- EuRoC ---------------------------------------------------------------------------------------

EUROC = """# General sensor definitions.
sensor_type: camera
comment: a camera

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.1,
         0.0, 1.0, 0.0, 0.2,
         0.0, 0.0, 1.0, 0.3,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [1280, 960]
camera_model: pinhole
intrinsics: [421.3, 420.9, 643.1, 478.6] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.22, 0.05, 0.001, -0.002]
"""


@pytest.mark.parametrize("word", ["radial-tangential", "radial_tangential", "radtan"])
def test_eurocs_sensor_yaml(word):
    lens = loads(EUROC.replace("radial-tangential", word), dtype=f64)
    assert_pinhole(lens, PLUMB_BOB[:4])
    assert lens.image_size.tolist() == [[960, 1280]]


def test_eurocs_name_beside_a_camera_matrix():
    described = {"distortion_model": "radial-tangential", "K": K.tolist(), "D": PLUMB_BOB[:4]}
    assert_pinhole(loads(json.dumps(described), **SIZE), PLUMB_BOB[:4])


def test_errors_of_eurocs_files_name_the_entry():
    with pytest.raises(ValueError, match=r"distortion_coefficients must be 4 finite numbers"):
        loads(EUROC.replace("[-0.22, ", "["))
    with pytest.raises(ValueError, match="distortion_coeffs is missing"):
        loads(EUROC.replace("distortion_coefficients", "_"))


# -- K and D, as they are ------------------------------------------------------------------------


@pytest.mark.parametrize("dump", [json.dumps, yaml.safe_dump])
def test_k_and_d_alone_need_the_model(dump):
    text = dump({"K": K.tolist(), "D": [[d] for d in FISHEYE]})
    said = (
        r"the coefficients of D may be cv2.fisheye's \(k1 to k4\) or a pinhole's \(k1, k2, p1, p2\)"
        r'.*give model="fisheye" or model="pinhole"'
    )
    with pytest.raises(ValueError, match=said):
        loads(text)
    assert_fisheye(loads(text, model="fisheye", **SIZE))
    assert_pinhole(loads(text, model="pinhole", **SIZE), FISHEYE)


# -- intrinsics by their names -------------------------------------------------------------------

PLANE = {"fx": 421.3, "fy": 420.9, "cx": 643.1, "cy": 478.6, "width": 1280, "height": 960}


def flat(*names, **entries):
    return json.dumps(PLANE | dict(zip(names, FISHEYE)) | entries)  # noqa: B905


def test_k1_to_k4_are_the_fisheye_models():
    lens = loads(flat("k1", "k2", "k3", "k4"), dtype=f64)
    assert_fisheye(lens)
    assert lens.image_size.tolist() == [[960, 1280]]
    assert_fisheye(loads(yaml.safe_dump(json.loads(flat("k1", "k2", "k3", "k4"))), dtype=f64))
    plain = loads(flat("k1", "k2", "k3", model="fisheye"), dtype=f64)
    assert isinstance(plain, KannalaBrandt) and plain.radial[0, 3] == 0


def test_intrinsics_with_p1_are_a_pinholes():
    assert_pinhole(loads(flat("k1", "k2", "p1", "p2"), dtype=f64), FISHEYE)
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    eight = dict(zip(names, (0.2, 0.05, 0.001, -0.002, 0.003, 0.25, 0.04, 0.002), strict=True))
    assert_pinhole(loads(flat(**eight), dtype=f64), [*eight.values()])
    skewed = loads(flat("k1", "k2", "p1", "p2", skew=1.5), dtype=f64)
    assert (skewed.focal * skewed.affine[:, 0, 1]).item() == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (flat("k1", "k2"), r"the coefficients of k1, k2 may be .*give model=\"fisheye\" or"),
        (flat(), r"a camera without coefficients may be .*give model="),
        (flat("k1", "k2", "k3", "k4", model="pinhole"), "k4 of the pinhole model is of its denom"),
        (flat("k1", "k2", "k3", "k4", p1=0.1, model="fisheye"), "the fisheye model has no p1"),
        (flat("k1", "k2", "k3", "k4", k5=0.1), r"the coefficients of k1, .* may be"),
        (flat("k1", "k2", "k3", "k4", D0=0.1), "the fisheye model has no place for the numbers of"),
        (flat("k1", "k2", "k3", "k4", fx=-1), "fx must be a finite number above 0, got -1"),
        (flat("k1", "k2", "k3", "k4", k2=None), "k2 must be a finite number, got None"),
        (flat("k1", "k2", "k3", "k4", model="magic"), "model must be one of .*, got 'magic'"),
        (flat("k1", "k2", xi="a"), "xi must be a finite number"),
    ],
)
def test_intrinsics_that_do_not_say_their_model_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        loads(text)


# -- np.savez ------------------------------------------------------------------------------------


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize(
    ("matrix", "coefficients"),
    [("K", "D"), ("mtx", "dist"), ("camera_matrix", "dist_coeffs"), ("cameraMatrix", "distCoeffs")],
)
def test_arrays_of_numpy(save, matrix, coefficients, tmp_path):
    path = tmp_path / "calib.npz"
    points = np.random.default_rng(0).normal(size=(20, 5000, 3))  # megabytes, and no lens's
    save(path, **{matrix: K, coefficients: np.array([PLUMB_BOB])}, DIM=np.array([1280, 960]),
         rvecs=np.zeros((20, 3, 1)), ret=0.31, objpoints=points)  # fmt: skip
    lens = load(path, dtype=f64)
    assert_pinhole(lens, PLUMB_BOB)
    assert lens.image_size.tolist() == [[960, 1280]]
    save(path, **{matrix: K, coefficients: np.array(FISHEYE)[:, None]})
    with pytest.raises(ValueError, match=r"calibration .*calib.npz: the coef.*model=\"fisheye\""):
        load(path)
    assert_fisheye(load(path, model="fisheye", dtype=f64))


def test_objects_in_numpys_files_are_never_unpickled(tmp_path):
    path = tmp_path / "calib.npz"
    rvecs = np.array([np.zeros(3), np.zeros(2)], dtype=object)
    np.savez(path, K=K, D=PLUMB_BOB, rvecs=rvecs)
    assert_pinhole(load(path, **SIZE), PLUMB_BOB)
    np.savez(path, K=K, D=np.array(PLUMB_BOB, dtype=object))
    with pytest.raises(ValueError, match="a camera without coefficients"):
        load(path)


def test_damaged_archives_are_refused_in_a_sentence(tmp_path):
    path, data = tmp_path / "calib.npz", io.BytesIO()
    np.savez(data, K=K, D=PLUMB_BOB)
    rng = np.random.default_rng(0)
    for _ in range(300):
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
    with pytest.raises(ValueError, match="it must be of one of the formats"):
        load(path)


# -- binning and regions of ROS ------------------------------------------------------------------


def message(binning=(0, 0), roi=(0, 0, 0, 0), **entries):
    names = ("x_offset", "y_offset", "width", "height")
    return yaml.safe_dump(
        dict(height=960, width=1280, distortion_model="plumb_bob", d=PLUMB_BOB,
             k=K.flatten().tolist(), binning_x=binning[0], binning_y=binning[1],
             roi=dict(zip(names, roi, strict=True)) | {"do_rectify": False}) | entries
    )  # fmt: skip


@pytest.mark.parametrize("binning", [(0, 0), (1, 1), (2, 2), (1, 4), (3, 2)])
@pytest.mark.parametrize("roi", [(0, 0, 0, 0), (0, 0, 1280, 960), (101, 52, 640, 483)])
def test_binned_regions_show_what_the_sensor_sees(binning, roi):
    whole = loads(message(), dtype=f64)
    assert_pinhole(whole, PLUMB_BOB)
    lens = loads(message(binning, roi), dtype=f64).with_theta_max(None)
    left, top, width, height = roi if any(roi) else (0, 0, 1280, 960)
    across, down = (max(side, 1) for side in binning)
    assert lens.image_size.tolist() == [[height // down, width // across]]
    points = torch.as_tensor(points_around(0.7))
    # A pixel of the image is as many of the sensor's, whose middles it has in its own.
    sensor = whole.with_theta_max(None).project_points(points) - torch.tensor([left, top])
    expected = (sensor + 0.5) / torch.tensor([across, down], dtype=f64) - 0.5
    torch.testing.assert_close(lens.project_points(points), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (message((-1, 1)), "binning_x must be a whole number of pixels, 0 to .*, got '-1'"),
        (message((1, 1.5)), r"binning_y must be a whole number of pixels, .*, got '1\.5'"),
        (message((1, 961)), "binning must leave a pixel, got 1 by 961 as one"),
        (message(roi=(5, 0, 0, 0)), "roi must be a region of the image of 1 pixel or more, or all"),
        (message(roi=(0, 0, 1281, 9)), r"roi must be .*, got 1281×9 px at \(0, 0\)"),
        (message(roi=(-1, 0, 10, 9)), r"roi.x_offset must be a whole number of pixels"),
        (message(roi=(0, 0, "a", 9)), r"roi.width must be a whole number .*, got 'a'"),
        (message(roi=(0, 0, 0, 0), binning_x=None), "binning_x must be a whole number of pixels"),
    ],
)
def test_regions_that_are_none_are_refused(text, said):
    with pytest.raises(ValueError, match=said):
        loads(text)
