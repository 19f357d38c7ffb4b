"""Text files of every kind mean the same in each encoding, and JSON files name nothing twice."""

import codecs
import json
import shutil

import numpy as np
import pytest
from scenes import CALIBRATIONS, WOODSCAPE, write, write_coco, write_plain, write_woodscape

from darswin.data import Calibrations, open_scenes, open_source

ENCODINGS = {
    "UTF-8": str.encode,
    "UTF-8 with a mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16, little endian": lambda text: codecs.BOM_UTF16_LE + text.encode("utf-16-le"),
    "UTF-16, big endian": lambda text: codecs.BOM_UTF16_BE + text.encode("utf-16-be"),
    "UTF-32, little endian": lambda text: codecs.BOM_UTF32_LE + text.encode("utf-32-le"),
    "UTF-8 with two marks": lambda text: codecs.BOM_UTF8 + text.encode("utf-8-sig"),
    "line ends of Windows": lambda text: text.replace("\n", "\r\n").encode(),
}


@pytest.fixture(params=ENCODINGS)
def encode(request):
    """A function that writes a text to a file, or JSON."""

    def encoded(file, content):
        text = content if isinstance(content, str) else json.dumps(content, ensure_ascii=False)
        file.write_bytes(ENCODINGS[request.param](text))
        return file

    return encoded


@pytest.fixture
def photos(tmp_path):
    for name in ("Käfer", "dog", "cat"):
        for k in range(4):
            write(tmp_path / "photos" / name / f"{k}.png", np.zeros((6, 8), np.uint8))
    return tmp_path / "photos"


@pytest.mark.parametrize("name", ["classes.txt", "classes.json", "classes.JSON"])
def test_classes(tmp_path, photos, encode, name):
    content = "Käfer\ndog\n" if name.endswith("txt") else ["Käfer", "dog"]
    source = open_source(photos, "train", classes=encode(tmp_path / name, content))
    assert source.classes == ["Käfer", "dog"]
    write_plain(tmp_path / "scenes", 2)
    content = content + (["tree"] if isinstance(content, list) else "tree\n")
    file = encode(tmp_path / name, content)
    scenes = open_scenes(tmp_path / "scenes", "all", "labels", classes=file)
    assert scenes.classes == ["Käfer", "dog", "tree"]


@pytest.mark.filterwarnings("ignore::darswin.data.splits.LeftOut")
def test_lists_of_splits(tmp_path, photos, encode):
    lists = tmp_path / "lists"
    lists.mkdir()
    encode(lists / "train.txt", "Käfer/0.png\ndog/1.png\n")
    encode(lists / "val.txt", "dog/2.png\n")
    file = encode(tmp_path / "lists.json", {"train": ["Käfer/0.png", "dog/1.png"], "val": []})
    for splits in (lists, file):
        source = open_source(photos, "train", splits=splits)
        assert [str(source.file(k).relative_to(photos)) for k in range(2)] == [
            "Käfer/0.png", "dog/1.png"
        ]  # fmt: skip
    write_plain(tmp_path / "scenes", 4)
    encode(lists / "train.txt", "000\n003\n")
    encode(lists / "val.txt", "001\n")
    scenes = open_scenes(tmp_path / "scenes", "train", "labels", splits=lists)
    assert [scenes.file(k).stem for k in range(len(scenes))] == ["000", "003"]


def test_label_maps_and_classes_of_a_folder(tmp_path, encode):
    write_plain(tmp_path, 2)
    encode(tmp_path / "classes.json", {"names": ["Käfer", "b", "c"], "colors": [[1, 2, 3]] * 3})
    assert open_scenes(tmp_path, "all", "labels").classes == ["Käfer", "b", "c"]
    file = encode(tmp_path / "map.json", {"0": "Käfer", "1": None, "2": "Tür"})
    assert open_scenes(tmp_path, "all", "labels", label_map=file).classes == ["Käfer", "Tür"]


def test_lenses(tmp_path, photos, encode):
    lens = {"model": "Equidistant", "focal": 9.0, "theta_max": 1.2, "image_size": [6, 8]}
    for content in (lens, {"Käfer": lens, ".": lens | {"focal": 8.0}}):
        file = encode(tmp_path / "lenses.json", content)
        found = Calibrations(file, photos).lens_of(photos / "Käfer" / "0.png", (6, 8))
        assert found.focal.item() == 9
    write_plain(tmp_path / "scenes", 2, own_lenses=True)
    for own in (tmp_path / "scenes" / "lenses").iterdir():
        encode(own, own.read_text())
    scenes = open_scenes(tmp_path / "scenes", "all", "labels")
    assert scenes[0].lens.image_size.tolist() == [[121, 160]]


def test_files_of_data_sets(tmp_path, encode):
    write_coco(tmp_path / "coco")
    shutil.copy(WOODSCAPE, tmp_path / "coco" / "lens.json")
    write_woodscape(tmp_path / "woodscape")
    before = open_scenes(tmp_path / "coco", "train", "labels")[0].target
    for file in (*(tmp_path / "coco").rglob("*.json"), *(tmp_path / "woodscape").rglob("*.json")):
        encode(file, file.read_text())
    assert (open_scenes(tmp_path / "coco", "train", "labels")[0].target == before).all()
    assert open_scenes(tmp_path / "woodscape", "all", "labels").classes[4] == "person"


def twice(content):
    """The JSON of an object whose first entry appears twice."""
    name, value = next(iter(content.items()))
    return json.dumps(content)[:-1] + f", {json.dumps(name)}: {json.dumps(value)}}}"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("map.json", {"0": "sky", "1": "b", "2": "c"}),
        ("classes.json", {"names": ["a", "b", "c"]}),
        ("lists.json", {"train": ["000"], "val": ["001"]}),
        ("lenses.json", {".": {"model": "Equidistant", "fov": 2.0}}),
        ("lens.json", {"model": "Equidistant", "fov": 2.0}),
        ("lenses/001.json", {"model": "Equidistant", "fov": 2.0}),
        ("annotations/panoptic_train2017.json", None),
        ("semantic_annotations/seg_annotation_info.json", None),
    ],
)
def test_a_name_that_stands_twice_is_an_error(tmp_path, name, content):
    options = {"map.json": "label_map", "lists.json": "splits", "lenses.json": "lens"}
    file = tmp_path / name
    if name.startswith("annotations"):
        write_coco(tmp_path)
        shutil.copy(CALIBRATIONS / "woodscape.json", tmp_path / "lens.json")
    elif name.startswith("semantic"):
        write_woodscape(tmp_path)
    else:
        write_plain(tmp_path, 4)
        file.parent.mkdir(exist_ok=True)
    content = content or json.loads(file.read_text())
    file.write_text(twice(content))
    arguments = {options[name]: file} if name in options else {}
    split = "train" if name.startswith(("annotations", "lists")) else "all"
    first = next(iter(content))
    with pytest.raises(ValueError, match=rf"{file.name}.*'{first}' appears twice") as error:
        open_scenes(tmp_path, split, "labels", **arguments)[0]
    assert str(tmp_path) in str(error.value)
