"""`darswin predict --network`: what a network of a known answer finds, at its exact place."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import refused, save_picture, slow_but
from PIL import Image

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from graphs import write_constants, write_detector, write_graph

from darswin.boxes import Instances, decode_rle, encode_rle
from darswin.cli.main import main
from darswin.cli.names import read_names
from darswin.cli.network import NetworkAnswers, rounded
from darswin.data.labels.yolo import yolo_lines
from darswin.frames.onnx import OnnxNetwork
from darswin.lens import Equidistant
from darswin.utils.video import write_frames
from darswin.views import make_view

SIZE = (240, 320)
CENTER = [163.0, 117.0]
NAMES = ["red", "green", "blue"]
RADIUS = 7.0  # degrees, of the discs that are to be found
WIDE = {
    "model": "Equidistant", "focal": 88.0, "theta_max": math.radians(95), "center": CENTER,
    "image_size": [*SIZE],
}  # fmt: skip
KANNALA = WIDE | {"model": "KannalaBrandt", "focal": 95.0, "theta_max": 1.5,
                  "radial": [0.02, -0.01, 0.003, -0.0005]}  # fmt: skip
SMALL = {"model": "Equidistant", "focal": 24.0, "image_size": [64, 80], "theta_max": 1.2}
F = np.float32


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def direction_of(azimuth, elevation):
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    level = math.cos(elevation)
    return np.array([level * math.sin(azimuth), -math.sin(elevation), level * math.cos(azimuth)])


def disc_at(place, channel=1, lens=WIDE):
    """A picture through a lens, by OpenCV, with a disc at a place in degrees; and its box."""
    direction, angle = direction_of(*place), math.radians(RADIUS)
    aside = np.cross(direction, (0, 1, 0))
    aside /= np.linalg.norm(aside)
    other, turn = np.cross(direction, aside), np.linspace(0, 2 * np.pi, 720)[:, None]
    rim = np.cos(turn) * aside + np.sin(turn) * other
    rim = math.cos(angle) * direction + math.sin(angle) * rim
    camera = np.array([[lens["focal"], 0, CENTER[0]], [0, lens["focal"], CENTER[1]], [0, 0, 1]])
    radial = np.array(lens.get("radial", [0.0] * 4))
    points, _ = cv2.fisheye.projectPoints(rim[None], np.zeros(3), np.zeros(3), camera, radial)
    picture = np.zeros((*SIZE, 3), np.uint8)
    picture[..., channel] = 20
    color = [255 * (k == channel) for k in range(3)]
    cv2.fillPoly(picture, [np.rint(16 * points[0]).astype(np.int32)], color, shift=4)
    return picture, np.concatenate((points[0].min(0), points[0].max(0))) + 0.5


def predict(command, lens=WIDE):
    main(["predict", *command.split(), "--lens", json.dumps(lens), "--out", "out"])
    return json.loads(Path("out/predictions.json").read_text())


@pytest.fixture
def disc():
    """A picture p.png with a green disc where two tiles overlap, and a network; gives its box."""
    picture, box = disc_at((36, -8))
    save_picture("p.png", picture)
    write_graph(Path("n.onnx"), size=(256, 256))
    return box


# By how many pixels of the picture a box may be wrong: less than one and a half pixels of the view,
# and more where a view does not show discs as upright ellipses.
@pytest.mark.parametrize(
    ("view", "size", "lens", "tolerance"),
    slow_but(
        [("none", SIZE, KANNALA, 1.1), ("tiles:5", (256, 256), WIDE, 1.8),
         ("mercator", (256, 384), KANNALA, 1.5), ("tiles:9", (256, 256), KANNALA, 2.0),
         ("panorama", (320, 512), WIDE, 2.2)],
        ("none", SIZE, KANNALA, 1.1), ("tiles:5", (256, 256), WIDE, 1.8),
    ),
)  # fmt: skip
def test_a_disc_is_found_at_its_place(view, size, lens, tolerance):
    places = [(0, 0), (40, 15), (-55, -10), (5, 38), (75, 0), (-50, 30)]  # to the right and up
    boxes = []
    for k, place in enumerate(places):
        picture, box = disc_at(place, k % 3, lens)
        save_picture(f"in/{k}.png", picture)
        boxes.append(box)
    Path("names.txt").write_text("\n".join(NAMES))
    write_graph(Path("n.onnx"), size=size)
    argv = f"in --network n.onnx --view {view} --threshold 0.5"  # parts of discs have lower scores
    found = predict(f"{argv} --labels names.txt", lens)
    for k, (entry, place, box) in enumerate(zip(found, places, boxes, strict=True)):
        assert entry["image"] == f"in/{k}.png" and entry["overlay"] == f"overlays/{k}.jpg"
        (thing,) = entry["detections"]  # of all tiles
        assert thing["label"] == NAMES[k % 3] and 0.5 < thing["score"] < 1 == thing["visible"]
        np.testing.assert_allclose(thing["box"], box, atol=tolerance)
        # The direction that was painted; a pixel of the picture is less than 0.7 degrees.
        assert (thing["azimuth_deg"], thing["elevation_deg"]) == pytest.approx(place, abs=0.7)
        sides = thing["width_deg"], thing["height_deg"]
        assert sides == pytest.approx([2 * RADIUS] * 2, abs=2.5)
        np.testing.assert_allclose(thing["ray"], direction_of(*place), atol=0.015)


def test_colours_and_their_normalization_are_the_networks(disc):
    """BGR makes red of blue; and only a picture that is normalised is above 0.5."""
    save_picture("p.png", disc_at((36, -8), 2)[0])
    for options, labels in (
        ("", [2]),
        ("--channels rgb", [2]),
        ("--channels bgr", [0]),
        ("--mean 0.6", []),  # 1 becomes 0.4
        ("--mean 0.6 --std 0.5", [2]),  # 0.8
        ("--mean 0.2,0.3,0.6 --std 1,1,1", []),
        ("--mean 0.6,0.3,0.2 --std 1,1,1", [2]),
        ("--mean 0.6,0.3,0.2 --channels bgr", []),
        ("--std 0.3", [2]),
    ):
        (entry,) = predict(f"p.png --network n.onnx {options}")
        assert [thing["label"] for thing in entry["detections"]] == labels, options


def test_what_is_seen_and_how_its_box_is_drawn(disc):
    """Tiles that are level with another up, a view too narrow for the disc, and other networks."""
    for options, count, form in (
        ("--view tiles:5 --up 0.6,-0.8,0", 1, {}),
        ("--view tiles:5 --up 0 -1 2", 1, {}),
        ("--view mercator --fov_deg 50", 0, {}),
        ("--view mercator --fov_deg 120", 1, {}),
        ("--view mercator --fov_deg 120 --up 1,0,0", 1, {}),
        ("--view square", 1, {}),
        ("--view tiles:5 --size 256,256", 1, dict(size=("H", "W"))),
        ("--view tiles:5", 1, dict(dtype="uint8", channels_last=True)),
    ):
        write_graph(Path("n.onnx"), **({"size": (256, 256)} | form))
        (entry,) = predict(f"p.png --network n.onnx {options}")
        assert [thing["label"] for thing in entry["detections"]] == [1] * count, options
        for thing in entry["detections"]:
            np.testing.assert_allclose(thing["box"], disc, atol=1.8 if form else 3)
    drawn = cv2.imread(f"out/{entry['overlay']}").astype(int)
    changed = np.abs(drawn - cv2.imread("p.png")).max(-1) > 60
    left, _, right, bottom = np.rint(thing["box"]).astype(int)
    assert changed[bottom - 1, left:right].mean() > 0.9  # a line along the last row of the box
    assert not changed[bottom + 3 :].any() and not changed[:, : left - 3].any()
    mercator, default = (predict(f"p.png --network n.onnx {o}") for o in ("", "--view mercator"))
    assert mercator == default


def of_constants(options="", view="mercator", **outputs):
    """What a network with these outputs gives for a picture of 64 × 80 pixels."""
    write_constants(Path("n.onnx"), (64, 64), **outputs)
    save_picture("p.png", np.zeros((64, 80, 3), np.uint8))
    (entry,) = predict(f"p.png --network n.onnx --view {view} {options}", SMALL)
    return entry


def test_where_things_stand_on_the_floor():
    """A camera that looks down by 30°; each box is that of its own tile."""
    up = (0, -math.cos(math.radians(30)), -math.sin(math.radians(30)))
    boxes = np.array([[[20, 20, 30, 50], [30, 10, 40, 20]]], F)
    outputs = dict(boxes=boxes, scores=np.array([[0.9, 0.8]], F), labels=np.array([[1, 2]]))
    options = f"--up={','.join(map(str, up))} --fov_deg 120"
    plain = of_constants(options, "tiles:4", **outputs)["detections"]
    options += " --height 3 --radius 0.25"
    entries = of_constants(options, "tiles:4", **outputs)["detections"]
    lens = Equidistant(24.0, 1.2, image_size=(64, 80))
    made = make_view("tiles", (64, 64), fov=math.radians(120), up=up, count=4)
    known = []
    for tile in made.at(lens, (64, 80)).tiles:
        there, visible, _ = tile.boxes_to_image(boxes[0].astype(float))
        places = tile.floor(boxes[0].astype(float), 3.0, up, 0.25)
        known += [(box, place) for box, place, v in zip(there, places, visible, strict=True) if v]
    assert len(entries) == len(plain) > 1
    for entry, before in zip(entries, plain, strict=True):
        place = entry.pop("floor")
        assert entry == before
        (want,) = [p for box, p in known if np.abs(box - entry["box"]).max() < 0.01]
        place = [np.nan] * len(want) if place is None else place
        np.testing.assert_allclose(place, want, atol=1e-3)


def test_a_thing_that_is_cut_by_the_end_of_the_lens_is_partly_visible(capsys):
    """A box that a network draws around what it guesses beyond θ_max, and one that is all there."""
    table = {
        "inside": [100, 60, 130, 90], "cut": [2, 40, 72, 90], "beyond": [0, 0, 20, 20],
        "outside": [400, 0, 420, 20], "no width": [150, 100, 150, 120], "turned": [9, 9, 5, 5],
        "half outside": [150, 100, np.inf, 120],
    }  # fmt: skip
    rows = np.array([[*box, 0.9 - k / 100, k] for k, box in enumerate(table.values())])
    rows = np.concatenate((rows, [[105, 65, 125, 85, 0.5, 0]]))  # in the first, of its class
    write_constants(Path("n.onnx"), SIZE, found=rows[None].astype(F))
    Path("names.json").write_text(json.dumps([*table]))
    save_picture("p.png", np.zeros((*SIZE, 3), np.uint8))
    lens = WIDE | {"theta_max": 1.0}  # 88 px around (163, 117)
    (entry,) = predict("p.png --network n.onnx --labels names.json --view stereographic", lens)
    assert (
        "n.onnx: left out, because they have no area, are 2 of 8 boxes" in capsys.readouterr().err
    )
    labels = [thing["label"] for thing in entry["detections"]]
    assert labels == ["inside", "cut", "half outside", "inside"]  # the best first
    kept = dict(zip(labels[:3], entry["detections"], strict=False))
    assert kept["inside"]["visible"] == 1 and 0.1 < kept["cut"]["visible"] < 0.9
    for thing in kept.values():
        x0, y0, x1, y1 = thing["box"]
        assert x0 < x1 and y0 < y1
        assert max(abs(x0 - CENTER[0]), abs(x1 - CENTER[0])) < 89.5


def test_a_stream_ends_by_ctrl_c_with_its_predictions(disc, monkeypatch, capsys):
    picture = cv2.imread("p.png")

    class Camera:
        def __init__(self, source):
            assert source == "rtsp://me:secret@host/door"

        isOpened = release = lambda self: True  # noqa: N815

        def read(self):
            return True, picture

    seen, add = [], NetworkAnswers.add

    def interrupted(self, entry, image, lens):
        seen.append(entry["frame"])
        if len(seen) == 3:
            raise KeyboardInterrupt
        add(self, entry, image, lens)

    monkeypatch.setattr("darswin.utils.video.cv2.VideoCapture", Camera)
    monkeypatch.setattr(NetworkAnswers, "add", interrupted)
    command = "rtsp://me:secret@host/door --network n.onnx --view tiles:5 --every 2"
    *found, speed = predict(command)
    assert [entry["frame"] for entry in found] == seen[:2] and seen[1] - seen[0] >= 2
    for entry in found:
        (thing,) = entry["detections"]
        np.testing.assert_allclose(thing["box"], disc, atol=1.8)
        assert entry["overlay"] == f"overlays/rtsp_host_door/{entry['frame']:06}.jpg"
        assert Path("out", entry["overlay"]).is_file()
    assert speed["frames"] == 2 and speed["video"] == "rtsp://host/door"
    for lens in (json.dumps(WIDE | {"image_size": [9, 9]}), "."):
        with pytest.raises(SystemExit, match=r"for 9 × 9|no calibration in") as error:
            main(["predict", *command.split(), "--lens", lens, "--out", "out"])
        assert "secret" not in str(error.value)
    assert "secret" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "view", slow_but(["tiles:5", "mercator", "square", "perspective"], "tiles:5", "square")
)
def test_a_view_that_sees_nothing_is_told_for_each_camera(disc, view):
    """The image circle of one of two cameras is beside of its pictures."""
    for name in "ab":
        Path(f"{name}.png").write_bytes(Path("p.png").read_bytes())
    lenses = {"a.png": WIDE | {"center": [500.0, 100.0]}, "b.png": WIDE}
    Path("lenses.json").write_text(json.dumps(lenses))
    argv = f"predict a.png b.png --network n.onnx --view {view} --lens lenses.json --out out"
    with pytest.raises(SystemExit, match=r"for 1 of 2 pictures:\n.*a\.png has no such view: "):
        main(argv.split())
    (found,) = json.loads(Path("out/predictions.json").read_text())
    assert found["image"] == "b.png"


def test_what_a_network_needs(disc, monkeypatch):
    for size, said in (
        ((256, 256), "resamples it$"),
        (("H", "W"), "or give it by --size, 240,320"),
    ):
        write_graph(Path("n.onnx"), size=size)
        known = "" if size[0] == 256 else "--size 256,256"
        with pytest.raises(SystemExit, match=rf"p\.png .* 240 × 320 px .* 256 × 256 px .*{said}"):
            predict(f"p.png --network n.onnx --view none {known}")
        assert Path("out/predictions.json").read_text() == "[]"
    monkeypatch.setattr("darswin.frames.onnx.lack", lambda extra, modules: f"{modules[0]} missing")
    refused("onnxruntime missing", predict, "p.png --network n.onnx", error=SystemExit)


@pytest.mark.parametrize(
    ("outputs", "options", "said"),
    [
        ("nan boxes", "", r"no prediction for .*b\.png: .*n\.onnx computes NaN"),
        ("named", "--labels names.txt", "class 1, but --labels has 1 name, 0 to 0"),
    ],
)
def test_what_was_found_before_an_error_is_kept(disc, outputs, options, said):
    """Of a network that computes NaN where there is light, and of a class without a name."""
    save_picture("in/a.png", np.zeros((*SIZE, 3), np.uint8))
    Path("p.png").rename("in/b.png")
    Path("names.txt").write_text("red\n")
    write_graph(Path("n.onnx"), outputs, size=(256, 256))
    refused(said, predict, f"in --network n.onnx --view tiles:5 {options}", error=SystemExit)
    (found,) = json.loads(Path("out/predictions.json").read_text())
    assert found["image"] == "in/a.png" and found["detections"] == []


# -- masks, keypoints, turned boxes, and other files ----------------------------------------------

PLACES = np.array([(140.0, 100.0), (225.0, 128.0), (95.0, 95.0), (170.0, 150.0)])  # px
ANGLES = np.array([0.2, -0.6, 1.2, 0.9])
SEEN_BY = [("mercator", (256, 384)), ("tiles:5", (192, 192))]


def seen_in(view, size):
    """The map of each tile of a view of the wide lens."""
    lens = Equidistant(88.0, WIDE["theta_max"], CENTER, image_size=SIZE)
    name, _, count = view.partition(":")
    return make_view(name, size, **({"count": int(count)} if count else {})).at(lens, SIZE)


def stack(rows, width):
    """The rows of each tile, with others whose score is 0."""
    most = max(map(len, rows))
    rows = [np.pad(r.reshape(-1, width), ((0, most - len(r)), (0, 0))) for r in rows]
    return np.stack(rows).astype(F)


def things_of(remap, size):
    """In each tile, the things whose middles it shows well inside: their numbers and places."""
    found = []
    for tile in remap.tiles:
        places = tile.to_view(PLACES - 0.5) + 0.5
        inner = ((places > 30) & (places < np.array(size[::-1]) - 30)).all(1)
        found.append((np.flatnonzero(inner), places[inner]))
    assert {k for numbers, _ in found for k in numbers} == {*range(len(PLACES))}
    return found


@pytest.mark.parametrize(("view", "size"), SEEN_BY)
def test_masks_and_keypoints_come_back(view, size):
    """Discs of the picture are the masks of the view, and their middles and tops its keypoints."""
    remap = seen_in(view, size)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    discs = [np.hypot(x - u, y - v) < 12 for u, v in PLACES]
    tops, rows, masks, points = PLACES - (0, 10), [], [], []
    seen = [np.reshape(remap((255 * disc).astype(np.uint8)), (-1, *size)) / 255 for disc in discs]
    things = things_of(remap, size)
    most = max(len(numbers) for numbers, _ in things)
    for number, (numbers, places) in enumerate(things):
        above = remap.tiles[number].to_view(tops[numbers] - 0.5) + 0.5
        far = np.full(places.shape, -500.0)  # beyond what the picture shows
        ones = np.ones((len(places), 3, 1))
        points.append(np.concatenate((np.stack((places, above, far), 1), 0.5 * ones), 2))
        rows.append(np.column_stack((places - 14, places + 14, 0.9 - numbers / 10, numbers)))
        masks.append(np.zeros((most, *size), F))
        for row, k in enumerate(numbers):
            masks[-1][row] = seen[k][number]
    table = stack(rows, 6)
    outputs = dict(
        boxes=table[..., :4], scores=table[..., 4], labels=table[..., 5], masks=np.stack(masks),
        keypoints=stack(points, 9).reshape(*table.shape[:2], 3, 3),
    )  # fmt: skip
    write_detector(Path("n.onnx"), size, outputs, batch=len(table))
    save_picture("p.png", np.zeros((*SIZE, 3), np.uint8))
    (entry,) = predict(f"p.png --network n.onnx --view {view}")
    assert [thing["label"] for thing in entry["detections"]] == [0, 1, 2, 3]
    for thing, disc, place, top in zip(entry["detections"], discs, PLACES, tops, strict=True):
        mask = decode_rle(thing["mask"])
        assert (mask & disc).sum() > 0.9 * (mask | disc).sum()
        middle, head, nothing = thing["keypoints"]
        np.testing.assert_allclose(middle, [*place, 0.5], atol=0.01)
        np.testing.assert_allclose(head, [*top, 0.5], atol=0.01)
        assert nothing == [None, None, 0.5]
    drawn = cv2.imread(f"out/{entry['overlay']}")
    assert all(drawn[disc].mean() > 40 for disc in discs)


@pytest.mark.parametrize(("view", "size"), SEEN_BY)
def test_turned_boxes_come_back(view, size):
    """Their sides are those of the picture: small ones keep their angles to those of the map."""
    remap, half, rows = seen_in(view, size), np.array([9.0, 5.0]), []
    for tile, (numbers, places) in zip(remap.tiles, things_of(remap, size), strict=True):
        ahead = PLACES + 0.1 * np.column_stack((np.cos(ANGLES), np.sin(ANGLES)))
        step = tile.to_view(ahead[numbers] - 0.5) + 0.5 - places
        scale = np.hypot(*step.T)[:, None] / 0.1
        turns = np.arctan2(step[:, 1], step[:, 0])
        scores = 0.9 - numbers / 10
        rows.append(np.column_stack((places, 2 * half * scale, scores, numbers, turns)))
    names = {0: "a", 1: "b", 2: "c", 3: "d"}
    outputs, said = dict(output0=stack(rows, 7)), dict(task="obb", names=names)
    write_detector(Path("n.onnx"), size, outputs, batch=len(rows), metadata=said)
    save_picture("000042.png", np.zeros((*SIZE, 3), np.uint8))
    command = f"000042.png --network n.onnx --view {view} --format"
    (entry,) = predict(f"{command} coco")
    assert [thing["label"] for thing in entry["detections"]] == list("abcd")  # of the file itself
    turned = np.array([thing["turned"] for thing in entry["detections"]])
    np.testing.assert_allclose(turned[:, :2], PLACES, atol=0.5)
    np.testing.assert_allclose(turned[:, 2:4], np.tile(2 * half, (4, 1)), atol=2.0)
    np.testing.assert_allclose(np.sin(turned[:, 4] - ANGLES), 0, atol=0.1)
    results = json.loads(Path("out/coco.json").read_text())
    assert [one["image_id"] for one in results] == [42] * 4
    assert [one["category_id"] for one in results] == [0, 1, 2, 3]
    assert predict(f"{command} yolo") == [entry]
    lines = Path("out/labels/000042.txt").read_text().splitlines()
    for thing, (u, v, w, h, angle), one, line in zip(
        entry["detections"], turned, results, lines, strict=True
    ):
        across = (w * abs(np.cos(angle)) + h * abs(np.sin(angle))) / 2
        x0, y0, x1, y1 = thing["box"]
        assert (x0, x1) == pytest.approx((u - across, u + across), abs=0.6)
        np.testing.assert_allclose(one["bbox"], [x0, y0, x1 - x0, y1 - y0], atol=0.02)
        assert one["score"] == thing["score"] and len(one["segmentation"][0]) == 8
        label, *numbers, score = map(float, line.split())
        points = np.reshape(numbers, (4, 2)) * [SIZE[1], SIZE[0]]
        np.testing.assert_allclose(points.mean(0), (u, v), atol=0.01)
        side = [w * np.cos(angle), w * np.sin(angle)]
        np.testing.assert_allclose(points[1] - points[0], side, atol=0.01)
        assert (names[label], round(score, 4)) == (thing["label"], thing["score"])


def test_each_picture_has_an_id_of_its_own_in_coco():
    """Their names are their ids, unless two have one number; and an old file is replaced."""
    write_constants(Path("n.onnx"), (64, 64), found=np.array([[[10, 10, 30, 30, 0.5, 1]]], F))
    for name in ("in/a/7.png", "in/b/8.png", "in/b/c.png", "more/b/07.png"):
        save_picture(name, np.zeros((64, 80, 3), np.uint8))
    write_frames("in/v.mp4", np.zeros((2, 64, 80, 3), np.uint8), 10)
    frames = ["v.mp4/000000", "v.mp4/000001"]
    names = ["a/7", "b/8", "b/c", *frames]
    for paths, threshold, expected in (
        ("in", "0.1", dict(zip(names, [7, 8, 9, 10, 11], strict=True))),
        ("in more", "0.1", {f"in/{name}": k for k, name in enumerate(names, 1)} | {"more/b/07": 6}),
        ("in", "0.9", {}),
    ):
        predict(f"{paths} --network n.onnx --format coco --threshold {threshold}", SMALL)
        results = json.loads(Path("out/coco.json").read_text())
        assert {one["file_name"]: one["image_id"] for one in results} == expected


def test_a_mask_of_few_pixels_is_a_box_in_yolo_and_infinity_is_null_in_json():
    """Two points would read as a box."""
    mask = np.zeros((10, 20), bool)
    mask[4, 6:8] = True
    columns = dict(boxes=np.array([[5.0, 4, 9, 6]]), scores=[0.5], labels=np.array([3]))
    lines = yolo_lines(Instances(**columns, masks=[encode_rle(mask)]), (10, 20))
    assert lines == "3 0.350000 0.500000 0.200000 0.200000 0.500000\n"
    assert rounded([[1.26, np.inf], [np.nan, 2]], 1) == [[1.3, None], [None, 2.0]]


def test_boxes_that_overlap_are_merged_and_words_answer_questions(capsys):
    """Of YOLO without its metadata, in whose boxes each thing has several."""
    y, x = np.mgrid[:16, :16] * 8 + 4.0
    cells = np.array([x.ravel(), y.ravel(), 0 * x.ravel() + 60, 0 * x.ravel() + 60])
    rows = np.concatenate((cells, np.zeros((2, 256))))
    near = (np.abs(x - 56) < 5) & (np.abs(y - 56) < 5)
    rows[5, np.flatnonzero(near.ravel())] = np.linspace(0.8, 0.9, near.sum())
    rows = np.pad(rows, ((0, 0), (0, 80)))  # the cells of 16 and 32 px
    write_detector(Path("n.onnx"), (128, 128), {"output0": rows[None].astype(F)})
    save_picture("p.png", np.zeros((64, 80, 3), np.uint8))
    with pytest.raises(SystemExit, match=r"may be detect or obb: say which by --form, or"):
        predict("p.png --network n.onnx", SMALL)
    (entry,) = predict("p.png --network n.onnx --form detect", SMALL)
    (thing,) = entry["detections"]
    assert (thing["label"], thing["score"]) == (1, 0.9)
    assert (
        "detections (form detect, boxes that overlap are merged); pixels are rgb"
        in capsys.readouterr().err
    )


def test_pixels_are_those_of_the_form_unless_they_are_given(capsys):
    outputs = dict(dets=np.full((1, 5, 4), 0.5, F), labels=np.zeros((1, 5, 9), F))
    write_detector(Path("n.onnx"), (64, 64), outputs)
    for options, mean, std, step in (
        ({}, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225), 1),
        ({"std": (0.5,)}, (0.0,) * 3, (0.5,) * 3, 1),
        ({"mean": (0.2,), "channels": "bgr"}, (0.2,) * 3, (1.0,) * 3, -1),
    ):
        answers = NetworkAnswers("n.onnx", **options)
        assert (answers._mean, answers._std, answers._step) == (mean, std, step)
        said = capsys.readouterr().err
        assert "detections (form rfdetr); pixels are" in said and f"std {std[0]:g}" in said


CORNERS = np.array([[[8, 10, 30, 40], [40, 5, 60, 22], [20, 30, 50, 60]]], F)
CENTRES = np.array([[[30, 40, 8, 10], [50, 22, 8, 9], [20, 30, 50, 60]]], F)


def test_boxes_are_pixels_or_parts_and_an_error_if_they_are_none(capsys):
    labels = np.zeros((1, 3), np.int64)
    outputs = dict(scores=np.full((1, 3), 0.9, F), labels=labels, more=labels * 0.5)
    first, other = (of_constants(boxes=CORNERS / by, **outputs) for by in (1, 64))
    assert first == other and len(first["detections"]) == 3
    assert "outputs that are not used: more; pixels" in capsys.readouterr().err
    for boxes, said in ((CENTRES, "2 of 3 .* centres and"), (CORNERS[..., [2, 3, 0, 1]], "3 of 3")):
        for by in (1, 64):
            with pytest.raises(SystemExit, match=said) as error:
                of_constants(boxes=boxes / by, **outputs)
            assert error.value.code != 0 and "corners x0, y0, x1, y1" in capsys.readouterr().err
            assert json.loads(Path("out/predictions.json").read_text())  # what was found is kept


# -- maps and numbers -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "view", slow_but(["none", "tiles:5", "mercator", "square", "perspective"], "none", "tiles:5")
)
def test_maps_come_back_to_the_pixels(view):
    """A map of the view's own pixels is the picture again, where the view shows it."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    smooth = [128 + 100 * np.sin(x / 40), 128 + 100 * np.cos(y / 30), 60 + 0 * x]
    picture = np.stack(smooth, -1).astype(np.uint8)
    save_picture("p.png", picture)
    write_graph(Path("n.onnx"), "map and numbers", size=SIZE if view == "none" else (320, 320))
    narrow = "--fov_deg 120" if view == "perspective" else ""
    (entry,) = predict(f"p.png --network n.onnx --view {view} {narrow}")
    files = entry["same"]
    assert files == {"map": "maps/same/p.npy", "labels": "labels/same/p.png",
                     "overlay": "overlays/same/p.jpg"}  # fmt: skip
    same, labels = np.load(f"out/{files['map']}"), np.array(Image.open(f"out/{files['labels']}"))
    assert same.shape == (3, *SIZE) and same.dtype == F
    assert labels.shape == SIZE and set(np.unique(labels)) <= {0, 1, 2, 255}
    shown = labels != 255
    beyond = np.hypot(x - CENTER[0], y - CENTER[1]) > 88 * math.radians(95) + 2  # θ_max
    if view == "none":
        assert shown.all()
    else:
        assert shown.mean() > 0.3 and not shown[beyond].any() and not same[:, beyond].any()
    inner = cv2.erode(shown.astype(np.uint8), np.ones((15, 15))) > 0
    difference = np.abs(same.transpose(1, 2, 0) - picture / 255)[inner]
    assert np.quantile(difference, 0.99) < 0.01  # the borders of the picture mix with black
    clear = inner & (np.abs(picture[..., 0].astype(int) - picture[..., 1]) > 15)
    assert (labels == picture.argmax(-1))[clear].mean() > 0.99
    numbers = np.array(entry["light_"])  # of the view, or of each tile
    assert numbers.shape == ((5, 3) if view == "tiles:5" else (3,))


def test_numbers_are_printed_or_written_to_a_file(disc, capsys):
    write_graph(Path("n.onnx"), "numbers", size=(64, 64))
    argv = ["predict", "p.png", "--network", "n.onnx", "--view", "tiles:4"]
    argv += ["--lens", json.dumps(WIDE)]
    main(argv)
    (entry,) = json.loads(capsys.readouterr().out)
    assert np.array(entry["logits"]).shape == (4, 3) and entry["image"] == "p.png"
    main([*argv, "--out", "o.json"])
    assert json.loads(Path("o.json").read_text()) == [entry]


@pytest.mark.parametrize(
    ("view", "kind"),
    [("mercator", np.int64), ("tiles:4", np.int32), ("square", np.uint8), ("panorama", np.bool_)],
)
def test_a_map_of_integers_keeps_its_ids(view, kind):
    """Of the size of the view, and of a quarter of it without a channel."""
    ids = np.zeros((1, 1, 64, 64), kind)
    ids[..., 20:, :], ids[..., 30:, 41:] = (1, 1) if kind is np.bool_ else (10, 3)
    names = ["x", "y", "z", "three", *"abcdef", "ten"]
    Path("names.json").write_text(json.dumps(names))
    entry = of_constants("--labels names.json", view, whole=ids, quarter=ids[:, 0, ::4, ::4])
    known = {0, 1} if kind is np.bool_ else {0, 3, 10}
    for output in ("whole", "quarter"):
        found = np.load(f"out/{entry[output]['map']}")
        labels = np.asarray(Image.open(f"out/{entry[output]['labels']}"))
        assert found.shape == (1, 64, 80) and set(np.unique(found)) == known
        assert set(np.unique(labels)) == known | {255}
        shown = labels != 255
        assert (found[0] == labels)[shown].all() and not found[0][~shown].any()
        shares = {names[k]: pytest.approx((labels[shown] == k).mean(), abs=1e-6) for k in known}
        assert entry[output]["shares"] == shares


def test_what_is_a_map_and_what_is_refused():
    heads = {f"p{k}": np.zeros((1, 255, 64 // k, 64 // k), F) for k in (8, 16, 32)}
    for outputs, said in (
        (dict(heads=np.zeros((1, 1, 100, 9), F)), r"heads \(1, 1, 100, 9\); known"),
        (dict(maps=np.zeros((1, 3, 32, 16), F)), r"maps \(1, 3, 32, 16\); known are .*fraction"),
        (dict(maps=np.zeros((1, 3, 48, 48), F)), r"maps \(1, 3, 48, 48\); known"),
        (dict(maps=np.zeros((1, 3, 128, 128), F)), r"maps \(1, 3, 128, 128\); known"),
        (dict(last=np.zeros((1, 32, 32, 3), F)), r"last \(1, 32, 32, 3\); known"),
        (dict(table=np.zeros((1, 32, 32), F)), r"table \(1, 32, 32\); known"),
        (heads, r"same channels at several scales, p8 \(255, 8, 8\), .* heads of a detector"),
    ):
        refused(said, OnnxNetwork, write_constants(Path("n.onnx"), (64, 64), **outputs))
    # A network may have an auxiliary output; and one pixel is a number.
    entry = of_constants(
        main=np.zeros((1, 5, 64, 64), F), aux=np.zeros((1, 5, 8, 8), F),
        pooled=np.arange(3, dtype=F).reshape(1, 3, 1, 1),
    )  # fmt: skip
    assert entry["pooled"] == [0, 1, 2]
    assert all(entry[name]["labels"] for name in ("main", "aux"))


PBTXT = """# of TensorFlow
item { id: 0 name: "/m/01g317" display_name: "person" }
item {
  name: 'bicycle'
  id: 2
}"""


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("n.txt", "person\n\nbicycle\n", None),
        ("n.txt", "\ufeffperson\r\n \r\nbicycle\r\n\r\n", None),
        ("n.json", '["person", null, "bicycle"]', None),
        ("n.json", '{"0": "person", "2": "bicycle"}', None),
        ("config.json", '{"id2label": {"0": "person", "2": "bicycle"}, "x": 1}', None),
        ("data.yaml", "path: .\nnames: {0: person, 2: bicycle}\nnc: 3", None),
        ("data.yml", "names: [person, null, bicycle]", None),
        ("map.pbtxt", PBTXT, None),
        ("data.yaml", "train: images", "`labels` must be .* names .*data.yaml: train is no number"),
        ("n.json", '{"person": 0}', "person is no number of a class"),
        ("n.json", "[1, 2]", "1 is no name of class 0"),
        ("n.json", '{"0": "a", "00": "b"}', "0 appears twice"),
        ("map.pbtxt", "item { name: 'a' }", "an item has no id: name: 'a'"),
        ("n.txt", "\n\n", "it has no names; known are a text file with a name in each line"),
    ],
)
def test_names_of_classes_in_every_form(name, text, said):
    Path(name).write_text(text, newline="")
    if said is None:
        assert read_names(name) == {0: "person", 2: "bicycle"}
    else:
        refused(said, read_names, name)


def test_the_best_classes_of_a_classifier(capsys):
    Path("n.txt").write_text("cat\ndog\n\ncow\n")
    save_picture("p.png", np.zeros((64, 80, 3), np.uint8))

    def numbers(values, options=""):
        write_constants(Path("n.onnx"), (64, 64), out=values)
        argv = f"predict p.png --network n.onnx --out o.json {options} --lens"
        main([*argv.split(), json.dumps(SMALL)])
        return json.loads(Path("o.json").read_text())[0]["out"]

    logits = np.array([[1.0, 3.0, -9.0, 2.0]], F)
    shares = np.exp(logits[0]) / np.exp(logits[0]).sum()
    for values, key, expected in (
        (logits, "probability", shares), (shares[None], "probability", shares),
        (np.array([[0.5, 0.9, 0.0, 0.7]], F), "score", [0.5, 0.9, 0.0, 0.7]),
    ):  # fmt: skip
        for options, classes in (("", [1, 3]), ("--labels n.txt", ["dog", "cow"])):
            best = numbers(values, f"--top 2 {options}")
            said = "gives logits: their softmax" in capsys.readouterr().err
            assert said == (values is logits and not options)  # a warning is said once
            assert [one["class"] for one in best] == classes
            found = [one[key] for one in best]
            assert found == pytest.approx([expected[1], expected[3]], abs=1e-5)
    assert numbers(logits) == logits[0].tolist()
    with pytest.raises(SystemExit, match=r"--labels names the classes 0 to 3, but .*: 3 in out"):
        numbers(logits[:, :3], "--labels n.txt")
