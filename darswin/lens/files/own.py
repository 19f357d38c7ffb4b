"""Our own JSON: a model's name and the arguments of its constructor."""

from collections.abc import Mapping
from typing import Any

from darswin.lens.base import FRAME, ROW_DIMS
from darswin.lens.description import MODELS
from darswin.lens.files.cameras import Cameras, Description
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields, short, to_number, to_positive

MAX_NUMBERS = {"angles": 65536, "radii": 65536}  # of a table's columns
MAX_COEFFICIENTS = 64  # of all else


def fits(content: Content) -> bool:
    model = content.get("model") if isinstance(content, Mapping) else None
    return isinstance(model, str) and model in MODELS


def cameras(file: Fields) -> Cameras:
    return {"lens": lambda: _lens(file)}


def _lens(file: Fields) -> Description:
    name = file.text("model")
    model = MODELS[name]
    required, optional = list(model.parameters), [*model.optional, "theta_max", *FRAME]
    if "fov" in file and hasattr(model, "from_fov"):
        required.remove("focal")
        required.append("fov")
        optional.remove("theta_max")
    for key in file.entries:
        if key not in ("model", *required, *optional):
            known = ", ".join((*required, *optional))
            raise ValueError(f"{file.path(key)} is not of a {name} lens, which has {known}")
    description: Description = {"model": name}
    for key in (*required, *(key for key in optional if key in file)):
        value = file.get(key, "a finite number" if key not in ROW_DIMS else "a list of numbers")
        most = MAX_NUMBERS.get(key, MAX_COEFFICIENTS)
        description[key] = _value(value, file.path(key), ROW_DIMS.get(key, 0), most)
    if "image_size" in file:
        description["image_size"] = list(file.sides("image_size"))
    return description


def _value(value: Any, name: str, dims: int, most: int) -> Any:
    """A number, or lists of at most `most` numbers, `dims` deep."""
    if dims == 0:
        return to_positive(value, name) if name == "fov" else to_number(value, name)
    if not isinstance(value, list) or not value:
        raise ValueError(f"{name} must be a list of numbers, got {short(value)}")
    if len(value) > most:
        raise ValueError(f"{name} must be a list of at most {most} numbers, got {len(value)}")
    rows = [_value(entry, f"{name}[{i}]", dims - 1, most) for i, entry in enumerate(value)]
    if dims > 1 and len({len(row) for row in rows}) > 1:
        raise ValueError(f"{name} must have rows of one length, got {short(value)}")
    return rows
