"""What is read from calibrations: in any spelling, and with missing information."""

import json
import math
import re
from itertools import product

import cv2
import numpy as np
import pytest
import torch
import yaml
from helpers import CALIBRATIONS, refused
from lens_examples import (
    FILES,
    FISHEYE,
    FISHEYES,
    NGP,
    OTHER_CAMERAS,
    PLUMB_BOB,
    RATIONAL,
    K,
    f64,
    file_text,
    flat,
    instant_ngp,
    loads,
    opencv,
    sized,
    write_opencv,
)  # fmt: skip
from scipy.spatial.transform import Rotation

from darswin.lens import ImplausibleLens, from_dict, load, load_all, load_up, to_dict
from darswin.lens.files.load import Calibration
from darswin.views import up_of


@pytest.mark.parametrize(("name", "model", "center", "size"), [
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
    ("ocamcalib.txt", "OCam", (723.6, 715.2), (1440, 1440)),
    # The center of the upper left pixel is (0.5, 0.5).
    ("colmap.txt", "KannalaBrandt", (1504 - 0.5, 2048 - 0.5), (4096, 3008)),
    ("nerfstudio.json", "KannalaBrandt", (719.1 - 0.5, 962.3 - 0.5), (1920, 1440)),
    ("ours.json", "KannalaBrandt", (319.5, 241.0), (480, 640)),
])  # fmt: skip
def test_each_format_keeps_its_pixel_origin(name, model, center, size):
    lens = load(FILES / name, dtype=f64)
    assert type(lens).__name__ == model and len(lens) == 1
    assert lens.center.tolist() == [pytest.approx(center, abs=1e-12)]
    assert lens.image_size.tolist() == [list(size)]
    assert lens.theta_max.dtype == f64
    assert load(FILES / name).theta_max.dtype == torch.float32


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
SIZE = dict(image_size=[960, 1280])
SIZES = [
    *(dict([entry]) for entry in product(
        ("image_size", "imageSize", "img_size", "size", "DIM", "resolution", "frame_size",
         "frameSize", "img_dim"),
        ([1280, 960], [[1280, 960]], [[1280], [960]], [1280.0, 960.0], "1280 960",
         {"rows": 1, "cols": 2, "dt": "i", "data": [1280, 960]},
         {"rows": 2, "cols": 1, "data": "1280. 960."}, {"width": 1280, "height": 960}))),
    dict(image_width=[[1280]], image_height=[960]),
    dict(calib_dimension=dict(w=1280, h=960)),
    dict(width={"rows": 1, "cols": 1, "data": [1280]}, height=960),
    dict(shape=[960, 1280]), dict(image_shape=[960, 1280, 3]), dict(img_shape=[960, 1280, 1]),
    # Another order than the name's, which the principal point contradicts.
    dict(img_size=[960, 1280]), dict(image_size=[[960], [1280]]), dict(shape=[1280, 960]),
    dict(img_size=[960, 1280, 3]),
]  # fmt: skip


def single(**entries):
    """Single numbers of a fisheye whose size is given by the entries."""
    numbers = json.loads(flat("k1", "k2", "k3", "k4"))
    return json.dumps({k: v for k, v in numbers.items() if k not in ("width", "height")} | entries)


def fisheye_or_pinhole(**entries):
    """Four coefficients, whose model depends on the other entries."""
    return opencv(D=FISHEYE, **entries)


ROS2 = file_text("ros2_echo.yaml")
ECHOED = dict(image_size=[480, 640], center=[317.8, 236.4], denominator=[0.548, -0.071, 0.029])
PINHOLE = dict(model="BrownConrady", radial=FISHEYE[:2], tangential=FISHEYE[2:])
EIGHT = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
DIVIDED = dict(radial=[0.2, 0.05, 0.003], denominator=[0.25, 0.04, 0.002])
PLACE = dict(zip(("fx", "fy", "cx", "cy"), (421.3, 420.9, 643.1, 478.6), strict=True))
FOUR, KB4 = [*PLACE.values()], dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))
MRCAL = (
    "# mrcal\n{{ 'lensmodel': 'LENSMODEL_{}',\n 'imagersize': [ 1280, 960,],\n 'intrinsics': {},}}"
)
TWELVE = [*PLUMB_BOB, *RATIONAL[5:], 0.01, 0.02, 0.03, 0.04]
OST = (
    "# oST version 5.0 parameters\n[image]\nwidth\n1280\nheight\n960\n[narrow_stereo{}]\n"
    "camera matrix\n421.3 0 643.1\n0 420.9 478.6\n0 0 1\ndistortion\n{} 0.05 0.001 -0.002 0.003\n"
)
SENSORS = (
    "# kapture format: 1.1\nc 0, a b, camera, OPENCV_FISHEYE, 1280, 960, 421.3, 420.9, 643.6, "
    "479.1, -0.021, 0.0043, -0.0012, 0.00008\nw, , wifi, x\n"
)
EQUI = dict(radial=FISHEYE, model="KannalaBrandt", image_size=[960, 1280])


def okvis(kind, terms):
    """A camera of OKVIS."""
    return json.dumps(dict(cameras=[dict(
        distortion_type=kind, focal_length=FOUR[:2], principal_point=FOUR[2:], T_SC=[1.0] * 16,
        image_dimension=[1280, 960], distortion_coefficients=terms)]))  # fmt: skip


def ncamera(intrinsics, **distortion):
    """A camera of maplab."""
    camera = dict(label="left", type="pinhole" if len(intrinsics) < 5 else "unified-projection",
                  image_width=1280, image_height=960, intrinsics=dict(rows=4, cols=1,
                  data=intrinsics), **distortion and dict(distortion=distortion))  # fmt: skip
    return json.dumps(dict(cameras=[dict(camera=camera, T_B_C=[1.0] * 16)]))


def vikit(kind, **terms):
    """A camera of vikit."""
    place = {f"cam_{name}": value for name, value in PLACE.items()}
    return json.dumps(
        dict(cam_model=kind, cam_width=1280, cam_height=960, scale=0.5) | place | terms
    )


@pytest.mark.parametrize(("text", "options", "expected"), [
    # Programs whose files name the model.
    (MRCAL.format("PINHOLE", FOUR), {}, dict(model="Perspective") | SIZE),
    (MRCAL.format("OPENCV4", [*FOUR, *PLUMB_BOB[:4]]), {}, RADTAN | SIZE),
    (MRCAL.format("OPENCV5", [*FOUR, *PLUMB_BOB]), {}, PLUMB),
    (MRCAL.format("OPENCV8", [*FOUR, *RATIONAL]), {}, DIVIDED),
    (MRCAL.format("OPENCV12", [*FOUR, *TWELVE]), {}, dict(prism=TWELVE[8:])),
    (okvis("equidistant", FISHEYE), {}, EQUI),
    (okvis("radialtangential", PLUMB_BOB[:4]), {}, RADTAN),
    (okvis("radialtangential8", RATIONAL), {}, DIVIDED),
    (ncamera(FOUR, type="equidistant", parameters=FISHEYE), {}, EQUI),
    (ncamera(FOUR, type="radial-tangential", parameters=dict(data=PLUMB_BOB[:4])), {}, RADTAN),
    (ncamera(FOUR, type="fisheye", parameters=[0.9]), {}, dict(model="FieldOfView", omega=0.9)),
    *((ncamera(FOUR, **none), {}, dict(model="Perspective"))
      for none in ({}, dict(type="none", parameters=dict(data=[])))),
    (ncamera([1.1, *FOUR], type="none", parameters=[]), {}, dict(model="Spherical", xi=1.1)),
    (vikit("EquidistantCamera", **KB4), {}, EQUI),
    (vikit("Pinhole", cam_d0=-0.22, cam_d1=0.05, cam_d2=0.001, cam_d3=-0.002), {}, RADTAN),
    *((json.dumps({kind: dict(PLACE, width=1280, height=960, **terms)}), {}, expected)
      for kind, terms, expected in (
        ("KannalaBrandt4", KB4, EQUI), ("UCM", dict(alpha=0.6), dict(alpha=0.6, beta=1.0)),
        ("EUCM", dict(alpha=0.6, beta=1.1), dict(alpha=0.6, beta=1.1)),
        ("DoubleSphere", dict(xi=-0.1, alpha=0.6), dict(model="DoubleSphere", xi=-0.1)),
        ("FovCamera", dict(w=0), dict(model="Perspective")),
        ("OpenCVModel5", dict(k1=-0.22, k2=0.05, p1=0.001, p2=-0.002, k3=0.003), PLUMB))),
    (SENSORS, {}, EQUI | dict(center=[643.1, 478.6])), (OST.format("", -0.22), {}, PLUMB),
    *((OST.format("/left", 0) + OST.format("/right", -0.22), dict(camera=camera), PLUMB)
      for camera in ("right", 1)),
    ("1 FOV 1280 960 421.3 420.9 643.6 479.1 0\n", {}, dict(model="Perspective")),
    # A rig with any number of cameras.
    *((json.dumps({f"{k}{end}": [[300.0 + i, 0, 643], [0, 300, 478], [0, 0, 1]]
                   for i, end in enumerate(ends)} | {f"dist{end}": FISHEYE for end in ends}
                  | {f"shape{end}": [960, 1280] for end in ends} | dict(fisheye=1)),
       dict(camera=camera), EQUI | dict(focal=focal))
      for k, ends, camera, focal in (("K", [*range(12)], 11, 311.0),
                                     ("camera_matrix", ["_0", "_10"], "10", 301.0),
                                     ("mtx", [".5", "-6"], 6, 301.0))),
    # A field of view of a camera of Blender.
    *((json.dumps(dict(w=1280, h=960, camera_angle_x=2 * math.atan(640 / 421.3)) | entries), {},
       dict(model="Perspective", center=[639.5, 479.5]) | expected) for entries, expected in (
        ({}, {}), (dict(frames=[{"file_path": "a"}], camera_angle_y=2 * math.atan(480 / 842.6)),
                   dict(affine=[[1, 0], [0, pytest.approx(2)]])))),
    *((EUROC.format(word), {}, RADTAN | SIZE)
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
    (FISHEYES["Kalibr"](FISHEYE).replace("equidistant", "radtan"), {}, PINHOLE),
    (opencv(D=[*PLUMB_BOB, 0, 0]), {}, PLUMB),
    *((text(FISHEYE), {}, KB) for text in FISHEYES.values()),
    # The size of the image in every form.
    *((text, {}, SIZE) for entries in SIZES for text in (sized(**entries), single(**entries))),
    (sized(img_size=[960, 1280], image_size=[1280, 960], imageSize=[1280, 960]), {}, SIZE),
    # The name decides where the principal point does not.
    *((sized(K=[[421.3, 0, cx], [0, 421.3, cy], [0, 0, 1]], **{name: [1280, 1240]}), {},
       dict(image_size=size)) for cx, cy in ((643.1, 643.1), (200.0, 800.0), (1100.0, 100.0))
      for name, size in (("img_size", [1240, 1280]), ("shape", [1280, 1240]))),
    # Whether it is a fisheye in any word.
    *((text, {}, dict(model=model)) for name in ("is_fisheye", "isFisheye", "fisheye")
      for model, words in (("KannalaBrandt", ("True", "yes", 1, "1", "TRUE")),
                           ("BrownConrady", ("no", "False", 0)))
      for value in words
      for text in (instant_ngp(**{"is_fisheye": None, name: value}),
                   opencv(D=FISHEYE, **{name: value}))),
    *((instant_ngp(is_fisheye=value, **entries), {}, dict(model=model))
      for value, model in ((None, "BrownConrady"), (True, "KannalaBrandt"),
                           (False, "BrownConrady"))
      for off in (dict.fromkeys(other, 0) for other in OTHER_CAMERAS)
      for entries in (off, off | dict(frames=[NGP["frames"][0] | off]))),
    (instant_ngp(), {}, dict(model="KannalaBrandt", center=[803.0, 596.75],
                             radial=[0.0182, -0.0064, 0.0027, -0.0008])),
    # Single numbers.
    (flat("k1", "k2", "k3", "k4"), {}, KB | {"center": [643.1, 478.6], "focal": 421.3}),
    (yaml.safe_dump(json.loads(flat("k1", "k2", "k3", "k4"))), {}, KB),
    (flat("k1", "k2", "k3", model="fisheye"), {}, KB | dict(radial=[*FISHEYE[:3], 0.0])),
    (flat("k1", "k2", "p1", "p2"), {}, PINHOLE | dict(radial=[*FISHEYE[:2], 0.0])),
    (flat(**dict(zip(EIGHT, RATIONAL, strict=True))), {}, DIVIDED),
    (flat("k1", "k2", "p1", "p2", fy=421.3, skew=421.3), {}, {"affine": [[1, 1], [0, 1]]}),
    (flat("k1", "k2", "p1", "p2", xi=1.1), {}, PINHOLE | dict(model="Mei", xi=1.1)),
])  # fmt: skip
def test_what_is_read(text, options, expected):
    described = to_dict(loads(text, dtype=f64, **options))
    assert described | expected == described


ALIKE = {
    # Coefficients filled up with zeros, and beside numbers by name, as RealSense's tools write.
    **{f"{name} {zeros}": (text([*FISHEYE, *zeros]), text(FISHEYE))
       for name, text in FISHEYES.items()
       for zeros in ([0], [0.0], [-0.0, 0], [0, 0, 0, 0], [0.0] * 5)},
    **{name: (flat(model="kannala_brandt4", **{name: [*FISHEYE, 0]}), FISHEYES["by name"](FISHEYE))
       for name in ("coeffs", "D", "distortion_coefficients")},
    **{str(entries): (instant_ngp(**entries), instant_ngp()) for entries in (
        dict(is_fisheye="true"), dict(camera_model="OPENCV_FISHEYE"), dict(p1=0))},
    "reversed": (json.dumps(dict(reversed(NGP.items()))), instant_ngp()),
    # Degrees in our own JSON.
    **{f"{model} {name} {degrees}": tuple(json.dumps(
        dict(model=model, image_size=[640, 640], **entries) | angle)
        for angle in ({f"{name}_deg": degrees}, {name: math.radians(degrees)}))
       for model, entries, name, degrees in (
        ("Equidistant", dict(focal=300.0), "theta_max", 95),
        ("Polynomial", dict(coefficients=[300.0, 2.0]), "theta_max", 100.5),
        ("Spherical", dict(xi=0.5), "fov", 170),
        ("Equidistant", dict(focal=300.0), "theta_max", 180))},
}  # fmt: skip


@pytest.mark.parametrize("name", ALIKE)
def test_two_texts_of_one_lens(name):
    one, other = (to_dict(loads(text, dtype=f64)) for text in ALIKE[name])
    assert one == other


def test_frames_of_instant_ngp_may_have_their_own_numbers():
    inside = NGP["frames"][0] | {name: value for name, value in NGP.items() if name != "frames"}
    frames = dict(frames=[inside, inside | {"file_path": "2", "fl_x": 400.0}])
    first, second = Calibration(json.dumps(frames), "in a string").lenses(dtype=f64).values()
    assert to_dict(first) == to_dict(loads(instant_ngp(), dtype=f64))
    assert second.focal.item() == 400


def test_the_order_of_a_size_beside_the_matrix_of_a_smaller_image():
    k = [[421.3, 0, 960.0], [0, 421.3, 540.0], [0, 0, 1]]
    for name, size in product(("img_size", "shape"), ((2160, 3840), (3840, 2160))):
        with pytest.warns(ImplausibleLens, match="of 2160 × 3840 px .* would fit 10.. × 19.. px"):
            assert loads(sized(K=k, **{name: size})).image_size.tolist() == [[2160, 3840]]


@pytest.mark.parametrize(("model", "degrees"), [("Equidistant", 360), ("Orthographic", 180)])
@pytest.mark.parametrize("dtype", [torch.float32, f64])
def test_the_largest_angle_is_allowed_however_it_is_given(model, degrees, dtype):
    size = dict(model=model, image_size=[100, 100])
    half = dict(focal=9.0, theta_max_deg=degrees / 2)
    for entries in (dict(fov_deg=degrees), dict(fov=math.radians(degrees)), half):
        for lens in (loads(json.dumps(size | entries), dtype=dtype), from_dict(size | entries)):
            assert lens.theta_max.item() == pytest.approx(math.radians(degrees / 2), abs=1e-4)


def test_a_field_of_view_fills_the_image():
    lens = from_dict(dict(model="Equidistant", fov_deg=170), (100, 100))
    assert lens.r_max.item() == pytest.approx(50) == 50 * lens.theta_max / math.radians(85)
    lens = loads('{"model": "Spherical", "xi": 0.5, "fov": 2.8}', image_size=(40, 60))
    assert lens.r_max.item() == pytest.approx(20) == 20 * lens.theta_max / 1.4
    assert load(FILES / "ours_degrees.json").r_max.item() == pytest.approx(300)


@pytest.mark.parametrize("name", ["woodscape.json", "synwoodscape.json"])
def test_up_of_a_vehicles_camera_is_that_of_its_rotation(name):
    content = json.loads((CALIBRATIONS / name).read_text())
    rotation = Rotation.from_quat(content["extrinsic"]["quaternion"]).as_matrix()
    up = load_up(CALIBRATIONS / name)
    assert up == pytest.approx(rotation.T @ [0, 0, 1])
    assert up == pytest.approx(up_of(extrinsics=rotation))
    assert up[1] < -0.5 and np.linalg.norm(up) == pytest.approx(1)  # the camera stands upright


def test_files_that_do_not_say_what_is_up(tmp_path):
    path, content = tmp_path / "camera.json", json.loads(file_text("woodscape.json"))
    for extrinsic, said in (
        (dict(quaternion=[0, 0, 0, 0]), "extrinsic.quaternion must not be zero"),
        (dict(quaternion=[0, 0, 1]), r"extrinsic\.quaternion must be .*4"),
        (dict(), "quaternion"),
        (None, "extrinsic"),
    ):
        path.write_text(json.dumps(content | dict(extrinsic=extrinsic)))
        refused(f"{re.escape(str(path))}.*{said}", load_up, path)
    refused("Kalibr files do not say which way is up", load_up, FILES / "kalibr_tumvi.yaml")


def test_theta_max_is_the_widest_side():
    for name in ("woodscape.json", "kitti360_02.yaml", "ros_plumb_bob.yaml"):
        lens = load(FILES / name, dtype=f64)
        sides = lens.with_theta_max(None).side_angles()
        assert lens.theta_max.item() == sides.max().item() < lens.theta_limit.item()
    assert math.degrees(load(FILES / "woodscape.json").theta_max) == pytest.approx(95.206, abs=0.01)
    assert load(FILES / "woodscape.json", theta_max=1.2).theta_max.item() == pytest.approx(1.2)
    assert load(FILES / "ours.json").theta_max.item() == pytest.approx(1.6)
    # For an image larger than the image circle, θ_max is the limit.
    lens = load(FILES / "opencv_fisheye.yaml", dtype=f64)
    wide = loads(file_text("opencv_fisheye.yaml").replace("1280", "12800"), dtype=f64)
    assert wide.theta_max.item() == wide.theta_limit.item() > lens.theta_max.item()


def test_without_an_image_size():
    lens = loads(sized(), dtype=f64)
    assert lens.image_size is None and lens.theta_max.item() == lens.theta_limit.item()
    with_size = loads(sized(), image_size=(960, 1280), dtype=f64)
    assert with_size.image_size.tolist() == [[960, 1280]]
    sides = with_size.side_angles()
    assert with_size.theta_max.item() == sides.max().item() < lens.theta_max.item()
    pinhole = json.dumps(dict(K=K, D=[0.0] * 5))
    assert loads(pinhole, theta_max=1.0).theta_max.item() == pytest.approx(1.0)
    assert loads(pinhole, image_size=(960, 1280)).r_max.item() == pytest.approx(643.6, abs=0.5)
    # The file's own size takes precedence.
    assert load(FILES / "woodscape.json", image_size=(9, 9)).image_size.tolist() == [[966, 1280]]


def test_several_cameras():
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
    pair = dict(M1=K, D1=[0.1, 0, 0, 0, 0], M2=K, D2=[0.2, 0, 0, 0, 0], width=640, height=480)
    lenses = [loads(json.dumps(pair), camera=k, dtype=f64) for k in ("1", "2")]
    assert [lens.radial[0, 0].item() for lens in lenses] == [0.1, 0.2]
    assert load(FILES / "basalt.json", camera="cam4").image_size.tolist() == [[480, 640]]
    assert load(FILES / "numpy_shape.npz").image_size.tolist() == [[768, 1024]]
    # If the names are numbers, a number is a name.
    colmap = "".join(f"{i} SIMPLE_FISHEYE 640 480 {100 * i} 320 240\n" for i in (1, 2, 5, 7))
    for name in (1, 2, 5, 7, "1", "2", "5", "7"):
        assert loads(colmap, camera=name).focal.item() == 100 * int(name)
    # A camera with a missing entry is an error only if it is read.
    text = file_text("kalibr_tumvi.yaml").replace("camera_model", "model", 1)
    assert loads(text, camera="cam1").focal.item() == focal


@pytest.mark.parametrize("end", ["", "---\n", "---\n---\n"])
def test_equal_messages_are_one_camera(end, tmp_path):
    path, one = tmp_path / "messages.yaml", ROS2.removesuffix("---\n")
    assert "sec: 1695049213" in one
    messages = [one.replace("sec: 1695049213", f"sec: {k}") for k in range(3)]
    path.write_text("---\n".join(messages) + end)
    assert load(path).same_as(load(FILES / "ros2_echo.yaml"))
    messages[2] = messages[2].replace("width: 640", "width: 320")
    path.write_text("---\n".join(messages) + end)
    refused("documents 1 and 3, .* differ in width: keep one", load, path)


@pytest.mark.parametrize("end", ["yaml", "json", "xml"])
def test_a_file_storage_in_base64_and_a_multi_view_result(end, tmp_path):
    flags, path = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_WRITE_BASE64, str(tmp_path / f"c.{end}")
    for mode in (cv2.FILE_STORAGE_WRITE, flags):
        one = dict(
            fisheye_model=1,
            camera_matrix=np.array(K),
            D=np.array([FISHEYE]).T,
            image_points=np.zeros((9, 90000), np.float32)[:, :: 1 if mode == flags else 900],
        )
        rig = dict(
            Ks=np.stack([K] * 3),
            distortions=np.array([FISHEYE] * 3),
            cam_ids="l,m,r",
            is_fisheye=np.array([0, 0, 1]),
            image_sizes=np.array([[1280, 960]] * 3),
        )
        for entries, camera in ((one, None), (rig, "r")):
            write_opencv(path, mode, **entries)
            lens = load(path, camera=camera, dtype=f64, image_size=(960, 1280))
            described = to_dict(lens)
            assert described | EQUI == described
    assert type(load(path, camera="m")).__name__ == "BrownConrady"
