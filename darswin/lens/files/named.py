"""Cameras whose entries name the model: Kalibr, EuRoC, basalt, mrcal, OKVIS, maplab, vikit, ccrs.

Each format is a row: where its cameras are, which words name a model, and where its numbers are.
Kalibr's camchain YAML is written too.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import yaml

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, KannalaBrandt, Mei
from darswin.lens.files.fields import Fields, like_coefficients, short
from darswin.lens.files.format import (
    Cameras,
    Description,
    Format,
    Intrinsics,
    describe,
    has_several,
)
from darswin.lens.ideal import FieldOfView
from darswin.lens.image import Size
from darswin.lens.sphere import DoubleSphere, EnhancedUnified
from darswin.utils.text import mapping

# For the words that name a model: our class, and the numbers of each entry. A list has this order;
# in a mapping, such as "a.", or in the camera, "", the numbers have these names.
Kinds = dict[str, tuple[type[Lens], dict[str, str]]]
PLANE, RADTAN = "fx fy cx cy", "k1 k2 p1 p2"
RADTANS = ("radtan", "radial-tangential")  # Kalibr's word and others'
EIGHT = f"{RADTAN} k3 d1 d2 d3"
KEY = "the model"  # the name of a camera's entry in the mapping around it
MAX_DEPTH, MAX_ENTRIES = 3, 10_000  # of mappings in a camera, and of its entries


@dataclass(eq=False)
class Named(Format):
    """A format whose cameras are mappings. An entry inside a mapping is called a.b.

    Attributes:
        where: the paths of cameras, of which the first one that a file has counts. * is any name.
        marks: entries of a camera. One of the first two makes a camera, and the first one and
            another make the format.
        words: the entries that together name the model, as the keys of `kinds` do. KEY is the
            camera's own name.
        size: the entry with the width and the height, which may be missing; or an entry for each.
        label: the entry with the camera's name, if it has one.
        strict: a pattern of the entries whose numbers must all be used; else coefficients must.
    """

    name: str
    keys: str
    where: tuple[str, ...]
    marks: tuple[str, ...]
    words: tuple[str, ...]
    kinds: Kinds
    size: str
    label: str = KEY
    strict: str = "-"

    def _recognizes(self, content: Mapping) -> bool:
        return bool(self._found(content))

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        found = self._found(file.entries)
        return dict(mapping((name, partial(self._camera, camera)) for name, camera in found))

    def _found(self, content: Mapping) -> list[tuple[str, Fields]]:
        """The cameras with their names. One that lacks its model counts too: reading it must fail,
        not find another camera."""
        for where in self.where:
            found = [
                (path, {KEY: key, **entry})
                for path, key, entry in islice(_places(content, where), MAX_ENTRIES)
                if isinstance(entry, Mapping) and not {*self.marks[:2]}.isdisjoint({KEY, *entry})
            ]  # fmt: skip
            if any(self.marks[0] in e and has_several(e, self.marks) for _, e in found):
                cameras = ((path and f"{path}.", flat(entry)) for path, entry in found)
                return [(str(e.get(self.label, e[KEY])), Fields(e, path)) for path, e in cameras]
        return []

    def _camera(self, camera: Fields) -> Description:
        words: list[str] = []
        for name in self.words:
            kinds = [kind.split() for kind in self.kinds]
            allowed = dict.fromkeys(k[len(words)] for k in kinds if k[: len(words)] == words)
            is_none = "." in name and name not in camera and "none" in allowed  # of maplab
            words.append("none" if is_none else camera.one_of(name, allowed))
        across, *down = self.size.split()
        size: Size = None
        if down:
            size = camera.side(down[0]), camera.side(across)
        elif across in camera:
            size = camera.sides(across)[::-1]
        description = self._described(camera, " ".join(words), size)
        camera.check_all_read(
            f"a {' '.join(words)} camera",
            lambda name, value: (
                bool(re.fullmatch(self.strict, name))
                or like_coefficients(name.rpartition(".")[2], value)
            ),
        )
        return description

    def _described(self, camera: Fields, kind: str, size: Size) -> Description:
        model, entries = self.kinds[kind]
        values: dict[str, float] = {}
        for name, names in entries.items():
            by_name = not name or name.endswith(".")
            values |= camera.values(names, prefix=name) if by_name else _listed(camera, name, names)
        return describe(model, values, size)


def _listed(camera: Fields, names: str, words: str) -> dict[str, float]:
    """The numbers of a list, whose name may be any of several with | between. Programs fill up the
    coefficients of a fisheye with zeros."""
    name = next((name for name in names.split("|") if name in camera), names.split("|")[0])
    ours = words.split()
    least = len(ours) if "k4" in ours else None
    values = dict(zip(ours, camera.numbers(name, (len(ours),), least), strict=True))
    for i, word in enumerate(ours):
        if word in ("fx", "fy") and not values[word] > 0:
            where = camera.path(f"{name}[{i}]")
            raise ValueError(f"{where} must be a focal length above 0, got {values[word]:g}")
    return values


def _places(value: Any, where: str, path: str = "", key: str = "camera") -> Iterator[tuple]:
    """The path, the name and the value of each entry whose path `where` is."""
    name, _, rest = where.partition(".")
    if not where:
        yield path, key, value
    elif isinstance(value, Mapping):
        for key in value if name == "*" else {name} & value.keys():
            yield from _places(value[key], rest, f"{path}.{key}" if path else str(key), str(key))
    elif isinstance(value, list) and name == "*":
        for i, entry in enumerate(value):
            yield from _places(entry, rest, f"{path}[{i}]", f"cam{i}")


def flat(entry: Mapping, prefix: str = "", depth: int = MAX_DEPTH) -> dict[str, Any]:
    """The entries of a mapping and of those inside it. A matrix is its `data`."""
    found: dict[str, Any] = {}
    for key, value in entry.items():
        if len(found) > MAX_ENTRIES:
            raise ValueError(f"a camera must have at most {MAX_ENTRIES} entries")
        if isinstance(value, Mapping) and depth > 0 and "data" not in value:
            found |= flat(value, f"{prefix}{key}.", depth - 1)
        else:
            found[f"{prefix}{key}"] = value.get("data") if isinstance(value, Mapping) else value
    return found


def _pinholes(plane: str, terms: str, fov: str) -> Kinds:
    """Pinholes by the words for their distortion, with the coefficients in their own entry."""
    return {
        **dict.fromkeys(
            (f"pinhole {word}" for word in RADTANS), (BrownConrady, {plane: PLANE, terms: RADTAN})
        ),
        "pinhole equidistant": (KannalaBrandt, {plane: PLANE, terms: "k1 k2 k3 k4"}),
        f"pinhole {fov}": (FieldOfView, {plane: PLANE, terms: "omega"}),
        "pinhole none": (BrownConrady, {plane: PLANE}),
    }


class Kalibr(Named):
    """Several cameras with names, or one camera without a name."""

    needs_size = True
    holds = (
        "without skew, Perspective and BrownConrady (2 radial, tangential), Equidistant and "
        "KannalaBrandt (4 radial only), FieldOfView, Spherical and Mei (2 radial, tangential), "
        "DoubleSphere and EnhancedUnified"
    )

    def _text(self, camera: Intrinsics, suffix: str) -> str | None:
        height, width = camera.size
        found = [
            key for key, (of, names) in self.kinds.items()
            if camera.has_only(of, " ".join(names.values()))
        ]  # fmt: skip
        if not found or camera.values.get("beta", 1) < 0:
            return None
        intrinsics, *terms = self.kinds[found[0]][1].values()
        model, distortion = found[0].split()
        written = {
            "cam_overlaps": [],
            "camera_model": model,
            "distortion_coeffs": camera.listed(" ".join(terms)),
            "distortion_model": distortion,
            "intrinsics": camera.listed(intrinsics),
            "resolution": [width, height],
            "rostopic": "/cam0/image_raw",
        }
        return yaml.safe_dump({"cam0": written}, default_flow_style=None, width=1000)


class Basalt(Named):
    """Its cameras' sizes are in a list of their own."""

    def _recognizes(self, content: Mapping) -> bool:
        calibration = content.get("value0")
        return isinstance(calibration, Mapping) and "intrinsics" in calibration

    def _found(self, content: Mapping) -> list[tuple[str, Fields]]:
        calibration = Fields(content).section("value0")
        entries = calibration.sections("intrinsics")
        if calibration.entries.get("resolution"):
            expected = f"{len(entries)} pairs of a width and a height"
            pairs, where = calibration.get("resolution", expected), calibration.path("resolution")
            if not isinstance(pairs, list) or len(pairs) != len(entries):
                raise ValueError(f"{where} must be {expected}, got {short(pairs)}")
            for entry, pair in zip(entries, pairs, strict=True):
                entry.entries = {**entry.entries, self.size: pair}
        cameras = [
            Fields(flat(e.entries), f"value0.intrinsics[{i}].") for i, e in enumerate(entries)
        ]
        return [(f"cam{i}", entry) for i, entry in enumerate(cameras)]


_TERMS = "distortion_coeffs|distortion_coefficients"  # Kalibr's and EuRoC's
KALIBR = Kalibr(
    "Kalibr", "cam0 with camera_model, intrinsics and distortion_coeffs", ("", "*"),
    ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution"),
    ("camera_model", "distortion_model"),
    _pinholes("intrinsics", _TERMS, "fov") | {
        "omni radtan": (Mei, {"intrinsics": f"xi {PLANE}", _TERMS: RADTAN}),
        "omni none": (Mei, {"intrinsics": f"xi {PLANE}"}),
        "ds none": (DoubleSphere, {"intrinsics": f"xi alpha {PLANE}"}),
        "eucm none": (EnhancedUnified, {"intrinsics": f"alpha beta {PLANE}"})},
    "resolution",
)  # fmt: skip
BASALT = Basalt(
    "basalt", "value0 with intrinsics and resolution", (), (), ("camera_type",), {
        "ds": (DoubleSphere, {"intrinsics.": f"{PLANE} xi alpha"}),
        "eucm": (EnhancedUnified, {"intrinsics.": f"{PLANE} alpha beta"}),
        "ucm": (EnhancedUnified, {"intrinsics.": f"{PLANE} alpha"}),
        "kb4": (KannalaBrandt, {"intrinsics.": f"{PLANE} k1 k2 k3 k4"}),
        "fov": (FieldOfView, {"intrinsics.": f"{PLANE} omega=w"}),
        "pinhole": (BrownConrady, {"intrinsics.": PLANE}),
        "pinhole-radtan8": (
            BrownConrady, {"intrinsics.": f"{PLANE} {RADTAN} k3 d1=k4 d2=k5 d3=k6"})},
    "resolution", strict=r"intrinsics\.(?!rpmax).*",
)  # fmt: skip
# The numbers of other programs are in the terms of their own sources.
NEIGHBOURS = (
    Named(
        "mrcal", "lensmodel, intrinsics and imagersize", ("",),
        ("lensmodel", "intrinsics", "imagersize", "extrinsics"), ("lensmodel",), {
            f"LENSMODEL_{model}": (BrownConrady, {"intrinsics": f"{PLANE} {terms}"})
            for model, terms in (("PINHOLE", ""), ("OPENCV4", RADTAN), ("OPENCV5", f"{RADTAN} k3"),
                                 ("OPENCV8", EIGHT), ("OPENCV12", f"{EIGHT} s1 s2 s3 s4"))},
        "imagersize",
    ),
    Named(
        "OKVIS", "cameras with distortion_type, focal_length and principal_point", ("cameras.*",),
        ("distortion_type", "focal_length", "principal_point", "image_dimension"),
        ("distortion_type",), {
            word: (model, {"focal_length": "fx fy", "principal_point": "cx cy",
                           "distortion_coefficients": terms})
            for word, model, terms in (("radialtangential", BrownConrady, RADTAN),
                                       ("equidistant", KannalaBrandt, "k1 k2 k3 k4"),
                                       ("radialtangential8", BrownConrady, EIGHT))},
        "image_dimension",
    ),
    Named(
        "maplab or SVO", "cameras, each with its camera and T_B_C",
        ("cameras.*", "sensors.*.cameras.*"),
        ("camera", "T_B_C"), ("camera.type", "camera.distortion.type"),
        _pinholes("camera.intrinsics", "camera.distortion.parameters", "fisheye") | {
            "unified-projection radial-tangential": (Mei, {"camera.intrinsics": f"xi {PLANE}",
                                                "camera.distortion.parameters": RADTAN}),
            "unified-projection none": (Mei, {"camera.intrinsics": f"xi {PLANE}"})},
        "camera.image_width camera.image_height", "camera.label", r"camera\.distortion\..*",
    ),
    Named(
        "vikit", "cam_model, cam_fx, cam_fy, cam_cx, …", ("", "*", "*.ros__parameters", "*.*.*"),
        ("cam_model", "cam_fx", "cam_width"), ("cam_model",), {
            word: (model, {"": f"fx=cam_fx fy=cam_fy cx=cam_cx cy=cam_cy {terms}"})
            for word, model, terms in (
                ("Pinhole", BrownConrady, "k1=cam_d0 k2=cam_d1 p1=cam_d2 p2=cam_d3"),
                ("PinholeSimple", BrownConrady, ""),
                ("EquidistantCamera", KannalaBrandt, "k1 k2 k3 k4"))},
        "cam_width cam_height",
    ),
    Named(
        "ccrs", "KannalaBrandt4, EUCM, … with fx, fy, cx, cy, width and height",
        ("UCM", "EUCM", "EUCMT", "DoubleSphere", "FovCamera", "KannalaBrandt4", "OpenCVModel5",
         "Ftheta"), (KEY, "fx", "cx", "width"), (KEY,), {
            word: (model, {"": f"{PLANE} {terms}"}) for word, model, terms in (
                ("UCM", EnhancedUnified, "alpha"), ("EUCM", EnhancedUnified, "alpha beta"),
                ("DoubleSphere", DoubleSphere, "xi alpha"), ("FovCamera", FieldOfView, "omega=w"),
                ("KannalaBrandt4", KannalaBrandt, "k1 k2 k3 k4"),
                ("OpenCVModel5", BrownConrady, f"{RADTAN} k3"))},
        "width height", strict=".*",
    ),
)  # fmt: skip
