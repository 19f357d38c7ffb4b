"""Files of other tools, repeated messages, and what a format cannot hold."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import CALIBRATIONS

from darswin.cli.main import main
from darswin.lens import Fisheye624, load, save

MATRIX = [[500, 0, 320.5], [0, 501, 240.5], [0, 0, 1]]
# The start of the files of programs, in their own words; and the name and the advice in the error.
TOOLS = {
    "MATLAB": (dict(RadialDistortion=[-0.3, 0.1], TangentialDistortion=[0, 0], K=MATRIX),
               "MATLAB: cameraIntrinsicsToOpenCV"),
    "MATLAB's fisheye": (dict(Intrinsics=dict(MappingCoefficients=[881.2, -2.9e-4, 4e-8, -1e-11],
                                              StretchMatrix=[[1, 0], [0, 1]])), "MATLAB: write it"),
    "mrcal": ("{\n  'lensmodel': 'LENSMODEL_OPENCV4',\n  'intrinsics': [ 500.0, 501.0,],\n}\n",
              "mrcal: mrcal-to-kalibr"),
    "mrcal with comments": ("# by mrcal\n{ 'lensmodel': 'LENSMODEL_CAHVOR', 'intrinsics': [ 5,],}",
                            "mrcal: mrcal-to-kalibr"),
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
    "DepthAI": (dict(boardName="OAK-D", cameraData=[[0, dict(intrinsicMatrix=MATRIX)]]), "DepthAI"),
    "Gyroflow": (dict(calib_dimension=dict(w=9, h=9), fisheye_params=dict(camera_matrix=MATRIX)),
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
    with pytest.raises(ValueError) as error:
        load(path)
    assert said in str(error.value)
    assert not [word for word in OURS if word in str(error.value)]


@pytest.mark.parametrize("end", ["", "---\n", "---\n---\n"])
def test_equal_messages_are_one_camera(end, tmp_path):
    file, path = CALIBRATIONS / "ros2_echo.yaml", tmp_path / "messages.yaml"
    one = file.read_text().removesuffix("---\n")
    assert "sec: 1695049213" in one
    messages = [one.replace("sec: 1695049213", f"sec: {k}") for k in range(3)]
    path.write_text("---\n".join(messages) + end)
    assert load(path).same_as(load(file))
    messages[2] = messages[2].replace("width: 640", "width: 320")
    path.write_text("---\n".join(messages) + end)
    with pytest.raises(ValueError, match=r"documents 1 and 3, .* differ in width: keep one"):
        load(path)


TILTED = Fisheye624(
    300.0, radial=[0.02, -0.01], tangential=[0.0012, -0.0008], prism=[0.001, 0.0, -0.0006, 0.0],
    center=[320.2, 239.1], image_size=(480, 640), theta_max=1.2,
    affine=[[1.0, 0.002], [0.001, 1.003]],
)  # fmt: skip


@pytest.mark.parametrize(
    ("out", "model", "lost"),
    [
        ("camera.yaml", "KannalaBrandt", "tangential terms and prism terms and skew"),
        pytest.param("camera.yaml", "Mei", "prism terms and skew", marks=pytest.mark.slow),
        ("kalibr.yaml", "KannalaBrandt", "tangential terms and prism terms and skew"),
        ("camera.json", "Equidistant", "tangential terms and prism terms"),
        ("camera.json", "KannalaBrandt", None),
    ],
)
def test_convert_leaves_out_what_the_format_cannot_hold(out, model, lost, tmp_path, capsys):
    given, path = tmp_path / "given.json", tmp_path / out
    save(TILTED, given)
    main(["lens", "convert", str(given), str(path), "--model", model])
    printed = capsys.readouterr().out
    assert ("it leaves out" in printed) == (lost is not None)
    assert lost is None or f", whose {lost} it leaves out" in printed
    said = float(re.search(r"at most (\S+) px", printed)[1])
    found = load(path).with_theta_max(None)
    theta = torch.linspace(0.05, 1.2, 40)[:, None].expand(40, 60)[None]
    azimuth = torch.linspace(0, 2 * math.pi, 60)[None, None].expand(1, 40, 60)
    apart = found.project_rays(theta, azimuth) - TILTED.project_rays(theta, azimuth)
    assert apart.norm(dim=-1).max().item() == pytest.approx(said, rel=0.06)


def test_a_calibration_replaces_calibrations_alone(tmp_path, capsys):
    given, other, new = (str(tmp_path / name) for name in ("a.json", "b.json", "c.json"))
    save(TILTED, given)
    Path(other).write_bytes(b"\x89PNG and more")
    with pytest.raises(SystemExit) as end:
        main(["lens", "convert", given, other])
    assert (
        end.value.code == 2 and "b.json would replace a file that is no" in capsys.readouterr().err
    )
    assert Path(other).read_bytes() == b"\x89PNG and more"
    for _ in range(2):
        main(["lens", "convert", given, new])
    assert load(new).same_as(load(given))
