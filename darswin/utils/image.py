"""Reading picture files, turned upright by their EXIF orientation."""

import io
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from darswin.utils.exif import TURNS
from darswin.utils.files import check_is_file, replace_file

WRITTEN = frozenset((".bmp", ".dib", ".jpe", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"))

_PNG = b"\x89PNG\r\n\x1a\n"
# At the ends of complete files.
_LAST = {"PNG": b"IEND\xaeB`\x82", "JPEG": b"\xff\xd9", "MPO": b"\xff\xd9"}
_END = 1024  # bytes, because some programs write more behind it
_SAYS_MORE = frozenset((b"eXIf", b"tEXt", b"zTXt", b"iTXt"))  # chunks that may hold an orientation


class BrokenImageError(OSError):
    """Raised for files that are no readable image or video."""


def read_image(path: str | Path, channels: int = 3) -> np.ndarray:
    """A picture file as (H, W, C) uint8, C = 3 (RGB) or 1 (grey), turned upright by its EXIF.

    Raises:
        BrokenImageError: the file is missing, unreadable or no image. The error names the file.
    """
    return _picture(file_content(path), path, channels)


def read_oriented(path: str | Path, channels: int = 3) -> tuple[np.ndarray, int]:
    """`read_image`, and the EXIF orientation of the file, 1 to 8, which the lens needs.

    Raises:
        BrokenImageError: see `read_image`; or the orientation cannot be read.
    """
    data = file_content(path)
    upright = _picture(data, path, channels)
    orientation, kind = _exif(data, path)
    if orientation == 1 or kind == "TIFF":  # OpenCV turns TIFFs upright in any case
        return upright, orientation
    # Turned here, because some versions of OpenCV do not turn every kind of file.
    image = _picture(data, path, channels, cv2.IMREAD_IGNORE_ORIENTATION)
    swapped, *reversed_ = TURNS[orientation]
    image = image.swapaxes(0, 1) if swapped else image
    across, down = (slice(None, None, -1 if r else 1) for r in reversed_)
    return np.ascontiguousarray(image[down, across]), orientation


def read_stored(path: str | Path, channels: int = 3) -> np.ndarray:
    """`read_image` with the pixels as the camera stores them, which a calibration describes.

    Raises:
        BrokenImageError: see `read_oriented`.
    """
    return as_stored(*read_oriented(path, channels))


def as_stored(image: np.ndarray, orientation: int) -> np.ndarray:
    """An upright picture with its pixels as the camera stores them."""
    swapped, *reversed_ = TURNS[orientation]
    across, down = (slice(None, None, -1 if r else 1) for r in reversed_)
    image = image[down, across]
    return np.ascontiguousarray(image.swapaxes(0, 1) if swapped else image)


def written_as(path: Path) -> Path:
    """The name that `write_image` can write: other endings get .png in addition."""
    return path if path.suffix.lower() in WRITTEN else path.with_name(f"{path.name}.png")


def write_image(path: Path, image: np.ndarray) -> None:
    """Writes a picture (H, W, C) uint8, RGB or grey, completely or not at all."""
    done, content = cv2.imencode(path.suffix, image[..., ::-1])
    if not done:
        raise OSError(f"OpenCV cannot write {path}")
    replace_file(path, content.data)


class Header(NamedTuple):
    """What the header of a picture file says.

    Attributes: size: (H, W) as stored; orientation: of EXIF, 1 to 8; channels: 1 for grey, 3 for
    colours; is_sound: False if the EXIF data are damaged, or if the file does not end as usual.
    """

    size: tuple[int, int]
    orientation: int = 1
    channels: int = 1
    is_sound: bool = True

    @property
    def upright(self) -> tuple[int, int]:
        """(H, W) of the upright picture."""
        return self.size[::-1] if TURNS[self.orientation][0] else self.size


def read_header(path: str | Path) -> Header:
    """The header of a picture file, without the orientation that a PNG may name behind its pixels.

    Raises:
        BrokenImageError: the file is missing, unreadable or no image. The error names the file.
    """
    try:
        check_is_file(path)
        with Path(path).open("rb") as stream, Image.open(stream) as file:
            is_grey = file.mode in ("1", "L", "LA", "F") or file.mode.startswith("I")
            header = Header(file.size[::-1], channels=1 if is_grey else 3)
            try:  # a PNG's own method decodes its pixels to look behind them
                exif = Image.Image.getexif(file)
            except Exception:  # damaged EXIF fails in many ways
                return header._replace(is_sound=False)
            if file.format == "TIFF":  # whose size is that of the upright picture
                size = exif[ExifTags.Base.ImageLength], exif[ExifTags.Base.ImageWidth]
                header = header._replace(size=size)
            if (orientation := exif.get(ExifTags.Base.Orientation)) in TURNS:
                header = header._replace(orientation=orientation)
            stream.seek(max(0, stream.seek(0, os.SEEK_END) - _END))
            return header._replace(is_sound=_LAST.get(file.format or "", b"") in stream.read())
    except UnidentifiedImageError as error:  # its own message repeats the path
        raise BrokenImageError(f"cannot read {path}: no image that Pillow knows") from error
    except Exception as error:  # a damaged file fails in many ways
        raise BrokenImageError(f"cannot read {path}: {error}") from error


def file_content(path: str | Path) -> np.ndarray:
    """The bytes of a file; BrokenImageError if it cannot be read."""
    try:
        check_is_file(path)
        return np.fromfile(path, np.uint8)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise BrokenImageError(f"cannot read {path}: {reason}") from error


def _picture(data: np.ndarray, path: str | Path, channels: int, flags: int = 0) -> np.ndarray:
    flags |= cv2.IMREAD_COLOR_RGB if channels == 3 else cv2.IMREAD_GRAYSCALE
    image = decoded(data, path, flags)
    return image.reshape(*image.shape[:2], channels)


def decoded(data: np.ndarray, path: str | Path, flags: int) -> np.ndarray:
    """Decodes the content of a file; BrokenImageError if OpenCV cannot."""
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except (cv2.error, MemoryError) as error:  # too many pixels for OpenCV, or for the memory
        reason = getattr(error, "err", None) or "not enough memory"
        raise BrokenImageError(
            f"cannot read {path}: too many pixels for OpenCV, or damaged ({reason})"
        ) from error
    if image is None:
        raise BrokenImageError(f"cannot read {path}: no image that OpenCV can decode")
    return image


def _exif(data: np.ndarray, path: str | Path) -> tuple[int, str | None]:
    """The EXIF orientation, 1 by default, and Pillow's name of the file's format."""
    if data[:8].tobytes() == _PNG and _SAYS_MORE.isdisjoint(_png_chunks(data)):
        return 1, "PNG"  # Pillow would decode all of it to look for more
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data.data)) as file:
            orientation = file.getexif().get(ExifTags.Base.Orientation, 1)
            return orientation if orientation in TURNS else 1, file.format
    except UnidentifiedImageError:  # a format without EXIF
        return 1, None
    except Exception as error:  # damaged EXIF fails in many ways
        raise BrokenImageError(
            f"cannot read {path}: its EXIF orientation is unreadable, {error}"
        ) from error


def _png_chunks(data: np.ndarray) -> Iterator[bytes]:
    """The names of a PNG's chunks."""
    place = len(_PNG)
    while place + 8 <= data.size:
        yield data[place + 4 : place + 8].tobytes()
        place += 12 + int.from_bytes(data[place : place + 4].tobytes(), "big")


def with_channels(image: np.ndarray, channels: int) -> np.ndarray:
    """The image (H, W, C) with 1 or 3 channels: grey is repeated, RGB becomes its luminance."""
    if image.shape[2] == channels:
        return image
    if channels == 3:
        return np.repeat(image, 3, 2)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None]
