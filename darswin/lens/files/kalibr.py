"""Kalibr's camchain YAML: pinhole, omni, ds and eucm with radtan, equidistant, fov or none.

Also EuRoC's sensor.yaml, which calls the coefficients and their model by other names.
"""

import re
from collections.abc import Mapping
from functools import partial
from typing import Any

import yaml

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, KannalaBrandt, Mei
from darswin.lens.files.cameras import Camera, Cameras, Description, describe
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields
from darswin.lens.ideal import FieldOfView
from darswin.lens.sphere import DoubleSphere, EnhancedUnified

# Each model's intrinsics before fu, fv, pu, pv, and the distortions that Kalibr has for it.
MODELS = {
    "pinhole": ((), ("radtan", "equidistant", "fov", "none")),
    "omni": (("xi",), ("radtan", "none")),
    "ds": (("xi", "alpha"), ("none",)),
    "eucm": (("alpha", "beta"), ("none",)),
}
COEFFICIENTS = {"radtan": 4, "equidistant": 4, "fov": 1, "none": 0}
NAMES = ("distortion_coeffs", "distortion_coefficients")  # Kalibr's and EuRoC's
RADTAN = ("radial-tangential", "radial_tangential")  # EuRoC's
LIKE = re.compile("coef|dist(?!ance)")


def _is_camera(entry: object) -> bool:
    """Also one that lacks something, so that it is missed, and no other camera taken for it."""
    return isinstance(entry, Mapping) and ("camera_model" in entry or "intrinsics" in entry)


def _is_alone(content: Mapping) -> bool:
    return "camera_model" in content and "intrinsics" in content


def fits(content: Content) -> bool:
    """Whether a file's content is Kalibr's: it has a camera, or is one."""
    return isinstance(content, Mapping) and (
        _is_alone(content)
        or any(isinstance(e, Mapping) and "camera_model" in e for e in content.values())
    )


def cameras(file: Fields) -> Cameras:
    """Its cameras, by their names."""
    if _is_alone(file.entries):
        return {"camera": partial(_camera, file)}
    names = [name for name, entry in file.entries.items() if _is_camera(entry)]
    return {name: partial(_camera, file.section(name)) for name in names}


def _camera(fields: Fields) -> Description:
    model = _one_of(fields, "camera_model", tuple(MODELS))
    names, distortions = MODELS[model]
    if fields.entries.get("distortion_model") in RADTAN and "radtan" in distortions:
        distortion = "radtan"
    else:
        distortion = _one_of(fields, "distortion_model", distortions)
    *own, fu, fv, pu, pv = fields.numbers("intrinsics", (len(names) + 4,))
    for index, focal in ((-4, fu), (-3, fv)):
        if not focal > 0:
            where = fields.path(f"intrinsics[{len(names) + 4 + index}]")
            raise ValueError(f"{where} must be a focal length above 0, got {focal:g}")
    count = COEFFICIENTS[distortion]
    listed = next((name for name in NAMES if name in fields), NAMES[0])
    coefficients = fields.numbers(listed, (count,)) if count else []
    fields.check_all_read(f"a {distortion} camera", like=lambda name, _: LIKE.search(name))
    size = None
    if "resolution" in fields:
        width, height = fields.sides("resolution")
        size = (height, width)
    parameters: dict[str, Any] = dict(zip(names, own, strict=True))
    if distortion == "radtan":
        parameters |= {"radial": coefficients[:2], "tangential": coefficients[2:]}
    elif distortion == "equidistant":
        parameters |= {"radial": coefficients}
    elif distortion == "fov" and coefficients[0] != 0:
        return describe(FieldOfView, (fu, fv), (pu, pv), size, {"omega": coefficients[0]})
    pinhole = KannalaBrandt if distortion == "equidistant" else BrownConrady
    classes = {"pinhole": pinhole, "omni": Mei, "ds": DoubleSphere, "eucm": EnhancedUnified}
    return describe(classes[model], (fu, fv), (pu, pv), size, parameters)


def write(camera: Camera) -> str | None:
    """A camchain.yaml of cam0; None if Kalibr has no such camera."""
    if camera.size is None:
        raise ValueError("Kalibr's cameras have an image_size, (H, W), and this lens has none")
    kinds: dict[type[Lens], tuple[str, str, str]] = {
        BrownConrady: ("pinhole", "radtan", "k1 k2 p1 p2"),
        KannalaBrandt: ("pinhole", "equidistant", "k1 k2 k3 k4"),
        FieldOfView: ("pinhole", "fov", "omega"),
        Mei: ("omni", "radtan", "k1 k2 p1 p2"),
        DoubleSphere: ("ds", "none", ""),
        EnhancedUnified: ("eucm", "none", ""),
    }
    model, distortion, names = kinds.get(camera.model, ("", "", ""))
    known = model and camera.terms.keys() <= {*names.split()}
    if not known or camera.skew != 0 or camera.plane.get("beta", 1) < 0:
        return None
    own = [camera.plane[name] for name in MODELS[model][0]]
    coefficients = camera.listed(names)
    if distortion == "fov":
        coefficients = [camera.plane["omega"]]
    height, width = camera.size
    written = {
        "cam_overlaps": [],
        "camera_model": model,
        "distortion_coeffs": coefficients,
        "distortion_model": distortion,
        "intrinsics": own + [camera.plane[name] for name in ("fx", "fy", "cx", "cy")],
        "resolution": [width, height],
        "rostopic": "/cam0/image_raw",
    }
    return yaml.safe_dump({"cam0": written}, default_flow_style=None, width=1000)


def _one_of(fields: Fields, name: str, allowed: tuple[str, ...]) -> str:
    expected = f"one of {', '.join(allowed)}"
    value = fields.text(name, expected)
    if value not in allowed:
        raise ValueError(f"{fields.path(name)} must be {expected}, got {value!r}")
    return value
