"""`darswin predict --network`: what a network of a known answer finds, at its exact place."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import product
from PIL import Image

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from graphs import write_constants, write_detector, write_graph

from darswin.boxes import decode_rle, encode_rle
from darswin.cli.found import yolo_lines
from darswin.cli.main import main
from darswin.cli.network import NetworkAnswers
from darswin.lens import Equidistant
from darswin.utils.video import write_frames
from darswin.views import make_view

SIZE = (240, 320)
CENTER = [163.0, 117.0]
NAMES = ["red", "green", "blue"]
RADIUS = 7.0  # degrees, of the discs that are to be found


def fisheye(points, focal, radial, **_):
    camera = np.array([[focal, 0, CENTER[0]], [0, focal, CENTER[1]], [0, 0, 1.0]])
    there, _ = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), camera,
                                         np.array(radial))  # fmt: skip
    return there[0]


def pinhole(points, focal, radial, tangential, **_):
    camera = np.array([[focal, 0, CENTER[0]], [0, focal, CENTER[1]], [0, 0, 1.0]])
    there, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera,
                                 np.array([*radial[:2], *tangential, radial[2]]))  # fmt: skip
    return there[:, 0]


def equidistant(points, focal, **_):
    aside = np.linalg.norm(points[:, :2], axis=1)
    radius = focal * np.arctan2(aside, points[:, 2])
    return points[:, :2] * (radius / aside)[:, None] + CENTER


def mei(points, focal, xi, **_):
    return focal * points[:, :2] / (points[:, 2:] + xi) + CENTER


# Each lens, what computes its pixels without darswin, and where the discs are: degrees to the
# right and up.
ASIDE = [(0, 0), (40, 15), (-55, -10), (5, 38), (75, 0), (-50, 30)]
NEAR = [(0, 0), (25, 8), (-22, -12), (3, 14)]
LENSES = {
    "KannalaBrandt": (
        {"focal": 95.0, "radial": [0.02, -0.01, 0.003, -0.0005], "theta_max": 1.5}, fisheye, ASIDE),
    "BrownConrady": (
        {"focal": 240.0, "radial": [-0.12, 0.03, 0.0], "tangential": [0.002, -0.003],
         "theta_max": 0.7}, pinhole, NEAR),
    "Equidistant": ({"focal": 88.0, "theta_max": math.radians(95)}, equidistant, ASIDE),
    "Mei": ({"focal": 215.0, "xi": 1.3, "theta_max": 1.6}, mei, ASIDE),
}  # fmt: skip
# Each view, its size, and by how many pixels of the picture a box may be wrong: less than one and
# a half pixels of the view, and more where a view does not show discs as upright ellipses.
VIEWS = {
    "none": (None, 1.1),
    "tiles:9": ((256, 256), 2.0),
    "tiles:5": ((256, 256), 1.8),
    "mercator": ((256, 384), 1.5),
    "stereographic": ((320, 320), 1.5),
    "panorama": ((320, 512), 2.2),
    "perspective": ((512, 512), 2.0),
}


def direction_of(azimuth, elevation):
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    level = math.cos(elevation)
    return np.array([level * math.sin(azimuth), -math.sin(elevation), level * math.cos(azimuth)])


def rim_of(direction):
    """The unit vectors of the rim of a disc."""
    aside = np.cross(direction, (0, 1, 0))
    aside /= np.linalg.norm(aside)
    other, turn = np.cross(direction, aside), np.linspace(0, 2 * np.pi, 720)[:, None]
    angle = math.radians(RADIUS)
    around = np.cos(turn) * aside + np.sin(turn) * other
    return math.cos(angle) * direction + math.sin(angle) * around


def paint(points, channel, size=SIZE):
    """A picture with a disc whose rim is at these pixels, and its box."""
    picture = np.zeros((*size, 3), np.uint8)
    color = [0, 0, 0]
    color[channel] = 255
    picture[..., channel] = 20
    cv2.fillPoly(picture, [np.rint(16 * points).astype(np.int32)], color, shift=4)
    return picture, np.concatenate((points.min(0), points.max(0))) + 0.5


def lens_of(name, size=SIZE):
    return {"model": name, "center": CENTER, "image_size": list(size)} | LENSES[name][0]


def predict(*argv, out, lens):
    main(["predict", *map(str, argv), "--lens", json.dumps(lens), "--out", str(out)])
    return json.loads((Path(out) / "predictions.json").read_text())


def write_picture(path, picture):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1])
    return path


def picture_of(name, place, channel):
    """A picture through a lens, and the box of its disc."""
    options, project, _ = LENSES[name]
    return paint(project(rim_of(direction_of(*place)), **options), channel)


@pytest.mark.parametrize(("view", "name"), product(VIEWS, LENSES))
def test_a_disc_is_found_at_its_place(tmp_path, view, name):
    size, tolerance = VIEWS[view]
    places = [p for p in LENSES[name][2] if view != "perspective" or max(map(abs, p)) < 50]
    known = []
    for k, place in enumerate(places):
        picture, box = picture_of(name, place, k % 3)
        write_picture(tmp_path / "in" / f"{k}.png", picture)
        known.append((place, box, NAMES[k % 3]))
    (tmp_path / "names.txt").write_text("\n".join(NAMES))
    network = write_graph(tmp_path / "n.onnx", size=size or SIZE)
    argv = [tmp_path / "in", "--network", network, "--view", view, "--threshold", "0.5"]
    argv += ["--labels", tmp_path / "names.txt"]  # parts of discs have lower scores
    argv += ["--fov_deg", "130"] if view == "perspective" else []
    found = predict(*argv, out=tmp_path / "out", lens=lens_of(name))
    for k, (entry, (place, box, label)) in enumerate(zip(found, known, strict=True)):
        assert entry["image"] == str(tmp_path / f"in/{k}.png")
        assert entry["overlay"] == f"overlays/{k}.jpg"
        (one,) = entry["detections"]  # of all tiles
        assert one["label"] == label and 0.5 < one["score"] < 1 and one["visible"] == 1
        np.testing.assert_allclose(one["box"], box, atol=tolerance)
        # The direction that was painted; a pixel of the picture is less than 0.7 degrees.
        assert (one["azimuth_deg"], one["elevation_deg"]) == pytest.approx(place, abs=0.7)
        assert (one["width_deg"], one["height_deg"]) == pytest.approx([2 * RADIUS] * 2, abs=2.5)
        np.testing.assert_allclose(one["ray"], direction_of(*place), atol=0.015)


FORMS = {
    "table": dict(outputs="table"),
    "uint8": dict(dtype="uint8"),
    "channels last": dict(channels_last=True),
    "uint8, channels last": dict(dtype="uint8", channels_last=True),
    "half": dict(dtype="float16"),
    "batch 1": dict(batch=1),
    "batch 2": dict(batch=2, outputs="table"),
    "of one picture": dict(outputs="of one picture", batch=None),
    "free": dict(size=("H", "W")),
}


@pytest.fixture(scope="module")
def disc(tmp_path_factory):
    """A green disc where two tiles overlap, and what is found in it."""
    folder = tmp_path_factory.mktemp("disc")
    picture, box = picture_of("Equidistant", (36, -8), 1)
    write_picture(folder / "p.png", picture)
    (found,) = run_tiles(folder, write_graph(folder / "n.onnx", size=(256, 256)))
    return folder, box, found


def run_tiles(folder, network, *argv, picture="p.png"):
    argv = [folder / picture, "--network", network, "--view", "tiles:5", *argv]
    return predict(*argv, out=folder / "out", lens=lens_of("Equidistant"))


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_a_network_gives_the_same(tmp_path, disc, form):
    folder, box, expected = disc
    network = write_graph(tmp_path / "n.onnx", **({"size": (256, 256)} | FORMS[form]))
    (found,) = run_tiles(folder, network, *(["--size", "256,256"] if form == "free" else []))
    (one,), (other,) = found["detections"], expected["detections"]
    assert one["label"] == other["label"] == 1
    np.testing.assert_allclose(one["box"], other["box"], atol=0.7)  # uint8 is rounded before
    np.testing.assert_allclose(one["box"], box, atol=1.8)


def test_the_box_is_drawn_on_the_picture(disc):
    folder, _, found = disc
    drawn = cv2.imread(str(folder / "out" / found["overlay"]))[..., ::-1].astype(int)
    plain = cv2.imread(str(folder / "p.png"))[..., ::-1].astype(int)
    changed = np.abs(drawn - plain).max(-1) > 60
    (one,) = found["detections"]
    left, _, right, bottom = np.rint(one["box"]).astype(int)
    assert changed[bottom - 1, left:right].mean() > 0.9  # a line along the last row of the box
    assert not changed[bottom + 3 :].any() and not changed[:, : left - 3].any()


def test_colours_and_their_normalization_are_the_networks(disc, tmp_path):
    """BGR makes red of blue; and only a picture that is normalised is above 0.5."""
    folder, box, _ = disc
    write_picture(folder / "blue.png", picture_of("Equidistant", (36, -8), 2)[0])
    network = write_graph(tmp_path / "n.onnx", size=(256, 256))
    for argv, label in (([], 2), (["--channels", "rgb"], 2), (["--channels", "bgr"], 0)):
        (found,) = run_tiles(folder, network, *argv, picture="blue.png")
        assert [one["label"] for one in found["detections"]] == [label]
    for argv, count in (
        (["--mean", "0.6"], 0),  # 1 becomes 0.4
        (["--mean", "0.6", "--std", "0.5"], 1),  # 0.8
        (["--mean", "0.2,0.3,0.6", "--std", "1,1,1"], 0),
        (["--mean", "0.6,0.3,0.2", "--std", "1,1,1"], 1),
        (["--mean", "0.6,0.3,0.2", "--channels", "bgr"], 0),
        (["--std", "0.3"], 1),
    ):
        (found,) = run_tiles(folder, network, *argv, picture="blue.png")
        assert len(found["detections"]) == count, argv
        if count:
            np.testing.assert_allclose(found["detections"][0]["box"], box, atol=1.8)


def test_gravity_and_a_field_of_view_change_what_is_seen(disc, tmp_path):
    """Tiles that are level with another up, and a view too narrow for the disc."""
    folder, box, _ = disc
    network = write_graph(tmp_path / "n.onnx", size=(256, 256))
    for argv, count in (
        (["--up", "0.6,-0.8,0"], 1), (["--up", "0 -1 2"], 1),
        (["--view", "mercator", "--fov_deg", "50"], 0),
        (["--view", "mercator", "--fov_deg", "120"], 1),
        (["--view", "mercator", "--fov_deg", "120", "--up", "1,0,0"], 1),
        (["--view", "square"], 1),
    ):  # fmt: skip
        (found,) = run_tiles(folder, network, *argv)
        assert len(found["detections"]) == count, argv
        for one in found["detections"]:
            np.testing.assert_allclose(one["box"], box, atol=3)
    (mercator,), (default,) = (
        predict(folder / "p.png", "--network", network, *argv, out=folder / "out",
                lens=lens_of("Equidistant"))
        for argv in ([], ["--view", "mercator"])
    )  # fmt: skip
    assert mercator == default


@pytest.mark.parametrize("view", ["mercator", "tiles:4"])
def test_where_things_stand_on_the_floor(tmp_path, view):
    """A camera that looks down by 30°; each box is that of its own tile."""
    up = (0, -math.cos(math.radians(30)), -math.sin(math.radians(30)))
    found = np.array([[[20, 20, 30, 50], [30, 10, 40, 20]]], np.float32)
    scores, labels = np.array([[0.9, 0.8]], np.float32), np.array([[1, 2]])
    outputs = dict(boxes=found, scores=scores, labels=labels)
    argv = ["--up=" + ",".join(map(str, up)), "--fov_deg", "120"]
    plain = run_constants(tmp_path, *argv, view=view, **outputs)["detections"]
    argv += ["--height", "3", "--radius", "0.25"]
    entries = run_constants(tmp_path, *argv, view=view, **outputs)["detections"]
    lens = Equidistant(24.0, 1.2, image_size=(64, 80))
    name, _, count = view.partition(":")
    options = {"count": int(count)} if count else {}
    made = make_view(name, (64, 64), fov=math.radians(120), up=up, **options)
    known = []
    for tile in made.at(lens, (64, 80)).tiles:
        there, visible, _ = tile.boxes_to_image(found[0].astype(float))
        places = tile.floor(found[0].astype(float), 3.0, up, 0.25)
        known += [(box, place) for box, place, v in zip(there, places, visible, strict=True) if v]
    assert len(entries) == len(plain) > 1
    for entry, before in zip(entries, plain, strict=True):
        place = entry.pop("floor")
        assert entry == before
        (want,) = [p for box, p in known if np.abs(box - entry["box"]).max() < 0.01]
        if place is None:
            assert np.isnan(want).any()
        else:
            np.testing.assert_allclose(place, want, atol=1e-3)
    assert any(place is not None for _, place in known)


def test_a_thing_that_is_cut_by_the_end_of_the_lens_is_partly_visible(tmp_path, capsys):
    """A box that a network draws around what it guesses beyond θ_max, and one that is all there."""
    lens = lens_of("Equidistant") | {"theta_max": 1.0}  # 88 px around (163, 117)
    table = {
        "inside": [100, 60, 130, 90], "cut": [2, 40, 72, 90], "beyond": [0, 0, 20, 20],
        "outside": [400, 0, 420, 20], "no width": [150, 100, 150, 120], "turned": [9, 9, 5, 5],
        "half outside": [150, 100, np.inf, 120],
    }  # fmt: skip
    rows = np.array([[*box, 0.9 - k / 100, k] for k, box in enumerate(table.values())])
    rows = np.concatenate((rows, [[105, 65, 125, 85, 0.5, 0]]))  # in the first, of its class
    network = write_constants(tmp_path / "n.onnx", SIZE, found=rows[None].astype(np.float32))
    (tmp_path / "names.json").write_text(json.dumps([*table]))
    write_picture(tmp_path / "p.png", np.zeros((*SIZE, 3), np.uint8))
    argv = [tmp_path / "p.png", "--network", network, "--labels", tmp_path / "names.json"]
    (entry,) = predict(*argv, "--view", "stereographic", out=tmp_path / "out", lens=lens)
    assert "n.onnx were left out: 2 without an area, and 0 within" in capsys.readouterr().err
    labels = [one["label"] for one in entry["detections"]]
    assert labels == ["inside", "cut", "half outside", "inside"]  # the best first
    kept = dict(zip(labels[:3], entry["detections"], strict=False))
    assert kept["inside"]["visible"] == 1 and 0.1 < kept["cut"]["visible"] < 0.9
    for one in kept.values():
        x0, y0, x1, y1 = one["box"]
        corner = [max(abs(x0 - CENTER[0]), abs(x1 - CENTER[0])), 0]
        assert x0 < x1 and y0 < y1 and np.linalg.norm(corner) < 89.5


def test_each_frame_of_a_video(tmp_path, capsys):
    places = [(-40 + 20 * k, 5) for k in range(5)]
    pictures, known = zip(*(picture_of("Equidistant", place, 1) for place in places), strict=True)
    write_frames(tmp_path / "v.mp4", pictures, 10)
    network = write_graph(tmp_path / "n.onnx", size=(256, 256))
    *found, speed = run_tiles(tmp_path, network, "--every", "2", picture="v.mp4")
    assert [entry["frame"] for entry in found] == [0, 2, 4]
    for entry, box in zip(found, known[::2], strict=True):
        assert entry["overlay"] == f"overlays/v.mp4/{entry['frame']:06}.jpg"
        assert (tmp_path / "out" / entry["overlay"]).is_file()
        (one,) = entry["detections"]
        np.testing.assert_allclose(one["box"], box, atol=2.5)  # of compressed frames
    assert speed["frames"] == 3
    assert 0 < speed["frames_per_second"] < speed["network_frames_per_second"]
    assert "v.mp4: 3 frames at" in capsys.readouterr().err


def test_a_stream_ends_by_ctrl_c_with_its_predictions(tmp_path, monkeypatch, capsys):
    picture, box = picture_of("Equidistant", (36, -8), 1)

    class Camera:
        def __init__(self, source):
            assert source == "rtsp://me:secret@host/door"

        isOpened = release = lambda self: True  # noqa: N815
        read = lambda self: (True, picture[..., ::-1])  # noqa: E731

    seen, add = [], NetworkAnswers.add

    def interrupted(self, entry, image, lens):
        seen.append(entry["frame"])
        if len(seen) == 3:
            raise KeyboardInterrupt
        add(self, entry, image, lens)

    network = write_graph(tmp_path / "n.onnx", size=(256, 256))
    monkeypatch.setattr("darswin.utils.video.cv2.VideoCapture", Camera)
    monkeypatch.setattr(NetworkAnswers, "add", interrupted)
    argv = ["rtsp://me:secret@host/door", "--network", network, "--view", "tiles:5", "--every", "2"]
    *found, speed = predict(*argv, out=tmp_path / "out", lens=lens_of("Equidistant"))
    assert [entry["frame"] for entry in found] == seen[:2] and seen[1] - seen[0] >= 2
    for entry in found:
        (one,) = entry["detections"]
        np.testing.assert_allclose(one["box"], box, atol=1.8)
        assert entry["overlay"] == f"overlays/rtsp_host_door/{entry['frame']:06}.jpg"
        assert (tmp_path / "out" / entry["overlay"]).is_file()
    assert speed["frames"] == 2 and speed["video"] == "rtsp://host/door"
    for given in (json.dumps(lens_of("Equidistant") | {"image_size": [9, 9]}), str(tmp_path)):
        command = ["predict", *argv, "--lens", given, "--out", tmp_path / "out"]
        with pytest.raises(SystemExit, match=r"for 9×9|no calibration in") as error:
            main([str(word) for word in command])
        assert "secret" not in str(error.value)
    assert "secret" not in capsys.readouterr().err


def test_bad_files_are_named_and_all_others_are_written(disc, tmp_path):
    folder, _, expected = disc
    for name in ("b.png", "d.png"):
        (tmp_path / name).write_bytes((folder / "p.png").read_bytes())
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "c.mp4").write_text("no video")
    write_picture(tmp_path / "e.png", np.zeros((100, 100, 3), np.uint8))
    network = write_graph(tmp_path / "n.onnx", size=(256, 256))
    said = r"no complete prediction for 3 of 5 files:\n.*a\.png.*\n.*c\.mp4.*\n.*100×100"
    for _ in range(2):  # again into the folder that it left
        with pytest.raises(SystemExit, match=said):
            run_tiles(tmp_path, network, picture=".")
        found = json.loads((tmp_path / "out" / "predictions.json").read_text())
        assert [entry["image"] for entry in found] == [f"{tmp_path}/b.png", f"{tmp_path}/d.png"]
        assert all(entry["detections"] == expected["detections"] for entry in found)


@pytest.mark.parametrize("view", ["tiles:5", "mercator", "square", "perspective"])
def test_a_view_that_sees_nothing_is_told_for_each_camera(disc, tmp_path, view):
    """The image circle of one of two cameras is beside of its pictures."""
    folder, _, _ = disc
    for name in ("a", "b"):
        (tmp_path / f"{name}.png").write_bytes((folder / "p.png").read_bytes())
    lenses = {f"{name}.png": lens_of("Equidistant") for name in "ab"}
    lenses["a.png"] |= {"center": [500.0, 100.0]}
    (tmp_path / "lenses.json").write_text(json.dumps(lenses))
    network = write_graph(tmp_path / "n.onnx", size=(64, 64))
    argv = ["predict", *(tmp_path / f"{name}.png" for name in "ab"), "--network", network]
    argv += ["--view", view, "--lens", tmp_path / "lenses.json", "--out", tmp_path / "out"]
    with pytest.raises(SystemExit, match=r"for 1 of 2 pictures:\n.*a\.png has no such view: "):
        main([str(word) for word in argv])
    (found,) = json.loads((tmp_path / "out" / "predictions.json").read_text())
    assert found["image"] == str(tmp_path / "b.png")


def test_a_network_that_takes_other_pictures(disc, tmp_path):
    """The pictures as they are must have the size that it takes, and the way that one is given."""
    folder, _, _ = disc
    network, lens = write_graph(tmp_path / "n.onnx", size=(64, 64)), lens_of("Equidistant")
    argv = [folder / "p.png", "--network", network, "--view", "none"]
    with pytest.raises(SystemExit, match=r"p\.png .* is 320×240, but the network takes 64×64: cho"):
        predict(*argv, out=tmp_path / "out", lens=lens)
    assert (tmp_path / "out" / "predictions.json").read_text() == "[]"


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("--network n.onnx --view fish", r"--view must be one of .*, mercator, .* got fish"),
        ("--network n.onnx --view polar", "--view polar shows no picture to a network"),
        (
            "--network n.onnx --view mercator:3",
            "'mercator' has no option 'count'; it has fov,",
        ),
        ("--network n.onnx --view tiles:x", r"--view must be NAME or NAME:COUNT, .* got tiles:x"),
        ("--network n.onnx --view tiles:3", "count must be from 4 to 9, got 3"),
        (
            "--network n.onnx --view none --fov_deg 90",
            "'none' has no option 'fov'",
        ),
        ("--network n.onnx --view none --up 0,0,1", "'none' has no option 'up'"),
        ("--network n.onnx --fov_deg 0", "--fov_deg must be above 0° and at most 360° for a"),
        (
            "--network n.onnx --view perspective --fov_deg 180",
            "--fov_deg .* at most 179.9° for a pers",
        ),
        ("--network n.onnx --fov_deg 400", "--fov_deg must be above 0°"),
        ("--network n.onnx --up 0,0,0", "--up must be three finite numbers"),
        (
            "--network n.onnx --mean 123.7",
            r"--mean must be in parts of 255, at most 1 \(.*\), got 123.7",
        ),
        (
            "--network n.onnx --std 58.395,57.12,57.375",
            r"--std must be in parts of 255, at most 1 \(.* 0.229,0.224,0.225\), got 58.395",
        ),
        (
            "--network n.onnx --std 255",
            r"--std must be in parts of 255, at most 1 \(.* this is 1\)",
        ),
        ("--network n.onnx --top 2", "--top is for the classes of pictures, but n.onnx is a model"),
        ("--network n.onnx --mean 0.1,0.2", "mean.*per channel"),
        ("--network n.onnx --std 0", "std"),
        ("--network n.onnx --std nan", "--std must be finite, got nan"),
        ("--network n.onnx --mean inf", "--mean must be finite, got inf"),
        ("--network n.onnx --size 64,64", "--size must be 256,256 for n.onnx, got 64,64"),
        ("--network free.onnx", "missing --size: free.onnx takes pictures of any size"),
        ("--network free.onnx --size 0,64", r"--size must be at least 1,1, got \(0, 64\)"),
        (
            "--network bytes.onnx --std 0.2",
            "bytes.onnx takes pixels of uint8: leave --mean and --std",
        ),
        ("--network n.onnx --threshold nan", "--threshold must be finite, got nan"),
        ("--network gone.onnx", "there is no file gone.onnx"),
        ("--network p.png", r"onnxruntime cannot read p\.png"),
        ("--network raw.onnx", r"raw.onnx has the outputs output0 \(1, 4, 11\); known are"),
        ("--network nan.onnx", "nan.onnx computes NaN"),
        ("--network n.onnx --labels gone.txt", "gone.txt"),
        ("--network n.onnx --task distance", "--task is distance, but n.onnx is a model for detec"),
        ("--network n.onnx --model digits", "give either --run, .* or --network, an ONNX file"),
        ("--network n.onnx --run r", "give either --run, .* or --network, an ONNX file"),
        ("--network n.onnx --height 2", "--height needs --up, the direction away from gravity"),
        ("--network n.onnx --radius 1", "--radius must be given with --height, got 1.0"),
        ("--network n.onnx --height -1 --up=0,-1,0", "--height must be above 0 m, got -1"),
        ("--network n.onnx --height 2 --radius -1 --up=0,-1,0", "--radius must be at least 0 m"),
        ("--network n.onnx --height 2 --up=0,-1,0 --view square", "no .*up"),
        (
            "--network maps.onnx --height 2 --up=0,-1,0",
            "--height is for boxes, but maps.onnx gives",
        ),
        ("--model digits --view mercator", "--view is an option of --network, an ONNX file"),
        ("--model digits --labels l.txt", "--labels is an option of --network"),
    ],
)
def test_what_is_wrong_is_named(disc, tmp_path, monkeypatch, argv, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.png").write_bytes((disc[0] / "p.png").read_bytes())
    for name, options in (
        ("n", {}), ("free", {"size": ("H", "W")}), ("bytes", {"dtype": "uint8"}),
        ("raw", {"outputs": "undecoded"}), ("nan", {"outputs": "nan"}),
    ):  # fmt: skip
        write_graph(tmp_path / f"{name}.onnx", **({"size": (256, 256)} | options))
    write_constants(tmp_path / "maps.onnx", (64, 64), maps=np.zeros((1, 2, 64, 64), np.float32))
    words = ["p.png", *argv.split(), "--lens", json.dumps(lens_of("Equidistant")), "--out", "out"]
    with pytest.raises(SystemExit, match=said):
        main(["predict", *words])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("--up 0,1", "--up must be 3 numbers, such as 0.5,0.5,0.5, got [0,1]"),
        ("--mean a", "--mean must be numbers, such as 0.5,1, got a"),
        ("--channels grb", "--channels must be one of rgb, bgr, got grb"),
        ("--fov_deg wide", "--fov_deg must be a number, got wide"),
    ],
)
def test_what_cannot_be_read_is_named(capsys, argv, said):
    with pytest.raises(SystemExit):
        main(["predict", "--network", "n.onnx", *argv.split()])
    assert said in capsys.readouterr().err


def test_without_what_a_network_needs(disc, tmp_path, monkeypatch):
    network = str(write_graph(tmp_path / "n.onnx", size=(64, 64)))
    picture, lens = str(disc[0] / "p.png"), json.dumps(lens_of("Equidistant"))
    for argv, said in (
        ([picture], "missing --lens"), (["--lens", lens], "missing pictures or videos"),
        ([picture, "--lens", lens], "missing --out"),
    ):  # fmt: skip
        with pytest.raises(SystemExit, match=said):
            main(["predict", "--network", network, *argv])
    monkeypatch.setattr("darswin.frames.onnx.lack", lambda extra, modules: f"{modules[0]} missing")
    with pytest.raises(SystemExit, match="onnxruntime missing"):
        main(["predict", picture, "--network", network, "--lens", lens])


def test_what_was_found_before_an_error_is_kept(disc, tmp_path):
    """Of a network that computes NaN where there is light, and of a class without a name."""
    folder, _, _ = disc
    write_picture(tmp_path / "in/a.png", np.zeros((*SIZE, 3), np.uint8))
    (tmp_path / "in/b.png").write_bytes((folder / "p.png").read_bytes())
    (tmp_path / "names.txt").write_text("red\n")
    size = (256, 256)
    nan = write_graph(tmp_path / "nan.onnx", "nan boxes", size=size)
    net = write_graph(tmp_path / "n.onnx", size=size)
    for network, argv, said in (
        (nan, [], r"no prediction for .*b\.png: .*nan\.onnx computes NaN"),
        (
            net,
            ["--labels", tmp_path / "names.txt"],
            "found class 1, but --labels has 1 names, from 0 to 0",
        ),
    ):
        with pytest.raises(SystemExit, match=said):
            run_tiles(tmp_path, network, *argv, picture="in")
        (found,) = json.loads((tmp_path / "out" / "predictions.json").read_text())
        assert found["image"] == str(tmp_path / "in/a.png") and found["detections"] == []


# -- masks, keypoints, turned boxes, and other files ----------------------------------------------

PLACES = np.array([(140.0, 100.0), (225.0, 128.0), (95.0, 95.0), (170.0, 150.0)])  # px
ANGLES = np.array([0.2, -0.6, 1.2, 0.9])


def seen_in(view, size):
    """The lens, and the map of each tile of a view of it."""
    lens = {"model": "Equidistant", "focal": 88.0, "center": CENTER, "theta_max": math.radians(95)}
    bound = Equidistant(focal=88.0, theta_max=lens["theta_max"], center=CENTER, image_size=SIZE)
    name, _, count = view.partition(":")
    return lens, make_view(name, size, **({"count": int(count)} if count else {})).at(bound, SIZE)


def stack(rows, width):
    """The rows of each tile, with others whose score is 0."""
    most = max(map(len, rows))
    return np.stack(
        [np.pad(row.reshape(-1, width), ((0, most - len(row)), (0, 0))) for row in rows]
    )


def things_of(remap, size):
    """In each tile, the things whose middles it shows well inside: their numbers and places."""
    found = []
    for tile in remap.tiles:
        places = tile.to_view(PLACES - 0.5) + 0.5
        inner = ((places > 30) & (places < np.array(size[::-1]) - 30)).all(1)
        found.append((np.flatnonzero(inner), places[inner]))
    assert {k for numbers, _ in found for k in numbers} == {*range(len(PLACES))}
    return found


@pytest.mark.parametrize(("view", "size"), [("mercator", (256, 384)), ("tiles:5", (192, 192))])
def test_masks_and_keypoints_come_back(tmp_path, view, size):
    """Discs of the picture are the masks of the view, and their middles and tops its keypoints."""
    lens, remap = seen_in(view, size)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    discs = [np.hypot(x - u, y - v) < 12 for u, v in PLACES]
    tops, rows, masks, points = PLACES - (0, 10), [], [], []
    seen = [np.reshape(remap((255 * disc).astype(np.uint8)), (-1, *size)) / 255 for disc in discs]
    most = max(len(numbers) for numbers, _ in things_of(remap, size))
    for number, (numbers, places) in enumerate(things_of(remap, size)):
        above = remap.tiles[number].to_view(tops[numbers] - 0.5) + 0.5
        far = np.full(places.shape, -500.0)  # beyond what the picture shows
        ones = np.ones((len(places), 3, 1))
        points.append(np.concatenate((np.stack((places, above, far), 1), 0.5 * ones), 2))
        rows.append(np.column_stack((places - 14, places + 14, 0.9 - numbers / 10, numbers)))
        masks.append(np.zeros((most, *size)))
        for row, k in enumerate(numbers):
            masks[-1][row] = seen[k][number]
    table = stack(rows, 6)
    outputs = dict(
        boxes=table[..., :4],
        scores=table[..., 4],
        labels=table[..., 5],
        masks=np.stack(masks),
        keypoints=stack(points, 9).reshape(*table.shape[:2], 3, 3),
    )
    outputs = {name: value.astype(np.float32) for name, value in outputs.items()}
    network = write_detector(tmp_path / "n.onnx", size, outputs, batch=len(table))
    write_picture(tmp_path / "p.png", np.zeros((*SIZE, 3), np.uint8))
    argv = [tmp_path / "p.png", "--network", network, "--view", view]
    (entry,) = predict(*argv, out=tmp_path / "out", lens=lens)
    assert [one["label"] for one in entry["detections"]] == [0, 1, 2, 3]
    for one, disc, place, top in zip(entry["detections"], discs, PLACES, tops, strict=True):
        mask = decode_rle(one["mask"])
        assert (mask & disc).sum() > 0.9 * (mask | disc).sum()
        middle, head, nothing = one["keypoints"]
        np.testing.assert_allclose(middle, [*place, 0.5], atol=0.01)
        np.testing.assert_allclose(head, [*top, 0.5], atol=0.01)
        assert nothing == [None, None, 0.5]
    drawn = cv2.imread(str(tmp_path / "out" / entry["overlay"]))
    assert all(drawn[disc].mean() > 40 for disc in discs)


@pytest.mark.parametrize(("view", "size"), [("mercator", (256, 384)), ("tiles:5", (192, 192))])
@pytest.mark.parametrize("format", ["json", "coco", "yolo"])
def test_turned_boxes_come_back(tmp_path, view, size, format):
    """Their sides are those of the picture: small ones keep their angles to those of the map."""
    lens, remap = seen_in(view, size)
    half, rows = np.array([9.0, 5.0]), []
    for tile, (numbers, places) in zip(remap.tiles, things_of(remap, size), strict=True):
        ahead = PLACES + 0.1 * np.column_stack((np.cos(ANGLES), np.sin(ANGLES)))
        step = tile.to_view(ahead[numbers] - 0.5) + 0.5 - places
        scale = np.hypot(*step.T)[:, None] / 0.1
        turns = np.arctan2(step[:, 1], step[:, 0])
        scores = 0.9 - numbers / 10
        rows.append(np.column_stack((places, 2 * half * scale, scores, numbers, turns)))
    outputs = dict(output0=stack(rows, 7).astype(np.float32))
    names = {0: "a", 1: "b", 2: "c", 3: "d"}
    network = write_detector(
        tmp_path / "n.onnx", size, outputs, batch=len(rows), metadata=dict(task="obb", names=names)
    )
    write_picture(tmp_path / "000042.png", np.zeros((*SIZE, 3), np.uint8))
    argv = [tmp_path / "000042.png", "--network", network, "--view", view, "--format", format]
    (entry,) = predict(*argv, out=tmp_path / "out", lens=lens)
    assert [one["label"] for one in entry["detections"]] == list("abcd")  # of the file itself
    turned = np.array([one["turned"] for one in entry["detections"]])
    np.testing.assert_allclose(turned[:, :2], PLACES, atol=0.5)
    np.testing.assert_allclose(turned[:, 2:4], np.tile(2 * half, (4, 1)), atol=2.0)
    np.testing.assert_allclose(np.sin(turned[:, 4] - ANGLES), 0, atol=0.1)
    for one, (u, _, w, h, angle) in zip(entry["detections"], turned, strict=True):
        across = (w * abs(np.cos(angle)) + h * abs(np.sin(angle))) / 2
        assert abs(one["box"][0] - (u - across)) < 0.6 and abs(one["box"][2] - (u + across)) < 0.6
    if format == "coco":
        results = json.loads((tmp_path / "out/coco.json").read_text())
        assert [one["image_id"] for one in results] == [42] * 4
        assert [one["category_id"] for one in results] == [0, 1, 2, 3]
        for one, given in zip(results, entry["detections"], strict=True):
            x0, y0, x1, y1 = given["box"]
            np.testing.assert_allclose(one["bbox"], [x0, y0, x1 - x0, y1 - y0], atol=0.02)
            assert one["score"] == given["score"] and len(one["segmentation"][0]) == 8
    if format == "yolo":
        lines = (tmp_path / "out/labels/000042.txt").read_text().splitlines()
        for line, (u, v, w, _, angle), given in zip(
            lines, turned, entry["detections"], strict=True
        ):
            label, *numbers, score = map(float, line.split())
            points = np.reshape(numbers, (4, 2)) * [SIZE[1], SIZE[0]]
            ahead = points[1] - points[0]
            np.testing.assert_allclose(points.mean(0), (u, v), atol=0.01)
            np.testing.assert_allclose(ahead, [w * np.cos(angle), w * np.sin(angle)], atol=0.01)
            assert (names[label], round(score, 4)) == (given["label"], given["score"])


def test_each_picture_has_an_id_of_its_own_in_coco(tmp_path):
    """Their names are no ids if two have one number; and an old file is replaced by nothing."""
    rows = np.array([[[10, 10, 30, 30, 0.5, 1]]], np.float32)
    network = write_constants(tmp_path / "n.onnx", (64, 64), found=rows)
    lens = {"model": "Equidistant", "focal": 24.0, "theta_max": 1.2}
    for name in ("in/a/7.png", "in/b/8.png", "in/b/c.png", "more/b/07.png"):
        write_picture(tmp_path / name, np.zeros((64, 80, 3), np.uint8))
    write_frames(tmp_path / "in/v.mp4", np.zeros((2, 64, 80, 3), np.uint8), 10)
    folders, frames = [tmp_path / "in", tmp_path / "more"], ["v.mp4/000000", "v.mp4/000001"]
    names = [f"in/{name}" for name in ("a/7", "b/8", "b/c", *frames)]
    for paths, threshold, ids in (
        (folders[:1], "0.1", [7, 8, "b/c", *frames]),
        (folders, "0.1", [*names, "more/b/07"]),
        (folders, "0.9", []),
    ):
        argv = [*paths, "--network", network, "--format", "coco", "--threshold", threshold]
        predict(*argv, out=tmp_path / "out", lens=lens)
        results = json.loads((tmp_path / "out/coco.json").read_text())
        assert [one["image_id"] for one in results] == ids


def test_a_mask_of_few_pixels_is_a_box_in_yolo():
    """Two points would read as a box."""
    mask = np.zeros((10, 20), bool)
    mask[4, 6:8] = True
    found = dict(
        boxes=np.array([[5.0, 4, 9, 6]]), scores=[0.5], labels=[3], masks=[encode_rle(mask)]
    )
    assert yolo_lines((10, 20), found) == "3 0.35 0.5 0.2 0.2 0.5\n"


def test_infinity_is_null_in_json(tmp_path):
    points = np.array([[[[32, 32, np.inf], [np.inf, 32, 0.5]]]], np.float32)
    (one,) = run_constants(
        tmp_path, view="mercator", boxes=np.array([[[20, 20, 40, 40]]], np.float32),
        scores=np.array([[0.9]], np.float32), labels=np.array([[1]]), keypoints=points,
    )["detections"]  # fmt: skip
    assert one["keypoints"][0][2] is None and one["keypoints"][1] == [None, None, 0.5]


def test_boxes_that_overlap_are_merged_and_words_answer_questions(tmp_path, capsys):
    """Of YOLO without its metadata, in whose boxes each thing has several."""
    y, x = np.mgrid[:16, :16] * 8 + 4.0
    cells = np.array([x.ravel(), y.ravel(), 0 * x.ravel() + 60, 0 * x.ravel() + 60])
    rows = np.concatenate((cells, np.zeros((2, 256))))
    near = (np.abs(x - 56) < 5) & (np.abs(y - 56) < 5)
    rows[5, np.flatnonzero(near.ravel())] = np.linspace(0.8, 0.9, near.sum())
    rows = np.pad(rows, ((0, 0), (0, 80)))  # the cells of 16 and 32 px
    size, place = (128, 128), (64, 80)
    network = write_detector(tmp_path / "n.onnx", size, {"output0": rows[None].astype(np.float32)})
    write_picture(tmp_path / "p.png", np.zeros((*place, 3), np.uint8))
    lens = {"model": "Equidistant", "focal": 24.0, "image_size": [*place], "theta_max": 1.2}
    argv = [tmp_path / "p.png", "--network", network]
    with pytest.raises(SystemExit, match=r"2 classes \(detect\), .*: say which by --task, or"):
        predict(*argv, out=tmp_path / "out", lens=lens)
    (entry,) = predict(*argv, "--task", "detect", out=tmp_path / "out", lens=lens)
    (one,) = entry["detections"]
    assert (one["label"], one["score"]) == (1, 0.9)
    assert "detections (Ultralytics detect); pixels are rgb" in capsys.readouterr().err


def test_pixels_are_those_of_the_form_unless_they_are_given(tmp_path, capsys):
    outputs = dict(dets=np.full((1, 5, 4), 0.5, np.float32), labels=np.zeros((1, 5, 9), np.float32))
    network = write_detector(tmp_path / "n.onnx", (64, 64), outputs)
    for argv, mean, std, step in (
        ({}, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225), 1),
        ({"std": (0.5,)}, (0.0,) * 3, (0.5,) * 3, 1),
        ({"mean": (0.2,), "channels": "bgr"}, (0.2,) * 3, (1.0,) * 3, -1),
    ):
        answers = NetworkAnswers(str(network), **argv)
        assert (answers._mean, answers._std, answers._step) == (mean, std, step)
        said = capsys.readouterr().err
        assert "detections (RF-DETR); pixels are" in said and f"std {std[0]:g}" in said
    network = write_constants(
        tmp_path / "m.onnx", (64, 64), maps=np.zeros((1, 3, 64, 64), np.float32)
    )
    with pytest.raises(ValueError, match=r"`format` is for detections, but .* a network for maps"):
        NetworkAnswers(str(network), format="coco")


# -- maps and numbers -------------------------------------------------------------------------


@pytest.mark.parametrize("view", ["none", "tiles:5", "mercator", "square", "perspective"])
def test_maps_come_back_to_the_pixels(tmp_path, view):
    """A map of the view's own pixels is the picture again, where the view shows it."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    smooth = [128 + 100 * np.sin(x / 40), 128 + 100 * np.cos(y / 30), 60 + 0 * x]
    picture = np.stack(smooth, -1).astype(np.uint8)
    write_picture(tmp_path / "p.png", picture)
    size = SIZE if view == "none" else (320, 320)
    network = write_graph(tmp_path / "n.onnx", "map and numbers", size=size)
    argv = [tmp_path / "p.png", "--network", network, "--view", view]
    argv += ["--fov_deg", "120"] if view == "perspective" else []
    (entry,) = predict(*argv, out=tmp_path / "out", lens=lens_of("Equidistant"))
    files = entry["same"]
    assert files == {"map": "maps/same/p.npy", "labels": "labels/same/p.png",
                     "overlay": "overlays/same/p.jpg"}  # fmt: skip
    same = np.load(tmp_path / "out" / files["map"])
    assert same.shape == (3, *SIZE) and same.dtype == np.float32
    labels = np.asarray(Image.open(tmp_path / "out" / files["labels"]))
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


def test_numbers_are_printed_or_written_to_a_file(disc, tmp_path, capsys):
    folder, _, _ = disc
    network = write_graph(tmp_path / "n.onnx", "numbers", size=(64, 64))
    argv = ["predict", str(folder / "p.png"), "--network", str(network), "--view", "tiles:4"]
    argv += ["--lens", json.dumps(lens_of("Equidistant"))]
    main(argv)
    (entry,) = json.loads(capsys.readouterr().out)
    assert np.array(entry["logits"]).shape == (4, 3) and entry["image"] == str(folder / "p.png")
    main([*argv, "--out", str(tmp_path / "o.json")])
    assert json.loads((tmp_path / "o.json").read_text()) == [entry]


def run_constants(folder, *argv, size=(64, 64), view="mercator", **outputs):
    """What a network with these outputs gives for a picture of 64 × 80 pixels."""
    network = write_constants(folder / "n.onnx", size, **outputs)
    write_picture(folder / "p.png", np.zeros((64, 80, 3), np.uint8))
    lens = {"model": "Equidistant", "focal": 24.0, "image_size": [64, 80], "theta_max": 1.2}
    argv = [folder / "p.png", "--network", network, "--view", view, *argv]
    (entry,) = predict(*argv, out=folder / "out", lens=lens)
    return entry


@pytest.mark.parametrize("view", ["mercator", "tiles:4", "square", "panorama"])
@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint8, np.bool_])
def test_a_map_of_integers_keeps_its_ids(tmp_path, view, kind):
    """Of the size of the view, and of a quarter of it without a channel."""
    count = 4 if view == "tiles:4" else 1
    ids = np.zeros((1, 1, 64, 64), kind)
    ids[..., 20:, :], ids[..., 30:, 41:] = (1, 1) if kind is np.bool_ else (10, 3)
    names = ["x", "y", "z", "three", *"abcdef", "ten"]
    (tmp_path / "names.json").write_text(json.dumps(names))
    outputs = dict(whole=ids, quarter=ids[:, 0, ::4, ::4])
    entry = run_constants(tmp_path, "--labels", tmp_path / "names.json", view=view, **outputs)
    known = {0, 1} if kind is np.bool_ else {0, 3, 10}
    assert count == len({*entry} & {"whole"}) * count
    for output in outputs:
        found = np.load(tmp_path / "out" / entry[output]["map"])
        labels = np.asarray(Image.open(tmp_path / "out" / entry[output]["labels"]))
        assert found.shape == (1, 64, 80) and set(np.unique(found)) == known
        assert set(np.unique(labels)) == known | {255}
        shown = labels != 255
        assert (found[0] == labels)[shown].all() and not found[0][~shown].any()
        shares = {names[k]: pytest.approx((labels[shown] == k).mean(), abs=1e-6) for k in known}
        assert entry[output]["shares"] == shares


F = np.float32
HEADS = {f"p{k}": np.zeros((1, 255, 64 // k, 64 // k), F) for k in (8, 16, 32)}


@pytest.mark.parametrize(
    ("outputs", "said"),
    [
        (dict(heads=np.zeros((1, 1, 100, 9), F)), r"heads \(1, 1, 100, 9\); known"),
        (dict(maps=np.zeros((1, 3, 32, 16), F)), r"maps \(1, 3, 32, 16\); known are .*fraction"),
        (dict(maps=np.zeros((1, 3, 48, 48), F)), r"maps \(1, 3, 48, 48\); known"),
        (dict(maps=np.zeros((1, 3, 128, 128), F)), r"maps \(1, 3, 128, 128\); known"),
        (dict(last=np.zeros((1, 32, 32, 3), F)), r"last \(1, 32, 32, 3\); known"),
        (dict(table=np.zeros((1, 32, 32), F)), r"table \(1, 32, 32\); known"),
        (HEADS, r"same channels at several scales, p8 \(255, 8, 8\), .* heads of a detector"),
    ],
    ids=str,
)
def test_what_is_no_map_is_refused(tmp_path, outputs, said):
    with pytest.raises(SystemExit, match=said):
        run_constants(tmp_path, **outputs)


def test_maps_at_several_scales_may_be_maps(tmp_path):
    """A network and its auxiliary output; and one pixel is a number."""
    entry = run_constants(
        tmp_path, main=np.zeros((1, 5, 64, 64), F), aux=np.zeros((1, 5, 8, 8), F),
        pooled=np.arange(3, dtype=F).reshape(1, 3, 1, 1),
    )  # fmt: skip
    assert entry["pooled"] == [0, 1, 2]
    assert all(entry[name]["labels"] for name in ("main", "aux"))


CORNERS = np.array([[[8, 10, 30, 40], [40, 5, 60, 22], [20, 30, 50, 60]]], F)
CENTRES = np.array([[[30, 40, 8, 10], [50, 22, 8, 9], [20, 30, 50, 60]]], F)


@pytest.mark.parametrize(
    ("boxes", "said"),
    [
        (CENTRES, r"2 of 3 boxes of .* were left out: 2 without an area, .*centres and sizes"),
        (CORNERS / 64, r"3 within the first 2 px\. They may be parts of the picture"),
        (CENTRES / 64, r"3 within the first 2 px\. They may be parts of the picture"),
        (CORNERS[..., [2, 3, 0, 1]], "3 without an area"),
        (CORNERS, None),
    ],
)
def test_boxes_that_are_none_are_an_error(tmp_path, capsys, boxes, said):
    outputs = dict(boxes=boxes, scores=np.full((1, 3), 0.9, F), labels=np.zeros((1, 3), np.int64))
    if said is None:
        assert len(run_constants(tmp_path, view="stereographic", **outputs)["detections"]) == 3
        return
    with pytest.raises(SystemExit, match=said) as error:
        run_constants(tmp_path, **outputs)
    assert error.value.code != 0 and "corners x0, y0, x1, y1 in pixels" in capsys.readouterr().err
    assert json.loads((tmp_path / "out/predictions.json").read_text())  # what was found is kept


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
        (
            "data.yaml",
            "train: images",
            "--labels must be a file with the names .*data.yaml: train is no number",
        ),
        ("n.json", '{"person": 0}', "person is no number of a class"),
        ("n.json", "[1, 2]", "1 is no name of class 0"),
        ("n.json", '{"0": "a", "00": "b"}', "0 appears twice"),
        ("map.pbtxt", "item { name: 'a' }", "an item has no id: name: 'a'"),
        ("n.txt", "\n\n", "it has no names; known are a text file with a name in each line"),
        ("n.txt", "person\n", "found class 2, but --labels has 1 names, from 0 to 0"),
    ],
)
def test_names_of_classes_in_every_form(tmp_path, name, text, said):
    file = tmp_path / name
    file.write_text(text, newline="")
    outputs = dict(boxes=CORNERS[:, :2], scores=np.array([[0.9, 0.8]], F),
                   labels=np.array([[0, 2]]))  # fmt: skip
    if said is None:
        entry = run_constants(tmp_path, "--labels", file, view="stereographic", **outputs)
        assert [one["label"] for one in entry["detections"]] == ["person", "bicycle"]
    else:
        with pytest.raises(SystemExit, match=said):
            run_constants(tmp_path, "--labels", file, **outputs)


def test_the_best_classes_of_a_classifier(tmp_path, capsys):
    names = tmp_path / "n.txt"
    names.write_text("cat\ndog\n\ncow\n")
    logits = np.array([[1.0, 3.0, -9.0, 2.0]], F)
    shares = np.exp(logits[0]) / np.exp(logits[0]).sum()
    for values, key, expected in (
        (logits, "probability", shares), (shares[None], "probability", shares),
        (np.array([[0.5, 0.9, 0.0, 0.7]], F), "score", [0.5, 0.9, 0.0, 0.7]),
    ):  # fmt: skip
        for argv in (["--top", "2"], ["--top", "2", "--labels", names]):
            entry = run_numbers(tmp_path, *argv, out=values)
            said = capsys.readouterr().err  # a warning is said once
            assert ("gives logits: their softmax" in said) == (
                values is logits and "--labels" not in argv
            )
            assert [one["class"] for one in entry["out"]] == (
                ["dog", "cow"] if "--labels" in argv else [1, 3]
            )
            found = [one[key] for one in entry["out"]]
            assert found == pytest.approx([expected[1], expected[3]], abs=1e-5)
    assert run_numbers(tmp_path, out=logits)["out"] == logits[0].tolist()
    with pytest.raises(SystemExit, match=r"--labels names the classes 0 to 3, but .*: 3 in out"):
        run_numbers(tmp_path, "--labels", names, out=logits[:, :3])


def run_numbers(folder, *argv, out):
    network = write_constants(folder / "n.onnx", (64, 64), out=out)
    write_picture(folder / "p.png", np.zeros((64, 80, 3), np.uint8))
    lens = json.dumps({"model": "Equidistant", "focal": 24.0, "theta_max": 1.2})
    words = [folder / "p.png", "--network", network, "--lens", lens, *argv]
    main(["predict", *map(str, words), "--out", str(folder / "o.json")])
    return json.loads((folder / "o.json").read_text())[0]
