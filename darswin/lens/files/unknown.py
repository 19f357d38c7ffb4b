"""What to say of a file that is no calibration of a known format."""

import re
from collections.abc import Sequence

from darswin.lens.base import unknown_model
from darswin.lens.files.content import Content
from darswin.lens.files.fields import listed
from darswin.lens.files.format import Format
from darswin.utils.nearest import nearest

_MOST = 20  # entries that are compared
_LOOKED_AT = 1 << 20  # characters
_FOR_OPENCV, _FOR_COLMAP = (f"let it write the cameras for {to}" for to in ("OpenCV", "COLMAP"))
_BY_NAME = (
    "write its numbers, in px, by name, as fx, fy, cx, cy, k1, … beside width, height and model"
)
# Other programs, the names that all of their files have, and what to do.
PROGRAMS = (
    ("PhotonVision", r'"cameraIntrinsics" "distCoeffs"', "write its matrix, coefficients and "
     "resolution as OpenCV's"),
    ("mrcal", r"LENSMODEL_(?!PINHOLE\b|OPENCV(?:4|5|8|12)\b)\w+", "mrcal-convert-lensmodel "
     "LENSMODEL_OPENCV8 writes one that can be read"),
    ("OCamCalib for MultiCol", r"\bCamera\.nrpol: \bCamera\.a0:", "write calib_results.txt"),
    ("MATLAB", "RadialDistortion TangentialDistortion", "cameraIntrinsicsToOpenCV converts it"),
    ("MATLAB", "MappingCoefficients StretchMatrix", "write it as an OCam lens of darswin, whose "
     "pixels begin at 0"),
    ("the Camera Calibration Toolbox for MATLAB", r"\bfc\s*=\s*\[ \bkc\s*=\s*\[ \bcc\s*=\s*\[",
     "write fc, cc and kc as OpenCV's, whose pixels begin at 0"),
    ("Metashape", "<projection> <f>", _FOR_OPENCV),
    ("Metashape", "<document <chunk", _FOR_OPENCV),
    ("OpenMVG", '"sfm_data_version" "intrinsics"', _FOR_COLMAP),
    ("Meshroom", '"views" "intrinsics" "poses"', _FOR_COLMAP),
    ("OpenSfM", '"projection_type" "focal', _FOR_COLMAP),
    ("Kalibr's report", r"Camera-system\sparameters:", "take the camchain file beside it"),
    ("Kalibr's report", r"^Calibration\sresults ^Reprojection\serror", "take the camchain file"),
    ("Kalibr's boards", r"\btarget_type: \b(?:tag|target)Cols:", "take the camchain file"),
    ("ORB-SLAM", r"\bCamera\d?\.fx \bCamera\d?\.cx", "write its numbers as OpenCV's"),
    ("stella_vslam", r"^Camera: \bsetup: \bcolor_order:", "write its numbers as OpenCV's"),
    ("COLMAP's images and points", r"^\d+(?:\s[-+.\de]+){8}\s(\S+\.\w+)$|^#\s3D\spoint\slist",
     "take cameras.txt beside it"),
    ("KITTI", r"^(?:K_0\d|P\d|P_rect_0\d):", "its pictures follow a pinhole, whose matrix it has"),
    ("Cityscapes", '"intrinsic" "u0" "v0" "baseline"', "its pictures follow a pinhole, with fx, "
     "fy, u0 and v0"),
    ("DepthAI", '"cameraData" "boardName"', "write one of its cameras as OpenCV's"),
    ("Azure Kinect", '"CalibrationInformation" "ModelParameters"', "write one of its cameras as "
     "OpenCV's"),
    ("Gyroflow", '"fisheye_params" "calib_dimension"', "write its matrix, coefficients and size "
     "as OpenCV's"),
    ("maplab or SVO", r"\A(?![\s\S]*\bT_B_C:)[\s\S]*(\bcameras): \bcamera: \bintrinsics:",
     "write T_B_C beside each camera"),
    ("iKalibr", r"\bpolymorphic_name\b \bptr_wrapper\b \bdisto_param\b", _BY_NAME),
    ("Isaac Sim", r"\bomni:lensdistortion:\w+", _BY_NAME),
    ("COLMAP's rigs", '"image_prefix" "cameras"', "take cameras.txt beside it"),
    ("darswin's rigs", '"direction" "cameras" "lens"', "Rig.load reads it"),
    ("DSO or 4Seasons", r"\A\s*(?:(Pinhole|FOV|RadTan|EquiDistant|KannalaBrandt)\s+[-+.\d]|"
     r"(?:[-+.\de]+\s+){6,16}(crop|full|none)\b)", _BY_NAME),
    ("fisheye-calib-adapter", "^image: ^parameter:", _BY_NAME),
    ("BoofCV", "^pinhole: ^model:", _BY_NAME),
    ("ROS bags", "rosbag2_bagfile_information", "take the camera_info message in the bag"),
)  # fmt: skip


def program_of(text: str) -> str:
    """The program whose file a text is, and what to do, in words; "" if it is not known."""
    text = text[:_LOOKED_AT]
    for program, names, advice in PROGRAMS:
        found = [re.search(name, text, re.MULTILINE) for name in names.split(" ")]
        if all(found):
            shown = listed(
                match[match.lastindex or 0].strip('<>"=[:# ') for match in found if match
            )
            return f"its entries are {shown}, as in files of {program}: {advice}"
    return ""


def unknown(content: Content, formats: Sequence[Format]) -> str:
    """What a file of an unknown format holds, and what was expected."""
    if isinstance(content, list):
        tables = " or ".join(format.keys for format in formats if format.is_table)
        counts = {len(row) for row in content}
        words = " to ".join(map(str, sorted({min(counts), max(counts)})))
        return f"it is a table of {len(content)} lines of {words} words, but must have {tables}"
    found = f"its entries are {listed(content) or 'none'}"
    given = content.get("model")
    if isinstance(given, str):
        return f"{found}; in a darswin file, {unknown_model(given)}"
    names = [str(name) for name in list(content)[:_MOST]]
    keys = {format.name: format.keys for format in formats if not format.is_table}

    def score(format: str) -> int:
        words = re.findall(r"\w+", keys[format])
        return sum(bool(nearest(name, words)) for name in names)

    best = max(keys, key=score)
    is_near = score(best) > 1 and 2 * score(best) >= len(names)
    expected = keys[best] if is_near else f'{keys["OpenCV"]}, or a "model" of darswin'
    return f"{found}, but expected are, for example, {expected}"
