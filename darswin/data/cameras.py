"""The lens of each picture: one calibration for all, a lenses.json, or a file for each picture."""

import hashlib
import json
import os
import re
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from darswin.lens import MODELS, Lens
from darswin.lens.curves import as_curves, form_of
from darswin.lens.files.load import FORMATS, Calibration
from darswin.lens.orientation import in_upright_picture, stored_size
from darswin.utils.files import check_is_file
from darswin.utils.parameters import naming
from darswin.utils.text import is_json_file, parse_json, read_json, to_text

_ALL = PurePosixPath(".")
_NOMINAL = (1024, 1024)  # px, for a calibration without a size where no picture has one
# The names of entries that name a lens model, in any format.
_SAYS_MODEL = re.compile("model|distortion")
_NUMBER = re.compile(r"[-+]?[\d.,]+ *(°|deg|degrees)?")
_KEPT = 8192  # lenses in memory


class PictureCamera(NamedTuple):
    """A camera that took pictures.

    Attributes: calibration: a file, or a lens as JSON; camera: the name of the camera in the file;
    name: for errors; coefficients: as `Calibrations` takes them.
    """

    calibration: str
    camera: str | None
    name: str
    coefficients: str | None = None

    def lens(self, size: tuple[int, int]) -> Lens:
        """The lens; `size` (H, W) of stored pictures is for calibrations without a size."""
        if is_json(self.calibration):
            calibration = Calibration(self.calibration, self.name, self.coefficients)
        else:
            calibration = Calibration.read(self.calibration, self.coefficients)
        lens = calibration.lens(self.camera, image_size=size, nominal=size is _NOMINAL)
        # Lenses can only be joined if all have a center.
        return lens if lens.center is not None else lens.replace(center=lens.center_in())


class Calibrations:
    """The lenses of pictures, found by the files of the pictures.

    Args:
        lens: the cameras that took the pictures:

            - a calibration file in any format that `darswin.lens.load` reads, for all pictures;
            - a lens as JSON, as `darswin.lens.from_dict` takes it, for all pictures;
            - a `lenses.json`: a JSON object that maps folders and pictures, relative to `root`, to
              their cameras. "." means all pictures, and the most specific entry counts. A camera
              is the path of a calibration file, relative to the lenses.json; or {"file": path,
              "camera": name, "coefficients": model}, where the last two are optional; or a lens
              as above;
            - None, if `files` has a calibration for every picture.
        root: the folder of the pictures.
        camera: the name or number of the camera, if the calibration has several.
        coefficients: "fisheye", "pinhole" or "omnidir", the model of the coefficients if the
            calibration does not name it; the `model` of `darswin.lens.load`.
        files: pictures and their own calibration files, which take precedence over `lens`. A file
            is read together with its picture. Use JSON for many files.

    Attributes:
        cameras: the different cameras, first those of `files`, then those of `lens`.

    Raises:
        ValueError: an invalid lens, or lenses that cannot be joined; it names the lens.
        FileNotFoundError: a missing file.
    """

    def __init__(
        self,
        lens: str | Path | None,
        root: str | Path = ".",
        camera: str | None = None,
        coefficients: str | None = None,
        *,
        files: Mapping[Path, Path] | None = None,
    ):
        self._root, self._lens = os.path.abspath(root), lens
        paths = {os.path.abspath(picture): str(file) for picture, file in (files or {}).items()}
        own = {
            file: PictureCamera(file, None, file, coefficients)
            for file in dict.fromkeys(paths.values())
        }
        self._own = {picture: own[file] for picture, file in paths.items()}
        self._places = {} if lens is None else _places(lens, Path(root), camera, coefficients)
        shared = dict.fromkeys(self._places.values())
        self.cameras = [*own.values(), *shared]
        # Invalid lenses are refused here, before any work. Of the pictures' own files that differ
        # only in numbers, one is checked.
        forms: dict[Hashable, PictureCamera] = {}
        for file, own_camera in own.items():
            forms.setdefault(_form_of(file), own_camera)
        self._as_curves = _are_curves([*forms.values(), *shared])
        self._lenses: dict[tuple, Lens] = {}

    def camera_of(self, picture: str | Path | None) -> PictureCamera:
        """The camera that took a picture; None means a picture without its own file.

        Raises:
            ValueError: the picture has no lens.
        """
        key, file = _ALL, Path(os.path.abspath(picture or self._root))
        if (own := self._own.get(str(file))) is not None:
            return own
        if file.is_relative_to(self._root):
            key = PurePosixPath(file.relative_to(self._root).as_posix())
        for place in (key, *key.parents):
            if place in self._places:
                return self._places[place]
        pictures = picture or "pictures without a file"
        if self._lens is None:
            raise ValueError(f"{pictures} has no lens: its own calibration file is missing")
        raise ValueError(
            f'{self._lens} has no lens for {pictures}: the entry "." would be for all pictures'
        )

    def cameras_of(self, pictures: Sequence[str | Path | None]) -> np.ndarray:
        """The number of each picture's camera in `cameras`, (N,); errors as in `camera_of`."""
        number = {camera: k for k, camera in enumerate(self.cameras)}
        return np.array([number[self.camera_of(picture)] for picture in pictures], np.int64)

    def lens_of(
        self, picture: str | Path | None, size: tuple[int, int], orientation: int = 1
    ) -> Lens:
        """The lens of an upright picture.

        Args:
            picture: the file of the picture. size: (H, W) of the upright picture. orientation: the
                EXIF orientation of the stored picture, 1 to 8.

        Returns:
            One lens with a center and this image_size.

        Raises:
            ValueError: as `darswin.lens.load`; a picture with another aspect ratio than the
                calibration.
        """
        camera = self.camera_of(picture)
        key = camera, tuple(size), orientation
        found = self._lenses.get(key)
        if found is None:
            stored = stored_size(size, orientation)
            try:
                lens = in_upright_picture(camera.lens(stored), size, orientation)
            except ValueError as error:
                of = f"{picture}: " if picture is not None else ""
                raise ValueError(f"{of}{error} ({camera.name})") from error
            if len(self._lenses) >= _KEPT:
                self._lenses.clear()
            found = self._lenses[key] = self._form(lens)
        return found

    def check(
        self, picture: str | Path | None, size: tuple[int, int], orientation: int = 1
    ) -> None:
        """Raises the errors of `lens_of`, while lenses are few enough to be kept for it."""
        if len(self._lenses) < _KEPT:
            self.lens_of(picture, size, orientation)

    def digest(self) -> str:
        """The SHA-256 of what all calibrations say, and of which picture has which camera."""
        contents = {
            camera.calibration: camera.calibration.encode()
            if is_json(camera.calibration)
            else Path(camera.calibration).read_bytes()
            for camera in self.cameras
        }
        total = hashlib.sha256()
        for place, camera in (self._own | self._places).items():
            said = str(place), camera.camera, camera.coefficients
            total.update(repr(said).encode() + contents[camera.calibration])
        return total.hexdigest()

    def lens_alone(self, picture: str | Path | None) -> Lens:
        """The lens of a picture that cannot be read, at the size of the calibration."""
        return self._form(self.camera_of(picture).lens(_NOMINAL))

    def _form(self, lens: Lens) -> Lens:
        return as_curves(lens) if self._as_curves else lens


def is_json(lens: str | Path) -> bool:
    """True for a lens as JSON, False for a file."""
    return str(lens).lstrip().startswith("{")


def _places(
    lens: str | Path, root: Path, camera: str | None, coefficients: str | None
) -> dict[PurePosixPath, PictureCamera]:
    """The cameras of folders and pictures; arguments as for `Calibrations`."""
    name = "of the lens" if is_json(lens) else str(lens)
    if _NUMBER.fullmatch(str(lens)) and not os.path.exists(str(lens)):
        text = (
            f"`lens` {lens} is a number, but must be a calibration file, or a lens as JSON: for an "
            'ordinary picture {"model": "Perspective", "fov_deg": 60}, for a fisheye '
            '{"model": "Equidistant", "fov_deg": 170}, each with its own field of view'
        )
        raise naming(ValueError(text), "lens")
    entries = None if is_json(lens) else _entries(Path(lens), root)
    if entries is None:
        return {_ALL: PictureCamera(str(lens), camera, name, coefficients)}
    options = {"camera": camera, "coefficients": coefficients}
    if given := {key: value for key, value in options.items() if value is not None}:
        text = (
            f"`{next(iter(given))}` is for one calibration file, but {lens} lists several: write "
            f'{{"file": …, {json.dumps(given)[1:]} there'
        )
        raise naming(ValueError(text), *given)
    if not entries:
        raise ValueError(f"{lens} must list the lenses of the pictures, but is empty")
    cameras: dict[PurePosixPath, PictureCamera] = {}
    for place, value in entries.items():
        key = PurePosixPath(place)
        about = f"{lens}: {json.dumps(place, ensure_ascii=False)}"
        if key.is_absolute() or ".." in key.parts or (key != _ALL and not (root / key).exists()):
            raise ValueError(
                f"{about} must name a folder or a picture in {root}, but it does not exist"
            )
        if key in cameras:
            raise ValueError(f"{about} occurs twice")
        cameras[key] = _camera(Path(lens), about, value)
    return cameras


def _entries(path: Path, root: Path) -> Mapping[str, Any] | None:
    """The entries of a lenses.json; None for a calibration file, or a file of another program."""
    if not os.path.exists(path):
        raise FileNotFoundError(f"there is no calibration file {path}")
    if path.is_dir():
        raise ValueError(f"{path} is a folder, but must be a calibration file")
    check_is_file(path)
    try:
        content = read_json(path)
    except ValueError:  # the reader of calibrations says what is wrong
        return None
    if not isinstance(content, dict) or any(f.recognizes(content) for f in FORMATS):
        return None
    return content if path.name == "lenses.json" or _are_cameras(content, path, root) else None


def _are_cameras(content: Mapping[str, Any], path: Path, root: Path) -> bool:
    """True if an entry of a JSON object gives a picture or a folder in `root` a camera, or if all
    entries name calibrations that exist, or lenses."""

    def is_calibration(value: Any) -> bool:
        named = value.get("file") if isinstance(value, dict) else value
        if isinstance(named, str):
            return os.path.isfile(path.parent / named)
        return isinstance(value, dict) and value.get("model") in MODELS

    return any(
        isinstance(value, str | dict) and (place == "." or os.path.exists(root / place))
        for place, value in content.items()
    ) or all(map(is_calibration, content.values()))


def _camera(file: Path, about: str, value: Any) -> PictureCamera:
    """The camera of an entry."""
    if isinstance(value, dict) and "model" in value:
        return PictureCamera(json.dumps(value), None, f"in {about}")
    given = {"file": value} if isinstance(value, str) else value
    known = isinstance(given, dict) and given.keys() <= {"file", "camera", "coefficients"}
    if not known or not isinstance(given.get("file"), str):
        raise ValueError(
            f'{about} must be a calibration file, {{"file": …, "camera": …, "coefficients": …}} '
            f'or a lens, {{"model": …}}, got {json.dumps(value, ensure_ascii=False)}'
        )
    calibration, camera = file.parent / given["file"], given.get("camera")
    if not calibration.is_file():
        raise FileNotFoundError(f"{about} names the calibration {calibration}, which is not a file")
    name = str(calibration) if camera is None else f"camera {camera} of {calibration}"
    camera, model = (None if x is None else str(x) for x in (camera, given.get("coefficients")))
    return PictureCamera(str(calibration), camera, name, model)


def _are_curves(cameras: Sequence[PictureCamera]) -> bool:
    """True if the lenses can be joined only as curves; ValueError if they cannot be joined."""
    lenses = [camera.lens(_NOMINAL) for camera in cameras]
    if len({form_of(lens) for lens in lenses}) == 1:
        return False
    for camera, lens in zip(cameras, lenses, strict=True):
        if not lens.is_radial:
            raise ValueError(
                f"{camera.name}: cameras of several lens models are joined as curves, but this "
                "camera has tangential or thin-prism terms, which curves cannot hold: leave out "
                "these terms, or use cameras of one model"
            )
    return True


def _form_of(file: str) -> Hashable:
    """The content of a JSON calibration without its numbers; the name of any other file."""
    if not is_json_file(file):
        return file
    try:
        return _without_numbers(parse_json(to_text(Path(file).read_bytes())))
    except ValueError as error:
        raise ValueError(f"calibration {file}: it is not JSON: {error}") from error


def _without_numbers(value: Any, name: str = "") -> Hashable:
    if isinstance(value, dict):
        return frozenset((key, _without_numbers(entry, key)) for key, entry in value.items())
    if isinstance(value, list):
        nested = [_without_numbers(entry) for entry in value if isinstance(entry, dict | list)]
        return len(value), *nested
    return value if isinstance(value, str) and _SAYS_MODEL.search(name) else None
