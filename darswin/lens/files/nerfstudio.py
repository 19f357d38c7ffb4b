"""transforms.json of nerfstudio and instant-ngp: one camera for all frames, or one for each."""

import math
import re
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

from darswin.lens.distorted import BrownConrady, KannalaBrandt
from darswin.lens.files.fields import (
    Fields,
    holds_numbers,
    like_coefficients,
    plain_name,
    short,
    to_flag,
)
from darswin.lens.files.format import Cameras, Description, Format, describe, has_several
from darswin.lens.files.reader import SAYS_FISHEYE

MODELS = {
    "SIMPLE_PINHOLE": BrownConrady, "PINHOLE": BrownConrady, "SIMPLE_RADIAL": BrownConrady,
    "RADIAL": BrownConrady, "OPENCV": BrownConrady, "OPENCV_FISHEYE": KannalaBrandt,
}  # fmt: skip
TERMS: tuple[str, ...] = ("k1", "k2", "k3", "k4", "p1", "p2")
MARKS = ("frames", "fl_x", "fl_y", "transform_matrix", "camera_angle_x")
ANGLES = ("camera_angle_x", "camera_angle_y")
KEYS = ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", *ANGLES, *TERMS)
# Entries of instant-ngp, after `plain_name`, that name cameras which we do not read.
OTHERS = re.compile(r"ftheta.*|(is)?(latlong|equirectangular|orthographic|spherical|panorama)")
PAIRS = (("k1", "k2"), ("k3", "k4"), ("p1", "p2"))  # nerfstudio's tools write both or none


class Nerfstudio(Format):
    """The camera at the top level, or the frames' cameras, called by the frames' file names."""

    name = "nerfstudio"
    origin = 0.5
    keys = "fl_x, fl_y, cx, cy and frames"

    def _recognizes(self, content: Mapping) -> bool:
        frames = content.get("frames")
        first = frames[0] if isinstance(frames, list) and frames else None
        keys = {*content, *(first if isinstance(first, Mapping) else ())}
        return has_several(keys, MARKS) or {ANGLES[0], "w", "h"} <= keys

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        sections = file.sections("frames") if "frames" in file else []
        frames = [section.entries for section in sections]
        # Entries at the top level override those of the frames; one coefficient at the top level
        # overrides all coefficients of the frames.
        shared = {key: file.entries[key] for key in _of_camera(file.entries)}
        hidden = {*shared, *(TERMS if any(key in shared for key in TERMS) else ())}
        hidden |= {*ANGLES} if "fl_x" in shared else set()
        own = _of_camera(set().union(*frames)) - hidden
        if not own:
            return {"camera": partial(_camera, file)}
        found: Cameras = {}
        for index, frame in enumerate(frames):
            name = frame.get("file_path")
            name = name if isinstance(name, str) else f"frame {index}"
            if name in found:
                raise ValueError(f"frames[{index}].file_path appears twice: {short(name)}")
            found[name] = partial(_frame, shared, own, frame, f"frames[{index}].")
        return found


def _of_camera(keys: Iterable[str]) -> set[str]:
    return {
        key for key in keys
        if key in KEYS or plain_name(key) in SAYS_FISHEYE or OTHERS.fullmatch(plain_name(key))
        or like_coefficients(key, None)
    }  # fmt: skip


def _frame(shared: dict[str, Any], own: set[str], frame: Mapping, where: str) -> Description:
    return _camera(Fields(shared | {key: frame[key] for key in own if key in frame}, where))


def _camera(fields: Fields) -> Description:
    terms, flags = TERMS, []
    for key, value in fields.entries.items():
        name = plain_name(key)
        if name in SAYS_FISHEYE:
            flags.append(to_flag(value, fields.path(key)))
        elif OTHERS.fullmatch(name) and (
            holds_numbers(value) if name.startswith("ftheta") else to_flag(value, fields.path(key))
        ):
            known = ", ".join(MODELS)
            raise ValueError(
                f"{fields.path(key)} names another camera than {known}, which are those of "
                f"nerfstudio that can be read; got {short(value)}"
            )
    is_fisheye = any(flags)
    if "camera_model" in fields:
        model = fields.one_of("camera_model", MODELS)
    elif is_fisheye:  # instant-ngp's files, where p1 and p2 belong to other cameras
        model, terms = "OPENCV_FISHEYE", TERMS[:4]
    else:
        model = "OPENCV"
    size = (fields.side("h"), fields.side("w")) if "w" in fields or "h" in fields else None
    if is_fisheye and model != "OPENCV_FISHEYE":
        raise ValueError(f"is_fisheye is true, but camera_model is {model}")
    for pair in PAIRS:
        there = [name for name in pair if name in fields]
        if len(there) == 1:
            lacks = fields.path(*({*pair} - {*there}))
            raise ValueError(f"{fields.path(there[0])} needs {lacks}: write 0 if there is none")
    if ANGLES[0] in fields and "fl_x" not in fields:
        values = _of_angles(fields)
    else:
        values = fields.values("fx=fl_x fy=fl_y cx cy")
    values |= fields.values(" ".join(terms), 0.0)
    fields.check_all_read(f"nerfstudio's {model}", like_coefficients)
    return describe(MODELS[model], values, size)


def _of_angles(fields: Fields) -> dict[str, float]:
    """Focal lengths from fields of view, with the principal point in the image's middle if the
    file does not say it."""
    values = {"cx": fields.number("cx", fields.side("w") / 2)}
    values["cy"] = fields.number("cy", fields.side("h") / 2)
    expected = "above 0 and below π rad"
    for key, side, name in zip(ANGLES, ("w", "h"), ("fx", "fy"), strict=True):
        if key in fields:
            angle = fields.number(key, None, expected, lambda angle: 0 < angle < math.pi)
            values[name] = fields.side(side) / 2 / math.tan(angle / 2)
    return {"fy": values["fx"]} | values
