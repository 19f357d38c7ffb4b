"""COLMAP's cameras.txt and cameras.bin, with all camera models but the spherical ones."""

import struct
from functools import partial

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, Fisheye624, KannalaBrandt
from darswin.lens.files.fields import Fields, is_number, short
from darswin.lens.files.format import Cameras, Description, Format, Intrinsics, describe
from darswin.lens.ideal import FieldOfView
from darswin.lens.sphere import EnhancedUnified

# The class of each model and the order of its parameters. COLMAP, src/colmap/sensor/models/.
MODELS: dict[str, tuple[type[Lens], str]] = {
    "SIMPLE_PINHOLE": (BrownConrady, "f cx cy"),
    "PINHOLE": (BrownConrady, "fx fy cx cy"),
    "SIMPLE_RADIAL": (BrownConrady, "f cx cy k1"),
    "RADIAL": (BrownConrady, "f cx cy k1 k2"),
    "BROWN_CONRADY": (BrownConrady, "f cx cy k1 k2 k3 p1 p2"),
    "OPENCV": (BrownConrady, "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": (BrownConrady, "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    "SIMPLE_FISHEYE": (KannalaBrandt, "f cx cy"),
    "FISHEYE": (KannalaBrandt, "fx fy cx cy"),
    "SIMPLE_RADIAL_FISHEYE": (KannalaBrandt, "f cx cy k1"),
    "RADIAL_FISHEYE": (KannalaBrandt, "f cx cy k1 k2"),
    "OPENCV_FISHEYE": (KannalaBrandt, "fx fy cx cy k1 k2 k3 k4"),
    "THIN_PRISM_FISHEYE": (KannalaBrandt, "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        Fisheye624, "fx fy cx cy k1 k2 k3 k4 k5 k6 p2 p1 s1 s2 s3 s4"),
    "FOV": (FieldOfView, "fx fy cx cy omega"),
    "EUCM": (EnhancedUnified, "fx fy cx cy alpha beta"),
    "SIMPLE_DIVISION": (EnhancedUnified, "f cx cy division"),
    "DIVISION": (EnhancedUnified, "fx fy cx cy division"),
}  # fmt: skip

# The models in the order of their numbers in cameras.bin. BROWN_CONRADY has no number yet.
# Source: COLMAP 4.2, CameraModelId.
NUMBERED = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE",
    "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE",
    "EUCM",
)  # fmt: skip
_COUNT, _HEAD = struct.Struct("<Q"), struct.Struct("<IiQQ")  # id, model, width, height

# A camera is written with the first model of its class that holds all its terms.
WRITTEN = ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE",
           "RAD_TAN_THIN_PRISM_FISHEYE", "FOV", "EUCM", "DIVISION")  # fmt: skip


class Colmap(Format):
    """Rows whose second word names a model. Cameras are called by their ids."""

    name = "COLMAP"
    keys = "lines of an id, a model, width, height and parameters"
    is_table = True
    origin = 0.5
    needs_size = True
    holds = (
        "without skew, Perspective and BrownConrady (3 radial, no prism), Equidistant and "
        "KannalaBrandt (4 radial), Fisheye624 (6 radial), FieldOfView and EnhancedUnified"
    )

    def _recognizes(self, content: list[list[str]]) -> bool:
        row = content[0]
        return len(row) > 1 and (
            row[1] in MODELS
            or (row[1].isupper() and len(row) > 3 and all(map(is_number, row[2:4])))
        )

    def cameras(self, file: list[list[str]], coefficients: str | None) -> Cameras:
        found: Cameras = {}
        for row in file:
            if row[0] in found:
                raise ValueError(f"camera {short(row[0])} appears twice")
            found[row[0]] = partial(_camera, row)
        return found

    def _text(self, camera: Intrinsics, suffix: str) -> str | None:
        height, width = camera.size
        values = dict(camera.values)
        if values.get("beta", 1) < 0 and values["alpha"] == 0.5:
            values["division"] = values.pop("beta") / -4
            del values["alpha"]
        camera = camera._replace(values=values)
        name = next((name for name in WRITTEN if camera.has_only(*MODELS[name])), None)
        if name is None:
            return None
        numbers = " ".join(map(repr, camera.listed(MODELS[name][1])))
        return (
            "# Camera list with one line of data per camera:\n"
            "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# Number of cameras: 1\n"
            f"1 {name} {width} {height} {numbers}\n"
        )


def _camera(row: list[str]) -> Description:
    where = f"camera {short(row[0])}, "
    if len(row) < 4:
        raise ValueError(f"{where}must have an id, a model, a width, a height and parameters")
    name = row[1]
    if name not in MODELS:
        raise ValueError(f"{where}model must be one of {', '.join(MODELS)}, got {short(name)}")
    model, order = MODELS[name]
    names = order.split()
    if len(row) != 4 + len(names):
        raise ValueError(f"{where}{name} must have {len(names)} parameters, got {len(row) - 4}")
    file = Fields(dict(zip(["width", "height", *names], row[2:], strict=True)), where)
    values = file.values(order.replace("f cx", "fx=f fy=f cx"))
    return describe(model, values, (file.side("height"), file.side("width")))


def is_binary(data: bytes) -> bool:
    """True for a cameras.bin, which begins with the number of cameras in eight bytes."""
    return len(data) >= _COUNT.size and data[4:8] == bytes(4)


def from_binary(data: bytes, most: int) -> str:
    """A cameras.bin as the text of a cameras.txt; ValueError for more than `most` cameras."""
    (count,), place = _COUNT.unpack_from(data), _COUNT.size
    if count > most:
        raise ValueError(f"it must have 1 to {most} cameras, got {count}")
    lines = []
    try:
        for _ in range(count):
            camera, model, width, height = _HEAD.unpack_from(data, place)
            if not 0 <= model < len(NUMBERED):
                raise ValueError(
                    f"camera {camera}, model must be a number from 0 ({NUMBERED[0]}) to "
                    f"{len(NUMBERED) - 1} ({NUMBERED[-1]}), got {model}; images.bin and "
                    "points3D.bin have no cameras"
                )
            name = NUMBERED[model]
            values = struct.Struct(f"<{len(MODELS[name][1].split())}d")
            numbers = values.unpack_from(data, place + _HEAD.size)
            lines.append(f"{camera} {name} {width} {height} {' '.join(map(repr, numbers))}")
            place += _HEAD.size + values.size
    except struct.error as error:
        raise ValueError(f"it ends within camera {len(lines) + 1} of {count}") from error
    if place != len(data):
        raise ValueError(f"it has {len(data) - place} extra bytes after the last camera")
    return "\n".join(lines)
