"""Camera matrices and their coefficients: OpenCV's FileStorage and ROS's camera_info.

YAML, XML and JSON; of one camera, or of several whose keys end with 1 and 2, or left and right.
"""

import math
import re
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal, get_args

import numpy as np

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, KannalaBrandt, Mei
from darswin.lens.files.cameras import Camera, Cameras, Description, describe
from darswin.lens.files.content import Content
from darswin.lens.files.fields import MAX_SIDE, Fields, holds_numbers, listed, short

# Names as `plain_name` leaves them.
MATRIX = ("k", "cameramatrix", "intrinsicmatrix", "mtx", "m")
COEFFICIENTS = re.compile(
    r"d|coef{1,2}s?|coefficients|(camera|lens)?(dist|distort|distortions?|distorsion)"
    r"(coe?f{1,2}(s|icients?|icents?|ecients?|iecients?)?|params?|parameters?|vec|vector)?"
)
# What else may be some: d0, a name with a word like the above, or a number by the name of k1.
LIKE_COEFFICIENTS = re.compile(r"^d(\d*|left|right)$|coef|(?<!un)dist(?!an[ct])")
LIKE_A_COEFFICIENT = re.compile(r"[kps]\d+")
# How sure they are, which OpenCV's interactive calibration writes beside them.
DEVIATIONS = re.compile(r"std(dev|deviations?)?$")
SIZE = ("imagesize", "imgsize", "size", "dim", "resolution", "cameraresolution")
WIDTH, HEIGHT = ("imagewidth", "width", "w"), ("imageheight", "height", "h")
SAYS_FISHEYE = ("fisheyemodel", "fisheye", "isfisheye")
SAYS_MODEL = ("distortionmodel", "model", "cameramodel", "modeltype", "calibrationmodel")
SUFFIXES = ("0", "1", "2", "3", "left", "right")

Coefficients = Literal["fisheye", "pinhole", "omnidir"]
MODELS: tuple[Coefficients, ...] = get_args(Coefficients)
WORDS = {
    "fisheye": ("fisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt4", "kb", "kb4",
                "opencvfisheye"),
    "pinhole": ("pinhole", "plumbbob", "rationalpolynomial", "radtan", "radialtangential",
                "perspective", "brownconrady", "thinprism"),
    "omnidir": ("omnidir", "omni", "mei", "omnidirectional"),
}  # fmt: skip
# How many coefficients there may be.
COUNTS: dict[str, tuple[int, ...]] = {
    "fisheye": (4,),
    "pinhole": (4, 5, 8, 12, 14),
    "omnidir": (4,),
}

Pair = tuple[float, float]
Size = tuple[int, int] | None
Plane = tuple[Pair, Pair, Size]


def plain_name(name: str) -> str:
    """A name without what writers of files differ in."""
    return name.lower().replace("_", "").replace("-", "").replace(" ", "")


def fits(content: Content) -> bool:
    """Whether a file's content is OpenCV's or ROS's: it has a camera matrix."""
    if not isinstance(content, Mapping):
        return False
    names = {plain_name(name) for name in content}
    return any(m + suffix in names for m in MATRIX for suffix in ("", *SUFFIXES))


def fits_ros(content: Content) -> bool:
    """Whether a file's content is ROS's: it names its distortion model, too."""
    return fits(content) and "distortion_model" in content


def cameras(file: Fields, hint: str | None = None) -> Cameras:
    """Its cameras, by what their keys end with.

    Args:
        hint: one of `MODELS`, which rules where the file does not say it or is wrong.
    """
    reader = Reader(file, hint)
    suffixes = [suffix for suffix in SUFFIXES if reader.find(MATRIX, suffix) is not None]
    if reader.find(MATRIX) is not None:
        suffixes = [""]
    reader.check_coefficients(suffixes)
    return {suffix or "camera": partial(reader.camera, suffix) for suffix in suffixes}


def write(camera: Camera, suffix: str) -> str | None:
    """A file of OpenCV's FileStorage: XML, JSON or YAML; None if OpenCV has no such camera."""
    import cv2  # only here: reading does without

    order = "k1 k2 p1 p2 k3 d1 d2 d3 s1 s2 s3 s4"
    orders: dict[type[Lens], str] = {
        KannalaBrandt: "k1 k2 k3 k4",
        Mei: "k1 k2 p1 p2",
        BrownConrady: order,
    }
    order = orders.get(camera.model, "")
    if not camera.terms.keys() <= {*order.split()} or camera.model not in orders:
        return None
    if camera.model is BrownConrady:
        if camera.skew != 0:  # which cv2.projectPoints leaves out
            return None
        if not camera.terms.keys() & {"d1", "d2", "d3", "s1", "s2", "s3", "s4"}:
            order = "k1 k2 p1 p2 k3"
    plane = camera.plane
    matrix = [[plane["fx"], camera.skew, plane["cx"]], [0, plane["fy"], plane["cy"]], [0, 0, 1]]
    storage = cv2.FileStorage(
        suffix if suffix in (".xml", ".json") else ".yaml",
        cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY,
    )
    if camera.size is not None:
        storage.write("image_width", camera.size[1])
        storage.write("image_height", camera.size[0])
    if camera.model is Mei:
        storage.write("xi", plane["xi"])
    else:
        storage.write("fisheye_model", int(camera.model is KannalaBrandt))
    storage.write("camera_matrix", np.array(matrix, float))
    storage.write("distortion_coefficients", np.array([camera.listed(order)]).T)
    return storage.releaseAndGetString()


class Reader:
    """A file whose entries go by several names."""

    def __init__(self, file: Fields, hint: str | None):
        self.file, self.hint = file, hint
        # Of two names that are one here, the first counts.
        self.names = {plain_name(name): name for name in reversed(list(file.entries))}

    def find(self, names: tuple[str, ...], suffix: str = "") -> str | None:
        """The file's name of an entry that goes by several."""
        return next((self.names[n + suffix] for n in names if n + suffix in self.names), None)

    def find_coefficients(self, suffix: str) -> str | None:
        """The file's name of a camera's coefficients, if it has any; ValueError for several."""
        found = [
            name for name in self.file.entries
            if (plain := plain_name(name)).endswith(suffix)
            and COEFFICIENTS.fullmatch(plain.removesuffix(suffix))
        ]  # fmt: skip
        if len(found) > 1:
            raise ValueError(f"coefficients must stand in one entry, got {listed(found)}")
        return found[0] if found else None

    def check_coefficients(self, suffixes: list[str]) -> None:
        """That no coefficients are left out because of their names."""
        read = [self.find_coefficients(suffix) for suffix in suffixes]
        left = [
            name for name, value in self.file.entries.items()
            if name not in read and holds_numbers(value)
            and not DEVIATIONS.search(plain := plain_name(name)) and (
                LIKE_COEFFICIENTS.search(plain) or (
                    LIKE_A_COEFFICIENT.fullmatch(plain) and not isinstance(value, (list, Mapping))
                )
            )
        ]  # fmt: skip
        if left or (None in read and any(read)):
            raise ValueError(
                "each camera's coefficients must stand in one entry, such as "
                f"distortion_coefficients or D, got {listed(left or filter(None, read))}"
            )

    def camera(self, suffix: str) -> Description:
        """The camera whose entries end with `suffix`."""
        matrices = [self.names[n + suffix] for n in MATRIX if n + suffix in self.names]
        matrix = matrices[0]
        if any(self.matrix(other, (9,)) != self.matrix(matrix, (9,)) for other in matrices[1:]):
            raise ValueError(f"{' and '.join(matrices)} must be the same, a camera's matrix")
        fx, skew, cx, zero, fy, cy, *last = self.matrix(matrix, (9,))
        if not (fx > 0 and fy > 0 and zero == 0 and last == [0, 0, 1]):
            raise ValueError(
                f"{matrix} must be [fx, skew, cx, 0, fy, cy, 0, 0, 1] with fx and fy above 0, got "
                f"{[fx, skew, cx, zero, fy, cy, *last]}"
            )
        self.check_shape(matrix, 9)
        name = self.find_coefficients(suffix)
        coefficients = [] if name is None else self.matrix(name, (0, 4, 5, 8, 12, 14))
        xi = self.find(("xi",), suffix)
        kind = self.kind(name, coefficients, xi)
        says = xi is not None or self.find(SAYS_FISHEYE + SAYS_MODEL) is not None
        if name is None and (says or self.hint is None):
            raise ValueError(
                "distortion_coefficients or D is missing; write D: [] if the camera has none. The "
                f"file has {listed(self.file.entries)}"
            )
        if coefficients and len(coefficients) not in COUNTS[kind]:
            raise ValueError(
                f"{name} must have {' or '.join(map(str, COUNTS[kind]))} coefficients for the "
                f"{kind} model, got {len(coefficients)}"
            )
        if name is not None:
            self.check_shape(name, len(coefficients))
        plane: Plane = (fx, fy), (cx, cy), self.image_size(suffix)
        if fits_ros(self.file.entries):
            plane, skew = self.in_message(*plane), skew / self.binning()[0]
        if kind == "fisheye":
            return describe(KannalaBrandt, *plane, {"radial": coefficients}, skew)
        terms = {"radial": coefficients[:2] + coefficients[4:5], "tangential": coefficients[2:4]}
        if kind == "omnidir":
            if xi is None:
                raise ValueError("xi is missing, it must be a finite number")
            (value,) = self.matrix(xi, (1,))
            return describe(Mei, *plane, {"xi": value, **terms}, skew)
        if any(coefficients[12:]):
            raise ValueError(
                f"{name} must end with a tilt of 0, 0: a tilted sensor is not supported, got "
                f"{coefficients[12:]}"
            )
        terms |= {"denominator": coefficients[5:8], "prism": coefficients[8:12]}
        return describe(BrownConrady, *plane, terms, skew)

    def kind(
        self, name: str | None, coefficients: list[float], xi: str | None, only: str | None = None
    ) -> str:
        """Which of `MODELS`: the hint, what the file says, or what only one of them has."""
        if self.hint is not None:
            return self.hint
        flag = self.find(SAYS_FISHEYE)
        if flag is not None:
            value = self.file.entries[flag]
            word = plain_name(str(value)) if isinstance(value, (str, int)) else ""
            if word not in ("0", "1", "true", "false"):
                raise ValueError(f"{flag} must be 0 or 1, got {short(value)}")
            return "fisheye" if word in ("1", "true") else "pinhole"
        said = self.find(SAYS_MODEL)
        if said is not None:
            word = plain_name(self.file.text(said))
            found = next((kind for kind, words in WORDS.items() if word in words), None)
            if found is None:
                known = sorted(word for words in WORDS.values() for word in words)
                raise ValueError(
                    f"{said} must be one of {', '.join(known)}, got "
                    f"{short(self.file.entries[said])}; or give model=, one of {', '.join(MODELS)}"
                )
            return found
        if xi is not None:
            return "omnidir"
        if only is not None or len(coefficients) > 4:
            return only or "pinhole"
        what = f"the coefficients of {name}" if coefficients else "a camera without coefficients"
        raise ValueError(
            f"{what} may be cv2.fisheye's (k1 to k4) or a pinhole's (k1, k2, p1, p2), and "
            'the file does not say which: give model="fisheye" or model="pinhole", or write '
            "fisheye_model: 1 or 0 into it"
        )

    def matrix(self, name: str, counts: tuple[int, ...]) -> list[float]:
        """The numbers of a matrix: a mapping with `data`, a list, a list of rows, or a number."""
        value, where = self.file.entries[name], name
        if isinstance(value, Mapping):
            section, where = self.file.section(name), f"{name}.data"
            value = section.get("data", "numbers")
            if value == "" and not ("rows" in section and "cols" in section):
                value = None
        elif value == "":
            value = None  # an empty entry is an error, not a list of no numbers
        if isinstance(value, (int, float)):
            value = [value]
        if isinstance(value, list) and any(isinstance(row, list) for row in value[:3]):
            value = _flattened(value)
        return Fields({where: value}).numbers(where, counts)

    def check_shape(self, name: str, count: int) -> None:
        """That a matrix is of as many numbers as its rows and columns say."""
        section = Fields(self.file.entries[name], f"{name}.")
        if isinstance(section.entries, Mapping) and "rows" in section and "cols" in section:
            rows, columns = section.number("rows"), section.number("cols")
            if rows * columns != count:
                raise ValueError(f"{name}.data must be {rows:g} × {columns:g} numbers, got {count}")

    def binning(self) -> tuple[int, int]:
        """How many pixels across and down are one in a ROS message's image."""
        across, down = (_count(self.file, f"binning_{axis}") for axis in "xy")
        return max(across, 1), max(down, 1)  # 0 means 1

    def in_message(self, focal: Pair, center: Pair, size: Size) -> Plane:
        """Where a ROS message's image has the camera: its matrix is of the whole sensor, of which
        the image shows the region `roi`, with `binning_x` by `binning_y` pixels as one."""
        roi = self.file.section("roi") if "roi" in self.file else Fields({})
        left, top, width, height = (
            _count(roi, name) for name in ("x_offset", "y_offset", "width", "height")
        )
        across, down = self.binning()
        if width or height or left or top:
            rows, columns = size or (math.inf, math.inf)
            if not (0 < width <= columns - left and 0 < height <= rows - top):
                raise ValueError(
                    "roi must be a region of the image of 1 pixel or more, or all 0, got "
                    f"{width}×{height} px at ({left}, {top})"
                )
            size = height, width
        if size is not None:
            size = size[0] // down, size[1] // across
            if 0 in size:
                raise ValueError(f"binning must leave a pixel, got {across} by {down} as one")
        x, y = center[0] - left, center[1] - top
        center = (x + 0.5) / across - 0.5, (y + 0.5) / down - 0.5
        return (focal[0] / across, focal[1] / down), center, size

    def image_size(self, suffix: str) -> tuple[int, int] | None:
        """(H, W) of a camera's images, or of all cameras', if the file says it."""
        for end in (suffix, ""):
            pair = self.find(SIZE, end)
            if pair is not None:
                width, height = self.file.sides(pair)
                return height, width
            across, down = self.find(WIDTH, end), self.find(HEIGHT, end)
            if across is not None or down is not None:
                return (self.file.side(down or "image_height"),
                        self.file.side(across or "image_width"))  # fmt: skip
        return None


def _count(fields: Fields, name: str) -> int:
    """A number of pixels, 0 where it is missing."""
    number = fields.number(name, 0.0)
    if not (0 <= number <= MAX_SIDE and number.is_integer()):
        expected = f"a whole number of pixels, 0 to {MAX_SIDE}"
        raise ValueError(f"{fields.path(name)} must be {expected}, got {number:g}")
    return int(number)


def _flattened(rows: list[Any]) -> list[Any]:
    """A short list of short rows as one list."""
    flat = []
    for row in rows[:32]:
        flat += row[:32] if isinstance(row, list) else [row]
    return flat
