"""Our own JSON: the name of a lens model and the arguments of its constructor."""

import json
from collections.abc import Mapping
from typing import Any

from darswin.lens.base import MODELS, Lens, to_dict
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields, short, to_number
from darswin.lens.files.format import Cameras, Description, Format
from darswin.lens.ideal import FocalLens


class Own(Format):
    """One lens of any model in `MODELS`."""

    name = "darswin"

    def fits(self, content: Content) -> bool:
        model = content.get("model") if isinstance(content, Mapping) else None
        return isinstance(model, str) and model in MODELS

    def cameras(self, file: Fields, model: str | None) -> Cameras:
        return {"lens": lambda: _lens(file)}

    def write(self, lens: Lens, suffix: str) -> str:
        return json.dumps(to_dict(lens), indent=2, allow_nan=False) + "\n"


def _lens(file: Fields) -> Description:
    name = file.text("model")
    model = MODELS[name]
    required, optional = list(model.parameters), [*model.optional, *model.common]
    if "fov" in file and issubclass(model, FocalLens):
        required.remove("focal")
        required.append("fov")
        optional.remove("theta_max")
    for key in file.entries:
        if key not in ("model", *required, *optional):
            known = ", ".join((*required, *optional))
            raise ValueError(f"a {name} lens has no {file.path(key)}, only {known}")
    description: Description = {"model": name}
    for key in (*required, *(key for key in optional if key in file)):
        if key == "fov":
            description[key] = file.positive(key)
            continue
        dims = len(model.declared[key].shape)
        value = file.get(key, "a list of numbers" if dims else "a finite number")
        description[key] = _value(value, file.path(key), dims, model.max_numbers)
    if "image_size" in file:
        description["image_size"] = list(file.sides("image_size"))
    return description


def _value(value: Any, name: str, dims: int, most: int) -> Any:
    """A number, or nested lists: `dims` levels, each of at most `most` entries."""
    if dims == 0:
        return to_number(value, name)
    if not isinstance(value, list) or not value:
        raise ValueError(f"{name} must be a list of numbers, got {short(value)}")
    if len(value) > most:
        raise ValueError(f"{name} must be a list of at most {most} numbers, got {len(value)}")
    rows = [_value(entry, f"{name}[{i}]", dims - 1, most) for i, entry in enumerate(value)]
    if dims > 1 and len({len(row) for row in rows}) > 1:
        raise ValueError(f"{name} must have rows of equal length, got {short(value)}")
    return rows
