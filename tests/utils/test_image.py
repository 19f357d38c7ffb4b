import struct
import zlib

import cv2
import numpy as np
import pytest
from helpers import exif_of
from PIL import Image, ImageOps
from pngs import chunk

from darswin.utils.image import (
    BrokenImageError,
    read_header,
    read_image,
    read_oriented,
    read_stored,
)

# A header of 60,000 × 60,000 pixels: more than OpenCV reads.
HUGE = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0))
HUGE += chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no image that"),
        (b"no picture", "no image that"),
        (None, "No such file"),
        (HUGE, "too many pixels"),
    ],
)
@pytest.mark.parametrize("read", [read_image, read_oriented, read_stored])
def test_a_broken_picture_is_named(tmp_path, content, message, read):
    if content is not None:
        (tmp_path / "x.png").write_bytes(content)
    with pytest.raises(BrokenImageError, match=rf"cannot read .*x\.png: {message}"):
        read(tmp_path / "x.png")


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_pictures_are_upright_whoever_reads_them(tmp_path, suffix, channels):
    """Training and predicting read the same pixels, which Pillow turns the same way."""
    pixels = np.kron(np.arange(6, dtype=np.uint8).reshape(2, 3) * 40, np.ones((16, 16), np.uint8))
    for orientation in range(1, 9):
        path = tmp_path / f"{orientation}.{suffix}"
        Image.fromarray(pixels).convert("RGB").save(path, exif=exif_of(orientation), quality=100)
        with Image.open(path) as file:
            upright = np.asarray(ImageOps.exif_transpose(file).convert("L"))
        image, found = read_oriented(path, channels)
        assert found == orientation and image.flags.c_contiguous
        assert np.array_equal(image, read_image(path, channels))
        stored = read_stored(path, channels)
        assert stored.shape == (32, 48, channels) and stored.flags.c_contiguous
        assert np.abs(stored.astype(int) - pixels[..., None]).max() < 6
        header = read_header(path)
        assert header.orientation == orientation and header.upright == image.shape[:2]
        assert header.size == (32, 48) and header.channels == 3 and header.is_sound
        assert np.abs(image.astype(int) - upright[..., None]).max() < 6


@pytest.mark.parametrize(
    "exif", [b"Exif\0\0nothing", b"Exif\0\0II*\0\xff\xff\xff\xff", b"Exif\0\0"]
)
def test_exif_that_is_none(tmp_path, exif):
    Image.new("RGB", (8, 6)).save(tmp_path / "x.jpg", exif=exif)
    try:
        image, orientation = read_oriented(tmp_path / "x.jpg")
        assert image.shape == (6, 8, 3) and orientation == 1
    except BrokenImageError as error:
        assert "x.jpg: its EXIF orientation is unreadable" in str(error)


def test_grey_and_colour_files(tmp_path):
    colour = np.zeros((4, 5, 3), np.uint8)
    colour[..., 2] = 200  # OpenCV's order: red
    cv2.imwrite(str(tmp_path / "c.png"), colour)
    assert read_image(tmp_path / "c.png")[0, 0].tolist() == [200, 0, 0]
    assert read_image(tmp_path / "c.png", 1).shape == (4, 5, 1)
    cv2.imwrite(str(tmp_path / "g.png"), colour[..., 2])
    assert read_image(tmp_path / "g.png")[0, 0].tolist() == [200, 200, 200]


def test_a_png_that_says_no_orientation_is_decoded_once(tmp_path, monkeypatch):
    """Pillow decodes a PNG whole to look for EXIF behind its pixels."""
    Image.new("RGB", (8, 6)).save(tmp_path / "plain.png")
    Image.new("RGB", (8, 6)).save(tmp_path / "turned.png", exif=exif_of(8))
    # EXIF behind the pixels, where the format allows it too.
    data = (tmp_path / "turned.png").read_bytes()
    start = data.index(b"eXIf") - 4
    end = start + 12 + int.from_bytes(data[start : start + 4], "big")
    tail = data.index(b"IEND") - 4
    assert end <= tail
    behind = data[:start] + data[end:tail] + data[start:end] + data[tail:]
    (tmp_path / "behind.png").write_bytes(behind)
    assert read_oriented(tmp_path / "turned.png")[1] == 8
    assert read_oriented(tmp_path / "behind.png")[1] == 8
    monkeypatch.setattr(Image, "open", lambda *_: pytest.fail("Pillow was asked"))
    assert read_oriented(tmp_path / "plain.png")[1] == 1
