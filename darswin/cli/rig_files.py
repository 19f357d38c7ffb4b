"""The pictures of a rig's cameras in folders: names decide which camera took them."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from darswin.cli.pictures import check_paths
from darswin.data.folders import SUFFIXES
from darswin.lens.rig import Rig
from darswin.utils.image import read_header, read_stored
from darswin.utils.words import in_px

Files = Mapping[str, Path]  # of the cameras, by their names


def files_of(
    words: Sequence[str], names: Sequence[str], suffixes: Collection[str] | None = None
) -> dict[str, Files]:
    """The files of cameras with these names for each frame, by its name; "" is the only one.

    Args:
        words: a folder with front.png for the camera "front", or with a folder front of frames; or
            words front=PATH. Frames of all cameras belong together by their names without endings.
        suffixes: of the files that count, None for those of pictures.

    Raises:
        FileNotFoundError, ValueError: a file is missing, or it is unclear whose it is.
    """
    suffixes = SUFFIXES if suffixes is None else suffixes
    if not words:
        raise ValueError("missing pictures: give a folder with one of each camera, or NAME=PATH")
    given = [(name, path) for name, _, path in (word.partition("=") for word in words)]
    if len(words) == 1 and "=" not in words[0]:
        check_paths(words)
        if not Path(words[0]).is_dir():
            raise ValueError(f"{words[0]} must be a folder with a picture of each camera")
        entries = _entries(Path(words[0]), suffixes)
        given = [(entry.name if entry.is_dir() else entry.stem, str(entry)) for entry in entries]
    found: dict[str, dict[str, Path]] = {}
    for name, path in given:
        if not path:
            raise ValueError(f"{name} must be NAME=PATH, or a folder that is given alone")
        if name not in names:
            raise ValueError(f"{path} is of no camera: they are {', '.join(names)}")
        check_paths([path])
        files = [("", Path(path))]
        if Path(path).is_dir():
            files = [(f.stem, f) for f in _entries(Path(path), suffixes) if f.is_file()]
        for frame, file in files:
            if (other := found.setdefault(name, {}).setdefault(frame, file)) != file:
                raise ValueError(f"{other} and {file} are both of the camera {name}: remove one")
    for name in names:
        if name not in found:
            where = "" if "=" in words[0] else f" in {words[0]}"
            raise FileNotFoundError(f"there is no picture of the camera {name}{where}")
        if lacking := {*found[name]} ^ {*found[names[0]]}:
            if "" in lacking:
                text = f"give either a picture or a folder of each camera, not both, as of {name}"
                raise ValueError(text)
            frame = min(lacking)
            without = names[0] if frame in found[name] else name
            raise FileNotFoundError(f"the camera {without} has no frame {frame}, but others have")
    return {frame: {name: found[name][frame] for name in names} for frame in found[names[0]]}


def read_frames(rig: Rig, files: Files) -> dict[str, np.ndarray]:
    """A picture (H, W, C) uint8 of each camera, all with one number of channels."""
    channels = max(read_header(file).channels for file in files.values())
    frames = {name: read_stored(file, channels) for name, file in files.items()}
    return check_sizes(rig, files, frames)


def check_sizes(rig: Rig, files: Files, frames: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The frames; ValueError unless each has the (H, W) of its camera."""
    for name, frame in frames.items():
        if frame.shape[:2] != rig[name].size:
            size, found = in_px(rig[name].size), in_px(frame.shape[:2])
            raise ValueError(f"{files[name]} must be of {size}, as its camera, got {found}")
    return frames


def _entries(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """The folders and the files with these endings in a folder, without hidden ones."""
    entries = [entry for entry in sorted(folder.iterdir()) if not entry.name.startswith(".")]
    return [entry for entry in entries if entry.is_dir() or entry.suffix.lower() in suffixes]
