"""Before training, the headers of the files tell what `samples[i]` would refuse."""

import json
import re

import cv2
import numpy as np
import pytest
import torch
from helpers import exif_of, product, refused
from PIL import Image
from pngs import PALETTE, png
from scenes import write, write_plain

from darswin.data import IGNORE, Calibrations, SceneSamples, open_scenes, open_source
from darswin.data.headers import check_files
from darswin.data.lens_distributions import parse_lenses
from darswin.data.samples import Calibrated
from darswin.data.scenes.targets import OddLabels
from darswin.data.wide_angle import WideAngle
from darswin.utils import image
from darswin.utils.image import BrokenImageError

LENS = json.dumps({"model": "Equidistant", "focal": 12.0, "theta_max": 1.2, "image_size": [30, 40]})
PICTURE = np.random.default_rng(0).integers(256, size=(30, 40, 3), dtype=np.uint8)
SUFFIXES = ("jpg", "png", "bmp", "webp", "tif", "ppm")


def cut(share):
    return lambda file: file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])


def append(data):
    return lambda file: file.write_bytes(file.read_bytes() + data)


def resized(height, width):
    return lambda file: cv2.imwrite(str(file), PICTURE[:height, :width])


def turned(file):
    Image.fromarray(PICTURE).save(file, exif=exif_of(6))


def with_damaged_exif(file):
    """In every format that Pillow gives EXIF data."""
    if file.suffix in (".jpg", ".png", ".webp"):
        Image.fromarray(PICTURE).save(file, exif=b"Exif\0\0nothing that is known")


# What happens to a file.
CHANGES = {
    "nothing": lambda file: None,
    "empty": lambda file: file.write_bytes(b""),
    "text": lambda file: file.write_text("no picture"),
    "missing": lambda file: file.unlink(),
    "cut in the header": cut(0.004),
    "cut in the middle": cut(0.5),
    "cut at the end": lambda file: file.write_bytes(file.read_bytes()[:-1]),
    "more at the end": append(b"\0" * 100),
    "much more at the end": append(b"\0" * 5000),
    "another shape": resized(30, 30),
    "another size": resized(15, 20),
    "upright, but stored on its side": turned,
    "damaged EXIF": with_damaged_exif,
}


def write_photos(folder, suffix, count=10):
    for k in range(count):
        write(folder / "ab"[k % 2] / f"{k}.{suffix}", PICTURE)
    return open_source(folder, "train", holdout=0)


def of_photos(source, **options):
    yield WideAngle(source, parse_lenses("low"), size=16, render=32, **options)
    yield Calibrated(source, Calibrations(LENS, source.root), size=16, **options)


def error_of(function, argument):
    try:
        function(argument)
    except (BrokenImageError, ValueError) as error:
        return error
    return None


def told(samples):
    return error_of(check_files, {"photos": samples})


@pytest.mark.parametrize(("change", "suffix"), product(CHANGES, SUFFIXES))
def test_what_the_check_refuses_is_what_reading_refuses(tmp_path, suffix, change):
    """Only headers are read, so that a file may be broken later in a format without an end."""
    source = write_photos(tmp_path, suffix)
    CHANGES[change](source.file(1))
    for samples in of_photos(source):
        expected, found = error_of(samples.__getitem__, 1), told(samples)
        if expected is None or found is not None:
            assert type(found) is type(expected) and str(found) == str(expected)
        else:
            assert suffix not in ("jpg", "png") and change.startswith("cut"), expected
    for samples in of_photos(source, skip_broken=True):
        assert told(samples) is None or type(told(samples)) is ValueError
        assert samples.broken == []


def test_all_faults_are_listed_at_once(tmp_path):
    source = write_photos(tmp_path, "png", 20)
    kinds = ["empty", "text", "missing", "cut in the middle", "another shape"]
    for k in range(13):
        CHANGES[kinds[k % 5]](source.file(k))
    of_lenses, calibrated = of_photos(source)
    photos, said = {"photos": of_lenses}, "11 of 20 pictures cannot be used:"
    first, *lines = refused(said, check_files, photos, error=BrokenImageError).splitlines()
    assert first == said and len(lines) == 11 and lines[-1] == "  and 1 more"
    assert all(str(source.file(k)) in "".join(lines) for k in (0, 1, 2, 3, 5, 6, 7, 8, 10, 11))
    said = r"13 of 20 .*\n(.*\n){10}  and 3 more$"
    assert "the calibration is for 30 × 40" in refused(said, check_files, {"photos": calibrated})
    of_lenses, calibrated = of_photos(source, skip_broken=True)
    assert check_files({"a": of_lenses}) == {"a": 11}
    refused("2 of 20 pictures cannot be used", check_files, {"photos": calibrated})


def test_headers_alone_are_read(tmp_path, monkeypatch):
    """And each once. A picture whose header or end may be damaged is read whole, and so are
    eight others at most."""
    decoded, headers = [], []

    def counted(known, calls):
        return lambda *given, **options: calls.append(given) or known(*given, **options)

    monkeypatch.setattr(image, "decoded", counted(image.decoded, decoded))
    monkeypatch.setattr(image.Image, "open", counted(image.Image.open, headers))
    source = write_photos(tmp_path / "photos", "png", 20)
    headers.clear()  # some were read to find the channels
    for samples in of_photos(source):
        check_files({"photos": samples})
    assert len(headers) == 2 * 20 and len(decoded) == 2 * 7
    write_plain(tmp_path / "scenes", 9)
    for target in ("labels", "distance"):
        scenes = open_scenes(tmp_path / "scenes", "all", target)
        headers.clear()
        decoded.clear()
        check_files({"scenes": SceneSamples(scenes, size=16)})
        pictures = [path for _, path, *_ in decoded if "images" in str(path)]
        assert len(pictures) == 5 and len(headers) == 2 * 9 + 5 * (target == "labels")
    CHANGES["cut in the middle"](source.file(4))
    decoded.clear()
    assert told(next(of_photos(source))) is not None
    assert len(decoded) == 8


def of_another_size(file):
    file.write_text(LENS.replace("30", "50"))


LABELS = np.zeros((121, 160), np.uint8)
METRES = np.ones((121, 160), np.float32)


def saving(array):
    return lambda file: np.save(file, array, allow_pickle=True)


def writing(array, bits=8):
    return lambda file: file.write_bytes(png(array, bits))


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("images/001.png", CHANGES["empty"], "cannot read"),
        ("images/001.png", CHANGES["another shape"], r"images/001\.png.* 30 × 30"),
        ("images/001.png", turned, "has the EXIF orientation 6"),
        ("labels/001.png", writing(LABELS[:-1]), r"120 × 160 px .*images/001\.png has 121 × 160"),
        ("labels/001.png", CHANGES["empty"], "cannot read"),
        ("labels/001.png", CHANGES["cut in the middle"], "cannot read"),
        ("labels/001.png", CHANGES["missing"], "cannot read"),
        ("distance/001.png", writing(LABELS[:-1], 16), "has 120 × 160 px .*, "),
        ("distance/001.png", CHANGES["missing"], "cannot read"),
        ("distance/001.png", CHANGES["cut at the end"], "cannot read"),
        ("distance/001.npy", saving(METRES[:-1]), "has 120 × 160 px .*, "),
        ("distance/001.npy", saving(METRES[None]), r"\(H, W\), but holds float32 \(1,"),
        ("distance/001.npy", saving(LABELS.astype(int)), "but holds int64"),
        ("distance/001.npy", saving(np.array([[{}]])), "cannot read"),
        ("distance/001.npy", lambda file: np.savez(file.open("wb"), METRES), "holds an archive"),
        ("distance/001.npy", CHANGES["empty"], "cannot read"),
        ("distance/001.npy", CHANGES["cut in the middle"], "cannot read"),
        ("lens.json", of_another_size, "the calibration is for"),
        ("lenses/001.json", of_another_size, "the calibration is for"),
    ],
)
def test_scenes(tmp_path, name, change, said):
    write_plain(tmp_path, 10, own_lenses="lenses" in name)
    target = "distance" if name.startswith("distance") else "labels"
    if name.endswith("npy"):
        (tmp_path / "distance" / "001.png").unlink()
        np.save(tmp_path / name, METRES)
    samples = SceneSamples(open_scenes(tmp_path, "all", target), size=16)
    check_files({"scenes": samples})
    change(tmp_path / name)
    if name.startswith("lens"):  # lenses are read once
        samples = SceneSamples(open_scenes(tmp_path, "all", target), size=16)
    expected, found = error_of(samples.__getitem__, 1), told(samples)
    assert re.search(said, str(expected)) and type(found) is type(expected)
    assert str(expected) in str(found) and samples.broken == []
    assert name.startswith("lens") or str(tmp_path / name) in str(expected)
    skipping = SceneSamples(samples.scenes, size=16, skip_broken=True)
    if isinstance(expected, ValueError):  # a wrong target is not skipped as if its file were broken
        assert isinstance(told(skipping), ValueError)
        refused(said, skipping.__getitem__, 1)
    else:
        assert told(skipping) is None
        image, lens, nothing = skipping[1]
        assert (nothing == (IGNORE if target == "labels" else 0)).all()
        assert nothing.dtype == (torch.int64 if target == "labels" else torch.float32)
        assert lens.image_size.tolist() == [[16, 16]] and image.unique().numel() == 3
        assert skipping.broken == [1]


def test_some_labels_are_read(tmp_path):
    """An id that no class has, and what is told once, come before the training."""
    write_plain(tmp_path, 20)
    for k, file in enumerate(sorted((tmp_path / "labels").iterdir())):
        palette = [[2, 2, 2], [1, 1, 1], [9, 9, 9]]
        file.write_bytes(png(np.full((121, 160), k == 6, np.uint8) * 2, 2, PALETTE, palette))
    samples = SceneSamples(open_scenes(tmp_path, "all", "labels"), size=16)
    with pytest.warns(OddLabels) as warned:
        said = r"006\.png holds the ids \[9\], but the 3 classes"
        refused(said, check_files, {"scenes": samples})
    assert len(warned) == 1


def test_a_fault_that_headers_hide_makes_all_files_be_read(tmp_path):
    """The error counts the faults of all splits, not those of the few files that are read first."""
    for name, count in (("a", 20), ("b", 12)):
        write_plain(tmp_path / name, count)
        for file in (tmp_path / name / "labels").iterdir():
            if int(file.stem) % 2 == 0:
                file.write_bytes(png(np.full((121, 160), 7, np.uint8)))
    parts = {
        name: SceneSamples(open_scenes(tmp_path / name, "all", "labels"), size=16) for name in "ab"
    }
    refused(r"^16 of 32 pictures cannot be used:(?s:.*)and 6 more$", check_files, parts)


def test_pictures_in_memory_have_no_files():
    source = open_source("digits", "train", channels=1)
    options = dict(size=16, render=32, mean=[0.4], std=[0.2])
    check_files({"digits": WideAngle(source, parse_lenses("low"), **options)})
