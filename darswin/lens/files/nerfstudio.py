"""nerfstudio's transforms.json: one camera for all frames, or one a frame."""

from collections.abc import Mapping

from darswin.lens.distorted import BrownConrady, KannalaBrandt
from darswin.lens.files.cameras import Description, describe
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields

MODELS = {
    "SIMPLE_PINHOLE": BrownConrady, "PINHOLE": BrownConrady, "SIMPLE_RADIAL": BrownConrady,
    "RADIAL": BrownConrady, "OPENCV": BrownConrady, "OPENCV_FISHEYE": KannalaBrandt,
}  # fmt: skip
TERMS = ("k1", "k2", "k3", "k4", "p1", "p2")
KEYS = ("camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", *TERMS)


def fits(content: Content) -> bool:
    return isinstance(content, Mapping) and any(
        key in content for key in ("frames", "fl_x", "fl_y", "transform_matrix")
    )


def cameras(file: Fields) -> dict[str, Description]:
    if "frames" not in file:
        return {"camera": _camera(file)}
    frames = file.sections("frames")
    if not frames:
        return {"camera": _camera(file)}
    # What stands at the top rules. Terms are of one place: one of them at the top hides frames'.
    shared = {key: file.entries[key] for key in KEYS if key in file}
    hidden = {*shared, *(TERMS if any(key in shared for key in TERMS) else ())}
    own = [{k: f.entries[k] for k in KEYS if k in f and k not in hidden} for f in frames]
    if not any(own):
        return {"camera": _camera(file)}
    found = {}
    for index, (frame, entries) in enumerate(zip(frames, own, strict=True)):
        name = frame.entries.get("file_path")
        name = name if isinstance(name, str) and name not in found else f"frame {index}"
        found[name] = _camera(Fields(shared | entries, frame.path("")))
    return found


def _camera(fields: Fields) -> Description:
    model = fields.text("camera_model") if "camera_model" in fields else "OPENCV"
    if model not in MODELS:
        expected = ", ".join(MODELS)
        raise ValueError(f"{fields.path('camera_model')} must be one of {expected}, got {model!r}")
    size = None
    if "w" in fields or "h" in fields:
        size = (fields.side("h"), fields.side("w"))
    terms = {key: fields.number(key, 0.0) for key in TERMS}
    return describe(
        MODELS[model],
        (fields.positive("fl_x"), fields.positive("fl_y")),
        (fields.number("cx"), fields.number("cy")),
        size,
        radial=[terms[key] for key in TERMS[:4]],
        tangential=[terms[key] for key in TERMS[4:]],
    )
