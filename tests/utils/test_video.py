"""Frames of video files, against what was written into them and what OpenCV itself reads."""

import struct
import time

import cv2
import numpy as np
import pytest
from videos import turn_video, write_video

from darswin.utils import video
from darswin.utils.image import BrokenImageError
from darswin.utils.video import is_video, read_frames

FORMATS = {"a.mp4": "mp4v", "a.avi": "MJPG", "a.mkv": "mp4v"}


@pytest.mark.parametrize("name", FORMATS)
def test_frames_are_what_was_written(tmp_path, name):
    written = write_video(tmp_path / name, 30, codec=FORMATS[name])
    frames = list(read_frames(tmp_path / name))
    assert [frame.number for frame in frames] == list(range(30))
    assert [frame.time for frame in frames] == pytest.approx([k / 10 for k in range(30)], abs=1e-6)
    for frame, pixels in zip(frames, written, strict=True):
        assert frame.image.dtype == np.uint8 and frame.orientation == 1
        assert np.abs(frame.image.astype(int) - pixels).mean() < 4  # compressed, but RGB as written
    (grey, *_) = read_frames(tmp_path / name, channels=1)
    expected = cv2.cvtColor(frames[0].image, cv2.COLOR_RGB2GRAY)[..., None]
    assert np.abs(grey.image.astype(int) - expected).max() <= 1
    third = list(read_frames(tmp_path / name, every=3))
    assert [frame.number for frame in third] == list(range(0, 30, 3))
    for frame in third:
        assert frame.time == frames[frame.number].time
        assert np.array_equal(frame.image, frames[frame.number].image)


@pytest.mark.parametrize(("degrees", "turns"), [(0, 0), (90, -1), (180, 2), (270, 1)])
def test_frames_come_upright(tmp_path, degrees, turns):
    write_video(tmp_path / "stored.mp4", 5)
    write_video(tmp_path / "turned.mp4", 5)
    turn_video(tmp_path / "turned.mp4", degrees)
    for stored, frame in zip(
        read_frames(tmp_path / "stored.mp4"), read_frames(tmp_path / "turned.mp4"), strict=True
    ):
        assert np.array_equal(frame.image, np.rot90(stored.image, turns))
        assert frame.orientation == {0: 1, 90: 6, 180: 3, 270: 8}[degrees]


@pytest.mark.parametrize(
    ("name", "part"), [("a.avi", 0.5), ("a.mkv", 0.7), ("a.avi", 0.85), ("a.mkv", 0.5)]
)
def test_a_video_that_is_cut_off(tmp_path, name, part):
    path = tmp_path / name
    write_video(path, 40, codec=FORMATS[name])
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * part)])
    numbers = []
    with pytest.raises(BrokenImageError, match=rf"{name} is damaged or cut off: .* claims 4.0 s"):
        for frame in read_frames(path):
            numbers.append(frame.number)
    assert numbers == list(range(len(numbers))) and 0.4 * part < len(numbers) / 40 < part + 0.1


def test_frames_that_an_edit_list_hides_are_not_missing(tmp_path, monkeypatch):
    monkeypatch.setenv(video._OPTIONS, "threads;1")
    path = tmp_path / "a.mp4"
    write_video(path, 40)
    content = bytearray(path.read_bytes())
    place = content.index(b"elst") + 12  # ISO/IEC 14496-12, 8.6.6: 1 s in ms, from 3 s on
    struct.pack_into(">Ii", content, place, 1000, 3 * 10240)
    path.write_bytes(content)
    assert len(list(read_frames(path))) == 10
    assert video.os.environ[video._OPTIONS] == "threads;1"


def test_what_is_no_video(tmp_path):
    write_video(tmp_path / "a.mp4", 40)
    content = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(content[: len(content) // 2])  # its index is at the end
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "folder.mp4").mkdir()
    for name in ("cut.mp4", "text.mp4"):
        with pytest.raises(BrokenImageError, match=rf"{name}: no video that OpenCV can decode"):
            next(read_frames(tmp_path / name))
    for name in ("none.mp4", "folder.mp4"):
        with pytest.raises(BrokenImageError, match=rf"cannot read .*{name}: no such file"):
            next(read_frames(tmp_path / name))
    (tmp_path / "a.mp4").rename(tmp_path / "recording")
    cv2.imwrite(str(tmp_path / "picture.png"), np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "picture.png").rename(tmp_path / "picture")
    (tmp_path / "text").write_text("no video")
    found = {name: is_video(tmp_path / name) for name in ("recording", "picture", "text", "none")}
    assert found == {"recording": True, "picture": False, "text": False, "none": False}
    assert is_video("none.MP4")


class Camera:
    """A camera of 100 frames per second, whose frames are as bright as their number; it ends after
    `last` frames."""

    last, opened = 40, True

    def __init__(self, source):
        self.source, self.count, self.released = source, 0, False
        Camera.latest = self

    def isOpened(self):  # noqa: N802
        return self.opened

    def read(self):
        time.sleep(0.01)
        self.count += 1
        return self.count <= self.last, np.full((6, 8, 3), (self.count - 1, 0, 0), np.uint8)

    def release(self):
        self.released = True


@pytest.mark.parametrize(("every", "pause"), [(1, 0.05), (3, 0.0)])
def test_a_camera_gives_its_newest_frames(monkeypatch, every, pause):
    monkeypatch.setattr(video.cv2, "VideoCapture", Camera)
    numbers, times = [], []
    for frame in video.read_stream("0", every=every):
        assert (frame.image == (0, 0, frame.number)).all() and frame.orientation == 1  # RGB
        numbers.append(frame.number)
        times.append(frame.time)
        time.sleep(pause)
    assert Camera.latest.source == 0 and Camera.latest.released
    steps = np.diff(numbers)
    assert (steps >= every).all() and numbers[-1] >= 20 and sorted(times) == times
    if pause:
        assert len(numbers) < 40 / every  # what came meanwhile is dropped
    assert video.read_stream("rtsp://a", 1).__next__().image.shape == (6, 8, 1)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_camera_that_is_left_or_fails_is_released(monkeypatch):
    monkeypatch.setattr(video.cv2, "VideoCapture", Camera)
    frames = video.read_stream("/dev/video0")
    next(frames)
    frames.close()
    assert Camera.latest.released and Camera.latest.source == "/dev/video0"

    def read(self):
        if self.count == 2:
            raise video.cv2.error("broken")
        return Camera.read(self)

    monkeypatch.setattr(video.cv2, "VideoCapture", type("Failing", (Camera,), {"read": read}))
    assert [frame.number for frame in video.read_stream("0")][-1] <= 2
    assert Camera.latest.released


def test_streams_and_what_is_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "1").mkdir()
    (tmp_path / "2").write_text("")
    streams = ["0", "/dev/video2", "rtsp://u:p@host:554/a", "http://host/a.mjpg"]
    assert all(map(video.is_stream, streams))
    assert not any(map(video.is_stream, ["1", "2", "a.mp4", "C:/a.mp4", "/dev/null", "1234", "-1"]))
    assert video.stream_name(streams[2]) == "rtsp://host:554/a"
    assert video.stream_name("rtsp://u:p@:s@host/a@b//c@d") == "rtsp://host/a@b//c@d"
    monkeypatch.setattr(video.cv2, "VideoCapture", type("Closed", (Camera,), {"opened": False}))
    with pytest.raises(BrokenImageError, match="cannot read rtsp://host:554/a: OpenCV opens no"):
        next(video.read_stream(streams[2]))
    monkeypatch.setattr(video.cv2, "VideoCapture", type("Empty", (Camera,), {"last": 0}))
    with pytest.raises(BrokenImageError, match="cannot read 0: it gives no frame"):
        next(video.read_stream("0"))
