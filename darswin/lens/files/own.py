"""Our own JSON: the name of a lens model and the arguments of its constructor.

Angles may be in degrees: `theta_max_deg`, and `fov_deg` in place of `fov`. Beside the lens, a file
may say up to which angle corners support it.
"""

import json
import math
from collections.abc import Mapping
from typing import Any

from darswin.lens.base import IN_DEGREES, MODELS, ROUNDING, Lens, to_dict
from darswin.lens.files.fields import Fields, short, to_number
from darswin.lens.files.format import Cameras, Description, Format
from darswin.lens.ideal import FocalLens

# The largest value of each angle, rad.
ANGLES = {"fov": 2 * math.pi, "theta_max": math.pi}


class Own(Format):
    """One lens of any model in `MODELS`."""

    name = "darswin"
    keys = "model"

    def _recognizes(self, content: Mapping) -> bool:
        name = content.get("model")
        if not isinstance(name, str) or name not in MODELS:
            return False
        # Others name models too, such as Perspective, beside fx and fy.
        model, others = MODELS[name], content.keys() - {"model"}
        known = (*model.parameters, *model.optional, *model.common, *ANGLES, *IN_DEGREES)
        return not others or not others.isdisjoint(known)

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        self.supported(file)  # a wrong one is an error
        return {"lens": lambda: _lens(file)}

    def supported(self, file: Fields) -> float | None:
        if "supported" not in file:
            return None
        expected = f"above 0 and at most {math.pi:.4g} rad"
        return file.number("supported", None, expected, lambda x: 0 < x <= math.pi)

    def write(self, lens: Lens, suffix: str, supported: float | None = None) -> str:
        said = {} if supported is None else {"supported": float(supported)}
        if said:
            self.supported(Fields(said))
        return json.dumps(to_dict(lens) | said, indent=2, allow_nan=False) + "\n"


def _lens(file: Fields) -> Description:
    name = file.text("model")
    model = MODELS[name]
    required, optional = list(model.parameters), [*model.optional, *model.common]
    if ("fov" in file or "fov_deg" in file) and issubclass(model, FocalLens):
        fov = "fov" if "fov" in file else "fov_deg"
        if "focal" in file:
            raise ValueError(
                f"{fov} takes the place of focal, they must not both be given: beside focal, "
                f"{fov.replace('fov', 'theta_max')} is half of {fov}"
            )
        required[required.index("focal")] = "fov"
        optional.remove("theta_max")
    known = [*required, *optional]
    known += [key for key, angle in IN_DEGREES.items() if angle in known]
    for key in file.entries:
        if key not in ("model", "supported", *known):
            raise ValueError(f"a {name} lens has no {file.path(key)}, only {', '.join(known)}")
    angles: dict[str, float] = {}
    for in_degrees, angle in IN_DEGREES.items():
        if angle in known:
            angles |= _angle(file, angle, in_degrees)
    description: Description = {"model": name}
    for key in (*required, *(key for key in optional if key in file)):
        if key not in ANGLES:
            dims = len(model.declared[key].shape)
            value = file.get(key, "a list of numbers" if dims else "a finite number")
            description[key] = _value(value, file.path(key), dims, model.max_numbers)
    if "image_size" in file:
        description["image_size"] = list(file.sides("image_size"))
    return description | angles


def _angle(file: Fields, key: str, in_degrees: str) -> dict[str, float]:
    """An angle under the name that the file gives it, with or without "_deg"; {} for none."""
    if key in file and in_degrees in file:
        raise ValueError(f"{file.path(key)} and {file.path(in_degrees)} must not both be given")
    if in_degrees in file:
        most = math.degrees(ANGLES[key])
        expected = f"above 0 and at most {most:g} degrees"
        return {in_degrees: file.number(in_degrees, None, expected, lambda x: 0 < x <= most)}
    if key not in file:
        return {}
    expected = f"at most {ANGLES[key]:.4g} rad and above 0 ({in_degrees} takes degrees)"
    most = ANGLES[key] + ROUNDING
    return {key: file.number(key, None, expected, lambda x: 0 < x <= most)}


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
