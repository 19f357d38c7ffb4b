"""basalt's JSON: `value0` holds `intrinsics` and `resolution`, each with one entry per camera."""

from collections.abc import Mapping
from functools import partial

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, KannalaBrandt
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields, short, to_sides
from darswin.lens.files.format import Cameras, Description, Format, describe
from darswin.lens.ideal import FieldOfView
from darswin.lens.image import Size
from darswin.lens.sphere import DoubleSphere, EnhancedUnified

MODELS: dict[str, tuple[type[Lens], str]] = {
    "ds": (DoubleSphere, "xi alpha"),
    "eucm": (EnhancedUnified, "alpha beta"),
    "ucm": (EnhancedUnified, "alpha"),
    "kb4": (KannalaBrandt, "k1 k2 k3 k4"),
    "fov": (FieldOfView, "omega=w"),
    "pinhole": (BrownConrady, ""),
    "pinhole-radtan8": (BrownConrady, "k1 k2 p1 p2 k3 d1=k4 d2=k5 d3=k6"),
}


class Basalt(Format):
    """Its cameras are called cam0, cam1, …"""

    name = "basalt"
    keys = "value0 with intrinsics and resolution"

    def recognizes(self, content: Content) -> bool:
        calibration = content.get("value0") if isinstance(content, Mapping) else None
        return isinstance(calibration, Mapping) and "intrinsics" in calibration

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        calibration = file.section("value0")
        entries = calibration.sections("intrinsics")
        sizes: list[Size] = [None] * len(entries)
        if calibration.entries.get("resolution"):
            expected = f"{len(entries)} pairs of a width and a height"
            pairs, where = calibration.get("resolution", expected), calibration.path("resolution")
            if not isinstance(pairs, list) or len(pairs) != len(entries):
                raise ValueError(f"{where} must be {expected}, got {short(pairs)}")
            sizes = [to_sides(pair, f"{where}[{i}]")[::-1] for i, pair in enumerate(pairs)]
        cameras = enumerate(zip(entries, sizes, strict=True))
        return {f"cam{i}": partial(_camera, entry, size) for i, (entry, size) in cameras}


def _camera(entry: Fields, size: Size) -> Description:
    kind = entry.one_of("camera_type", MODELS)
    model, names = MODELS[kind]
    intrinsics = entry.section("intrinsics")
    values = intrinsics.values(f"fx fy cx cy {names}")
    intrinsics.check_all_read(f"basalt's {kind}", lambda name, _: name != "rpmax")
    return describe(model, {"beta": 1.0} | values, size)
