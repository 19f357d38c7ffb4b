"""nerfstudio's transforms.json: one camera for all frames, or one a frame."""

import re
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

from darswin.lens.distorted import BrownConrady, KannalaBrandt
from darswin.lens.files.cameras import Cameras, Description, describe
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields, short

MODELS = {
    "SIMPLE_PINHOLE": BrownConrady, "PINHOLE": BrownConrady, "SIMPLE_RADIAL": BrownConrady,
    "RADIAL": BrownConrady, "OPENCV": BrownConrady, "OPENCV_FISHEYE": KannalaBrandt,
}  # fmt: skip
TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")
KEYS = ("camera_model", "is_fisheye", "fl_x", "fl_y", "cx", "cy", "w", "h", *TERMS)
PAIRS = (("k1", "k2"), ("k3", "k4"), ("p1", "p2"))  # as its tools write them
LIKE = re.compile(r"(?i)^[a-z]{0,2}_?\d|coef|dist(?!ance)")


def fits(content: Content) -> bool:
    """Whether a file's content is nerfstudio's: it has frames, or what stands beside them."""
    return isinstance(content, Mapping) and any(
        key in content for key in ("frames", "fl_x", "fl_y", "transform_matrix")
    )


def cameras(file: Fields) -> Cameras:
    """Its cameras: the one at the top, or each frame's, by the frame's file."""
    frames = file.get("frames", "a list of mappings") if "frames" in file else []
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise ValueError(f"frames must be a list of mappings, got {short(frames)}")
    # What stands at the top rules. Terms are of one place: one of them at the top hides frames'.
    shared = {key: file.entries[key] for key in _of_camera(file.entries)}
    hidden = {*shared, *(TERMS if any(key in shared for key in TERMS) else ())}
    own = _of_camera(set().union(*frames)) - hidden
    if not own:
        return {"camera": partial(_camera, file)}
    found: Cameras = {}
    for index, frame in enumerate(frames):
        name = frame.get("file_path")
        name = name if isinstance(name, str) else f"frame {index}"
        if name in found:
            raise ValueError(f"frames[{index}].file_path is that of another frame: {short(name)}")
        found[name] = partial(_frame, shared, own, frame, f"frames[{index}].")
    return found


def _of_camera(keys: Iterable[str]) -> set[str]:
    return {key for key in keys if key in KEYS or LIKE.search(key)}


def _frame(shared: dict[str, Any], own: set[str], frame: dict, where: str) -> Description:
    return _camera(Fields(shared | {key: frame[key] for key in own if key in frame}, where))


def _camera(fields: Fields) -> Description:
    model = fields.text("camera_model") if "camera_model" in fields else "OPENCV"
    if model not in MODELS:
        expected = ", ".join(MODELS)
        raise ValueError(f"{fields.path('camera_model')} must be one of {expected}, got {model!r}")
    size = None
    if "w" in fields or "h" in fields:
        size = (fields.side("h"), fields.side("w"))
    if fields.entries.get("is_fisheye") in (True, "true") and model != "OPENCV_FISHEYE":
        raise ValueError(f"is_fisheye is true, and camera_model must not be {model} then")
    for pair in PAIRS:
        if (pair[0] in fields) != (pair[1] in fields):
            one, other = pair if pair[0] in fields else pair[::-1]
            there, lacks = fields.path(one), fields.path(other)
            raise ValueError(f"{lacks} is missing beside {there}; write 0 if there is none")
    terms = {key: fields.number(key, 0.0) for key in TERMS}
    focal = (fields.positive("fl_x"), fields.positive("fl_y"))
    center = (fields.number("cx"), fields.number("cy"))
    fields.check_all_read(f"nerfstudio's {model}", like=lambda name, _: LIKE.search(name))
    radial, tangential = [terms[key] for key in TERMS[:4]], [terms[key] for key in TERMS[4:]]
    parameters = {"radial": radial, "tangential": tangential}
    return describe(MODELS[model], focal, center, size, parameters)
