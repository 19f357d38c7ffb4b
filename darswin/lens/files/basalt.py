"""basalt's JSON: `value0` with one entry of `intrinsics` and of `resolution` a camera."""

from collections.abc import Mapping, Sequence
from functools import partial

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, KannalaBrandt
from darswin.lens.files.cameras import Cameras, Description, Parameters, describe
from darswin.lens.files.content import Content
from darswin.lens.files.fields import Fields
from darswin.lens.ideal import FieldOfView
from darswin.lens.sphere import DoubleSphere, EnhancedUnified

MODELS = ("ds", "eucm", "ucm", "kb4", "fov", "pinhole", "pinhole-radtan8")


def fits(content: Content) -> bool:
    """Whether a file's content is basalt's: it has `value0`."""
    return isinstance(content, Mapping) and "value0" in content


def cameras(file: Fields) -> Cameras:
    """Its cameras, as cam0, cam1, …"""
    calibration = file.section("value0")
    entries = calibration.sections("intrinsics")
    sizes: Sequence[tuple[int, int] | None] = [None] * len(entries)
    if calibration.entries.get("resolution"):
        sizes = calibration.sizes("resolution", len(entries))
    pairs = zip(entries, sizes, strict=True)
    return {f"cam{i}": partial(_camera, entry, size) for i, (entry, size) in enumerate(pairs)}


def _camera(entry: Fields, size: tuple[int, int] | None) -> Description:
    kind = entry.text("camera_type", f"one of {', '.join(MODELS)}")
    values = entry.section("intrinsics")
    focal = (values.positive("fx"), values.positive("fy"))
    center = (values.number("cx"), values.number("cy"))

    def listed(*names: str) -> list[float]:
        return [values.number(name) for name in names]

    model: type[Lens]
    parameters: Parameters
    if kind == "ds":
        model, parameters = DoubleSphere, {n: values.number(n) for n in ("xi", "alpha")}
    elif kind == "eucm":
        model, parameters = EnhancedUnified, {n: values.number(n) for n in ("alpha", "beta")}
    elif kind == "ucm":
        model, parameters = EnhancedUnified, {"alpha": values.number("alpha"), "beta": 1.0}
    elif kind == "kb4":
        model, parameters = KannalaBrandt, {"radial": listed("k1", "k2", "k3", "k4")}
    elif kind == "fov":
        model, parameters = FieldOfView, {"omega": values.number("w")}
    elif kind == "pinhole":
        model, parameters = BrownConrady, {}
    elif kind == "pinhole-radtan8":
        model = BrownConrady
        parameters = {
            "radial": listed("k1", "k2", "k3"),
            "denominator": listed("k4", "k5", "k6"),
            "tangential": listed("p1", "p2"),
        }
    else:
        where, expected = entry.path("camera_type"), ", ".join(MODELS)
        raise ValueError(f"{where} must be one of {expected}, got {kind!r}")
    values.check_all_read(f"basalt's {kind}", known=("rpmax",))
    return describe(model, focal, center, size, parameters)
