"""Intrinsics by their names: fx, fy, cx, cy, and k1, k2, p1, … beside them, in JSON or YAML."""

import re
from collections.abc import Mapping

from darswin.lens.distorted import BrownConrady, KannalaBrandt, Mei
from darswin.lens.files.cameras import Cameras, Description, describe
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields, listed
from darswin.lens.files.opencv import (
    LIKE_A_COEFFICIENT,
    LIKE_COEFFICIENTS,
    MATRIX,
    Reader,
    plain_name,
)

PLANE = ("fx", "fy", "cx", "cy")
TERM = re.compile(r"[kps]\d")
# In the order of OpenCV's functions.
TERMS = {
    "fisheye": ("k1", "k2", "k3", "k4"),
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "omnidir": ("k1", "k2", "p1", "p2"),
}


def fits(content: Content) -> bool:
    """Whether a file's content is one camera's intrinsics, without a matrix."""
    if not isinstance(content, Mapping):
        return False
    names = {plain_name(name): value for name, value in content.items()}
    return {*PLANE} <= names.keys() and not any(
        isinstance(names.get(matrix), (list, Mapping)) for matrix in MATRIX
    )


def cameras(file: Fields, hint: str | None = None) -> Cameras:
    """Its one camera. `hint`: as `darswin.lens.files.opencv.cameras`."""
    return {"camera": lambda: _camera(file, hint)}


def _camera(file: Fields, hint: str | None) -> Description:
    reader = Reader(file, hint)
    fx, fy = (file.positive(reader.names[name]) for name in PLANE[:2])
    cx, cy = (file.number(reader.names[name]) for name in PLANE[2:])
    terms = {
        plain: file.number(reader.names[plain])
        for plain in sorted(reader.names) if TERM.fullmatch(plain)
    }  # fmt: skip
    xi, skew = (reader.find((name,)) for name in ("xi", "skew"))
    # Their number says nothing of the model, as it does in a list: there are names.
    kind = reader.kind(listed(terms), [*terms.values()][:1], xi, _only_of(terms))
    if left := [name for name in terms if name not in TERMS[kind]]:
        raise ValueError(f"the {kind} model has no {listed(left)}, only {', '.join(TERMS[kind])}")
    if kind == "pinhole" and 0 < len({"k4", "k5", "k6"} & terms.keys()) < 3:
        raise ValueError(
            "k4 of the pinhole model is of its denominator, 1 + k4 r² + k5 r⁴ + k6 r⁶: write k4, "
            f"k5 and k6, got {listed(terms)}"
        )
    parameters: dict[str, float | list[float]] = {
        "radial": [terms.get(name, 0.0) for name in ("k1", "k2", "k3")],
        "tangential": [terms.get(name, 0.0) for name in ("p1", "p2")],
    }
    if kind == "fisheye":
        parameters = {"radial": [terms.get(name, 0.0) for name in TERMS[kind]]}
    elif kind == "omnidir":
        parameters["xi"] = file.number(xi or "xi")
    else:
        parameters["denominator"] = [terms.get(name, 0.0) for name in ("k4", "k5", "k6")]
        parameters["prism"] = [terms.get(name, 0.0) for name in ("s1", "s2", "s3", "s4")]
    slant = 0.0 if skew is None else file.number(skew)
    file.check_all_read(f"the {kind} model", like=_like_a_coefficient)
    classes = {"fisheye": KannalaBrandt, "pinhole": BrownConrady, "omnidir": Mei}
    return describe(classes[kind], (fx, fy), (cx, cy), reader.image_size(""), parameters, slant)


def _only_of(terms: Mapping[str, float]) -> str | None:
    """The model that alone has terms of these names."""
    if {*terms} == {*TERMS["fisheye"]}:
        return "fisheye"
    return "pinhole" if any(name[0] != "k" for name in terms) else None


def _like_a_coefficient(name: str, value: object) -> bool:
    plain = plain_name(name)
    alone = not isinstance(value, (list, Mapping))
    return bool(LIKE_COEFFICIENTS.search(plain) or (alone and LIKE_A_COEFFICIENT.fullmatch(plain)))
