"""Variants of calibration files: filled up coefficients, sizes in any form, degrees, encodings."""

import codecs
import json
import math
from itertools import product

import numpy as np
import pytest
import torch
import yaml
from lens_examples import FILES, FISHEYE, PLUMB_BOB, K, f64, file_text, flat, loads, message, opencv

from darswin.lens import ImplausibleLens, Orthographic, from_dict, load, load_all, to_dict
from darswin.lens.files.load import Calibration

KB = dict(model="KannalaBrandt", radial=FISHEYE)


# -- coefficients that are filled up with zeros ---------------------------------------------------


def in_ros(d):
    text = message().replace("plumb_bob", "equidistant")
    return yaml.safe_dump(yaml.safe_load(text) | {"d": d})


def in_kalibr(d):
    return json.dumps({"cam0": dict(
        camera_model="pinhole", distortion_model="equidistant", distortion_coeffs=d,
        intrinsics=[421.3, 420.9, 643.1, 478.6], resolution=[1280, 960])})  # fmt: skip


def in_euroc(d):
    return json.dumps(dict(
        camera_model="pinhole", distortion_model="equidistant", distortion_coefficients=d,
        intrinsics=[421.3, 420.9, 643.1, 478.6], resolution=[1280, 960]))  # fmt: skip


def by_name(d):
    names = [f"k{i}" for i in range(1, len(d) + 1)]
    return flat(**dict(zip(names, d, strict=True)), model="fisheye")


def in_camodocal(d):
    values = {f"k{i}": value for i, value in enumerate(d, 2)}
    plane = dict(mu=421.3, mv=420.9, u0=643.1, v0=478.6)
    return json.dumps(dict(model_type="KANNALA_BRANDT", image_width=1280, image_height=960,
                           projection_parameters=values | plane))  # fmt: skip


def in_nerfstudio(d):
    values = {f"k{i}": value for i, value in enumerate(d, 1)}
    plane = dict(fl_x=421.3, fl_y=420.9, cx=643.6, cy=479.1, w=1280, h=960)
    return json.dumps(plane | values | dict(camera_model="OPENCV_FISHEYE"))


def in_basalt(d):
    values = {f"k{i}": value for i, value in enumerate(d, 1)}
    plane = dict(fx=421.3, fy=420.9, cx=643.1, cy=478.6)
    entry = dict(camera_type="kb4", intrinsics=plane | values)
    return json.dumps(dict(value0=dict(intrinsics=[entry], resolution=[[1280, 960]])))


READERS = {
    "ROS": (in_ros, "d must have 4 coefficients"),
    "matrix": (lambda d: opencv(D={"rows": len(d), "cols": 1, "data": d}, fisheye=1), "D"),
    "rows": (lambda d: opencv(D=[[value] for value in d], fisheye_model=1), "D must"),
    "text": (lambda d: opencv(dist_coeffs=" ".join(map(str, d)), model="equidistant"), "dist_c"),
    "Kalibr": (in_kalibr, "cam0.distortion_coeffs must be 4 finite numbers"),
    "EuRoC": (in_euroc, "distortion_coefficients must be 4 finite numbers"),
    "by name": (by_name, "the fisheye model has no k5"),
    "CamOdoCal": (in_camodocal, "does not use the numbers of projection_parameters.k6"),
    "nerfstudio": (in_nerfstudio, "does not use the numbers of k5"),
    "basalt": (in_basalt, r"does not use the numbers of value0.intrinsics\[0\].intrinsics.k5"),
}


@pytest.mark.parametrize("name", READERS)
def test_zeros_after_the_four_coefficients_of_a_fisheye_change_nothing(name):
    text, refused = READERS[name]
    expected = to_dict(loads(text(FISHEYE), dtype=f64))
    assert expected | KB == expected
    for zeros in ([0], [0.0], [-0.0, 0], [0, 0, 0, 0], [0.0] * 5):
        assert to_dict(loads(text([*FISHEYE, *zeros]), dtype=f64)) == expected
    for others in ([1e-9], [0.001, 0]):
        with pytest.raises(ValueError, match=refused):
            loads(text([*FISHEYE, *others]))


@pytest.mark.parametrize("d", [[*FISHEYE, None], [*FISHEYE, "zero"], [*FISHEYE, False]], ids=str)
@pytest.mark.parametrize("text", [in_ros, in_kalibr])
def test_only_numbers_are_zeros(text, d):
    with pytest.raises(ValueError, match="finite number"):
        loads(text(d))


def test_other_models_keep_their_numbers_of_coefficients():
    with pytest.raises(ValueError, match="d must be 0 or 4 or 5 or 8 or 12 or 14 finite numbers"):
        loads(message().replace("d:", "d: [0.1, 0.2, 0.3]\nold:"))
    radtan = in_kalibr(FISHEYE).replace("equidistant", "radtan")
    assert loads(radtan, dtype=f64).radial.tolist() == [FISHEYE[:2]]
    with pytest.raises(ValueError, match=r"cam0.distortion_coeffs must be 4 finite numbers"):
        loads(in_kalibr([*FISHEYE, 0.0]).replace("equidistant", "radtan"))
    assert loads(opencv(D=[*PLUMB_BOB, 0, 0])).radial.shape == (1, 3)


@pytest.mark.parametrize("name", ["coeffs", "D", "distortion_coefficients"])
def test_numbers_by_name_beside_a_list_of_coefficients(name):
    """As RealSense's tools write them."""
    expected = to_dict(loads(flat(**dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True)),
                                  model="fisheye"), dtype=f64))  # fmt: skip
    text = flat(model="kannala_brandt4", **{name: [*FISHEYE, 0]})
    assert to_dict(loads(text, dtype=f64)) == expected
    with pytest.raises(ValueError, match=f"{name} must have 4 coefficients for the fisheye model"):
        loads(flat(model="kannala_brandt4", **{name: [*FISHEYE, 0.1]}))


# -- the size of the image ------------------------------------------------------------------------


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


def sized(**entries):
    return json.dumps(dict(K=K, D=FISHEYE, fisheye=1) | entries)


@pytest.mark.parametrize("entries", SIZES, ids=str)
def test_the_size_of_the_image_in_every_form(entries):
    assert loads(sized(**entries)).image_size.tolist() == [[960, 1280]]
    single = {name: value for name, value in json.loads(flat("k1", "k2", "k3", "k4")).items()
              if name not in ("width", "height")}  # fmt: skip
    assert loads(json.dumps(single | entries)).image_size.tolist() == [[960, 1280]]


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        (dict(image_size=[1280]), "image_size must be 2 or 3 finite numbers, got"),
        (dict(image_size=[1280.5, 960]), r"image_size\[0\] must be a whole number of pixels"),
        (dict(shape=[960, 0]), r"shape\[1\] must be a whole number of pixels"),
        (dict(shape=[960, 1280, 2]), r"shape\[2\] must be 1, 3 or 4 channels, got 2"),
        (dict(image_size={"rows": 1, "cols": 3, "data": [1280, 960]}), "must be 1 × 3 numbers"),
        (dict(image_size={"width": 1280}), "image_size.height is missing"),
        (dict(image_width=[[1280, 1]], image_height=960), "image_width must be 1 finite numbers"),
    ],
)  # fmt: skip
def test_wrong_sizes_are_refused_by_name(entries, said):
    with pytest.raises(ValueError, match=said):
        loads(sized(**entries))


CLOSE = 1.15  # the middles of both orders are so close that only an exact one tells them apart
SHIFTS = [(0.0, 0.0), (0.02, -0.02), (-0.03, 0.01)]


@pytest.mark.parametrize(
    ("ratio", "shift"), [*product([16 / 9, 3 / 2, 4 / 3, 5 / 4], SHIFTS), (CLOSE, (0.0, 0.0))]
)
@pytest.mark.parametrize("turned", [False, True])
def test_arrays_of_numpy_in_either_order(ratio, turned, shift, tmp_path):
    """`np.savez(img_size=img.shape[:2])` and `img_size=img.shape[1::-1]`."""
    short, long = 960, round(960 * ratio)
    height, width = (long, short) if turned else (short, long)
    path = tmp_path / "calib.npz"
    center = [(0.5 + part) * side for part, side in zip(shift, (width, height), strict=True)]
    k = np.array([[421.3, 0, center[0]], [0, 420.9, center[1]], [0, 0, 1]])
    array = np.zeros((height, width, 3), np.uint8)
    for entry in (
        dict(img_size=array.shape[:2]), dict(img_size=array.shape[1::-1]), dict(shape=array.shape),
        dict(shape=array.shape[:2]), dict(shape=array.shape[1::-1]), dict(size=array.shape),
    ):  # fmt: skip
        np.savez(path, K=k, D=np.array(FISHEYE), **entry)
        assert load(path, coefficients="fisheye").image_size.tolist() == [[height, width]], entry


@pytest.mark.parametrize(
    ("entries", "said"),
    [(dict(image_width=848, imageWidth=640, height=480), "image_width and imageWidth must be the"),
     (dict(img_size=[640, 480], image_size=[848, 480]), "img_size and image_size must be the same"),
     (dict(frame_size=[640, 480], frameSize=[848, 480]), "frame_size and frameSize must be the s")],
)  # fmt: skip
def test_two_entries_of_one_meaning_must_agree(entries, said):
    with pytest.raises(ValueError, match=said):
        loads(sized(**entries))
    with pytest.raises(ValueError, match="fx and Fx must be the same"):
        loads(flat("k1", "k2", "k3", "k4", Fx=300))
    both = dict(img_size=[960, 1280], image_size=[1280, 960], imageSize=[1280, 960])
    assert loads(sized(**both)).image_size.tolist() == [[960, 1280]]


@pytest.mark.parametrize("size", [(2160, 3840), (3840, 2160)])
@pytest.mark.parametrize("name", ["img_size", "shape"])
def test_the_order_of_a_size_beside_the_matrix_of_a_smaller_image(name, size):
    k = [[421.3, 0, 960.0], [0, 421.3, 540.0], [0, 0, 1]]
    with pytest.warns(ImplausibleLens, match="of 3840 × 2160 px .* would fit 19.. × 10.. px"):
        lens = loads(sized(K=k, **{name: size}))
    assert lens.image_size.tolist() == [[2160, 3840]]


def test_the_name_decides_where_the_principal_point_does_not():
    for cx, cy in ((643.1, 643.1), (200.0, 800.0), (1100.0, 100.0)):
        k = [[421.3, 0, cx], [0, 421.3, cy], [0, 0, 1]]
        by_size = loads(sized(K=k, img_size=[1280, 1240]))
        by_shape = loads(sized(K=k, shape=[1280, 1240]))
        assert by_size.image_size.tolist() == [[1240, 1280]]
        assert by_shape.image_size.tolist() == [[1280, 1240]]


# -- instant-ngp ----------------------------------------------------------------------------------


def test_is_fisheye_alone_names_the_model():
    lens = load(FILES / "instant_ngp.json", dtype=f64)
    assert lens.radial.tolist() == [[0.0182, -0.0064, 0.0027, -0.0008]]
    assert lens.center.tolist() == [[803.0, 596.75]]
    content = json.loads(file_text("instant_ngp.json"))
    for changes in (dict(is_fisheye="true"), dict(camera_model="OPENCV_FISHEYE"), dict(p1=0)):
        assert to_dict(loads(json.dumps(content | changes), dtype=f64)) == to_dict(lens)
    reverse = dict(reversed(content.items()))
    assert to_dict(loads(json.dumps(reverse), dtype=f64)) == to_dict(lens)
    frame = content["frames"][0]
    inside = {name: value for name, value in content.items() if name != "frames"}
    frames = dict(frames=[frame | inside, frame | inside | {"file_path": "2", "fl_x": 400.0}])
    first, second = Calibration(json.dumps(frames), "in a string").lenses(dtype=f64).values()
    assert to_dict(first) == to_dict(lens) and second.focal.item() == 400
    assert type(loads(json.dumps(content | dict(is_fisheye=False)))).__name__ == "BrownConrady"
    with pytest.raises(ValueError, match="does not use the numbers of p1"):
        loads(json.dumps(content | dict(p1=0.1)))
    with pytest.raises(ValueError, match="is_fisheye is true, but camera_model is OPENCV"):
        loads(json.dumps(content | dict(camera_model="OPENCV")))


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize("is_fisheye", [None, True, False])
@pytest.mark.parametrize(
    "other",
    [dict(ftheta_p0=0.0, ftheta_p1=0.001, ftheta_p2=0), dict(ftheta_p4="1e-9"), dict(latlong=True),
     dict(equirectangular=1), dict(is_orthographic="True"), dict(isLatLong="yes")],
    ids=str,
)  # fmt: skip
def test_other_cameras_of_instant_ngp_are_refused(other, is_fisheye, inside):
    content = json.loads(file_text("instant_ngp.json")) | dict(is_fisheye=is_fisheye)
    if is_fisheye is None:
        del content["is_fisheye"]
    off = dict.fromkeys(other, 0)
    name = next(name for name, value in other.items() if value)
    if inside:
        frame = content["frames"][0]
        content["frames"] = [frame | off, frame | other | {"file_path": "2"}]
        with pytest.raises(ValueError, match=rf"frames\[1\]\.{name} names another camera than"):
            loads(json.dumps(content), camera="2")
    else:
        with pytest.raises(ValueError, match=f": {name} names another camera than SIMPLE_PINHOLE"):
            loads(json.dumps(content | other))
    content["frames"] = content["frames"][:1]
    assert type(loads(json.dumps(content | off))).__name__ == (
        "KannalaBrandt" if is_fisheye else "BrownConrady")  # fmt: skip


@pytest.mark.parametrize("name", ["is_fisheye", "isFisheye", "fisheye"])
@pytest.mark.parametrize(
    ("value", "model"),
    [("True", "KannalaBrandt"), ("yes", "KannalaBrandt"), (1, "KannalaBrandt"), ("1", "KannalaBr"),
     ("TRUE", "KannalaBrandt"), ("no", "BrownConrady"), ("False", "BrownConrady"), (0, "Brown"),
     ("maybe", None), (2, None), (None, None), ([1], None)],
)  # fmt: skip
def test_is_fisheye_in_any_word(name, value, model):
    content = json.loads(file_text("instant_ngp.json"))
    del content["is_fisheye"]
    text, matrix = json.dumps(content | {name: value}), opencv(D=FISHEYE, **{name: value})
    if model is None:
        for wrong in (text, matrix):
            with pytest.raises(ValueError, match=f"{name} must be 0 or 1, got "):
                loads(wrong)
    else:
        assert type(loads(text)).__name__.startswith(model)
        assert type(loads(matrix)).__name__.startswith(model)


# -- degrees in our own JSON ----------------------------------------------------------------------

EQUIDISTANT = dict(model="Equidistant", focal=300.0, image_size=[640, 640])
SPHERICAL = dict(model="Spherical", xi=0.5, image_size=[640, 640])
POLYNOMIAL = dict(model="Polynomial", coefficients=[300.0, 2.0], image_size=[640, 640])


@pytest.mark.parametrize(
    ("entries", "radians"),
    [
        (EQUIDISTANT | dict(theta_max_deg=95), dict(theta_max=math.radians(95))),
        (POLYNOMIAL | dict(theta_max_deg=100.5), dict(theta_max=math.radians(100.5))),
        (SPHERICAL | dict(fov_deg=170), dict(fov=math.radians(170))),
        (EQUIDISTANT | dict(theta_max_deg=180), dict(theta_max=math.pi)),
    ],
)
def test_our_json_takes_degrees(entries, radians):
    found = to_dict(loads(json.dumps(entries), dtype=f64))
    plain = {name: value for name, value in entries.items() if not name.endswith("_deg")}
    assert found == to_dict(loads(json.dumps(plain | radians), dtype=f64))


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        (EQUIDISTANT | dict(theta_max_deg=95, theta_max=1.6),
         "theta_max and theta_max_deg must not both be given"),
        (SPHERICAL | dict(fov=2.9, fov_deg=170), "fov and fov_deg must not both be given"),
        (EQUIDISTANT | dict(theta_max=95), r"at most 3.142 rad .*\(theta_max_deg takes degrees\)"),
        (SPHERICAL | dict(fov=170), r"fov must be at most 6.283 rad .*\(fov_deg takes degrees\)"),
        (EQUIDISTANT | dict(theta_max_deg=190), "theta_max_deg must be above 0 and at most 180 de"),
        (SPHERICAL | dict(fov_deg=0), "fov_deg must be above 0 and at most 360 degrees, got 0"),
        (SPHERICAL | dict(fov_deg="wide"), "fov_deg must be above 0 .* got 'wide'"),
        (SPHERICAL | dict(fov_deg=170, theta_max_deg=80), "a Spherical lens has no theta_max_deg"),
        (SPHERICAL | dict(fov_deg=170, focal=80), "fov_deg takes the place of focal, .* theta_max"),
        (EQUIDISTANT | dict(fov=1.7), "fov takes the place of focal, .* theta_max is half of fov"),
        (dict(model="Orthographic", fov_deg=200, image_size=[64, 64]),
         r"fov_deg is 200, but fov must be at most 3.14\d+ rad \((180.00|179.99)°\)"),
        (dict(model="Orthographic", focal=9, theta_max_deg=100),
         r"theta_max_deg is 100, but theta_max must be at most 1.57\d+ rad"),
        (POLYNOMIAL | dict(fov_deg=170), "a Polynomial lens has no fov_deg, only coefficients"),
    ],
)  # fmt: skip
def test_wrong_angles_of_our_json(entries, said):
    with pytest.raises(ValueError, match=said):
        loads(json.dumps(entries))


@pytest.mark.parametrize(("model", "degrees"), [("Equidistant", 360), ("Orthographic", 180)])
@pytest.mark.parametrize("dtype", [torch.float32, f64])
def test_the_largest_angle_is_allowed_however_it_is_given(model, degrees, dtype):
    size = dict(model=model, image_size=[100, 100])
    half = dict(focal=9.0, theta_max_deg=degrees / 2)
    for entries in (dict(fov_deg=degrees), dict(fov=math.radians(degrees)), half):
        for lens in (loads(json.dumps(size | entries), dtype=dtype), from_dict(size | entries)):
            assert lens.theta_max.item() == pytest.approx(math.radians(degrees / 2), abs=1e-4)


def test_a_dict_takes_degrees_like_a_file():
    lens = from_dict(dict(model="Equidistant", fov_deg=170), (100, 100))
    assert math.degrees(lens.theta_max.item()) == pytest.approx(85)
    assert lens.r_max.item() == pytest.approx(50)
    for entries, said in (
        (dict(fov_deg=170, fov=2.9), "fov and fov_deg must not both be given"),
        (dict(fov_deg="wide"), "fov_deg must be a number of degrees, got 'wide'"),
        (dict(fov_deg=400), "fov_deg is 400, but fov must be"),
        (dict(focal=9, theta_max_deg=190), "theta_max_deg is 190, but theta_max must be"),
    ):
        with pytest.raises(ValueError, match=said):
            from_dict(dict(model="Equidistant") | entries, (100, 100))


@pytest.mark.parametrize("fov", [3.2, 2 * math.pi, 6.5])
def test_angles_near_the_limit_are_not_taken_for_degrees(fov):
    with pytest.raises(ValueError, match="fov must be at most") as error:
        Orthographic.from_fov(fov, 50.0)
    assert "radians" not in str(error.value)
    with pytest.raises(ValueError, match=r"170° is 2\.967"):
        Orthographic.from_fov(170.0, 50.0)


# -- encodings ------------------------------------------------------------------------------------

ENCODINGS = {
    "UTF-8 with a mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16, little end first": lambda text: codecs.BOM_UTF16_LE + text.encode("utf-16-le"),
    "UTF-16, big end first": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "Windows": lambda text: text.replace("\n", "\r\n").encode("utf-16"),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    "name",
    ["opencv_fisheye.yaml", "kalibr_ds.yaml", "kitti360_02.yaml", "woodscape.json", "ours.json",
     "opencv_omnidir.xml", "ocamcalib.txt", "colmap.txt"],
)  # fmt: skip
def test_editors_of_other_systems_may_have_saved_a_calibration(name, encoding, tmp_path):
    path = tmp_path / name
    text = file_text(name)
    if name.endswith(".xml") and "UTF-16" in encoding:
        text = text.replace('version="1.0"', 'version="1.0" encoding="UTF-16"')
    path.write_bytes(ENCODINGS[encoding](text))
    assert to_dict(load(path, dtype=f64)) == to_dict(load(FILES / name, dtype=f64))


def test_files_of_new_variants_are_read():
    assert torch.isfinite(load(FILES / "ours_degrees.json").r_max).all()
    assert load(FILES / "ours_degrees.json").r_max.item() == pytest.approx(300)
    assert load(FILES / "numpy_shape.npz").image_size.tolist() == [[768, 1024]]
    assert load(FILES / "opencv_size_matrix.yaml").image_size.tolist() == [[1200, 1920]]
    assert list(load_all(FILES / "kalibr_equidistant_five.yaml")) == ["cam0"]
    for name in ("kalibr_equidistant_five.yaml", "ros_equidistant_five.yaml"):
        assert load(FILES / name).radial.shape == (1, 4)
