"""Reading the frames of video files, turned upright by their metadata, and of cameras; and writing
frames."""

import errno
import math
import os
import re
import threading
import time as clock
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from darswin.utils.image import BrokenImageError
from darswin.utils.words import counted

SUFFIXES = frozenset((
    ".360", ".3gp", ".asf", ".avi", ".flv", ".h264", ".h265", ".hevc", ".insv", ".lrv", ".m2ts",
    ".m4v", ".mjpeg", ".mjpg", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".osv",
    ".ts", ".webm", ".wmv", ".y4m",
))  # fmt: skip
WRITTEN = frozenset((".avi", ".m4v", ".mkv", ".mov", ".mp4"))
# The EXIF orientations for the turns in a video's metadata, in degrees clockwise.
_ORIENTATIONS = {0: 1, 90: 6, 180: 3, 270: 8}
# A video may end earlier than its header claims, e.g. if its sound is longer: by these seconds, and
# at most by this part of its length.
_TOLERANCE = 0.5
_PART = 0.05
_STREAM = re.compile(r"\d{1,3}|/dev/video\d+|[A-Za-z][\w+.-]*://.+")
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_PATIENCE = 2.0  # s, in which a stream may answer when it is left


class Frame(NamedTuple):
    number: int  # from 0
    time: float  # s
    image: np.ndarray  # (H, W, C) uint8, upright
    orientation: int  # of EXIF, before the frame was turned upright


def is_video(path: str | Path) -> bool:
    """True for a file with the ending of a video, or that OpenCV can only open as a video."""
    if os.path.splitext(path)[1].lower() in SUFFIXES:
        return True
    return os.path.isfile(path) and not cv2.haveImageReader(str(path)) and _opened(path) is not None


def read_frames(path: str | Path, channels: int = 3, every: int = 1) -> Iterator[Frame]:
    """Reads the first frame of a video file and every `every`-th after it; C = 3 (RGB) or 1 (grey).

    Raises:
        BrokenImageError: the file is missing or no video. Or, after its last frame, the video ends
            earlier than its header claims, by half a second or a twentieth.
    """
    capture = _opened(path)
    if capture is None:
        reason = "no video that OpenCV can decode" if os.path.isfile(path) else "no such file"
        raise BrokenImageError(f"cannot read {path}: {reason}")
    upright = capture.get(cv2.CAP_PROP_ORIENTATION_AUTO) > 0
    degrees = round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) if upright else 0
    orientation = _ORIENTATIONS.get(degrees % 360, 1)
    colors = cv2.COLOR_BGR2RGB if channels == 3 else cv2.COLOR_BGR2GRAY
    count, time = 0, 0.0
    try:
        while capture.grab():
            time = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if count % every == 0:
                _, image = capture.retrieve()
                image = cv2.cvtColor(image, colors).reshape(*image.shape[:2], channels)
                yield Frame(count, time, image, orientation)
            count += 1
        _check_end(path, capture, count, time)
    finally:
        capture.release()


def is_stream(path: str | Path) -> bool:
    """True for the number of a camera, its device /dev/video0, and an address such as rtsp://…"""
    return _STREAM.fullmatch(str(path)) is not None and not (
        os.path.isfile(path) or os.path.isdir(path)
    )


def stream_name(path: str) -> str:
    """A stream in words: its address without user and password."""
    return re.sub(r"://[^/?#]*@", "://", path)


def read_stream(path: str, channels: int = 3, every: int = 1) -> Iterator[Frame]:
    """Reads a camera or a stream at its own pace: each frame is the newest one, at least `every`
    after the last. Those that come meanwhile are dropped, but counted. C = 3 (RGB) or 1 (grey).

    Raises:
        BrokenImageError: it cannot be opened, or gives no frame.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    capture = cv2.VideoCapture(int(path) if path.isdecimal() else path)
    if not capture.isOpened():
        raise BrokenImageError(f"cannot read {stream_name(path)}: OpenCV opens no such stream")
    colors = cv2.COLOR_BGR2RGB if channels == 3 else cv2.COLOR_BGR2GRAY
    changed, start = threading.Condition(), clock.monotonic()
    newest: tuple[int, float, np.ndarray | None] = -1, 0.0, None
    left = ended = False

    def watch() -> None:
        nonlocal newest, ended
        try:
            while not left:
                there, image = capture.read()
                if not there:
                    break
                with changed:
                    newest = newest[0] + 1, clock.monotonic() - start, image
                    changed.notify()
        finally:
            with changed:
                ended = True
                changed.notify()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    following = 0
    try:
        while True:
            with changed:
                while not ended and newest[0] < following:
                    changed.wait()
                number, time, image = newest
            if image is None or number < following:
                break
            following = number + every
            image = cv2.cvtColor(image, colors).reshape(*image.shape[:2], channels)
            yield Frame(number, time, image, 1)
    finally:
        left = True
        thread.join(_PATIENCE)
        if not thread.is_alive():
            capture.release()
    if number < 0:
        raise BrokenImageError(f"cannot read {stream_name(path)}: it gives no frame")


def frame_rate(path: str | Path) -> float:
    """The frames per second that a video file names; 25 if it names none, as a raw stream."""
    capture = _opened(path)
    rate = 0.0 if capture is None else capture.get(cv2.CAP_PROP_FPS)
    return rate if 0 < rate < math.inf else 25.0


def frame_count(path: str | Path) -> int:
    """The number of frames that a video file names; 0 if it names none."""
    capture = _opened(path)
    return 0 if capture is None else max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))


def write_frames(path: str | Path, frames: Iterable[np.ndarray], rate: float) -> None:
    """Writes frames (H, W, 3) uint8, RGB, as a video (MPEG-4, no sound); without frames, nothing.

    Args:
        path: its ending, one of `WRITTEN`, names the container. An old file is replaced once the
            new one is complete.
        frames: all of one size; H and W are even.
        rate: in frames per second.

    Raises:
        OSError: the video cannot be written.
    """
    path = Path(path)
    partial, writer = path.with_name(f".{path.stem}.partial{path.suffix}"), None
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        for frame in frames:
            if writer is None:
                code = cv2.VideoWriter.fourcc(*"mp4v")
                writer = cv2.VideoWriter(str(partial), code, rate, frame.shape[1::-1])
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
        if writer is not None:
            writer.release()
            if _opened(partial) is None:  # OpenCV does not say that the disk is full
                raise OSError(errno.EIO, "OpenCV cannot write the video", str(path))
            partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _opened(path: str | Path) -> cv2.VideoCapture | None:
    """The opened video; None for other files."""
    # FFmpeg would print many lines about damage to stderr.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    capture = cv2.VideoCapture(str(path)) if os.path.isfile(path) else None
    return capture if capture is not None and capture.isOpened() else None


def _check_end(path: str | Path, capture: cv2.VideoCapture, count: int, time: float) -> None:
    """BrokenImageError if a video of `count` frames, the last at `time`, is incomplete."""
    if count == 0:
        raise BrokenImageError(f"cannot read {path}: no frame that OpenCV can decode")
    rate, named = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
    if rate <= 0 or named <= 0:  # a stream without a header
        return
    # Times rather than counts: for some files OpenCV makes the count from the length.
    length, end = named / rate, time + 1 / rate
    last = length - min(_TOLERANCE, _PART * length)
    if end < last and _stored_end(path) + 1 / rate < last:
        raise BrokenImageError(
            f"{path} is damaged or cut off: it ends after {counted(count, 'frame')}, at {end:.1f} "
            f"s; its header claims {length:.1f} s"
        )


def _stored_end(path: str | Path) -> float:
    """The time of the last frame of a video, s, with those that its edit list hides: the count of
    a header has them too."""
    before = os.environ.get(_OPTIONS)
    os.environ[_OPTIONS] = "|".join(filter(None, (before, "ignore_editlist;1")))
    capture, time = _opened(path), 0.0
    del os.environ[_OPTIONS]
    os.environ.update({} if before is None else {_OPTIONS: before})
    while capture is not None and capture.grab():
        time = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
    return time
