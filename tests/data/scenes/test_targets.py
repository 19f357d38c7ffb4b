"""Damaged files are said by their names, whatever is wrong with them."""

import io

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from darswin.data.scenes.scene import IGNORE, read_distance, read_labels
from darswin.utils.image import BrokenImageError

LABELS = np.random.default_rng(0).integers(0, 4, size=(9, 13), dtype=np.uint8)
METRES = np.random.default_rng(1).uniform(0.5, 90, size=(9, 13)).astype(np.float32)


def png(array):
    return cv2.imencode(".png", array)[1].tobytes()


def npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


FILES = {
    "labels.png": (png(LABELS), lambda path: read_labels(path, 4)),
    "distance.png": (png(np.round(METRES * 256).astype(np.uint16)), read_distance),
    "distance.npy": (npy(METRES), read_distance),
}


@given(
    name=st.sampled_from(sorted(FILES)),
    changes=st.lists(st.tuples(st.integers(0, 500), st.integers(0, 255)), max_size=4),
    kept=st.floats(0, 1),
)
def test_any_damage(tmp_path_factory, name, changes, kept):
    content, read = FILES[name]
    damaged = bytearray(content[: round(kept * len(content))])
    for place, value in changes:
        if place < len(damaged):
            damaged[place] = value
    path = tmp_path_factory.mktemp("damaged") / name
    path.write_bytes(damaged)
    try:
        target = read(path)
    except (BrokenImageError, ValueError) as error:
        assert name in str(error)
        return
    assert target.ndim == 2 and target.dtype == (np.uint8 if "labels" in name else np.float32)
    assert np.isfinite(target).all() and (target >= 0).all()


def test_what_was_written_is_read(tmp_path):
    for name, (content, _) in FILES.items():
        (tmp_path / name).write_bytes(content)
    assert (read_labels(tmp_path / "labels.png", 4) == LABELS).all()
    assert (read_distance(tmp_path / "distance.npy") == METRES).all()
    error = np.abs(read_distance(tmp_path / "distance.png") - METRES)
    assert error.max() <= 1 / 512 + 1e-5
    far = read_distance(tmp_path / "distance.npy", far=40.0)
    assert (far == np.where(METRES < 40, METRES, 0)).all()


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_palettes_of_few_bits(tmp_path, bits):
    ids = LABELS & np.uint8(2**bits - 1)
    picture = Image.fromarray(ids)
    picture.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255, 9, 9, 9])
    picture.save(tmp_path / "p.png", bits=bits)
    assert (read_labels(tmp_path / "p.png", 4) == ids).all()
    Image.fromarray(LABELS > 1).save(tmp_path / "b.png")  # black and white: 0 and 1
    assert (read_labels(tmp_path / "b.png", 2) == (LABELS > 1)).all()


def test_ignored_pixels_are_of_no_class(tmp_path):
    (tmp_path / "l.png").write_bytes(png(np.where(LABELS == 3, IGNORE, LABELS)))
    assert (read_labels(tmp_path / "l.png", 3) == np.where(LABELS == 3, IGNORE, LABELS)).all()
    with pytest.raises(ValueError, match=r"l\.png holds the ids \[2\], and there are 2 classes"):
        read_labels(tmp_path / "l.png", 2)
