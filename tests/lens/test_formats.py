"""Formats are told apart by several entries, and files of other tools and kinds are named."""

import bz2
import gzip
import io
import json
import lzma
import re
import tarfile
import zipfile

import cv2
import numpy as np
import pytest
import yaml
from helpers import ended, refused
from lens_examples import FILES, K, file_text, flat, loads, opencv
from PIL import Image
from videos import write_video

from darswin.cli.main import main
from darswin.lens import MODELS, fit, from_dict, load
from darswin.lens.files.content import parse
from darswin.lens.files.load import FORMATS

UNKNOWN = r"^calibration in a string: unknown format: it.*\. The formats are darswin, WoodScape"
# Files of other programs, which have an entry or the notation of a known format.
OTHERS = {
    "rig": "intrinsic:\n  left: {model_type: POLYFISHEYE, camera_name: left, image_width: 350}\n",
    "Open3D": json.dumps(dict(intrinsic=dict(width=640, height=480, intrinsic_matrix=[525.0] * 9))),
    "RealSense": json.dumps(dict(intrinsic=dict(width=640, height=480, fx=380.0, k1=0.1))),
    "cereal": json.dumps(dict(value0=dict(cereal_class_version=0, poses=[1, 2]))),
    "frames": json.dumps(dict(frames=[dict(time=0.1, file="a.png")], fps=30)),
    "no frames": json.dumps(dict(frames=[])),
    "Hugging Face": json.dumps(dict(model_type="swin", image_size=224, depths=[2, 2, 6, 2])),
    "options": yaml.safe_dump(dict(k=5, m=3, size=9, width=64, model="darswin", lr=0.1)),
    "list": json.dumps(dict(K=[1, 2, 3, 4])),
    "anchors": yaml.safe_dump(dict(camera=dict(camera_model="x"), sensor=dict(rate=20))),
    "URDF": "<robot><link><k>1</k></link><link><k>2</k></link></robot>",
    "camera matrix": "8.12e+02 0 6.402e+02\n0 8.114e+02 3.617e+02\n0 0 1\n",
    "small matrix": "2 0 1\n0 2 1\n0 0 1\n",
    "coefficients": "-0.22 0.05 0.001 -0.002 0.003\n",
    "one number": "5\n",
    "pose": "1 0 0 0.5\n0 1 0 0\n0 0 1 2\n0 0 0 1\n",
    "trajectory": "1305031102.17 1.34 0.63 1.66 0.66 0.62 -0.29 -0.33\n" * 9,
    "classes": "0 cat\n1 dog\n2 bird\n",
    "capitals": "0 CAT\n1 DOG\n",
}  # fmt: skip
MATRIX = "camera_matrix and distortion_coefficients"
# Texts with unknown names of entries, these names, and those that are expected.
NAMES = (
    (json.dumps(dict(camera_mat=K, dist_coefs=[0.1] * 5)), "camera_mat, dist_coefs", MATRIX),
    (json.dumps(dict(foo=1, bar=2)), "foo, bar", MATRIX),
    (json.dumps(dict(f_x=1, f_y=2, c_x=1, k_1=3)), "f_x, f_y, c_x, k_1", "fx, fy, cx, cy"),
    (json.dumps(dict(flx=1, fly=2, cx=1, cy=3)), "flx, fly, cx, cy", "fl_x, fl_y, cx, cy"),
    ("cam_0: {model: ds}\ncamera_modell: ds", "cam_0, camera_modell", "cam0 with camera_model"),
    ("projection_params: {a: 1}\nmodel_types: MEI\n", "projection_params, model_types",
     "model_type and projection_parameters"),
    ("{}", "none", MATRIX),
)  # fmt: skip
# Texts of programs, which are known, and the format that they should write.
PROGRAMS = (
    ("<calibration><projection>fisheye</projection><width>9</width><f>3</f><cx>1</cx><k1>0</k1>"
     "<k2>0</k2></calibration>", "Metashape", "OpenCV"),
    ('<document version="2.0.0"><chunk><sensor><calibration class="initial"><f>14</f>'
     '</calibration><calibration class="adjusted"><f>15</f></calibration></sensor></chunk>'
     "</document>", "Metashape", "OpenCV"),
    (json.dumps(dict(sfm_data_version="0.3", root_path="/x", views=[], intrinsics=[],
                     extrinsics=[], structure=[])), "OpenMVG", "COLMAP"),
    (json.dumps(dict(version=["1"], views=[], intrinsics=[], poses=[])), "Meshroom", "COLMAP"),
)  # fmt: skip


@pytest.mark.parametrize(("text", "said"), [
    *((text, "") for text in OTHERS.values()),
    *((text, f"its entries are {found}, but expected are, for example, {expected}")
      for text, found, expected in NAMES),
    *((text, f", as in files of {program}: let it write the cameras for {other}. The")
      for text, program, other in PROGRAMS),
])  # fmt: skip
def test_a_text_of_no_format_is_told_by_its_entries(text, said):
    found = refused(UNKNOWN, loads, text)
    assert said in found and (": its entries are " in found or ": it is a table of " in found)
    assert ("unknown lens model" in found) == (text == OTHERS["options"])
    assert ("as in files of" in found) == (said.startswith(", as")) and len(found) < 900
    assert not (said.startswith(", as") and "expected are" in found)
    assert "appears twice" not in found


# The start of the files of programs, in their own words; and the name and the advice in the error.
TOOLS = {
    "MATLAB": (dict(RadialDistortion=[-0.3, 0.1], TangentialDistortion=[0, 0], K=K),
               "MATLAB: cameraIntrinsicsToOpenCV"),
    "MATLAB's fisheye": (dict(Intrinsics=dict(MappingCoefficients=[881.2, -2.9e-4, 4e-8, -1e-11],
                                              StretchMatrix=[[1, 0], [0, 1]])), "MATLAB: write it"),
    "mrcal": ("# by mrcal\n{ 'lensmodel': 'LENSMODEL_CAHVOR', 'intrinsics': [ 5,],}",
              "mrcal: mrcal-convert-lensmodel LENSMODEL_OPENCV8"),
    "MultiCol": ("%YAML:1.0\nCamera.Iw: 754\nCamera.nrpol: 5\nCamera.a0: -205.0\n", "MultiCol: "),
    "Kalibr's IMU report": ("Calibration results\n====\nReprojection error (cam0): mean 0.2\n",
                            "take the camchain file"),
    "maplab": ("cameras:\n- camera:\n    type: pinhole\n    intrinsics: {data: [300, 300, 9, 9]}\n",
               "maplab or SVO: write T_B_C"),
    "iKalibr": ("Intrinsics:\n  polymorphic_name: pinhole_fisheye\n  ptr_wrapper: {data: "
                "{img_width: 9, disto_param: [0.1]}}\n", "iKalibr: "),
    "Isaac Sim": ({"omni:lensdistortion:model": "opencvFisheye"}, "Isaac Sim: "),
    "COLMAP's rig": ('[{"cameras": [{"image_prefix": "a/", "params": [3]}]}]', "cameras.txt"),
    "DSO": ("EquiDistant 528.0 527.9 399.2 172.8 -0.036 -0.005 0 0\n800 400\ncrop\n800 400\n",
            "DSO or 4Seasons: "),
    "FCA": ("image:\n  width: 752\nparameter:\n  fx: 461.6\n  k1: 0\n", "fisheye-calib-adapter"),
    "BoofCV": ("pinhole:\n  fx: 2100.0\nmodel: omnidirectional_universal\n", "BoofCV: "),
    "PhotonVision": (dict(resolution=dict(width=1280.0, height=720.0), distCoeffs=dict(data=[0.1]),
                          cameraIntrinsics=dict(rows=3, cols=3, data=[900.1] * 9)),
                     "PhotonVision: write"),
    "a toolbox": ("% Intrinsic\nfc = [ 657.3 ; 657.7 ];\ncc = [ 302 ; 242 ];\nkc = [ -0.25 ; 0 ];",
                  "Camera Calibration Toolbox"),
    "Kalibr's report": ("Calibration results\n====\nCamera-system parameters:\ncam0 (/cam0):\n"
                        "    type: <class 'a'>\n", "take the camchain file"),
    "Kalibr's board": ("target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\n", "take the camchain"),
    "ORB-SLAM": ("%YAML:1.0\nCamera1.fx: 190.9\nCamera1.cx: 254.9\n", "ORB-SLAM: "),
    "stella_vslam": ("Camera:\n  setup: 'monocular'\n  fx: 458\n  color_order: 'Gray'\n", "stella"),
    "KITTI": ("calib_time: 09-Jan-2012\nK_00: 9.8e2 0 6e2 0 9e2 2e2 0 0 1\nD_00: 1 2 0 0 0\n",
              "KITTI: "),
    "Cityscapes": (dict(extrinsic=dict(baseline=0.2), intrinsic=dict(fx=9, fy=9, u0=5, v0=4)),
                   "Cityscapes: "),
    "DepthAI": (dict(boardName="OAK-D", cameraData=[[0, dict(intrinsicMatrix=K)]]), "DepthAI"),
    "Gyroflow": (dict(calib_dimension=dict(w=9, h=9), fisheye_params=dict(camera_matrix=K)),
                 "Gyroflow: "),
    "a bag's": ("rosbag2_bagfile_information:\n  version: 4\n", "camera_info message in the bag"),
    "COLMAP's images": ("1 0.8 0.1 0.2 0.5 1.0 2.0 3.0 1 a.png\n23.3 4 -1\n", "take cameras.txt"),
    "a ROS bag": (b"#ROSBAG V2.0\nE\0\0\0", "it is a ROS bag"),
    "images.bin": (np.array([9, 99 << 32], "<u8").tobytes() + bytes(64), "have no cameras"),
}  # fmt: skip
# What errors of our formats ask for.
OURS = ("poly_order", "value0", "OpenCV calibration", "camera_matrix", "projection_parameters",
        "fl_x", "must have 5 lines", "valid JSON", "valid YAML")  # fmt: skip


@pytest.mark.parametrize("name", TOOLS)
def test_files_of_other_tools_are_named_without_the_entries_of_a_format(name, tmp_path):
    content, said = TOOLS[name]
    content = json.dumps(content) if isinstance(content, dict) else content
    path = tmp_path / "camera"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    found = refused(re.escape(said), load, path)
    assert not [word for word in OURS if word in found]


@pytest.mark.parametrize(("given", "nearest"), [
    ("KanalaBrandt", "KannalaBrandt"), ("equidistant", "Equidistant"), ("Sperical", "Spherical"),
    ("brown_conrady", "BrownConrady"), ("EQUISOLID", "Equisolid"), ("zzz", None), ("Kb", None),
])  # fmt: skip
def test_an_unknown_model_gets_the_nearest_name(given, nearest):
    meant = f"; did you mean {nearest}? The models" if nearest else ". The models"
    said = re.escape(f"unknown lens model '{given}'{meant}")
    for start, make in (
        (UNKNOWN.partition("it.*")[0] + ".*; in a darswin file, ",
         lambda: loads(json.dumps(dict(model=given, focal=300)))),
        ("", lambda: from_dict(dict(model=given, focal=300))),
        ("", lambda: fit(given, load(FILES / "ours.json"))),
    ):  # fmt: skip
        found = refused(start + said, make)
        assert all(name in found for name in MODELS)


@pytest.mark.parametrize("path", sorted(FILES.iterdir()), ids=lambda path: path.name)
def test_the_order_of_entries_does_not_change_the_format(path):
    if path.suffix not in (".json", ".yaml"):
        assert path.suffix in (".md", ".txt", ".bin", ".xml", ".npz")
        return
    content = parse(path.read_text())
    first = next(format for format in FORMATS if format.recognizes(content))
    reverse = dict(reversed(content.items()))
    assert next(format for format in FORMATS if format.recognizes(reverse)) is first
    fitting = {format.name for format in FORMATS if format.recognizes(content)} - {first.name}
    assert fitting <= {"OpenCV"}  # which reads messages of ROS too


def test_entries_that_others_have_too_do_not_change_the_format():
    matrix = dict(camera_matrix=K, width=1280, height=960)
    for text in (
        json.dumps(matrix | dict(model_type="pinhole", distortion_parameters=[-0.2, 0, 0, 0, 0])),
        opencv(D=[-0.2, 0, 0, 0, 0], frames=[1, 2], value0={}, intrinsic={}),
        flat("k1", "k2", "p1", "p2", model="Perspective"),
        flat("k1", "k2", "k3", "k4", frames=12, model_type="fisheye"),
    ):
        assert loads(text).image_size.tolist() == [[960, 1280]]


def written(write):
    """What a function writes into a file."""
    data = io.BytesIO()
    write(data)
    return data.getvalue()


def zipped(data, **files):
    with zipfile.ZipFile(data, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)


def tarred(data):
    with tarfile.open(fileobj=data, mode="w") as archive:
        archive.add(FILES / "ours.json", "ours.json")


TEXT, BLACK = file_text("woodscape.json").encode(), np.zeros((8, 8, 3), np.uint8)
BLACK_PICTURE = Image.fromarray(BLACK)
KINDS = {
    **{form: (lambda form=form: written(lambda data: BLACK_PICTURE.save(data, form)), "a picture")
       for form in ("PNG", "JPEG", "GIF", "BMP", "TIFF", "WEBP", "PPM", "ICO", "JPEG2000")},
    "small BMP": (lambda: cv2.imencode(".bmp", BLACK)[1].tobytes(), "a picture"),
    "EXR": (lambda: b"v/1\x01\x02\0\0\0", "a picture"),
    "AVIF": (lambda: b"\0\0\0 ftypavif", "a picture"),
    "HEIC": (lambda: b"\0\0\0 ftypheic", "a picture"),
    "MP4": (lambda: b"\0\0\0 ftypisom\0\0\2\0isomiso2avc1mp41", "a video"),
    "QuickTime": (lambda: b"\0\0\0\x14ftypqt  ", "a video"),
    "Matroska": (lambda: b"\x1a\x45\xdf\xa3\x01\0\0\0", "a video"),
    "large video": (lambda: b"\0\0\0 ftypisom" + bytes(17 << 20), "a video"),
    "gzip": (lambda: gzip.compress(TEXT, mtime=0), "an archive"),
    "bzip2": (lambda: bz2.compress(TEXT), "an archive"),
    "xz": (lambda: lzma.compress(TEXT), "an archive"),
    "7z": (lambda: b"7z\xbc\xaf\x27\x1c\0\4", "an archive"),
    "RAR": (lambda: b"Rar!\x1a\7\1\0", "an archive"),
    "tar": (lambda: written(tarred), "an archive"),
    "zip": (lambda: written(lambda data: zipped(data, a="text")), "a zip archive"),
    "empty zip": (lambda: written(zipped), "an archive"),
    "PDF": (lambda: b"%PDF-1.7\n", "a PDF document"),
    "MATLAB": (lambda: b"MATLAB 5.0 MAT-file, Platform: GLNXA64", "a file of MATLAB"),
    "HDF5": (lambda: b"\x89HDF\r\n\x1a\n", "a file of MATLAB or HDF5"),
    "npy": (lambda: written(lambda data: np.save(data, np.eye(3))), "one array of NumPy"),
    "pickle": (lambda: b"\x80\4\x95\x10\0\0\0\0", "a pickle"),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_a_file_of_another_kind_is_named(name, tmp_path):
    make, kind = KINDS[name]
    path = tmp_path / "file.yaml"  # the name of a file does not matter
    path.write_bytes(make())
    said = refused("but must be a calibration: text in YAML", load, path)
    assert said.startswith(f"calibration {path}: it is {kind}")
    assert "UTF-8" not in said and "\n" not in said


def test_a_recorded_video_is_named(tmp_path):
    for name, codec in (("a.mp4", "mp4v"), ("a.avi", "MJPG")):
        write_video(tmp_path / name, 3, codec=codec)
        refused("it is a video, but must be a calibration", load, tmp_path / name)


def test_a_file_that_is_missing(tmp_path, capsys):
    said = r"^calibration .*none\.json: there is no such file$"
    refused(said, load, tmp_path / "none.json", error=FileNotFoundError)
    printed = ended(capsys, 2, main, ["lens", "info", "nofile"])
    assert printed.err == "darswin: calibration nofile: there is no such file\n"
