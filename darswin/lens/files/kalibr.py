"""Kalibr's camchain YAML: pinhole, omni, ds and eucm with radtan, equidistant, fov or none.

Also EuRoC's sensor.yaml, which has other names for the coefficients and their model.
"""

from collections.abc import Mapping
from functools import partial

import yaml

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, KannalaBrandt, Mei
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields, like_coefficients
from darswin.lens.files.format import (
    Cameras,
    Description,
    Format,
    Intrinsics,
    describe,
    has_several,
)
from darswin.lens.ideal import FieldOfView
from darswin.lens.sphere import DoubleSphere, EnhancedUnified

# For each model and distortion: our class, the intrinsics before fx, fy, cx and cy, and the
# coefficients. A camera is written with the first entry that fits.
MODELS: dict[tuple[str, str], tuple[type[Lens], str, str]] = {
    ("pinhole", "radtan"): (BrownConrady, "", "k1 k2 p1 p2"),
    ("pinhole", "equidistant"): (KannalaBrandt, "", "k1 k2 k3 k4"),
    ("pinhole", "fov"): (FieldOfView, "", "omega"),
    ("pinhole", "none"): (BrownConrady, "", ""),
    ("omni", "radtan"): (Mei, "xi", "k1 k2 p1 p2"),
    ("omni", "none"): (Mei, "xi", ""),
    ("ds", "none"): (DoubleSphere, "xi alpha", ""),
    ("eucm", "none"): (EnhancedUnified, "alpha beta", ""),
}
PLANE = "fx fy cx cy"
MARKS = ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution")
NAMES = ("distortion_coeffs", "distortion_coefficients")  # Kalibr's and EuRoC's
RADTAN = ("radial-tangential", "radial_tangential")  # EuRoC's


class Kalibr(Format):
    """Several cameras with names, or one camera without a name."""

    name = "Kalibr"
    keys = "cam0 with camera_model, intrinsics and distortion_coeffs"
    needs_size = True
    holds = (
        "without skew, Perspective and BrownConrady (2 radial, tangential), Equidistant and "
        "KannalaBrandt (4 radial only), FieldOfView, Spherical and Mei (2 radial, tangential), "
        "DoubleSphere and EnhancedUnified"
    )

    def recognizes(self, content: Content) -> bool:
        return isinstance(content, Mapping) and (
            _is_alone(content)
            or any(
                isinstance(entry, Mapping) and "camera_model" in entry and has_several(entry, MARKS)
                for entry in content.values()
            )
        )

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        if _is_alone(file.entries):
            return {"camera": partial(_camera, file)}
        # An entry that lacks its model counts too: reading it must fail, not find another camera.
        names = [
            name for name, entry in file.entries.items()
            if isinstance(entry, Mapping) and ("camera_model" in entry or "intrinsics" in entry)
        ]  # fmt: skip
        return {name: partial(_camera, file.section(name)) for name in names}

    def _text(self, camera: Intrinsics, suffix: str) -> str | None:
        height, width = camera.size
        found = [
            key for key, (of, *names) in MODELS.items() if camera.has_only(of, " ".join(names))
        ]  # fmt: skip
        if not found or camera.values.get("beta", 1) < 0:
            return None
        _, own, terms = MODELS[found[0]]
        written = {
            "cam_overlaps": [],
            "camera_model": found[0][0],
            "distortion_coeffs": camera.listed(terms),
            "distortion_model": found[0][1],
            "intrinsics": camera.listed(f"{own} {PLANE}"),
            "resolution": [width, height],
            "rostopic": "/cam0/image_raw",
        }
        return yaml.safe_dump({"cam0": written}, default_flow_style=None, width=1000)


def _is_alone(content: Mapping) -> bool:
    return "camera_model" in content and "intrinsics" in content


def _camera(fields: Fields) -> Description:
    kind = fields.one_of("camera_model", dict.fromkeys(kind for kind, _ in MODELS))
    distortions = [distortion for of, distortion in MODELS if of == kind]
    if fields.entries.get("distortion_model") in RADTAN and "radtan" in distortions:
        distortion = "radtan"
    else:
        distortion = fields.one_of("distortion_model", distortions)
    model, own, terms = MODELS[kind, distortion]
    names, coefficients = f"{own} {PLANE}".split(), terms.split()
    values = dict(zip(names, fields.numbers("intrinsics", (len(names),)), strict=True))
    for name in ("fx", "fy"):
        if not values[name] > 0:
            where = fields.path(f"intrinsics[{names.index(name)}]")
            raise ValueError(f"{where} must be a focal length above 0, got {values[name]:g}")
    if coefficients:
        listed = next((name for name in NAMES if name in fields), NAMES[0])
        least = len(coefficients) if model is KannalaBrandt else None
        found = fields.numbers(listed, (len(coefficients),), least)
        values |= dict(zip(coefficients, found, strict=True))
    fields.check_all_read(f"a {distortion} camera", like_coefficients)
    if values.get("omega") == 0:
        model = BrownConrady
    size = fields.sides("resolution")[::-1] if "resolution" in fields else None
    return describe(model, values, size)
