"""Pictures for commands: files, folders, videos and streams, with their orientations and lenses.
Also what is kept for each lens, the files that cannot be read, and the folder that is written to.
"""

import json
import os
import re
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from darswin.cli.arguments import check_out_folder
from darswin.data.folders import PICTURES, pictures_and_videos_below
from darswin.lens import Lens
from darswin.utils.files import check_is_file, remove_partial_files, replace_file
from darswin.utils.image import BrokenImageError, read_header, read_oriented
from darswin.utils.parameters import with_flags
from darswin.utils.video import is_stream, is_video, read_frames, read_stream, stream_name

if TYPE_CHECKING:
    from darswin.data.cameras import Calibrations

Made = TypeVar("Made")


class Picture(NamedTuple):
    """An upright picture or frame, (H, W, C) uint8, with its lens; entry: {"image": name}, or the
    name of a video with "frame" and "time"."""

    entry: dict[str, Any]
    image: np.ndarray
    lens: Lens


class File(NamedTuple):
    """A picture, or a video or stream."""

    name: str
    is_video: bool

    @property
    def said(self) -> str:
        """The name without a user and a password."""
        return stream_name(self.name)

    def pictures(
        self, lenses: "Calibrations", channels: int | None = None, every: int = 1
    ) -> Iterator[Picture]:
        """The picture, or the frames.

        Args:
            channels: 1 or 3; None means those of the file, and 3 for videos.
            every: the step between frames.

        Raises:
            BrokenImageError: the file cannot be read, or has no lens that fits.
        """

        said = self.said

        def picture(entry: dict[str, Any], image: np.ndarray, orientation: int) -> Picture:
            try:
                lens = lenses.lens_of(said, (image.shape[0], image.shape[1]), orientation)
            except ValueError as error:
                raise BrokenImageError(with_flags(error)) from error
            return Picture(entry, image, lens)

        if not self.is_video:
            if channels is None:
                with warnings.catch_warnings(action="ignore"):  # Pillow's, about what it skips
                    channels = read_header(self.name).channels
            yield picture({"image": self.name}, *read_oriented(self.name, channels))
            return
        read = read_stream if is_stream(self.name) else read_frames
        for frame in read(self.name, channels or 3, every):
            time = round(frame.time, 6)
            entry = {"video": said, "frame": frame.number, "time": time}
            yield picture(entry, frame.image, frame.orientation)


def files_at(
    paths: Sequence[str], *, leave_out: str | None = None, streams: bool = False
) -> list[File]:
    """The files at the paths; a folder stands for all pictures and videos in it, but for those
    below the folder `leave_out`.

    Raises:
        FileNotFoundError: it lists all that are missing.
        ValueError: a pipe, a device or a socket.
    """
    check_paths(path for path in paths if not (streams and is_stream(path)))
    files: list[File] = []
    for path in paths:
        names = [str(path)]
        if os.path.isdir(path) and not _is_picture(path):
            below = pictures_and_videos_below(Path(path))
            names = [n for n in below if leave_out is None or not is_below(n, leave_out)]
            for name in names:
                check_is_file(name)
        videos = (is_stream(n) or (not _is_picture(n) and is_video(n)) for n in names)
        files += map(File, names, videos)
    return files


def check_paths(paths: Iterable[str]) -> None:
    """FileNotFoundError that lists all missing files; ValueError for pipes, devices and sockets."""
    paths = list(paths)
    if missing := [path for path in paths if not os.path.exists(path)]:
        raise FileNotFoundError(f"there is no file or folder {', '.join(missing)}")
    for path in paths:
        check_is_file(path)


def _is_picture(path: str) -> bool:
    return os.path.splitext(path)[1].lower() in PICTURES


def is_below(path: str, folder: str) -> bool:
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))


class ByLens:
    """What is made of a lens, kept for the last `most` lenses.

    A lens is known by its identity: pictures of one camera should have the same object.
    """

    def __init__(self, most: int = 8):
        self._most = most
        self._kept: dict[Hashable, tuple[Lens, object]] = {}  # with the lens, which so stays itself

    def __call__(self, lens: Lens, make: Callable[[], Made], *more: Hashable) -> Made:
        """What `make` makes of a lens; more: what else it depends on."""
        key = id(lens), *more
        if key not in self._kept:
            made = make()
            if len(self._kept) == self._most:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = lens, made
        return self._kept[key][1]  # type: ignore[return-value]


class Broken:
    """The errors of files that cannot be read: all others are done first, then these are named."""

    def __init__(self) -> None:
        self.errors: list[str] = []

    @contextmanager
    def skipped(self, *kinds: type[Exception]) -> Iterator[None]:
        """Keeps an error of these kinds, and `BrokenImageError`, for the end."""
        expected: tuple[type[Exception], ...] = (BrokenImageError, *kinds)
        try:
            yield
        except expected as error:
            self.errors.append(with_flags(error))

    def report(self, heading: str = "") -> None:
        """Raises BrokenImageError with all errors, if there are any."""
        if self.errors:
            raise BrokenImageError("\n".join([heading] * bool(heading) + self.errors))


def file_names(paths: Sequence[str], files: Sequence[tuple[str, bool]]) -> dict[str, str]:
    """The names of output files for pictures and videos: their paths relative to the common folder
    of all arguments, without the endings of pictures unless two names would become equal."""
    whole = relative_names(paths, files)
    videos = {name for name, is_video in files if is_video}
    short = {n: w if n in videos else os.path.splitext(w)[0] for n, w in whole.items()}
    return short if len(set(short.values())) == len(set(whole.values())) else whole


def relative_names(paths: Sequence[str], files: Sequence[tuple[str, bool]]) -> dict[str, str]:
    """The paths of pictures and videos relative to the common folder of all arguments."""
    streams = [stream_name(name) for name, _ in files if is_stream(name)]
    files = [file for file in files if not is_stream(file[0])]
    paths = [path for path in paths if not is_stream(path)] or ["."]
    folders = [os.path.abspath(p if os.path.isdir(p) else os.path.dirname(p) or ".") for p in paths]
    root = os.path.commonpath(folders)
    relative = {name: os.path.relpath(os.path.abspath(name), root) for name, _ in files}
    return relative | {name: re.sub(r"\W+", "_", name) for name in streams}


def claim_folder(out: str | None, record: str, settings: Mapping[str, Any] | None = None) -> Path:
    """The folder for the pictures of a command: new, empty, or from an earlier run of the command,
    which left the file `record` there; with settings, which a run keeps there, of the same ones."""
    if out is None:
        raise ValueError("missing --out: this model writes pictures; give a folder for them")
    folder = Path(out)
    check_out_folder(folder)
    content = json.loads(json.dumps(settings or []))
    try:
        before = json.loads((folder / record).read_bytes())
    except (OSError, ValueError):
        before = None
    is_ours = before == content if settings else isinstance(before, list)
    if folder.is_dir() and not is_ours and any(folder.iterdir()):
        end = (
            "with the same calibrations, which then goes on" if settings else "to replace its files"
        )
        raise ValueError(
            f"--out {out} holds other files: give a new or an empty folder, or one of an earlier "
            f"run of the same command {end}"
        )
    if is_ours:
        remove_partial_files(folder)
    replace_file(folder / record, json.dumps(content, indent=1, ensure_ascii=False))
    return folder
