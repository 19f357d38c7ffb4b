"""Text files of every kind are read in each encoding, and JSON files name nothing twice.

tests/utils/test_text.py has the encodings; here is one of them, for each kind of file.
"""

import json
import shutil

import numpy as np
import pytest
from helpers import refused
from scenes import WOODSCAPE, write, write_coco, write_plain, write_woodscape

from darswin.data import Calibrations, open_scenes, open_source

LENS = {"model": "Equidistant", "focal": 9.0, "theta_max": 1.2, "image_size": [6, 8]}
pytestmark = pytest.mark.filterwarnings("ignore::darswin.data.splits.LeftOut")


def encode(file, content):
    """Writes a text, or JSON, as an editor of Windows may save it."""
    text = content if isinstance(content, str) else json.dumps(content, ensure_ascii=False)
    file.write_bytes(text.replace("\n", "\r\n").encode("utf-16"))
    return file


def test_files_of_photos(tmp_path):
    photos, lists = tmp_path / "photos", tmp_path / "lists"
    for name in ("Käfer", "dog", "cat"):
        for k in range(4):
            write(photos / name / f"{k}.png", np.zeros((6, 8), np.uint8))
    for name in ("classes.txt", "classes.json", "classes.JSON"):
        file = encode(tmp_path / name, "Käfer\ndog\n" if name[-1] == "t" else ["Käfer", "dog"])
        assert open_source(photos, "train", classes=file).classes == ["Käfer", "dog"]
    paths = {"train": ["Käfer/0.png", "dog/1.png"], "val": ["dog/2.png"]}
    lists.mkdir()
    for split in paths:
        encode(lists / f"{split}.txt", "\n".join(paths[split]))
    for splits in (lists, encode(tmp_path / "lists.json", paths)):
        source = open_source(photos, "train", splits=splits)
        assert [source.file(k) for k in range(2)] == [photos / path for path in paths["train"]]
    for content in (LENS, {"Käfer": LENS, ".": LENS | {"focal": 8.0}}):
        lenses = Calibrations(encode(tmp_path / "lenses.json", content), photos)
        assert lenses.lens_of(photos / "Käfer" / "0.png", (6, 8)).focal == 9


def plain_or_other(folder, name):
    """A data set to which a file of this name belongs."""
    if name.startswith("annotations"):
        shutil.copy(WOODSCAPE, write_coco(folder) / "lens.json")
    elif name.startswith("semantic"):
        write_woodscape(folder)
    else:
        write_plain(folder, 4, own_lenses=name.startswith("lenses/"))
    return folder / name


@pytest.mark.parametrize(
    ("name", "option", "content"),
    [
        ("map.json", "label_map", {"0": "Käfer", "1": None, "2": "Tür"}),
        ("classes.json", None, {"names": ["Käfer", "b", "c"], "colors": [[1, 2, 3]] * 3}),
        ("mine.json", "classes", {"names": ["Käfer", "b", "c"]}),
        ("mine.txt", "classes", "Käfer\nb\nc\n"),
        ("lists.json", "splits", {"train": ["000", "003"], "val": ["001"]}),
        ("lists/train.txt", "splits", "000\n003\n"),
        ("lenses.json", "lens", {".": {"model": "Equidistant", "fov": 2.0}}),
        ("lens.json", None, {"model": "Equidistant", "fov": 2.0}),
        ("lenses/001.json", None, {"model": "Equidistant", "fov": 2.0}),
        ("annotations/panoptic_train2017.json", None, None),
        ("semantic_annotations/seg_annotation_info.json", None, None),
    ],
)
def test_files_of_scenes(tmp_path, name, option, content):
    def opened():
        scenes = open_scenes(tmp_path, "train", "labels", holdout=0, **options)
        places = range(len(scenes))
        lenses = [str(scenes[k].lens) for k in places]
        return scenes.classes, [*map(scenes.file, places)], lenses, scenes[0].target.tolist()

    file = plain_or_other(tmp_path, name)
    file.parent.mkdir(exist_ok=True)
    options = {option: file.parent if "lists/" in name else file} if option else {}
    if content is None:
        content = json.loads(file.read_text())
    elif isinstance(content, str):
        file.write_text(content)
    else:
        file.write_text(json.dumps(content))
    expected = opened()
    encode(file, content)
    assert opened() == expected
    if isinstance(content, dict):
        first = next(iter(content))
        twice = json.dumps(content)[:-1] + f", {json.dumps({first: content[first]})[1:]}"
        file.write_text(twice)
        said = refused(rf"{file.name}.*'{first}' appears twice", opened)
        assert str(tmp_path) in said
