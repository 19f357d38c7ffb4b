"""Reading and writing a calibration file of any format."""

import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from darswin.lens.base import MODELS, Lens, from_dict
from darswin.lens.files import colmap, opencv
from darswin.lens.files.basalt import Basalt
from darswin.lens.files.camodocal import CamOdoCal, OCamCalib
from darswin.lens.files.content import Content, parse, read_bytes, to_text
from darswin.lens.files.fields import Fields, listed, short
from darswin.lens.files.format import Description, Format
from darswin.lens.files.kalibr import Kalibr
from darswin.lens.files.nerfstudio import Nerfstudio
from darswin.lens.files.own import Own
from darswin.lens.files.woodscape import WoodScape
from darswin.utils.files import replace_file

# A curve that lands further out than this, px, is of no use: a pinhole's near 90°.
MAX_RADIUS = 1e6
# A θ_max that was written in another precision may pass the limit by this, rad.
ROUNDING = 1e-4
MAX_CAMERAS = 10_000

# The first that fits is taken.
FORMATS: tuple[Format, ...] = (
    Own(), WoodScape(), Basalt(), Nerfstudio(), CamOdoCal(), Kalibr(), opencv.ByName(),
    opencv.Ros(), opencv.OpenCV(), OCamCalib(), colmap.Colmap(),
)  # fmt: skip
# Those that `save` writes.
WRITTEN: dict[str, Format] = {
    "darswin": Own(), "opencv": opencv.OpenCV(), "colmap": colmap.Colmap(), "kalibr": Kalibr()
}  # fmt: skip


def load(
    path: str | os.PathLike,
    *,
    camera: str | int | None = None,
    theta_max: float | None = None,
    image_size: tuple[int, int] | None = None,
    model: str | None = None,
    dtype: torch.dtype | None = None,
) -> Lens:
    """The lens of a calibration file, in our pixel origin.

    Reads WoodScape, KITTI-360 and CamOdoCal, Kalibr, EuRoC, OpenCV (fisheye, omnidir and pinhole;
    also `np.savez` of its arrays, or fx, fy, cx, cy, k1, … by name), ROS camera_info, OCamCalib,
    COLMAP (cameras.txt, cameras.bin), nerfstudio, basalt, and what `save` writes; the format is
    told from the content.

    Args:
        camera: of a file with several different cameras: a name, or a number from 0. Where names
            are numbers, as COLMAP's are, a number is a name.
        theta_max: rad. None means the file's, or the widest of the lens's `side_angles`: the
            corners of the image may see more; or `theta_limit`, where no image size is known.
        image_size: (H, W) px, for a file that does not say it.
        model: "fisheye", "pinhole" or "omnidir": what the coefficients of an OpenCV or ROS file
            are, if it does not say it.
        dtype: of the lens; None means torch's default.

    Raises:
        ValueError: an unknown format, a field that is missing or wrong, several cameras and none
            chosen, a theta_max beyond the limit; it names the file. OSError: as `open`.
    """
    return Calibration.read(path, model).lens(camera, theta_max, image_size, dtype)


def load_all(
    path: str | os.PathLike,
    *,
    theta_max: float | None = None,
    image_size: tuple[int, int] | None = None,
    model: str | None = None,
    dtype: torch.dtype | None = None,
) -> dict[str, Lens]:
    """All cameras of a calibration file by their names. Arguments and errors: as `load`."""
    return Calibration.read(path, model).lenses(theta_max, image_size, dtype)


def save(lens: Lens, path: str | os.PathLike, format: str | None = None) -> str:
    """Writes one lens as a file that `load` reads; returns the format.

    Our own JSON holds any lens. The other formats hold those of their own models, all but θ_max:
    `load` finds it from the image's sides.

    Args:
        format: "darswin", "opencv", "colmap" or "kalibr". None tells it from the path: OpenCV's for
            .xml, .yaml and .yml, but Kalibr's where the name has "camchain" or "kalibr"; COLMAP's
            for .txt; else ours.

    Raises:
        ValueError: several lenses, a lens of a model that is not in `MODELS`, or one that the
            format cannot hold exactly.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if format is None:
        by_suffix = {".xml": "opencv", ".yaml": "opencv", ".yml": "opencv", ".txt": "colmap"}
        format = by_suffix.get(suffix, "darswin")
        if suffix in (".yaml", ".yml") and re.search("camchain|kalibr", path.stem.lower()):
            format = "kalibr"
    if format not in WRITTEN:
        raise ValueError(f"format must be {', '.join(WRITTEN)} or None, got {format!r}")
    replace_file(path, WRITTEN[format].write(lens, suffix))
    return format


class Calibration:
    """The text of a calibration file: its format, and its cameras, described when asked for."""

    def __init__(self, text: str, name: str, model: str | None = None):
        self.what = f"calibration {name}"  # in errors
        with self._about():
            content = parse(text)
            self.format = _format_of(content)
        self.what = f"{self.format.name} {self.what}"
        with self._about():
            if model is not None and not self.format.takes_model:
                raise ValueError(f"its cameras say their model, but model={model!r} was given")
            if model not in (None, *opencv.MODELS):
                raise ValueError(f"model must be one of {', '.join(opencv.MODELS)}, got {model!r}")
            fields = content if isinstance(content, list) else Fields(content)
            self._cameras = self.format.cameras(fields, model)
            self.names = list(self._cameras)
            if not 1 <= len(self.names) <= MAX_CAMERAS:
                raise ValueError(f"it must have 1 to {MAX_CAMERAS} cameras, got {len(self.names)}")

    @classmethod
    def read(cls, path: str | os.PathLike, model: str | None = None) -> Self:
        """The file at a path; `model` as of `load`."""
        name = os.fspath(path)
        try:
            data = read_bytes(path)
            is_binary = colmap.is_binary(data)
            text = colmap.from_binary(data, MAX_CAMERAS) if is_binary else to_text(data)
        except ValueError as error:
            raise ValueError(f"calibration {name}: {error}") from error
        return cls(text, name, model)

    def choose(self, camera: str | int | None) -> str:
        """The name of a camera, as `load` chooses it."""
        names, shown = self.names, listed(map(short, self.names))
        with self._about():
            if camera is None:
                first = self._describe(names[0]) if len(names) > 1 else None
                if any(self._describe(name) != first for name in names[1:]):
                    raise ValueError(f"it has several cameras, choose one as camera=: {shown}")
                return names[0]
            if str(camera) in self._cameras:
                return str(camera)
            if any(name.isdecimal() for name in names):  # a number is a name, or a mistake
                raise ValueError(f"camera must be one of {shown}, got {camera!r}")
            number = str(camera) if type(camera) in (str, int) else ""
            if number.isdecimal() and len(number) <= 9 and int(number) < len(names):
                return names[int(number)]
            raise ValueError(f"camera must be one of {shown}, or its number, got {camera!r}")

    def lens(
        self,
        camera: str | int | None = None,
        theta_max: float | None = None,
        image_size: tuple[int, int] | None = None,
        dtype: torch.dtype | None = None,
    ) -> Lens:
        """As `load`."""
        name = self.choose(camera)
        description = self._describe(name)
        with self._about(name):
            return _batch([description], theta_max, image_size, dtype)

    def lenses(
        self,
        theta_max: float | None = None,
        image_size: tuple[int, int] | None = None,
        dtype: torch.dtype | None = None,
    ) -> dict[str, Lens]:
        """As `load_all`."""
        # By description, for frames often repeat one camera; those alike are computed together.
        keys: dict[str, str] = {}
        firsts: dict[str, str] = {}
        alike: dict[str, list[str]] = {}
        for name in self.names:
            description = self._describe(name)
            keys[name] = repr(description)
            if firsts.setdefault(keys[name], name) == name:
                alike.setdefault(_shape(description), []).append(name)
        found: dict[str, Lens] = {}
        for names in alike.values():
            found |= self._together(names, theta_max, image_size, dtype)
        return {name: found[firsts[key]] for name, key in keys.items()}

    def _together(self, names: list[str], *arguments) -> dict[str, Lens]:
        """The lenses of cameras that are alike; of the first bad one, its error."""
        try:
            with self._about(names[0]):
                lenses = _batch([self._describe(name) for name in names], *arguments)
        except ValueError:
            if len(names) == 1:
                raise
            half = len(names) // 2
            first = self._together(names[:half], *arguments)
            return first | self._together(names[half:], *arguments)
        return {name: lenses[i] for i, name in enumerate(names)}

    def _describe(self, name: str) -> Description:
        """In our pixel origin."""
        with self._about(name):
            description = self._cameras[name]()
        if "center" in description:
            description["center"] = [c - self.format.origin for c in description["center"]]
        return description

    @contextmanager
    def _about(self, camera: str | None = None) -> Iterator[None]:
        """Errors within name the file, and the camera if there are several."""
        try:
            yield
        except ValueError as error:
            if str(error).startswith(self.what):
                raise
            which = f"camera {short(camera)}: " if camera and len(self.names) > 1 else ""
            raise ValueError(f"{self.what}: {which}{error}") from error


def _format_of(content: Content) -> Format:
    found = next((format for format in FORMATS if format.fits(content)), None)
    if found is None:
        known = ", ".join(format.name for format in FORMATS)
        given = content.get("model") if isinstance(content, Mapping) else None
        raise ValueError(
            f'it must be of one of the formats {known}; darswin\'s own "model" must be one of '
            f"{', '.join(sorted(MODELS))}, got {short(given)}"
        )
    return found


def _shape(value: object) -> str:
    """The same for descriptions that differ in numbers only."""
    if isinstance(value, dict):
        return f"{value['model']} " + " ".join(f"{k}{_shape(v)}" for k, v in value.items())
    return f"[{','.join(map(_shape, value))}]" if isinstance(value, list) else ""


def _batch(
    descriptions: list[Description],
    theta_max: float | None,
    image_size: tuple[int, int] | None,
    dtype: torch.dtype | None,
) -> Lens:
    """The lenses of descriptions of one `_shape`, used as far as `load` says."""
    dtype = dtype or torch.get_default_dtype()
    first = descriptions[0]
    values: dict[str, Any] = {
        name: torch.tensor([description[name] for description in descriptions], dtype=dtype)
        for name in first
        if name != "model"
    }
    if image_size is not None:
        values.setdefault("image_size", torch.tensor([image_size], dtype=dtype))
    wanted = values.pop("theta_max", None)
    if theta_max is not None:
        wanted = torch.tensor([theta_max], dtype=dtype)
    lens = from_dict({"model": first["model"], **values}, first.get("image_size", image_size))
    limit = lens.theta_max
    if wanted is not None:
        rounded = (limit < wanted) & (wanted <= limit + ROUNDING)
        lens = lens.with_theta_max(torch.where(rounded, limit, wanted))
    elif "image_size" in values and "fov" not in values:
        lens = lens.with_theta_max(reach(lens))
    _check(lens, math.inf if wanted is not None else MAX_RADIUS)
    return lens


def reach(lens: Lens) -> Tensor:
    """(N,) rad: how far a lens that is used up to its limit is, where no θ_max is given: to the
    widest of the image's sides, if it has a size."""
    if lens.image_size is None:
        return lens.theta_max
    return torch.minimum(lens.side_angles().amax(1), lens.theta_max)


def _check(lens: Lens, most: float) -> None:
    """ValueError unless rays land at finite places, within `most` px of the center."""
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
