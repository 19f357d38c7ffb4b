"""Labels and distances are the numbers that their files store, whatever the files' form; damaged
files and wrong ones are named."""

import io
import json
import warnings

import cv2
import numpy as np
import pytest
from helpers import exif_of, refused
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pngs import COLOUR, COLOUR_ALPHA, GREY, GREY_ALPHA, PALETTE, png
from scenes import SIZE, write, write_plain

from darswin.data import IGNORE, open_scenes
from darswin.data.scenes.targets import OddLabels, read_distance, read_labels
from darswin.utils.image import BrokenImageError

RANDOM = np.random.default_rng(0)
COLORS = RANDOM.permuted(np.stack([np.arange(256)] * 3, 1), axis=0).astype(np.uint8)
COLORS[0] = 9, 8, 7  # not all entries are grey
LABELS = RANDOM.integers(0, 4, size=(9, 13), dtype=np.uint8)
METRES = RANDOM.uniform(0.5, 90, size=(9, 13)).astype(np.float32)


def npy(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def png16(metres):
    return png(np.round(metres * 256).astype(int), 16)


@pytest.fixture
def read(tmp_path):
    """Labels from the bytes of a file."""

    def read_content(content, classes=256, class_of=None, name="x.png"):
        (tmp_path / name).write_bytes(content)
        return read_labels(tmp_path / name, classes, class_of)

    return read_content


# -- any file ---------------------------------------------------------------------------------

FILES = {
    "labels.png": (png(LABELS), lambda path: read_labels(path, 4)),
    "distance.png": (png16(METRES), read_distance),
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
    write(tmp_path / "wrong.png", LABELS)
    said = "must hold a distance of 16 bits .* 1 × 8 bits"
    refused(rf"wrong\.png {said}", read_distance, tmp_path / "wrong.png")
    unknown = METRES.astype(np.float64)
    unknown[0, :7] = 0, -1, np.nan, np.inf, -np.inf, 1e300, 40.0
    np.save(tmp_path / "u.npy", unknown)
    assert (read_distance(tmp_path / "u.npy", far=40.0)[0, :7] == 0).all()
    ignored = np.where(LABELS == 3, IGNORE, LABELS)
    assert (read_labels(write(tmp_path / "i.png", ignored), 3) == ignored).all()


def test_wrong_lenses_and_turned_pictures_are_named(tmp_path):
    write_plain(tmp_path, 3)
    scenes = open_scenes(tmp_path, "all", "labels")
    picture = tmp_path / "images" / "001.png"
    Image.open(picture).save(picture, exif=exif_of(6))
    refused(r"001\.png has the EXIF orientation 6", scenes.__getitem__, 1)
    lens = json.loads((tmp_path / "lens.json").read_text())
    (tmp_path / "lens.json").write_text(json.dumps(lens | {"image_size": [50, 50]}))
    scenes = open_scenes(tmp_path, "all", "labels")
    refused(r"000\.png: the calibration is for 50 × 50", scenes.__getitem__, 0)
    write(tmp_path / "labels" / "002.png", np.full(SIZE, IGNORE, np.uint8))
    write_plain(tmp_path, 2)
    scenes = open_scenes(tmp_path, "all", "labels")
    assert (scenes[2].target == IGNORE).all() and scenes.unknown.tolist() == [-1, -1, 121 * 160]


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        (None, 'no classes.json in .*, for example {"names":'),
        ([], "must list the classes"),
        ({"names": ["a", "a"]}, "must name each class once"),
        ({"names": ["a", 3]}, "must name the classes as a list of words"),
        ({"names": ["a", "b"], "colors": [[0, 0, 0]]}, "must give all 2 classes a color"),
        ({"names": ["a"], "colors": [[0, 0, 256]]}, "must give all 1 classes a color"),
        ({"names": ["a"], "colors": [[0, 0]]}, "must give all 1 classes a color"),
        ({"names": [str(k) for k in range(256)]}, "must name each class once, and at most 255"),
    ],
)
def test_wrong_classes_are_named(tmp_path, classes, message):
    write_plain(tmp_path, 2, classes=classes)
    error = FileNotFoundError if classes is None else ValueError
    refused(message, open_scenes, tmp_path, "all", "labels", error=error)
    (tmp_path / "mine.txt").write_text("a\nb\nc\n")
    scenes = open_scenes(tmp_path, "all", "labels", classes=tmp_path / "mine.txt")
    assert scenes.classes == ["a", "b", "c"] and scenes.colors == []


# -- ids in PNGs of every form ----------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("interlaced", [False, True])
@pytest.mark.parametrize("kind", [GREY, PALETTE])
@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_stored_numbers_are_the_ids(tmp_path, read, bits, kind, interlaced):
    ids = RANDOM.integers(2**bits, size=(11, 13), dtype=np.uint8)
    palette = COLORS[: 2**bits] if kind == PALETTE else None
    assert (read(png(ids, bits, kind, palette, interlaced)) == ids).all()
    shown = cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_COLOR_RGB)  # another decoder agrees
    greys = ids.astype(int) * 255 // (2**bits - 1)
    assert (shown == (COLORS[ids] if kind == PALETTE else np.dstack([greys] * 3))).all()


MASK = RANDOM.integers(2, size=(9, 17), dtype=np.uint8)


def test_masks(read):
    white = png(MASK * np.uint8(255))
    with warnings.catch_warnings(action="error"):
        for content in (png(MASK, 1), png(MASK), png(MASK, 1, PALETTE, [[0, 0, 0], [255, 0, 0]])):
            assert (read(content, 2) == MASK).all()
        read(white, 3)
        read(white, 2, {0: 0, 255: 1})
        read(png(MASK + np.where(np.eye(9, 17), 255 - MASK, 0).astype(np.uint8)), 2)
    said = 'if it is a class here, give a `label_map`, {"0": 0, "255": 1}'
    with pytest.warns(OddLabels, match=said) as warned:
        for _ in range(2):
            assert (read(white, 2, name="white.png") == MASK * np.uint8(IGNORE)).all()
    assert len(warned) == 1


@pytest.mark.parametrize(
    ("content", "said", "error"),
    [
        (png(LABELS, 16), "must hold an id of 8 bits .* holds 16 bits", ValueError),
        (png(np.dstack([LABELS] * 3), 8, COLOUR), r"holds colours \(RGB\)", ValueError),
        (png(np.dstack([LABELS] * 4), 8, COLOUR_ALPHA), r"holds colours \(RGBA\)", ValueError),
        (png(np.dstack([LABELS] * 2), 8, GREY_ALPHA), r"grey with transparency \(LA\)", ValueError),
        (cv2.imencode(".jpg", LABELS)[1].tobytes(), "no PNG", BrokenImageError),
    ],
)
def test_other_forms_are_named(read, content, said, error):
    refused(rf"x\.png.* {said}", read, content, error=error)


@pytest.mark.parametrize(
    ("greys", "bits", "padding"),
    [
        ([0, 2, 3], 2, 0), ([3, 0, 2], 2, 0), ([0, IGNORE], 1, 0), ([7], 1, 0),
        ([*range(5, 21)], 4, 0), ([1, 0], 8, 0), ([0, 2, 3], 2, 1), ([0, 2, 3], 8, 253),
        ([3, 0], 2, 2), ([7], 1, 1),
    ],
)  # fmt: skip
def test_a_palette_of_greys_is_a_grey_picture(tmp_path, read, greys, bits, padding):
    """As programs that shrink PNGs write the same picture; they sort the entries as they like."""
    stored = RANDOM.integers(len(greys), size=(9, 17), dtype=np.uint8)
    original = np.array(greys, np.uint8)[stored]
    content = png(stored, bits, PALETTE, [[grey] * 3 for grey in greys + [0] * padding])
    with pytest.warns(OddLabels, match=rf"{tmp_path} holds label PNGs whose palette has only"):
        assert (read(content) == original).all()
    with warnings.catch_warnings(action="error"):  # it is said once
        assert (read(content, name="another.png") == original).all()


@pytest.mark.parametrize(
    ("palette", "used", "said"),
    [
        # Greys among colours, as in VOC.
        ([[0, 0, 0], [128, 0, 0], [9, 9, 9], [128, 128, 128]], [0, 3], None),
        ([[0, 0, 0], [50, 50, 50], [128, 128, 128], [0, 0, 0]], [0, 3], None),  # 0 twice: none
        ([[k, k, k] for k in range(256)], [0, 3], None),  # the numbers of the entries
        # Predictions of `darswin` have one colour for all numbers without a class: it may be
        # grey, and the classes too.
        *(([[grey] * 3 for grey in (0, 50, 128, 200, 200)], used, "repeats one .* are the numbers")
          for used in ([0, 3], [0, 2], [1])),
    ],
)  # fmt: skip
def test_other_palettes_count_their_entries(read, palette, used, said):
    ids = RANDOM.choice(np.array(used, np.uint8), size=(9, 17))
    with warnings.catch_warnings() if said is None else pytest.warns(OddLabels, match=said):
        warnings.simplefilter("error" if said is None else "always")
        assert (read(png(ids, 8, PALETTE, palette)) == ids).all()


IDS = png(np.array([[0, 1, 2, 9, 255]], np.uint8))


@pytest.mark.filterwarnings("ignore::darswin.data.scenes.targets.OddLabels")
@pytest.mark.parametrize(
    ("content", "class_of", "said"),
    [
        (IDS, None, r"\[9\], but the 3 classes have the ids 0 to 2; 255 means"),
        (IDS, {0: 0, 1: 1, 2: 2}, r"\[9\], but the known ids are \[0, 1, 2\]; 255 means"),
        (IDS, {9: 0, 0: 1}, r"\[1, 2\], but the known ids are \[0, 9\]"),
        # A number without an entry in the palette.
        (png(np.array([[0, 1, 2, 200]]), 8, PALETTE, [[1] * 3, [0] * 3, [2] * 3]), None, r"\[200"),
    ],
)
def test_unknown_ids_are_named(read, content, class_of, said):
    refused(rf"x\.png holds the ids {said}", read, content, 3, class_of)


def test_ids_that_count_as_unlabelled(read):
    class_of = {0: 1, 1: IGNORE, 2: 0, 9: IGNORE, 1000: 0}
    assert read(IDS, 2, class_of).tolist() == [[1, 255, 0, 255, 255]]
    assert read(IDS, 2, class_of | {255: 0})[0, 4] == 0  # a mask's 255
