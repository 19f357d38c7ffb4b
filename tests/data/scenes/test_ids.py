"""The ids in label PNGs are the numbers that the file stores, whatever its form."""

import warnings

import cv2
import numpy as np
import pytest
from pngs import COLOUR, COLOUR_ALPHA, GREY, GREY_ALPHA, PALETTE, png

from darswin.data import IGNORE
from darswin.data.scenes.targets import OddLabels, read_labels
from darswin.utils.image import BrokenImageError

RANDOM = np.random.default_rng(0)
COLORS = RANDOM.permuted(np.stack([np.arange(256)] * 3, 1), axis=0).astype(np.uint8)
COLORS[0] = 9, 8, 7  # not all entries are grey


def ids_of(bits):
    return RANDOM.integers(2**bits, size=(11, 13), dtype=np.uint8)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize("kind", [GREY, PALETTE])
@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_stored_numbers_are_the_ids(tmp_path, bits, kind, interlaced):
    ids, file = ids_of(bits), tmp_path / "ids.png"
    palette = COLORS[: 2**bits] if kind == PALETTE else None
    file.write_bytes(png(ids, bits, kind, palette, interlaced))
    assert (read_labels(file, 256) == ids).all()
    shown = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB)  # another decoder agrees on the picture
    greys = ids.astype(int) * 255 // (2**bits - 1)
    expected = COLORS[ids] if kind == PALETTE else np.dstack([greys] * 3)
    assert (shown == expected).all()


def test_masks(tmp_path):
    mask = RANDOM.integers(2, size=(9, 17), dtype=np.uint8)
    for name, content, expected in (
        ("1 bit", png(mask, 1), mask),
        ("8 bits", png(mask), mask),
        ("0 and 255", png(mask * np.uint8(255)), mask * np.uint8(IGNORE)),
        ("colours", png(mask, 1, PALETTE, [[0, 0, 0], [255, 0, 0]]), mask),
    ):
        (tmp_path / f"{name}.png").write_bytes(content)
        with warnings.catch_warnings(record=True, action="always") as warned:
            assert (read_labels(tmp_path / f"{name}.png", 2) == expected).all(), name
            read_labels(tmp_path / f"{name}.png", 2)
        told = [str(warning.message) for warning in warned]
        assert len(told) == (name == "0 and 255"), name  # once
        assert all(
            'if it is a class here, give a `label_map`, {"0": 0, "255": 1}' in t for t in told
        )
    for content, options in (
        (png(mask * np.uint8(255)), dict(classes=3)),
        (png(mask * np.uint8(255)), dict(classes=2, class_of={0: 0, 255: 1})),
        (png(mask + np.where(np.eye(9, 17), 255 - mask, 0).astype(np.uint8)), dict(classes=2)),
    ):
        (tmp_path / "other").mkdir(exist_ok=True)
        (tmp_path / "other" / "x.png").write_bytes(content)
        with warnings.catch_warnings(action="error"):
            read_labels(tmp_path / "other" / "x.png", **options)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (png(ids_of(8), 16), "16 bits"),
        (png(np.dstack([ids_of(8)] * 3), 8, COLOUR), r"colours \(RGB\)"),
        (png(np.dstack([ids_of(8)] * 4), 8, COLOUR_ALPHA), r"colours \(RGBA\)"),
        (png(np.dstack([ids_of(8)] * 2), 8, GREY_ALPHA), r"grey with transparency \(LA\)"),
    ],
)
def test_other_forms_are_named(tmp_path, content, message):
    (tmp_path / "x.png").write_bytes(content)
    with pytest.raises(ValueError, match=rf"x\.png must hold an id of 8 bits .* holds {message}"):
        read_labels(tmp_path / "x.png", 256)


def test_labels_are_no_jpeg(tmp_path):
    cv2.imwrite(str(tmp_path / "x.jpg"), ids_of(2))
    (tmp_path / "x.jpg").rename(tmp_path / "x.png")
    with pytest.raises(BrokenImageError, match=r"cannot read .*x\.png: no PNG"):
        read_labels(tmp_path / "x.png", 256)


@pytest.mark.parametrize(
    ("greys", "bits", "padding"),
    [
        ([0, 2, 3], 2, 0), ([3, 0, 2], 2, 0), ([0, IGNORE], 1, 0), ([7], 1, 0),
        ([*range(5, 21)], 4, 0), ([1, 0], 8, 0), ([0, 2, 3], 2, 1), ([0, 2, 3], 8, 253),
        ([3, 0], 2, 2), ([7], 1, 1),
    ],
)  # fmt: skip
def test_a_palette_of_greys_is_a_grey_picture(tmp_path, greys, bits, padding):
    """As programs that shrink PNGs write the same picture; they sort the entries as they like."""
    stored = RANDOM.integers(len(greys), size=(9, 17), dtype=np.uint8)
    original = np.array(greys, np.uint8)[stored]
    for name in ("a", "b"):
        content = png(stored, bits, PALETTE, [[grey] * 3 for grey in greys + [0] * padding])
        (tmp_path / f"{name}.png").write_bytes(content)
    with pytest.warns(OddLabels, match=rf"{tmp_path} holds label PNGs whose palette has only"):
        assert (read_labels(tmp_path / "a.png", 256) == original).all()
    with warnings.catch_warnings(action="error"):  # it is said once
        assert (read_labels(tmp_path / "b.png", 256) == original).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "palette",
    [
        [[0, 0, 0], [128, 0, 0], [9, 9, 9], [128, 128, 128]],  # greys among colours, as in VOC
        [[0, 0, 0], [50, 50, 50], [128, 128, 128], [0, 0, 0]],  # no optimiser uses one twice
        [[k, k, k] for k in range(256)],  # the greys are the numbers of the entries
    ],
)
def test_other_palettes_count_their_entries(tmp_path, palette):
    ids = RANDOM.choice(np.array([0, 3], np.uint8), size=(9, 17))
    (tmp_path / "x.png").write_bytes(png(ids, 8, PALETTE, palette))
    assert (read_labels(tmp_path / "x.png", 256) == ids).all()


@pytest.mark.parametrize("used", [[0, 3], [0, 2], [1]])
def test_a_grey_that_is_repeated_is_ambiguous(tmp_path, used):
    """Predictions of `darswin` have one colour for all numbers without a class: it may be grey, and
    the classes too."""
    ids = RANDOM.choice(np.array(used, np.uint8), size=(9, 17))
    palette = [[grey] * 3 for grey in (0, 50, 128, 200, 200)]
    (tmp_path / "x.png").write_bytes(png(ids, 8, PALETTE, palette))
    with pytest.warns(OddLabels, match="has only greys, and repeats one .* are the numbers of"):
        assert (read_labels(tmp_path / "x.png", 256) == ids).all()


@pytest.mark.filterwarnings("ignore::darswin.data.scenes.targets.OddLabels")
def test_a_number_without_an_entry_in_the_palette_is_an_unknown_id(tmp_path):
    stored = np.array([[0, 1, 2, 200]], np.uint8)
    (tmp_path / "x.png").write_bytes(png(stored, 8, PALETTE, [[1] * 3, [0] * 3, [2] * 3]))
    with pytest.raises(ValueError, match=r"x\.png holds the ids \[200\]"):
        read_labels(tmp_path / "x.png", 3)


@pytest.mark.parametrize(
    ("class_of", "message"),
    [
        (None, r"holds the ids \[9\], but the 3 classes have the ids 0 to 2; 255 means"),
        ({0: 0, 1: 1, 2: 2}, r"holds the ids \[9\], but the known ids are \[0, 1, 2\]; 255 means"),
        ({9: 0, 0: 1}, r"holds the ids \[1, 2\], but the known ids are \[0, 9\]"),
    ],
)
def test_unknown_ids_are_named(tmp_path, class_of, message):
    (tmp_path / "x.png").write_bytes(png(np.array([[0, 1, 2, 9, 255]], np.uint8)))
    with pytest.raises(ValueError, match=rf"x\.png {message}"):
        read_labels(tmp_path / "x.png", 3, class_of)


def test_ids_that_count_as_unlabelled(tmp_path):
    (tmp_path / "x.png").write_bytes(png(np.array([[0, 1, 2, 9, 255]], np.uint8)))
    class_of = {0: 1, 1: IGNORE, 2: 0, 9: IGNORE, 1000: 0}
    assert read_labels(tmp_path / "x.png", 2, class_of).tolist() == [[1, 255, 0, 255, 255]]
    assert read_labels(tmp_path / "x.png", 2, class_of | {255: 0})[0, 4] == 0  # a mask's 255
