"""Lenses of scenes: one calibration file a picture, of thousands."""

import json
import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

from darswin.data.calibrations import NOMINAL, Calibrations, Camera, PictureLenses, are_curves
from darswin.lens import Lens

# What names a lens model in any format; other words in a file say nothing of its lens's form.
_SAYS_MODEL = re.compile("model|distortion")
_KEPT = 8192  # lenses in memory


class OwnLenses(PictureLenses):
    """Lenses of pictures with a calibration file each; those without one have a `shared` lens.

    The files are looked through when this is made, and each is read when its picture is.

    Args:
        files: pictures and their calibrations, of any format that `darswin.lens.load` reads; in
            JSON where there are many.
        coefficients: of the files, as `Calibrations` has them.

    Raises:
        ValueError: a file that is no JSON or no lens, or lenses that cannot be joined; it names
            the file.
    """

    def __init__(
        self,
        files: Mapping[Path, Path],
        shared: Calibrations | None = None,
        coefficients: str | None = None,
    ):
        self._coefficients = coefficients
        self._files = {str(picture): str(file) for picture, file in files.items()}
        self._shared = shared
        # Files that differ in numbers alone have lenses of one form: one of them stands for all.
        alike: dict[Hashable, Camera] = {}
        for file in dict.fromkeys(self._files.values()):
            form = _form(_content(file)) if file.endswith(".json") else file
            alike.setdefault(form, self._own(file))
        examples = [*alike.values(), *(shared.cameras if shared else ())]
        super().__init__(are_curves(examples, [camera.lens(NOMINAL) for camera in examples]))

    @property
    def cameras(self) -> list[Camera]:
        """The different cameras: the files, then those of the shared lens."""
        own = [self._own(file) for file in dict.fromkeys(self._files.values())]
        return own + (self._shared.cameras if self._shared else [])

    def camera_of(self, picture: str | Path | None) -> Camera:
        """What took a picture; ValueError for one that has neither a file nor a shared lens."""
        file = self._files.get(str(picture))
        if file is not None:
            return self._own(file)
        if self._shared is not None:
            return self._shared.camera_of(picture)
        raise ValueError(f"{picture} has no lens: neither a file of its own nor one for all")

    def _own(self, file: str) -> Camera:
        return Camera(file, None, file, self._coefficients)

    def lens_of(
        self, picture: str | Path | None, size: tuple[int, int], orientation: int = 1
    ) -> Lens:
        """As `PictureLenses.lens_of`."""
        if len(self._lenses) >= _KEPT:
            self._lenses.clear()
        return super().lens_of(picture, size, orientation)


def _content(file: str) -> Any:
    try:
        return json.loads(Path(file).read_bytes())
    except ValueError as error:
        raise ValueError(f"calibration {file}: it is no JSON: {error}") from error


def _form(value: Any, name: str = "") -> Hashable:
    """What a file's content says but its numbers."""
    if isinstance(value, dict):
        return frozenset((key, _form(entry, key)) for key, entry in value.items())
    if isinstance(value, list):
        nested = [_form(entry) for entry in value if isinstance(entry, dict | list)]
        return len(value), *nested
    return value if isinstance(value, str) and _SAYS_MODEL.search(name) else None
