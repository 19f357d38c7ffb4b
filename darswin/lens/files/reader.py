"""The camera matrices, coefficients and sizes of OpenCV's and ROS's files, under various names."""

import math
import re
from collections.abc import Mapping
from typing import Any, Literal, get_args

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, KannalaBrandt, Mei
from darswin.lens.files.fields import (
    Fields,
    holds_numbers,
    is_number,
    like_coefficients,
    listed,
    plain_name,
    short,
    to_flag,
    to_number,
    to_side,
)
from darswin.lens.files.format import Description, describe
from darswin.lens.image import Size
from darswin.lens.plausible import NEAR, off_middle, swap_fits
from darswin.utils.parameters import naming
from darswin.utils.words import in_px

Coefficients = Literal["fisheye", "pinhole", "omnidir"]
MODELS: tuple[Coefficients, ...] = get_args(Coefficients)
# For each model: our class, its coefficients in OpenCV's order, and their possible numbers.
ORDERS: dict[str, tuple[type[Lens], str, tuple[int, ...]]] = {
    "fisheye": (KannalaBrandt, "k1 k2 k3 k4", (4,)),
    "pinhole": (BrownConrady, "k1 k2 p1 p2 k3 d1 d2 d3 s1 s2 s3 s4 tilt1 tilt2",
                (4, 5, 8, 12, 14)),
    "omnidir": (Mei, "k1 k2 p1 p2", (4,)),
}  # fmt: skip
WORDS = {
    "fisheye": ("fisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt4", "kb", "kb4",
                "opencvfisheye"),
    "pinhole": ("pinhole", "plumbbob", "rationalpolynomial", "radtan", "radialtangential",
                "perspective", "brownconrady", "thinprism"),
    "omnidir": ("omnidir", "omni", "mei", "omnidirectional"),
}  # fmt: skip

# Names of entries, after `plain_name`.
PLANE = ("fx", "fy", "cx", "cy")
MATRIX = ("k", "cameramatrix", "intrinsicmatrix", "mtx", "m")
COEFFICIENTS = ("d", "coeffs", "coefficients", *(
    name + kind for name in ("dist", "distortion", "cameradistortion")
    for kind in ("", "coef", "coefs", "coeff", "coeffs", "coefficients", "params", "parameters")
))  # fmt: skip
SIZE = ("imagesize", "imgsize", "size", "dim", "resolution", "cameraresolution", "framesize",
        "imgdim", "imagedim", "calibdimension", "calibdim")  # fmt: skip  # (W, H)
SHAPE = ("shape", "imageshape", "imgshape", "frameshape")  # (H, W) or (H, W, C) of an array
WIDTH, HEIGHT = ("imagewidth", "width", "w"), ("imageheight", "height", "h")
SAYS_FISHEYE = ("fisheyemodel", "fisheye", "isfisheye")
SAYS_MODEL = ("distortionmodel", "model", "cameramodel", "modeltype", "calibrationmodel")
BESIDE = (*COEFFICIENTS, *SIZE, *SHAPE, *WIDTH, *HEIGHT, *SAYS_FISHEYE, *SAYS_MODEL, "xi")
SUFFIX = r"\d+|left|right"


class Reader:
    """A file whose entries have various names, and the model that the user named."""

    def __init__(self, file: Fields, given: str | None):
        self.file, self.given = file, given
        # Of two names that `plain_name` makes equal, the first counts if they agree.
        seen: dict[str, str] = {}
        for name, value in file.entries.items():
            plain = plain_name(name).replace("imgsize", "imagesize")
            first = seen.setdefault(plain, name)
            if _plain_value(file.entries[first]) != _plain_value(value) and _is_once(plain):
                raise ValueError(f"{file.path(first)} and {file.path(name)} must be the same")
        self.names = {plain_name(name): name for name in reversed(list(file.entries))}

    def find_all(self, names: tuple[str, ...], suffix: str) -> list[str]:
        """All names in the file that are among `names` with a suffix."""
        return [self.names[n + suffix] for n in names if n + suffix in self.names]

    def find(self, names: tuple[str, ...], suffix: str = "") -> str | None:
        return next(iter(self.find_all(names, suffix)), None)

    def coefficients(self, suffix: str) -> str | None:
        """The name of the entry with a camera's coefficients, if any; ValueError for several."""
        found = self.find_all(COEFFICIENTS, suffix)
        if len(found) > 1:
            raise ValueError(f"coefficients must be in one entry, got {listed(found)}")
        return found[0] if found else None

    def check_coefficients(self, suffixes: list[str]) -> None:
        """Raises ValueError if an entry looks like coefficients but has an unknown name."""
        read = [self.coefficients(suffix) for suffix in suffixes]
        left = [
            name for name, value in self.file.entries.items()
            if name not in read and like_coefficients(name, value) and holds_numbers(value)
        ]  # fmt: skip
        if left or (None in read and any(read)):
            raise ValueError(
                "each camera's coefficients must be in one entry, such as "
                f"distortion_coefficients or D, got {listed(left or filter(None, read))}"
            )

    def camera(self, suffix: str) -> Description:
        """The camera whose entries' names end with `suffix`."""
        matrices = self.find_all(MATRIX, suffix)
        values = [self.matrix(name, (9,)) for name in matrices]
        if any(other != values[0] for other in values[1:]):
            raise ValueError(f"{' and '.join(matrices)} must be the same camera matrix")
        fx, skew, cx, zero, fy, cy, *last = values[0]
        if not (fx > 0 and fy > 0 and zero == 0 and last == [0, 0, 1]):
            form = "[fx, skew, cx, 0, fy, cy, 0, 0, 1] with fx and fy above 0"
            raise ValueError(f"{matrices[0]} must be {form}, got {values[0]}")
        plane = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": skew}
        name, xi = self.coefficients(suffix), self.find(("xi",), suffix)
        kind = self.given or self.says(suffix)  # before the numbers: each model has its own
        coefficients = [] if name is None else self.matrix(name, (0, 4, 5, 8, 12, 14), 4)
        kind = kind or self.kind(name, coefficients, xi)
        says = xi is not None or self.find(SAYS_FISHEYE + SAYS_MODEL) is not None
        if name is None and (says or self.given is None):
            raise ValueError(
                "distortion_coefficients or D is missing; write D: [] if the camera has none. The "
                f"file's entries are {listed(self.file.entries)}"
            )
        model, order, counts = ORDERS[kind]
        while kind != "pinhole" and len(coefficients) > 4 and coefficients[-1] == 0:
            coefficients.pop()  # of T265 and MYNT
        if coefficients and len(coefficients) not in counts:
            expected = f"{' or '.join(map(str, counts))} coefficients for the {kind} model"
            raise ValueError(f"{name} must have {expected}, got {len(coefficients)}")
        if tilt := [angle for angle in coefficients[12:] if angle]:
            raise ValueError(
                f"{name} must end with 0, 0: tilted sensors are unsupported, got {tilt}"
            )
        terms = dict(zip(order.split(), coefficients, strict=False))
        if kind == "omnidir":
            if xi is None:
                raise ValueError("xi is missing: it must be a finite number")
            (terms["xi"],) = self.matrix(xi, (1,))
        size = self.image_size(suffix, (cx, cy))
        sensor: dict[str, list[float]] = {}
        if "distortion_model" in self.file:
            size, sensor = _in_message(self.file, plane, size)
        return describe(model, plane | terms, size) | sensor

    def camera_by_name(self) -> Description:
        """The camera of a file with single numbers."""
        file, names = self.file, self.names
        plane = {name: file.positive(names[name]) for name in ("fx", "fy")}
        plane |= {name: file.number(names[name]) for name in ("cx", "cy")}
        found = sorted(name for name in names if re.fullmatch(r"[kps]\d", name))
        terms = {name: file.number(names[name]) for name in found}
        xi, skew = (self.find((name,)) for name in ("xi", "skew"))
        only = None
        if found == ["k1", "k2", "k3", "k4"]:
            only = "fisheye"
        elif any(name[0] != "k" for name in found):
            only = "pinhole"
        # The names of coefficients tell the model; their number, as in a list, does not.
        kind = (
            self.given or self.says() or self.kind(listed(terms), [*terms.values()][:1], xi, only)
        )
        model, order, _ = ORDERS[kind]
        # OpenCV calls the denominator's coefficients k4 to k6.
        ours = {"k4": "d1", "k5": "d2", "k6": "d3"} if kind == "pinhole" else {}
        known = {name for name in found if ours.get(name, name) in order.split()}
        if left := [name for name in found if terms[name] != 0 and name not in known]:
            raise ValueError(f"the {kind} model has no {listed(left)}")
        if 0 < len(ours.keys() & terms.keys()) < 3:
            raise ValueError(
                "the pinhole model's denominator is 1 + k4 r² + k5 r⁴ + k6 r⁶: write all of k4, k5 "
                f"and k6, got {listed(terms)}"
            )
        terms = {ours.get(name, name): terms[name] for name in found if name in known}
        values = plane | dict.fromkeys(order.split(), 0.0) | terms
        if kind == "omnidir":
            values["xi"] = file.number(xi or "xi")
        if skew is not None:
            values["skew"] = file.number(skew)
        file.check_all_read(f"the {kind} model", like_coefficients)
        return describe(model, values, self.image_size("", (plane["cx"], plane["cy"])))

    def says(self, suffix: str = "") -> str | None:
        """The one of `MODELS` that the file names for a camera, or for all; None if it does not."""
        for end in (suffix, ""):
            if (flag := self.find(SAYS_FISHEYE, end)) is not None:
                return "fisheye" if to_flag(self.file.entries[flag], flag) else "pinhole"
            if (entry := self.find(SAYS_MODEL, end)) is not None:
                word = plain_name(self.file.text(entry))
                if found := [kind for kind, words in WORDS.items() if word in words]:
                    return found[0]
                known = ", ".join(sorted(word for words in WORDS.values() for word in words))
                text = (
                    f"{entry} must be one of {known}, got {short(self.file.entries[entry])}; else "
                    f"choose with `coefficients` one of {', '.join(MODELS)}"
                )
                raise naming(ValueError(text), "coefficients")
        return None

    def kind(
        self, name: str | None, coefficients: list[float], xi: str | None, only: str | None = None
    ) -> str:
        """The only one of `MODELS` with such coefficients."""
        if xi is not None:
            return "omnidir"
        if only is not None or len(coefficients) > 4:
            return only or "pinhole"
        what = f"the coefficients of {name}" if coefficients else "a camera without coefficients"
        text = (
            f"{what} may belong to cv2.fisheye (k1 to k4) or to a pinhole (k1, k2, p1, p2): give "
            '`coefficients` "fisheye" or "pinhole", or write fisheye_model: 1 or 0 into the file'
        )
        raise naming(ValueError(text), "coefficients")

    def matrix(self, name: str, counts: tuple[int, ...], least: int | None = None) -> list[float]:
        """The numbers of a matrix: a mapping with `data`, a list, a list of rows or a number. The
        other arguments are those of `Fields.numbers`."""
        value, where, shape = self.file.entries[name], name, None
        if isinstance(value, Mapping):
            section, where = self.file.section(name), f"{name}.data"
            value = section.get("data", "numbers")
            if "rows" in section and "cols" in section:
                shape = section.number("rows"), section.number("cols")
        if value == "" and shape is None:
            value = None  # an empty entry is an error, not an empty list
        if isinstance(value, (int, float)):
            value = [value]
        if isinstance(value, list) and any(isinstance(row, list) for row in value[:3]):
            rows = [row[:32] if isinstance(row, list) else [row] for row in value[:32]]
            value = [entry for row in rows for entry in row]
        if isinstance(value, str):
            value = value.split()
        numbers = Fields({where: value}).numbers(where, counts, least)
        if shape is not None and math.prod(shape) != len(value):
            height, width = shape
            raise ValueError(f"{where} must be {height:g} × {width:g} numbers, got {len(value)}")
        return numbers

    def image_size(self, suffix: str, center: tuple[float, float]) -> Size:
        """(H, W) of a camera's images, or of all cameras' images; None if the file has neither."""
        for end in (suffix, ""):
            for names, is_shape in ((SIZE, False), (SHAPE, True)):
                if (pair := self.find(names, end)) is not None:
                    return self.pair(pair, is_shape, center)
            across, down = self.find(WIDTH, end), self.find(HEIGHT, end)
            if across is not None or down is not None:
                return self.side(down or "image_height"), self.side(across or "image_width")
        return None

    def pair(self, name: str, is_shape: bool, center: tuple[float, float]) -> tuple[int, int]:
        """(H, W) of an entry with both sides. Scripts write both orders under any name: the name
        tells the order, unless only the other one has the center near the image's middle, or has
        the center's ratio of x to y, as beside the matrix of a smaller image."""
        value = self.file.entries[name]
        if isinstance(value, Mapping) and "data" not in value:
            both = Reader(self.file.section(name), None)
            return both.side(both.find(HEIGHT) or "height"), both.side(both.find(WIDTH) or "width")
        sides = self.matrix(name, (2, 3))
        first, second = (to_side(side, f"{name}[{i}]") for i, side in enumerate(sides[:2]))
        if len(sides) == 3:
            to_number(sides[2], f"{name}[2]", "1, 3 or 4 channels", lambda n: n in (1, 3, 4))
            return first, second
        size, other = (first, second), (second, first)
        if not is_shape:
            size, other = other, size
        return other if swap_fits(*center, *size[::-1]) or _looks_turned(*center, *size) else size

    def side(self, name: str) -> int:
        """One side of an image, px, from a number or from a matrix of one."""
        if isinstance(self.file.entries.get(name), (list, Mapping)):
            return to_side(self.matrix(name, (1,))[0], self.file.path(name))
        return self.file.side(name)


def matrices(names: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """The ending of each name of a matrix, and its value. Single numbers, as k1, are no matrix."""
    found = [(re.fullmatch(rf"({'|'.join(MATRIX)})({SUFFIX})?", n), v) for n, v in names.items()]
    return [
        (m[2] or "", v) for m, v in found
        if m and (isinstance(v, (list, Mapping)) or not is_number(str(v)))
    ]  # fmt: skip


def _in_message(
    file: Fields, plane: dict[str, float], size: Size
) -> tuple[Size, dict[str, list[float]]]:
    """The image size of a ROS message, and the place of its region on the sensor, if any.
    Changes `plane` from the sensor's pixels to the image's: the image shows the region `roi`,
    and joins `binning_x` × `binning_y` pixels to one."""
    roi = file.section("roi") if "roi" in file else Fields({})
    left, top, width, height = (
        _pixels(roi, name) for name in ("x_offset", "y_offset", "width", "height")
    )
    across, down = (max(_pixels(file, f"binning_{axis}"), 1) for axis in "xy")
    sensor: dict[str, list[float]] = {}
    if width or height or left or top:
        rows, columns = size or (math.inf, math.inf)
        if not (0 < width <= columns - left and 0 < height <= rows - top):
            raise ValueError(
                "roi must be a part of the image of 1 pixel or more, or all 0, got "
                f"{in_px((height, width))} at x = {left}, y = {top}"
            )
        if size is not None:
            sides = size[0] / down, size[1] / across
            sensor = {"sensor": [left / across, top / down, *sides]}
        size = height, width
    if size is not None:
        size = size[0] // down, size[1] // across
        if 0 in size:
            raise ValueError(f"the binning of {across}×{down} pixels leaves none of the image")
    plane["cx"] = (plane["cx"] - left + 0.5) / across - 0.5
    plane["cy"] = (plane["cy"] - top + 0.5) / down - 0.5
    for name, count in (("fx", across), ("fy", down), ("skew", across)):
        plane[name] /= count
    return size, sensor


def _pixels(fields: Fields, name: str) -> int:
    """A number of pixels; 0 if the entry is missing."""
    if name not in fields:
        return 0
    return to_side(fields.get(name, "a whole number of pixels"), fields.path(name), least=0)


def _is_once(plain: str) -> bool:
    """True for the names of one number or size, of which two values cannot both be right."""
    once = "|".join((*PLANE, *SIZE, *SHAPE, *WIDTH, *HEIGHT, "[kps]\\d"))
    return re.fullmatch(rf"({once})({SUFFIX})?", plain) is not None


def _plain_value(value: Any) -> Any:
    """For comparisons. The sides of an image may be in any order."""
    if isinstance(value, list) and all(isinstance(side, (int, float)) for side in value):
        return sorted(value)
    return value


def _looks_turned(x: float, y: float, height: float, width: float) -> bool:
    """True if x / y is far from width / height, but that of the other order, height / width."""
    if min(x, y) <= 0 or off_middle(x, y, width, height) < NEAR:
        return False
    given, other = (abs(math.log(x / y / ratio)) for ratio in (width / height, height / width))
    return given > 4 * other and other < NEAR / 2
