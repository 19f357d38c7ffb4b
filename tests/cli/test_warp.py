"""`darswin warp`: pictures and labels move together; the pictures show where things are."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from helpers import ended, slow_but
from PIL import Image
from scenes import drawn, write_woodscape

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


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def warp(source, to, options="", out="out", lens=FLAT):
    given = [] if lens is None else ["--lens", lens]
    main(["warp", str(source), "--to", to, "--out", str(out), *given, *options.split()])
    return Path(out, "annotations.json")


def refused(capsys, *arguments, **options):
    """What the command says when it ends with exit code 2."""
    return ended(capsys, 2, warp, *arguments, **options).err.strip()


def blob(rng):
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    radius = 1 + 0.2 * np.cos(3 * angle + rng.uniform(0, 7)) + 0.1 * np.cos(2 * angle)
    shape = radius[:, None] * np.stack((np.cos(angle), np.sin(angle)), -1)
    return rng.uniform(0.25, 0.75, 2) * SIZE[::-1] + rng.uniform(20, 60) * shape


def write_set(folder, count=3, forms=("polygon", "mask", "box"), suffix=".png", seed=0):
    """A COCO set. Each picture has one white thing on black for each of three channels."""
    rng = np.random.default_rng(seed)
    images, annotations = [], []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for k in range(count):
        planes = []
        for j in range(3):
            outline = blob(rng)
            planes.append(drawn([outline], SIZE))
            entry = {"id": len(annotations) + 1, "image_id": k, "category_id": 1 + j, "iscrowd": 0}
            entry |= {"bbox": [*outline.min(0), *np.ptp(outline, 0)], "area": 1.0}
            form = forms[(j + k) % len(forms)]
            if form == "polygon":
                entry["segmentation"] = [outline.ravel().tolist()]
            if form == "mask":
                entry["segmentation"] = encode_rle(planes[-1] > 127)
            annotations.append(entry)
        images.append({"id": k, "file_name": f"{k}{suffix}", "height": SIZE[0], "width": SIZE[1]})
        cv2.imwrite(str(folder / "images" / f"{k}{suffix}"), np.stack(planes[::-1], -1))
    categories = [{"id": 1 + j, "name": name} for j, name in enumerate("abc")]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (folder / "instances.json").write_text(json.dumps(content))
    return folder / "instances.json"


def edited(flat, edit=lambda content: None):
    """The set with its pictures, whose content is changed."""
    content = json.loads(flat.read_text())
    edit(content)
    Path("images").symlink_to(flat.parent / "images")
    Path("edited.json").write_text(json.dumps(content))
    return "edited.json"


def check_shown(file, box_overlap, mask_overlap):
    """Every label lies on its thing in the new picture. Returns how many there are."""
    data, count = read_coco(file), 0
    for k, name in enumerate(data.files):
        picture = cv2.imread(str(data.folder / name))[..., ::-1]
        for instance in data.labels(k).instances:
            shown = picture[..., instance.labels[0] - 1] > 127
            if instance.more["visible"][0] < 0.98 or shown.sum() < 100:
                continue
            count += 1
            y, x = np.nonzero(shown)
            box = [[x.min(), y.min(), x.max() + 1, y.max() + 1]]
            assert iou(instance.boxes, box)[0, 0] > box_overlap, (name, instance)
            if instance.masks[0] is not None:
                mask = decode_rle(instance.masks[0])
            elif len(instance.outlines[0]):
                mask = drawn(instance.outlines[0], picture.shape[:2]) > 127
            else:
                continue
            assert (mask & shown).sum() / (mask | shown).sum() > mask_overlap, (name, instance)
    return count


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("flat"))


@pytest.fixture(scope="module")
def wide(flat, tmp_path_factory):
    """The same set through a fisheye lens."""
    return warp(flat, WIDE, out=tmp_path_factory.mktemp("wide") / "out")


def test_a_perspective_set_becomes_a_fisheye_set(wide):
    assert check_shown(wide, 0.75, 0.95) == 9
    assert (wide.parent / "images" / "0.png").is_file() and (wide.parent / "warp.json").is_file()
    camera = lenses.load(wide.parent / "lens.json")
    assert type(camera).__name__ == "Equidistant" and camera.image_size.tolist() == [[400, 400]]
    assert json.loads((wide.parent / "left.json").read_text()) == []
    content = json.loads(wide.read_text())
    assert [one["id"] for one in content["annotations"]] == list(range(1, 10))
    assert [c["name"] for c in content["categories"]] == ["a", "b", "c"]


@pytest.mark.parametrize(
    "lens",
    [{"model": "Perspective", "fov_deg": 70},
     {"model": "BrownConrady", "focal": 214.0, "radial": [-0.05, 0.01]}],
)  # fmt: skip
def test_a_flat_picture_is_used_up_to_its_corners(flat, lens):
    """θ_max of such a lens is that of a side; a pinhole camera has no image circle."""
    corner = {"bbox": [1, 1, 30, 20], "segmentation": []}
    source = edited(flat, lambda content: content["annotations"][0].update(corner))
    wide = json.dumps({"model": "Equidistant", "fov_deg": 130, "image_size": [400, 400]})
    first = json.loads(warp(source, wide, lens=json.dumps(lens)).read_text())["annotations"][0]
    assert first["id"] == 1 and first["visible"] == 1
    assert cv2.imread("out/images/0.png").shape == (400, 400, 3)


@pytest.mark.parametrize("view", slow_but(VIEWS, "mercator", "square", "tiles:5"))
def test_a_fisheye_set_in_every_view(wide, view, capsys):
    size = "256,320" if view != "square" else "300,300"
    file = warp(wide, view, f"--size {size}", lens=None)
    tiles = int(view[-1]) if ":" in view else 1
    data = read_coco(file)
    assert len(data) == 3 * tiles and f"{3 * tiles} pictures of 3" in capsys.readouterr().out
    assert check_shown(file, 0.6, 0.9) >= (9 if tiles == 1 else 5)
    said = json.loads(Path("out/view.json").read_text())
    assert said["view"] == view and len(said["lenses"]) == 1
    if tiles > 1:
        assert {entry["source"] for entry in data.entries} == {"0.png", "1.png", "2.png"}
        assert data.files[1] == "0_1.png"


def test_a_view_level_with_gravity(wide):
    """The camera looks down by 40°, so that the panorama shows what is below the horizon."""
    up = f"0,{-np.cos(0.7):.4f},{-np.sin(0.7):.4f}"
    file = warp(wide, "panorama", f"--size 300,900 --up {up}", lens=None)
    assert check_shown(file, 0.6, 0.85) >= 3
    assert json.loads(Path("out/view.json").read_text())["up"][1] < 0


def test_there_and_back():
    """Polygons come back within half a pixel, and bare boxes as the measured mean says."""
    source = write_set(Path("in"), 4, ("polygon", "box"), ".jpg", seed=3)
    back = warp(warp(source, WIDE, out="wide"), FLAT, "--size 300,400", lens=None)
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


def test_woodscape_becomes_tiles():
    root = write_woodscape(Path("woodscape"), 4)
    data = read_coco(warp(root, "tiles:5", "--size 96,96", lens=None))
    assert len(data) == 20 and {c["name"] for c in data.categories} == {"vehicles"}
    assert any(len(data.labels(k).instances) for k in range(20))
    assert len(json.loads(Path("out/view.json").read_text())["lenses"]) > 1  # four cameras


def test_yolo_stays_yolo(flat):
    Path("yolo/labels").mkdir(parents=True)
    Path("yolo/images").symlink_to(flat.parent / "images")
    data = read_coco(flat)
    for k, name in enumerate(data.files):
        lines = [
            " ".join([str(t.labels[0] - 1), *map(str, (t.outlines[0][0] / SIZE[::-1]).ravel())])
            for t in data.labels(k).instances if len(t.outlines[0])
        ]  # fmt: skip
        Path("yolo/labels", name).with_suffix(".txt").write_text("\n".join(lines))
    Path("yolo/data.yaml").write_text(yaml.safe_dump({"names": ["a", "b", "c"]}))
    warp("yolo", WIDE)
    found, by_coco = read_yolo(Path("out")), read_coco(warp(flat, WIDE, out="coco"))
    assert list(found.files) == [f"images/{name}" for name in by_coco.files]
    assert found.lenses is not None and not Path("out/annotations.json").exists()
    for k in range(3):
        (mine,) = found.labels(k).instances
        (same,) = (t for t in by_coco.labels(k).instances if len(t.outlines[0]))
        np.testing.assert_allclose(mine.outlines[0], same.outlines[0], atol=2e-3)
        assert mine.labels == same.labels - 1


def test_things_that_leave_are_reported(flat, capsys):
    narrow = json.dumps({"model": "Perspective", "fov_deg": 20, "image_size": [200, 200]})
    kept = json.loads(warp(flat, narrow).read_text())["annotations"]
    left = json.loads(Path("out/left.json").read_text())
    assert left and sorted([one["id"] for one in left + kept]) == list(range(1, 10))
    assert set(left[0]) == {"file", "id", "category", "visible", "fits_no_tile"}
    assert max(one["visible"] for one in left) < 0.2 and not left[0]["fits_no_tile"]
    said = capsys.readouterr().out
    assert f"{len(left)} instances left the picture, because less than 20% of them" in said


def test_a_second_run_goes_on(flat, capsys):
    file = warp(flat, WIDE)
    pictures = sorted(Path("out/images").iterdir())
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in pictures}
    text = file.read_text()
    pictures[1].unlink()
    file.unlink()
    Path("out/images/.0.png.xyz.partial").write_text("of a killed run")
    warp(flat, WIDE)
    assert file.read_text() == text and sorted(Path("out/images").iterdir()) == pictures
    for picture, (changed, content) in before.items():
        assert picture.read_bytes() == content
        assert (picture.stat().st_mtime_ns == changed) == (picture != pictures[1])
    said = refused(capsys, flat, FLAT, "--size 9,9")
    assert "one of an earlier run of the same command with the same calibrations" in said


@pytest.mark.parametrize(
    ("calibration", "lens"),
    [("lens.json", None), ("other.json", "other.json"), ("lens.json", "lenses.json")],
)
def test_pictures_of_another_calibration_are_not_kept(flat, capsys, calibration, lens):
    """One beside the labels, one that is given, and one in a table."""
    source = edited(flat)
    Path(calibration).write_text(FLAT)
    Path("lenses.json").write_text(json.dumps({".": "lens.json"}))
    for _ in range(2):
        warp(source, "mercator", "--size 32,32", lens=lens)
    Path(calibration).write_text(FLAT.replace("70", "90"))
    said = refused(capsys, source, "mercator", "--size 32,32", lens=lens)
    assert "with the same calibrations" in said


@pytest.mark.slow
def test_several_processes_write_the_same(flat):
    one, two = warp(flat, "tiles:4", out="1"), warp(flat, "tiles:4", "--processes 2", out="2")
    assert one.read_bytes() == two.read_bytes()
    for name in read_coco(one).files:
        assert Path("1/images", name).read_bytes() == Path("2/images", name).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_a_killed_run_leaves_no_half_file(processes):
    write_set(Path("in"), 40)
    command = [sys.executable, "-m", "darswin", "warp", "in/instances.json", "--to", WIDE, "--out",
               "out", "--lens", FLAT, "--processes", str(processes)]  # fmt: skip
    run, out = subprocess.Popen(command), Path("out")
    while len(list(out.glob("images/*.png"))) < 5:
        assert run.poll() is None
        time.sleep(0.01)
    run.send_signal(signal.SIGKILL)
    run.wait()
    time.sleep(1)  # the other processes die too
    pictures = list(out.glob("images/*.png"))
    assert all(cv2.imread(str(picture)) is not None for picture in pictures)
    time.sleep(1)
    assert len(list(out.glob("images/*.png"))) == len(pictures)
    subprocess.run(command, check=True)
    assert len(read_coco(out / "annotations.json")) == 40
    assert not list(out.rglob("*.partial"))


# -- wrong or unusual input -----------------------------------------------------------------------


def test_what_cannot_be_read_is_named_at_the_end(flat, capsys):
    """A bad annotation does not take its picture away, and a missing picture no other."""

    def edit(content):
        content["annotations"][0].update(bbox=[0, 0, None, 1])
        content["annotations"][1].update(category_id=9)
        content["images"][1].update(height=9)
        content["images"][2].update(file_name="no.png")

    said = refused(capsys, edited(flat, edit), WIDE)
    for words in (
        "left out: 1 of 2 pictures", "left out: 3 of the", "1.png has 9 × 400,",
        "no picture no.png", "annotation 1 has the box", "annotation 2 has the category 9",
    ):  # fmt: skip
        assert words in said
    data = read_coco("out/annotations.json")
    entries = data.labels(0).instances.more["entry"]
    assert [entry["id"] for entry in entries] == [3] and len(data) == 1


@pytest.mark.parametrize(("shares", "said"), [((0.1, 0.15), "too large for"),
                                              ((0.1, 0), "left")])  # fmt: skip
def test_what_no_tile_shows_is_named_as_what_it_is(flat, capsys, monkeypatch, shares, said):
    def lost(instances, move):
        visible = (*shares, 0.0, 0.0)[len(calls) % 4]
        calls.append(move)
        return instances.with_columns(visible=np.full(len(instances), visible))

    calls = []
    monkeypatch.setattr(module, "move_instances", lost)
    warp(flat, "tiles:4", "--size 32,32")
    assert f"9 instances {said} the" in capsys.readouterr().out


LAYOUTS = {
    "images/train": ("images/train", "images/val",
                     {"train": "images/train", "val": ["images/val"], "test": "images/test"}),
    "train/images": ("train/images", "valid/images",
                     {"train": "..\\train\\images", "val": "../valid/images"}),
    "lists": ("images/train", "images/val",
              {"path": "../in", "train": "train.txt", "val": "sub/val.txt"}),
    "only names": ("images/train", "images/val", {}),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_splits_of_yolo_stay_apart(layout, capsys):
    *folders, splits = LAYOUTS[layout]
    content = {"flip_idx": [0, 2, 1], "nc": 1, "names": {0: "cone"}}
    root, out = Path("in"), Path("out")
    files = [f"{folder}/{name}.png" for folder, name in zip(folders, "ab", strict=True)]
    for file in files:
        text = (root / file.replace("images", "labels")).with_suffix(".txt")
        for parent in ((root / file).parent, text.parent, root / "sub"):
            parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(root / file), np.zeros((60, 80, 3), np.uint8))
        text.write_text("0 0.5 0.5 0.3 0.3\n")
    (root / "train.txt").write_text(f"./{files[0]}\r\n".replace("/", "\\"))
    (root / "sub/val.txt").write_text(f"{root.absolute() / files[1]}\n\n")
    (root / "data.yaml").write_text(yaml.safe_dump(splits | content))
    warp(root / "data.yaml", "tiles:4", "--size 32,32")
    found = yaml.safe_load((out / "data.yaml").read_text())
    assert {name: found[name] for name in content} == content
    assert ("left out of data.yaml" in capsys.readouterr().out) == ("test" in splits)
    want = {name: value for name, value in splits.items() if name not in ("path", "test")}
    if layout == "train/images":
        want = {"train": "train/images", "val": "valid/images"}
    assert {name: found[name] for name in ("train", "val", "test") if name in found} == want
    assert len(list(out.rglob("a_?.png"))) == len(list(out.rglob("b_?.txt"))) == 4
    if layout == "lists":
        names = [f"./images/val/b_{k}.png" for k in range(4)]
        assert (out / "sub/val.txt").read_text().split() == names


def test_what_yolo_lists_in_vain_is_named(capsys):
    """Lines of another machine, texts without a picture, and keypoints that kpt_shape has not."""
    for folder in ("images", "labels"):
        Path("in", folder).mkdir(parents=True)
    for name in ("a", "b#1"):
        cv2.imwrite(f"in/images/{name}.png", np.zeros((60, 80, 3), np.uint8))
    Path("in/labels/a.txt").write_text("0 .5 .5 .3 .3 .5 .5 2\n0 .5 .5 .3 .3 .5 .5 2 .4 .4 2")
    Path("in/labels/b_1.txt").write_text("0 .5 .5 .3 .3 .5 .5 2")
    Path("in/labels/notes.txt").write_text("0 of 5")
    Path("in/train.txt").write_text("C:\\set\\images\\a.png\nimages/a.png\n")
    shape = {"kpt_shape": [2, 3], "names": ["hand"]}
    Path("in/data.yaml").write_text(yaml.safe_dump(shape | {"train": "train.txt"}))
    said = refused(capsys, "in", WIDE)
    for words in ("out: 3 of", "a.txt, line 1 must be", "b_1.txt has 1 label,", "not in in, ['C:"):
        assert words in said
    assert Path("out/train.txt").read_text() == "./images/a.png\n"
    assert yaml.safe_load(Path("out/data.yaml").read_text())["kpt_shape"] == [2, 3]
    assert len(Path("out/labels/a.txt").read_text().splitlines()) == 1


def test_two_pictures_never_become_one(capsys):
    source = write_set(Path("in"), 2, ("box",))
    Path("in/images/0.png").rename("in/images/0.gif.png")
    Image.fromarray(np.zeros((*SIZE, 3), np.uint8)).save("in/images/0.gif")
    source.write_text(source.read_text().replace("0.png", "0.gif.png").replace("1.png", "0.gif"))
    said = refused(capsys, source, WIDE)
    assert "0.gif.png and 0.gif would both become 0.gif.png: rename one" in said


def test_a_view_that_sees_nothing_of_the_lens(flat, capsys, monkeypatch):
    behind = make_view("mercator", (64, 64), fov=0.5, direction=(0, 0, -1))
    monkeypatch.setattr(module, "named_view", lambda *_, **options: behind)
    said = refused(capsys, flat, "mercator")
    assert "left out: 3 of 3 pictures" in said and said.count("\n") == 3
    assert all(f"{k}.png: this view sees nothing of the lens" in said for k in range(3))


def test_many_errors_are_counted(capsys):
    source = write_set(Path("in"), 12)
    for picture in Path("in/images").iterdir():
        picture.write_bytes(b"no picture")
    said = refused(capsys, source, WIDE)
    assert said.count("cannot read") == 10 and said.endswith("and 2 more")


@pytest.mark.parametrize(("to", "count"), [(WIDE, 1), ("tiles:4", 4)])
def test_grey_pictures_without_things(to, count, capsys):
    source = edited(write_set(Path("in"), 1), lambda content: content["annotations"].clear())
    grey = cv2.imread("images/0.png", cv2.IMREAD_GRAYSCALE)
    cv2.imwrite("images/0.png", grey)
    file = warp(source, to)
    assert f"{count} picture{'s' * (count > 1)} of 1, with 0 instances" in capsys.readouterr().out
    assert json.loads(file.read_text())["annotations"] == []
    for new in Path("out/images").iterdir():
        assert cv2.imread(str(new), cv2.IMREAD_UNCHANGED).ndim == 2


def test_where_labels_and_pictures_are(flat, monkeypatch):
    """In a folder with a COCO file, and in the current one; the contract has --pictures."""
    Path("set/annotations").mkdir(parents=True)
    Path("set/images").symlink_to(flat.parent / "images")
    Path("set/annotations/instances.json").write_text(flat.read_text())
    assert len(read_coco(warp("set", WIDE))) == 3
    out = Path("2").absolute()
    monkeypatch.chdir(flat.parent)
    assert len(read_coco(warp("instances.json", WIDE, out=out))) == 3
