"""Reads calibration files of all formats."""

import math
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import Any, Self

import torch
from torch import Tensor

from darswin.lens.base import Lens, from_dict, naming_degrees, with_rounded_theta_max
from darswin.lens.files import colmap, opencv
from darswin.lens.files.camodocal import CAMODOCAL, OCamCalib
from darswin.lens.files.content import decoded, parse, read_bytes
from darswin.lens.files.fields import Fields, is_number, listed, plain_name, short
from darswin.lens.files.format import Description, Format
from darswin.lens.files.named import BASALT, KALIBR, NEIGHBOURS
from darswin.lens.files.nerfstudio import Nerfstudio
from darswin.lens.files.own import Own
from darswin.lens.files.unknown import program_of, unknown
from darswin.lens.files.woodscape import WoodScape
from darswin.lens.image import Size
from darswin.lens.plausible import ImplausibleLens, doubts
from darswin.utils.parameters import check, naming
from darswin.utils.words import counted

# Rays must not land further out than this, px, as a pinhole's do near 90°.
MAX_RADIUS = 1e6
MAX_CAMERAS = 10_000

# The first one that fits a file reads it.
FORMATS: tuple[Format, ...] = (
    Own(), WoodScape(), BASALT, Nerfstudio(), CAMODOCAL, KALIBR, *NEIGHBOURS, opencv.MultiView(),
    opencv.ByName(), opencv.Ros(), opencv.OpenCV(), OCamCalib(), colmap.Colmap(),
)  # fmt: skip
# Names of entries with the px by which a calibration missed its corners, after `plain_name`.
_MISSED = ("rms", "rmserror", "rmsreprojectionerror", "reprojectionerror", "avgreprojectionerror",
           "meanreprojectionerror", "reprojerror", "meanerror")  # fmt: skip
_UNKNOWN = "unknown format: {}. The formats are " + ", ".join(format.name for format in FORMATS)


def load(
    path: str | os.PathLike,
    *,
    camera: str | int | None = None,
    theta_max: float | None = None,
    image_size: Size = None,
    coefficients: str | None = None,
    dtype: torch.dtype | None = None,
) -> Lens:
    """Reads the lens of a calibration file; its pixel centres are integers, whatever the file's.

    The formats are WoodScape, KITTI-360 and CamOdoCal, Kalibr, EuRoC, OpenCV (fisheye, omnidir and
    pinhole; also its arrays in an .npz file, or fx, fy, cx, cy, k1, … by name), ROS camera_info,
    OCamCalib, COLMAP, kapture, nerfstudio, instant-ngp, basalt, mrcal, OKVIS, maplab, SVO, vikit,
    ccrs, and our own JSON.
    The content of the file tells the format; its name does not matter.

    Args:
        camera: the camera, if the file has several different ones: its name, or its number from 0.
            If the names are numbers, as in COLMAP's files, a number is a name.
        theta_max: rad. None means the file's θ_max; else the largest of the lens's `side_angles`,
            although the image's corners may see more; or `theta_limit` if the image size is
            unknown.
        image_size: (H, W) px, used if the file has no image size.
        coefficients: "fisheye", "pinhole" or "omnidir", the model of the coefficients in an OpenCV
            or ROS file that does not name it.
        dtype: of the lens; None means torch's default.

    Warns:
        ImplausibleLens: the lens does not fit its image, as if its lengths were in another unit.

    Raises:
        ValueError: an unknown format, a missing or wrong entry, several cameras without a choice,
            or a theta_max beyond the limit. The message names the file.
        OSError: the file cannot be opened.
    """
    return Calibration.read(path, coefficients).lens(camera, theta_max, image_size, dtype)


def load_all(
    path: str | os.PathLike,
    *,
    theta_max: float | None = None,
    image_size: Size = None,
    coefficients: str | None = None,
    dtype: torch.dtype | None = None,
) -> dict[str, Lens]:
    """Reads all cameras of a calibration file, by name. Arguments, warnings, errors: see `load`."""
    options = dict(theta_max=theta_max, image_size=image_size, dtype=dtype)
    return Calibration.read(path, coefficients).lenses(**options)


def load_up(path: str | os.PathLike) -> tuple[float, float, float]:
    """Reads the direction away from gravity in a camera's frame, for the argument `up` of views.

    WoodScape's and SynWoodScape's files say it, for a vehicle that stands level. See
    `darswin.views.up_of` for the extrinsics of other files.

    Returns:
        The unit vector (x, y, z), with x right, y down and z forward.

    Raises:
        ValueError: another format, or extrinsics that are missing or wrong.
        OSError: the file cannot be opened.
    """
    return Calibration.read(path).up()


class Calibration:
    """A parsed calibration file: its format and its cameras, which are read on demand. `fields` are
    its entries, or the rows of a table."""

    def __init__(self, text: str, name: str, coefficients: str | None = None):
        self.what, self._text = f"calibration {name}", text  # for errors
        with self._about():
            content = parse(text)
            found = next((format for format in FORMATS if format.recognizes(content)), None)
            if found is None:
                raise ValueError(_UNKNOWN.format(unknown(content, FORMATS)))
            self.format = found
        self.what = f"{self.format.name} {self.what}"
        with self._about():
            if coefficients is not None:
                if not self.format.takes_coefficients:
                    text = (
                        f"the file names the models, but `coefficients` {coefficients!r} was given"
                    )
                    raise naming(ValueError(text), "coefficients")
                known = coefficients in opencv.MODELS
                check(
                    "coefficients", repr(coefficients), known, f"one of {', '.join(opencv.MODELS)}"
                )
            fields = content if isinstance(content, list) else Fields(content)
            self.fields = fields
            self._cameras = self.format.cameras(fields, coefficients)
            self.names = list(self._cameras)
            if not 1 <= len(self.names) <= MAX_CAMERAS:
                raise ValueError(f"it must have 1 to {MAX_CAMERAS} cameras, got {len(self.names)}")

    @classmethod
    def read(cls, path: str | os.PathLike, coefficients: str | None = None) -> Self:
        """Reads the file at a path; `coefficients` is that of `load`."""
        name = os.fspath(path)
        try:
            data = read_bytes(path)
            is_binary = colmap.is_binary(data)
            text = colmap.from_binary(data, MAX_CAMERAS) if is_binary else decoded(data)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"calibration {name}: there is no such file") from error
        except ValueError as error:
            raise ValueError(f"calibration {name}: {error}") from error
        return cls(text, name, coefficients)

    def up(self) -> tuple[float, float, float]:
        """The result of `load_up`."""
        with self._about():
            x, y, z = self.format.up(self.fields)
        return x, y, z

    def supported(self) -> float | None:
        """rad: the angle up to which corners support the lens, or None if the file does not say. It
        holds for crops of the camera's pictures, and for a lens of another model fitted to it."""
        return self.format.supported(self.fields)

    def has_several(self) -> bool:
        """True if its cameras are not all the same."""
        first = self._describe(self.names[0]) if len(self.names) > 1 else None
        return any(self._describe(name) != first for name in self.names[1:])

    def choose(self, camera: str | int | None) -> str:
        """The name of the camera that `load` would read."""
        names, shown = self.names, listed(map(short, self.names))
        with self._about():
            if camera is None:
                if self.has_several():
                    text = f"it has several cameras, choose one with `camera`: {shown}"
                    raise naming(ValueError(text), "camera")
                return names[0]
            if str(camera) in self._cameras:
                return str(camera)
            if not any(name.isdecimal() for name in names):  # else a number is never an index
                number = str(camera) if type(camera) in (str, int) else ""
                if number.isdecimal() and len(number) <= 9 and int(number) < len(names):
                    return names[int(number)]
                shown += ", or its number"
            raise ValueError(f"camera must be one of {shown}, got {camera!r}")

    def lens(self, camera: str | int | None = None, *options: Any, **named: Any) -> Lens:
        """One camera; warnings are those of `load`, and options those of `judged`."""
        name = self.choose(camera)
        lens, doubt = self.judged(name, *options, **named)
        self._warn({name: doubt})
        return lens

    def judged(
        self, camera: str | int | None = None, *options: Any, nominal: bool = False, **named: Any
    ) -> tuple[Lens, str]:
        """One camera, and its `doubts` in place of a warning.

        options: `theta_max`, `image_size` and `dtype` of `load`, in this order or by name.

        nominal: True if `image_size` stands in for a size that is not known, and the lens shall not
        be held against it.
        """
        name = self.choose(camera)
        description = self._describe(name)
        with self._about(name):
            lens, (doubt,) = _batch([description], self._missed(), *options, **named)
        return lens, "" if nominal and "image_size" not in description else doubt

    def lenses(self, **options: Any) -> dict[str, Lens]:
        """All cameras; warnings are those of `load_all`, and options those of `judged`."""
        # Frames often repeat one camera: each description becomes one lens, and descriptions of
        # the same shape become one batch.
        keys: dict[str, str] = {}
        batches: dict[str, dict[str, str]] = {}
        for name in self.names:
            description = self._describe(name)
            keys[name] = repr(description)
            batches.setdefault(_shape(description), {}).setdefault(keys[name], name)
        found: dict[str, tuple[Lens, str]] = {}
        for firsts in batches.values():
            lenses = self._together([*firsts.values()], options)
            found |= {key: lenses[name] for key, name in firsts.items()}
        self._warn({name: found[key][1] for name, key in keys.items()})
        return {name: found[key][0] for name, key in keys.items()}

    def _warn(self, doubts: Mapping[str, str]) -> None:
        """Warns once of the cameras that are in doubt."""
        names = [name for name, doubt in doubts.items() if doubt]
        if names:
            which = f"camera {short(names[0])}: " if len(self.names) > 1 else ""
            more = f" (and {counted(len(names) - 1, 'more camera')})" if len(names) > 1 else ""
            text = f"{self.what}: {which}it describes {doubts[names[0]]}{more}"
            warnings.warn(text, ImplausibleLens, stacklevel=2)

    def _together(
        self, names: list[str], options: Mapping[str, Any]
    ) -> dict[str, tuple[Lens, str]]:
        """The lenses of cameras whose descriptions have one shape, and their doubts. Raises the
        error of the first camera that has one."""
        try:
            with self._about(names[0]):
                described = [self._describe(name) for name in names]
                lenses, said = _batch(described, self._missed(), **options)
        except ValueError:
            if len(names) == 1:
                raise
            half = len(names) // 2
            first = self._together(names[:half], options)
            return first | self._together(names[half:], options)
        return {name: (lenses[i], said[i]) for i, name in enumerate(names)}

    def _describe(self, name: str) -> Description:
        """A camera's description in our pixel convention."""
        with self._about(name):
            description = self._cameras[name]()
        if "center" in description:
            description["center"] = [c - self.format.origin for c in description["center"]]
        return description

    def _missed(self) -> float:
        """px by which the calibration missed its corners; 0 if the file does not say."""
        entries = {} if isinstance(self.fields, list) else self.fields.entries
        said = (value for name, value in entries.items() if plain_name(str(name)) in _MISSED)
        return next((float(value) for value in said if is_number(str(value))), 0.0)

    @contextmanager
    def _about(self, camera: str | None = None) -> Iterator[None]:
        """Adds the file to errors, and the camera if there are several. Of another program's file,
        the error names the program: what a format misses in it would lead astray."""
        try:
            yield
        except ValueError as error:
            if str(error).startswith(self.what):
                raise
            if program := program_of(self._text):
                what = self.what[self.what.index("calibration ") :]
                text = f"{what}: {_UNKNOWN.format(program)}"
                raise ValueError(text) from error
            which = f"camera {short(camera)}: " if camera and len(self.names) > 1 else ""
            raise ValueError(f"{self.what}: {which}{error}") from error


def _shape(value: object) -> str:
    """The structure of a description without its numbers."""
    if isinstance(value, dict):
        return f"{value['model']} " + " ".join(f"{k}{_shape(v)}" for k, v in value.items())
    return f"[{','.join(map(_shape, value))}]" if isinstance(value, list) else ""


def _batch(
    descriptions: list[Description],
    missed: float,
    theta_max: float | None = None,
    image_size: Size = None,
    dtype: torch.dtype | None = None,
) -> tuple[Lens, list[str]]:
    """The lenses of descriptions with one `_shape`, with the θ_max that `load` documents, and their
    doubts, which are about the file's θ_max, not the caller's."""
    dtype = dtype or torch.get_default_dtype()
    first = descriptions[0]
    values: dict[str, Any] = {
        name: torch.tensor([description[name] for description in descriptions], dtype=dtype)
        for name in first
        if name != "model"
    }
    if image_size is not None:
        values.setdefault("image_size", torch.tensor([image_size], dtype=dtype))
    sensor, wanted = values.pop("sensor", None), values.pop("theta_max", None)
    degrees = values.pop("theta_max_deg", None)
    if degrees is not None:
        wanted = degrees.deg2rad()
    if theta_max is not None:
        degrees, wanted = None, torch.tensor([theta_max], dtype=dtype)
    lens = from_dict({"model": first["model"], **values}, first.get("image_size", image_size))
    whole = lens
    if wanted is not None:
        with naming_degrees("theta_max", degrees) if degrees is not None else nullcontext():
            lens = with_rounded_theta_max(lens, wanted)
    elif "image_size" in values and values.keys().isdisjoint(("fov", "fov_deg")):
        lens = lens.with_theta_max(reach(lens))
    _check(lens, math.inf if wanted is not None else MAX_RADIUS)
    judged = lens if theta_max is None else whole.with_theta_max(reach(whole))
    if sensor is not None:
        left_top, size = sensor.split(2, 1)
        judged = judged.replace(center=judged.center_in() + left_top, image_size=size)
    return lens, doubts(judged, missed)


def reach(lens: Lens) -> Tensor:
    """(N,) rad: θ_max for a lens whose file has none. `lens` is used up to its limit; its θ_max is
    reduced to the largest of its `side_angles` if it has an image size."""
    if lens.image_size is None:
        return lens.theta_max
    return torch.minimum(lens.side_angles().amax(1), lens.theta_max)


def _check(lens: Lens, most: float) -> None:
    """Raises ValueError unless all rays land within `most` px of the principal point."""
    theta = lens.theta_max[:, None] * torch.linspace(0, 1, 33, dtype=lens.theta_max.dtype)
    azimuth = torch.linspace(0, 2 * math.pi, 5, dtype=theta.dtype)[:4]
    shape = (len(lens), 33, 4)
    pixels = lens.project_rays(theta[..., None].expand(shape), azimuth.expand(shape), (1, 1))
    reach = pixels.abs().amax((1, 2, 3))
    wrong = ~((reach <= most) & reach.isfinite())
    if bool(wrong.any()):
        raise ValueError(
            f"up to theta_max = {lens.theta_max[wrong][0].item():.4f} rad rays must land at most "
            f"{MAX_RADIUS:g} px away, got {reach[wrong][0].item():.3g} px: give a smaller "
            "theta_max, or the image_size if the file has none"
        )
