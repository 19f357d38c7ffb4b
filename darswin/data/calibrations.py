"""Which lens took which picture: one calibration for all, or a `lenses.json` that says it."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from darswin.lens import Lens
from darswin.lens.curves import as_curves, form_of
from darswin.lens.files.load import FORMATS, Calibration
from darswin.lens.orientation import in_upright_picture, stored_size

_ALL = PurePosixPath(".")
NOMINAL = (1024, 1024)  # px, for a calibration without a size where no picture says it


class Camera(NamedTuple):
    """A camera that took pictures.

    Attributes: calibration: a file, or a description as JSON; camera: which of the file's;
    name: what errors call it; coefficients: as `Calibrations` has them.
    """

    calibration: str
    camera: str | None
    name: str
    coefficients: str | None = None

    def lens(self, size: tuple[int, int]) -> Lens:
        """Its lens; `size` (H, W) is of pictures as stored, for a calibration without one."""
        lens = self._read().lens(self.camera, image_size=size)
        # All lenses have a center, so that they can be joined.
        return lens if lens.center is not None else lens.replace(center=lens.center_in())

    def _read(self) -> Calibration:
        if is_json(self.calibration):
            return Calibration(self.calibration, self.name, self.coefficients)
        return Calibration.read(self.calibration, self.coefficients)


class PictureLenses:
    """Which lens took which picture. A class says it in `cameras` and `camera_of`.

    Args:
        as_curves: whether the lenses are to be curves, because they cannot be joined otherwise.
    """

    def __init__(self, as_curves: bool):
        self._as_curves = as_curves
        self._lenses: dict[tuple, Lens] = {}

    @property
    def cameras(self) -> list[Camera]:
        """The different cameras."""
        raise NotImplementedError

    def camera_of(self, picture: str | Path | None) -> Camera:
        """What took a picture; None is one that has no file of its own.

        Raises:
            ValueError: a picture that has no lens.
        """
        raise NotImplementedError

    def cameras_of(self, pictures: Sequence[str | Path | None]) -> np.ndarray:
        """(N,): the number of each picture's camera in `cameras`; errors as `camera_of`."""
        number = {camera: k for k, camera in enumerate(self.cameras)}
        return np.array([number[self.camera_of(picture)] for picture in pictures], np.int64)

    def lens_of(
        self, picture: str | Path | None, size: tuple[int, int], orientation: int = 1
    ) -> Lens:
        """The lens in an upright picture.

        Args:
            picture: its file. size: (H, W), upright. orientation: the EXIF's that it was turned
                from, 1 to 8.

        Returns:
            One lens with a center and this image_size.

        Raises:
            ValueError: as `darswin.lens.load`; a picture of another shape than the calibration's.
        """
        camera = self.camera_of(picture)
        key = camera, tuple(size), orientation
        if key not in self._lenses:
            stored = stored_size(size, orientation)
            try:
                lens = in_upright_picture(camera.lens(stored), size, orientation)
            except ValueError as error:
                of = f"{picture}: " if picture is not None else ""
                raise ValueError(f"{of}{error} ({camera.name})") from error
            self._lenses[key] = self._form(lens)
        return self._lenses[key]

    def lens_alone(self, picture: str | Path | None) -> Lens:
        """The lens of a picture that cannot be read: in one of the size that it was made for."""
        return self._form(self.camera_of(picture).lens(NOMINAL))

    def _form(self, lens: Lens) -> Lens:
        return as_curves(lens) if self._as_curves else lens


class Calibrations(PictureLenses):
    """The lenses of pictures, by their files.

    Args:
        lens: what took them:

            - a calibration file, of any format that `darswin.lens.load` reads: all pictures;
            - a lens as JSON, as `darswin.lens.from_dict` takes it: all pictures;
            - a `lenses.json`: a JSON object from folders and pictures, relative to `root`, to
              their cameras; "." is all, and the most specific counts. A camera is a calibration
              file's path, relative to the lenses.json, or {"file": path, "camera": name,
              "coefficients": what they are}, of which the last two may be left out, or a lens as
              above.
        root: the folder of the pictures.
        camera: which, of one calibration of several cameras.
        coefficients: "fisheye", "pinhole" or "omnidir": what they are, in one calibration that
            does not say it; the `model` of `darswin.lens.load`.

    Raises:
        ValueError: what says no lens, in a sentence that names it. FileNotFoundError: a file that
            is missing.
    """

    def __init__(
        self,
        lens: str | Path,
        root: str | Path,
        camera: str | None = None,
        coefficients: str | None = None,
    ):
        self._root = os.path.abspath(root)
        self._lens = lens
        entries = None if is_json(lens) else _entries(Path(lens))
        if entries is None:
            name = "of the lens" if is_json(lens) else str(lens)
            self._cameras = {_ALL: Camera(str(lens), camera, name, coefficients)}
        elif camera is not None or coefficients is not None:
            said = {"camera": camera, "coefficients": coefficients}
            said = {key: value for key, value in said.items() if value is not None}
            what = "coefficients are said" if camera is None else "a camera is chosen"
            raise ValueError(
                f"{what} of one calibration file, and {lens} lists several; say it there as "
                f'{{"file": …, {json.dumps(said)[1:]}'
            )
        else:
            self._cameras = _listed(Path(lens), entries, Path(root))
        # Early, so that what is no lens is said before any work.
        nominal = [camera.lens(NOMINAL) for camera in self.cameras]
        super().__init__(are_curves(self.cameras, nominal))

    @property
    def cameras(self) -> list[Camera]:
        """The different cameras."""
        return list(dict.fromkeys(self._cameras.values()))

    def camera_of(self, picture: str | Path | None) -> Camera:
        """What took a picture; None is one that has no file of its own.

        Raises:
            ValueError: a picture that no entry is of.
        """
        key, file = _ALL, Path(os.path.abspath(picture or self._root))
        if file.is_relative_to(self._root):
            key = PurePosixPath(file.relative_to(self._root).as_posix())
        for place in (key, *key.parents):
            if place in self._cameras:
                return self._cameras[place]
        raise ValueError(
            f'{self._lens} has no lens for {picture or "pictures without a file"}: an entry "." '
            "is of all pictures"
        )


def is_json(lens: str | Path) -> bool:
    """Whether a lens is a description, not a file."""
    return str(lens).lstrip().startswith("{")


def _entries(path: Path) -> Mapping[str, Any] | None:
    """What a lenses.json says; None for a calibration file, and for what is no JSON object."""
    try:
        content = json.loads(path.read_bytes())
    except ValueError:
        return None
    if not isinstance(content, dict) or any(f.fits(content) for f in FORMATS):
        return None
    return content


def _listed(file: Path, entries: Mapping[str, Any], root: Path) -> dict[PurePosixPath, Camera]:
    """The cameras of a lenses.json's entries."""
    cameras: dict[PurePosixPath, Camera] = {}
    for name, value in entries.items():
        key = PurePosixPath(name)
        about = f"{file}: {json.dumps(name, ensure_ascii=False)}"
        if key.is_absolute() or ".." in key.parts or (key != _ALL and not (root / key).exists()):
            raise ValueError(
                f"{about} must name a folder or a picture in {root}, and there is none"
            )
        if key in cameras:
            raise ValueError(f"{about} is there twice")
        cameras[key] = _camera(file, about, value)
    if not cameras:
        raise ValueError(f"{file} must say which lens took which pictures, but is empty")
    return cameras


def _camera(file: Path, about: str, value: Any) -> Camera:
    """The camera that an entry means."""
    if isinstance(value, dict) and "model" in value:
        return Camera(json.dumps(value), None, f"in {about}")
    given = {"file": value} if isinstance(value, str) else value
    fits = isinstance(given, dict) and given.keys() <= {"file", "camera", "coefficients"}
    if not fits or not isinstance(given.get("file"), str):
        raise ValueError(
            f'{about} must be a calibration file, {{"file": …, "camera": …, "coefficients": …}} '
            f'or a lens, {{"model": …}}, got {json.dumps(value, ensure_ascii=False)}'
        )
    calibration, camera = file.parent / given["file"], given.get("camera")
    if not calibration.is_file():
        raise FileNotFoundError(
            f"{about} is to have the calibration {calibration}, which is no file"
        )
    name = str(calibration) if camera is None else f"camera {camera} of {calibration}"
    camera, model = (None if x is None else str(x) for x in (camera, given.get("coefficients")))
    return Camera(str(calibration), camera, name, model)


def are_curves(cameras: Sequence[Camera], lenses: Sequence[Lens]) -> bool:
    """Whether the cameras' lenses can be joined only as curves; ValueError if not even so."""
    if len({form_of(lens) for lens in lenses}) == 1:
        return False
    for camera, lens in zip(cameras, lenses, strict=True):
        if not lens.is_radial:
            raise ValueError(
                f"{camera.name}: cameras of several lens models are joined as curves, and this "
                "one's tangential or thin-prism terms have none; leave those terms out of it, or "
                "take cameras of one model"
            )
    return True
