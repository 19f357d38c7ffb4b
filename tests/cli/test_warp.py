"""`darswin warp`: pictures and labels move together; the pictures show where things are."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from helpers import slow_but
from PIL import Image
from scenes import write_woodscape

from darswin import lens as lenses
from darswin.boxes import decode_rle, encode_rle, iou
from darswin.cli import warp as module
from darswin.cli.main import main
from darswin.data.labels import read_coco, read_yolo
from darswin.views import make_view
from darswin.views.registry import flat_views

SIZE = (300, 400)
FLAT = json.dumps({"model": "Perspective", "fov_deg": 70})
WIDE = json.dumps({"model": "Equidistant", "fov_deg": 110, "image_size": [400, 400]})
VIEWS = [*sorted(set(flat_views()) - {"panorama"}), "tiles:4", "tiles:5"]


def blob(rng, size=SIZE, largest=60):
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    radius = 1 + 0.2 * np.cos(3 * angle + rng.uniform(0, 7)) + 0.1 * np.cos(2 * angle)
    shape = radius[:, None] * np.stack((np.cos(angle), np.sin(angle)), -1)
    middle = rng.uniform(0.25, 0.75, 2) * size[::-1]
    return middle + rng.uniform(20, largest) * shape


def box_of(points):
    low, high = points.min(0), points.max(0)
    return [*low.tolist(), *(high - low).tolist()]


def drawn(polygons, size, fine=4):
    points = [np.round((p * fine - 0.5) * 16).astype(np.int32) for p in polygons]
    mask = cv2.fillPoly(np.zeros(np.array(size) * fine, np.uint8), points, 255, shift=4)
    return cv2.resize(mask, size[::-1], interpolation=cv2.INTER_AREA)


def write_set(folder, count=3, forms=("polygon", "mask", "box"), suffix=".png", seed=0):
    """A COCO set. Each picture has one white thing on black for each of three channels."""
    rng = np.random.default_rng(seed)
    images, annotations = [], []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for k in range(count):
        planes = []
        for j in range(3):
            outline = blob(rng)
            mask = drawn([outline], SIZE)
            planes.append(mask)
            entry = {"id": len(annotations) + 1, "image_id": k, "category_id": 1 + j, "iscrowd": 0}
            entry |= {"bbox": box_of(outline), "area": 1.0}
            form = forms[(j + k) % len(forms)]
            if form == "polygon":
                entry["segmentation"] = [outline.ravel().tolist()]
            if form == "mask":
                entry["segmentation"] = encode_rle(mask > 127)
            annotations.append(entry)
        images.append({"id": k, "file_name": f"{k}{suffix}", "height": SIZE[0], "width": SIZE[1]})
        cv2.imwrite(str(folder / "images" / f"{k}{suffix}"), np.stack(planes[::-1], -1))
    categories = [{"id": 1 + j, "name": name} for j, name in enumerate("abc")]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (folder / "instances.json").write_text(json.dumps(content))
    return folder / "instances.json"


def warp(source, out, to, *options):
    main(["warp", str(source), "--to", to, "--out", str(out), *map(str, options)])
    return out / "annotations.json"


def check_shown(file, box_overlap, mask_overlap):
    """Every label lies on its thing in the new picture. Returns how many things there are."""
    data, count = read_coco(file), 0
    for k, name in enumerate(data.files):
        picture = cv2.imread(str(data.folder / name))[..., ::-1]
        for thing in data.labels(k).things:
            shown = picture[..., thing.category - 1] > 127
            if thing.visible < 0.98 or shown.sum() < 100:
                continue
            count += 1
            y, x = np.nonzero(shown)
            box = [[x.min(), y.min(), x.max() + 1, y.max() + 1]]
            assert iou(thing.box[None], box)[0, 0] > box_overlap, (name, thing)
            if thing.rle is not None:
                mask = decode_rle(thing.rle)
            elif len(thing.polygons):
                mask = drawn(thing.polygons, picture.shape[:2]) > 127
            else:
                continue
            assert (mask & shown).sum() / (mask | shown).sum() > mask_overlap, (name, thing)
    return count


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("flat"))


@pytest.fixture(scope="module")
def wide(flat, tmp_path_factory):
    """The same set through a fisheye lens."""
    return warp(flat, tmp_path_factory.mktemp("wide") / "out", WIDE, "--lens", FLAT)


def test_a_perspective_set_becomes_a_fisheye_set(wide, capsys):
    out = wide.parent
    assert check_shown(wide, 0.75, 0.95) == 9
    assert (out / "images" / "0.png").is_file() and (out / "warp.json").is_file()
    camera = lenses.load(out / "lens.json")
    assert type(camera).__name__ == "Equidistant" and camera.image_size.tolist() == [[400, 400]]
    assert json.loads((out / "left.json").read_text()) == []
    content = json.loads(wide.read_text())
    assert [one["id"] for one in content["annotations"]] == list(range(1, 10))
    assert [c["name"] for c in content["categories"]] == ["a", "b", "c"]


@pytest.mark.parametrize(
    "lens",
    [
        {"model": "Perspective", "fov_deg": 70},
        {"model": "BrownConrady", "focal": 214.0, "radial": [-0.05, 0.01]},
    ],
)
def test_a_flat_picture_is_used_up_to_its_corners(flat, tmp_path, lens):
    """θ_max of such a lens is that of a side; a pinhole camera has no image circle."""
    corner = {"bbox": [1, 1, 30, 20]}
    source = edited(flat, tmp_path, lambda c: c["annotations"][0].update(segmentation=[], **corner))
    wide = json.dumps({"model": "Equidistant", "fov_deg": 130, "image_size": [400, 400]})
    file = warp(source, tmp_path / "out", wide, "--lens", json.dumps(lens))
    first = json.loads(file.read_text())["annotations"][0]
    assert first["id"] == 1 and first["visible"] == 1
    picture = cv2.imread(str(tmp_path / "out" / "images" / "0.png"))
    assert picture.shape == (400, 400, 3)


@pytest.mark.parametrize("view", slow_but(VIEWS, "mercator", "square", "tiles:5"))
def test_a_fisheye_set_in_every_view(wide, tmp_path, view, capsys):
    size = "256,320" if view != "square" else "300,300"
    file = warp(wide, tmp_path / "out", view, "--size", size)
    tiles = int(view[-1]) if ":" in view else 1
    data = read_coco(file)
    assert len(data) == 3 * tiles and f"{3 * tiles} pictures of 3" in capsys.readouterr().out
    assert check_shown(file, 0.6, 0.9) >= (9 if tiles == 1 else 5)
    said = json.loads((tmp_path / "out" / "view.json").read_text())
    assert said["view"] == view and len(said["lenses"]) == 1
    if tiles > 1:
        assert {entry["source"] for entry in data.entries} == {"0.png", "1.png", "2.png"}
        assert data.files[1] == "0_1.png"


def test_a_view_level_with_gravity(wide, tmp_path):
    """The camera looks down by 40°, so that the panorama shows what is below the horizon."""
    up = f"0,{-np.cos(0.7):.4f},{-np.sin(0.7):.4f}"
    file = warp(wide, tmp_path / "out", "panorama", "--size", "300,900", "--up", up)
    assert check_shown(file, 0.6, 0.85) >= 3
    assert json.loads((tmp_path / "out" / "view.json").read_text())["up"][1] < 0


def test_there_and_back(tmp_path):
    """Polygons come back within half a pixel, and bare boxes as the measured mean says."""
    source = write_set(tmp_path / "in", 4, ("polygon", "box"), ".jpg", seed=3)
    wide = warp(source, tmp_path / "wide", WIDE, "--lens", FLAT)
    back = warp(wide, tmp_path / "back", FLAT, "--size", "300,400")
    before, after = (json.loads(file.read_text())["annotations"] for file in (source, back))
    overlaps = []
    for old, new in zip(before, after, strict=True):
        assert (old["id"], old["category_id"]) == (new["id"], new["category_id"])
        assert new["visible"] == 1
        if "segmentation" in old:
            np.testing.assert_allclose(new["bbox"], old["bbox"], atol=1)  # 0.5 px at each side
        else:
            corners = np.array([old["bbox"], new["bbox"]])
            corners[:, 2:] += corners[:, :2]
            overlaps.append(iou(corners[:1], corners[1:])[0, 0])
    assert len(overlaps) == 6 and np.mean(overlaps) > 0.965


def test_woodscape_becomes_tiles(tmp_path):
    root = write_woodscape(tmp_path / "woodscape", 4)
    file = warp(root, tmp_path / "out", "tiles:5", "--size", "96,96")
    data = read_coco(file)
    assert len(data) == 20 and {c["name"] for c in data.categories} == {"vehicles"}
    assert any(data.labels(k).things for k in range(20))
    said = json.loads((tmp_path / "out" / "view.json").read_text())
    assert len(said["lenses"]) > 1  # four cameras


def test_yolo_stays_yolo(flat, tmp_path):
    root = tmp_path / "yolo"
    (root / "labels").mkdir(parents=True)
    (root / "images").symlink_to(flat.parent / "images")
    data = read_coco(flat)
    for k, name in enumerate(data.files):
        lines = [
            " ".join([str(t.category - 1), *map(str, (t.polygons[0] / SIZE[::-1]).ravel())])
            for t in data.labels(k).things if len(t.polygons)
        ]  # fmt: skip
        (root / "labels" / name).with_suffix(".txt").write_text("\n".join(lines))
    (root / "data.yaml").write_text(yaml.safe_dump({"names": ["a", "b", "c"]}))
    warp(root, tmp_path / "out", WIDE, "--lens", FLAT)
    found = read_yolo(tmp_path / "out")
    by_coco = read_coco(warp(flat, tmp_path / "coco", WIDE, "--lens", FLAT))
    assert list(found.files) == [f"images/{name}" for name in by_coco.files]
    assert found.lenses is not None and not (tmp_path / "out" / "annotations.json").exists()
    for k in range(3):
        (mine,) = found.labels(k).things
        (same,) = (t for t in by_coco.labels(k).things if len(t.polygons))
        np.testing.assert_allclose(mine.polygons[0], same.polygons[0], atol=2e-3)
        assert mine.category == same.category - 1


def test_things_that_leave_are_reported(flat, tmp_path, capsys):
    narrow = json.dumps({"model": "Perspective", "fov_deg": 20, "image_size": [200, 200]})
    file = warp(flat, tmp_path / "out", narrow, "--lens", FLAT)
    left = json.loads((tmp_path / "out" / "left.json").read_text())
    kept = json.loads(file.read_text())["annotations"]
    assert left and sorted([one["id"] for one in left + kept]) == list(range(1, 10))
    assert set(left[0]) == {"file", "id", "category", "visible", "fits_no_tile"}
    assert max(one["visible"] for one in left) < 0.2 and not left[0]["fits_no_tile"]
    said = capsys.readouterr().out
    assert f"{len(left)} things have left the picture, because less than 20% of them" in said


def test_a_second_run_goes_on(flat, tmp_path, capsys):
    options = (tmp_path / "out", WIDE, "--lens", FLAT)
    file = warp(flat, *options)
    pictures = sorted((tmp_path / "out" / "images").iterdir())
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in pictures}
    text = file.read_text()
    pictures[1].unlink()
    file.unlink()
    (tmp_path / "out" / "images" / ".0.png.xyz.partial").write_text("of a killed run")
    warp(flat, *options)
    assert file.read_text() == text and sorted((tmp_path / "out" / "images").iterdir()) == pictures
    for picture, (changed, content) in before.items():
        assert picture.read_bytes() == content
        assert (picture.stat().st_mtime_ns == changed) == (picture != pictures[1])
    said = refused(flat, tmp_path / "out", FLAT, "--lens", FLAT, "--size", "9,9", capsys=capsys)
    assert said.endswith(
        "out holds other files: give a new or an empty folder, or one of an earlier run of the "
        "same command with the same calibrations, which then goes on"
    )


@pytest.mark.parametrize("given", ["a lens.json beside the labels", "a file", "a table"])
def test_pictures_of_another_calibration_are_not_kept(flat, tmp_path, capsys, given):
    source = edited(flat, tmp_path, lambda content: None)
    calibration, options = tmp_path / "lens.json", ()
    calibration.write_text(FLAT)
    if given == "a file":
        calibration = calibration.rename(tmp_path / "other.json")
        options = ("--lens", calibration)
    if given == "a table":
        (tmp_path / "lenses.json").write_text(json.dumps({".": "lens.json"}))
        options = ("--lens", tmp_path / "lenses.json")
    arguments = source, tmp_path / "out", "mercator", *options, "--size", "32,32"
    warp(*arguments)
    warp(*arguments)
    calibration.write_text(FLAT.replace("70", "90"))
    assert "with the same calibrations" in refused(*arguments, capsys=capsys)


@pytest.mark.slow
def test_several_processes_write_the_same(flat, tmp_path):
    one = warp(flat, tmp_path / "one", "tiles:4", "--lens", FLAT)
    two = warp(flat, tmp_path / "two", "tiles:4", "--lens", FLAT, "--processes", 2)
    assert one.read_bytes() == two.read_bytes()
    for name in read_coco(one).files:
        same = [(folder / "images" / name).read_bytes() for folder in (one.parent, two.parent)]
        assert same[0] == same[1]


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_a_killed_run_leaves_no_half_file(tmp_path, processes):
    source, out = write_set(tmp_path / "in", 40), tmp_path / "out"
    command = [sys.executable, "-m", "darswin", "warp", str(source), "--to", WIDE, "--out",
               str(out), "--lens", FLAT, "--processes", str(processes)]  # fmt: skip
    run = subprocess.Popen(command)
    while len(list(out.glob("images/*.png"))) < 5:
        assert run.poll() is None
        time.sleep(0.01)
    run.send_signal(signal.SIGKILL)
    run.wait()
    time.sleep(1)  # the other processes die too
    there = list(out.glob("images/*.png"))
    for picture in there:
        assert cv2.imread(str(picture)) is not None
    time.sleep(1)
    assert len(list(out.glob("images/*.png"))) == len(there)
    subprocess.run(command, check=True)
    assert len(read_coco(out / "annotations.json")) == 40
    assert not list(out.rglob("*.partial"))


# -- wrong input ----------------------------------------------------------------------------------


def refused(source, out, to, *options, capsys):
    with pytest.raises(SystemExit) as error:
        warp(source, out, to, *options)
    assert error.value.code == 2
    return capsys.readouterr().err.strip()


def edited(flat, folder, edit):
    content = json.loads(flat.read_text())
    edit(content)
    (folder / "images").symlink_to(flat.parent / "images")
    (folder / "edited.json").write_text(json.dumps(content))
    return folder / "edited.json"


def test_what_cannot_be_read_is_named_at_the_end(flat, tmp_path, capsys):
    """A bad annotation does not take its picture away, and a missing picture no other."""

    def edit(content):
        content["annotations"][0].update(bbox=[0, 0, None, 1])
        content["annotations"][1].update(category_id=9)
        content["images"][1].update(height=9)
        content["images"][2].update(file_name="no.png")

    source = edited(flat, tmp_path, edit)
    text = refused(source, tmp_path / "out", WIDE, "--lens", FLAT, capsys=capsys)
    assert "1 of 2 pictures were left out" in text and "3 pictures and annotations of" in text
    for said in ("1.png has 400 × 9 px", "no picture no.png", "annotation 1 has the box",
                 "annotation 2 has the category 9"):  # fmt: skip
        assert said in text
    data = read_coco(tmp_path / "out" / "annotations.json")
    assert [thing.more["id"] for thing in data.labels(0).things] == [3] and len(data) == 1


@pytest.mark.parametrize(("shares", "said"), [((0.1, 0.15), "too large for"), ((0.1, 0), "left")])
def test_what_no_tile_shows_is_named_as_what_it_is(
    flat, tmp_path, capsys, monkeypatch, shares, said
):
    def lost(things, move):
        given = (*shares, 0.0, 0.0)[len(calls) % 4]
        calls.append(move)
        return [replace(thing, visible=given) for thing in things]

    calls = []
    monkeypatch.setattr(module, "move_things", lost)
    warp(flat, tmp_path / "out", "tiles:4", "--size", "32,32", "--lens", FLAT)
    assert f"9 things {'are' if 'large' in said else 'have'} {said} the" in capsys.readouterr().out


LAYOUTS = {
    "images/train": ("images/train", "images/val",
                     {"train": "images/train", "val": ["images/val"], "test": "images/test"}),
    "train/images": ("train/images", "valid/images",
                     {"train": "../train/images", "val": "../valid/images"}),
    "lists": ("images/train", "images/val",
              {"path": "../in", "train": "train.txt", "val": "sub/val.txt"}),
    "only names": ("images/train", "images/val", {}),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_splits_of_yolo_stay_apart(tmp_path, layout, capsys):
    root, out = tmp_path / "in", tmp_path / "out"
    *folders, splits = LAYOUTS[layout]
    content = {"flip_idx": [0, 2, 1], "nc": 1, "names": {0: "cone"}}
    files = [f"{folder}/{name}.png" for folder, name in zip(folders, "ab", strict=True)]
    for file in files:
        text = (root / file.replace("images", "labels")).with_suffix(".txt")
        for parent in ((root / file).parent, text.parent, root / "sub"):
            parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / file), np.zeros((60, 80, 3), np.uint8))
        text.write_text("0 0.5 0.5 0.3 0.3\n")
    (root / "train.txt").write_text(f"./{files[0]}\n")
    (root / "sub/val.txt").write_text(f"{root / files[1]}\nnowhere.png\n")
    (root / "data.yaml").write_text(yaml.safe_dump(splits | content))
    warp(root / "data.yaml", out, "tiles:4", "--lens", FLAT, "--size", "32,32")
    found = yaml.safe_load((out / "data.yaml").read_text())
    assert {name: found[name] for name in content} == content
    assert ("left out of data.yaml" in capsys.readouterr().out) == ("test" in splits)
    want = {name: value for name, value in splits.items() if name not in ("path", "test")}
    if layout == "train/images":
        want = {name: value.removeprefix("../") for name, value in want.items()}
    assert {name: found[name] for name in ("train", "val", "test") if name in found} == want
    assert len(list(out.rglob("a_?.png"))) == len(list(out.rglob("b_?.txt"))) == 4
    if layout == "lists":
        names = [f"./images/val/b_{k}.png" for k in range(4)]
        assert (out / "sub/val.txt").read_text().split() == names


def test_two_pictures_never_become_one(tmp_path, capsys):
    source = write_set(tmp_path / "in", 2, ("box",))
    folder = source.parent / "images"
    (folder / "0.png").rename(folder / "0.gif.png")
    Image.fromarray(np.zeros((*SIZE, 3), np.uint8)).save(folder / "0.gif")
    content = json.loads(source.read_text())
    for entry, name in zip(content["images"], ("0.gif.png", "0.gif"), strict=True):
        entry["file_name"] = name
    source.write_text(json.dumps(content))
    text = refused(source, tmp_path / "out", WIDE, "--lens", FLAT, capsys=capsys)
    assert "0.gif.png and 0.gif would both become 0.gif.png: rename one" in text


def test_a_view_that_sees_nothing_of_the_lens(flat, tmp_path, capsys, monkeypatch):
    behind = make_view("mercator", (64, 64), fov=0.5, direction=(0, 0, -1))
    monkeypatch.setattr(module, "named_view", lambda *_, **options: behind)
    text = refused(flat, tmp_path / "out", "mercator", "--lens", FLAT, capsys=capsys)
    assert "3 of 3 pictures were left out" in text and text.count("\n") == 3, text
    assert all(f"{k}.png: this view sees nothing of the lens" in text for k in range(3))


def test_no_things_at_all(flat, tmp_path, capsys):
    source = edited(flat, tmp_path, lambda c: c["annotations"].clear())
    file = warp(source, tmp_path / "out", WIDE, "--lens", FLAT)
    assert "3 pictures of 3, with 0 things" in capsys.readouterr().out
    assert json.loads(file.read_text())["annotations"] == []


def test_many_errors_are_counted(tmp_path, capsys):
    source = write_set(tmp_path / "in", 12)
    for picture in (tmp_path / "in" / "images").iterdir():
        picture.write_bytes(b"no picture")
    text = refused(source, tmp_path / "out", WIDE, "--lens", FLAT, capsys=capsys)
    assert text.count("cannot read") == 10 and text.endswith("and 2 more")


@pytest.mark.parametrize("to", [WIDE, "tiles:4"])
def test_grey_pictures_stay_grey(tmp_path, to):
    source = write_set(tmp_path / "in", 1)
    picture = tmp_path / "in" / "images" / "0.png"
    cv2.imwrite(str(picture), cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE))
    warp(source, tmp_path / "out", to, "--lens", FLAT)
    for new in (tmp_path / "out" / "images").iterdir():
        assert cv2.imread(str(new), cv2.IMREAD_UNCHANGED).ndim == 2


def test_the_folder_of_the_pictures(flat, tmp_path, monkeypatch):
    (tmp_path / "labels.json").write_text(flat.read_text())
    warp(tmp_path / "labels.json", tmp_path / "out", WIDE, "--lens", FLAT, "--pictures",
         flat.parent / "images")  # fmt: skip
    assert len(os.listdir(tmp_path / "out" / "images")) == 3
    monkeypatch.chdir(Path(flat).parent)
    main(["warp", "instances.json", "--to", WIDE, "--out", str(tmp_path / "2"), "--lens", FLAT])
