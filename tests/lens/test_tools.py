"""Files of other tools, repeated messages, and what a format cannot hold."""

import json

import numpy as np
import pytest
from helpers import CALIBRATIONS

from darswin.lens import load

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
