"""`darswin predict`: its arguments, the lenses of files, and classes of pictures and videos."""

import json
import os
import socket

import cv2
import hypothesis.strategies as st
import numpy as np
import pytest
import torch
import yaml
from helpers import fixture
from hypothesis import given
from PIL import ExifTags, Image, ImageOps
from scenes import write_plain
from videos import turn_video, write_video

from darswin.cli.answers import ClassAnswers
from darswin.cli.lenses import given_lenses, lenses_of_run
from darswin.cli.main import main
from darswin.compat import load_official
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD
from darswin.lens import Spherical, from_dict, load, save
from darswin.lens.orientation import in_upright_picture
from darswin.models.registry import pretrained_file
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.utils.video import read_frames

LENS = {"model": "Spherical", "xi": 0.5, "fov": 2.8}
CIRCLE = {"model": "Equidistant", "fov": 2.8}
SIZE = (64, 96)
COLMAP = """1 OPENCV_FISHEYE 96 64 40 40 48 32 0 0 0 0
2 OPENCV_FISHEYE 96 64 30 30 48 32 0 0 0 0
"""
UNNAMED = dict(K=[30.0, 0, 47.5, 0, 30.0, 31.5, 0, 0, 1], D=[0.1, 0.02, 0.01, 0], w=96, h=64)


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path)


def write_run(folder):
    """A run's folder with an untrained model in it, a picture, and calibrations."""
    options = dict(num_classes=6, in_chans=3, mean=[0.5] * 3, std=[0.25] * 3)
    card = ModelCard("darswin_a_nano", options, list("abcdef"), 32, 2.8)
    save_model(folder / "checkpoints" / "best.safetensors", card.create().state_dict(), card)
    picture = np.random.default_rng(0).integers(256, size=(*SIZE, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "p.png"), picture)
    (folder / "cameras.txt").write_text(COLMAP)
    (folder / "kd.json").write_text(json.dumps(UNNAMED))
    (folder / "other.json").write_text(json.dumps({"name": "A camera", "focal_mm": 2.1}))
    return folder


def answers(argv, run, capsys, lens=LENS) -> list[dict]:
    lens = json.dumps(lens) if isinstance(lens, dict) else str(lens)
    main(["predict", *map(str, argv), "--lens", lens, "--run", str(run), "--top", "6"])
    return json.loads(capsys.readouterr().out)


def close(one: dict, other: dict) -> bool:
    a, b = ({t["class"]: t["probability"] for t in answer["top"]} for answer in (one, other))
    return all(a[name] == pytest.approx(b[name], abs=1e-4) for name in a)


def test_the_most_probable_classes(run, capsys):
    argv = [str(run / "p.png"), str(run / "p.png"), "--top", "3", "--run", str(run)]
    main(["predict", *argv, "--lens", json.dumps(LENS)])
    printed = json.loads(capsys.readouterr().out)
    assert [p["image"] for p in printed] == [str(run / "p.png")] * 2
    assert all(len({t["class"] for t in p["top"]}) == 3 for p in printed)
    probabilities = [t["probability"] for t in printed[0]["top"]]
    assert probabilities == sorted(probabilities, reverse=True)
    (run / "lens.json").write_text(json.dumps(LENS))
    main(["predict", *argv, "--lens", str(run / "lens.json"), "--out", str(run / "out.json")])
    assert json.loads((run / "out.json").read_text()) == printed
    # They are the model's for the normalised picture.
    net, _ = load_model(run / "checkpoints" / "best.safetensors")
    image = cv2.imread(str(run / "p.png"))[..., ::-1]
    image = cv2.resize(np.ascontiguousarray(image), (48, 32), interpolation=cv2.INTER_AREA)
    image = (torch.from_numpy(image).permute(2, 0, 1)[None] / 255 - 0.5) / 0.25
    expected = net(image, Spherical.from_fov(0.5, 2.8, 16)).softmax(-1)[0]
    for entry in printed[0]["top"]:
        k = "abcdef".index(entry["class"])
        assert entry["probability"] == pytest.approx(expected[k].item(), abs=1e-5)


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("none.png p.png a.mp4 --run . --lens L", r"no file or folder none\.png, a\.mp4$"),
        ("p.png --model m.safetensors --lens L", r"No such file .*m\.safetensors"),
        ("none.png --lens L", "give either --run, .* or --model, a safetensors file or one of"),
        ("p.png --model digits --run .", "or --model, a safetensors file or one of digits"),
        ("p.png --run . --lens {}", 'or a "model" of darswin'),
        ("p.png --run . --lens none.json", r"there is no calibration file none\.json"),
        ("p.png --run . --lens 170", '--lens 170 is a number, but must be a calib.*"fov_deg": 170'),
        (
            "p.png --run . --lens other.json",
            r"other\.json: (?!.*must name).*its entries are '?name",
        ),
        ("p.png --run .", "missing --lens: give the camera"),
        ("--lens L --run .", "missing pictures or videos"),
        ("p.png --model digits", "missing --lens: give the camera"),
        (
            "p.png --run checkpoints/best.safetensors --lens L",
            "--run names the folder .* a file",
        ),
        (
            "p.png --run . --lens L --out p.png",
            r"--out p\.png would replace p\.png, which this",
        ),
        ("p.png --run . --lens lens.json --out ./lens.json", r"would replace lens\.json"),
        ("p.png --run . --lens L --every 0", "--every must be at least 1, got 0"),
        ("p.png --run . --lens L --task distance", r"--task is distance, but .*best\.safe"),
        ("checkpoints --run . --lens L", "no pictures or videos in checkpoints"),
        ("p.png --run . --lens cameras.txt", "choose one with --camera: '1', '2'"),
        ("p.png --run . --lens kd.json", 'give --coefficients "fisheye" or "pinhole"'),
        ("p.png --run . --lens checkpoints", r"no calibration in .*: checkpoints/p\.json"),
        ("p.png --run . --lens checkpoints --camera 1", "--camera 1 chooses a camera of a file"),
    ],
)
def test_what_is_wrong_is_named(run, monkeypatch, argv, said):
    monkeypatch.chdir(run)
    (run / "lens.json").write_text(json.dumps(CIRCLE))
    words = [json.dumps(LENS) if word == "L" else word for word in argv.split()]
    with pytest.raises(SystemExit, match=said):
        main(["predict", *words])


def test_the_lenses_of_files(run, monkeypatch):
    """Of one calibration, of a lenses.json, and of a folder with a calibration of each file."""
    for folder, name in (("own", "2"), ("all", "p"), ("all", "1")):
        (run / folder).mkdir(exist_ok=True)
        (run / folder / f"{name}.json").write_text(json.dumps(UNNAMED))
    (run / "own" / "2.png").touch()
    (run / "lenses.json").write_text(json.dumps({"own/2.png": "lens.json", ".": CIRCLE}))
    camera = load(run / "cameras.txt", camera="2", image_size=SIZE)
    save(camera, run / "lens.json")
    pinhole = load(run / "kd.json", coefficients="pinhole")
    circle = from_dict(CIRCLE | {"center": [47.5, 31.5], "image_size": list(SIZE)})
    monkeypatch.chdir(run / "own")
    for options, expected in (
        ((str(run / "cameras.txt"), "2", None), [camera, camera]),
        ((str(run / "kd.json"), None, "pinhole"), [pinhole, pinhole]),
        ((json.dumps(CIRCLE), None, None), [circle, circle]),
        ((str(run / "lenses.json"), None, None), [camera, circle]),
        ((str(run / "own"), None, "pinhole"), [pinhole, None]),
        ((str(run / "all"), None, "pinhole"), [None, pinhole]),
    ):
        files = ["2.png", "../p.png"]
        lenses = given_lenses(*options, files)
        for file, lens in zip(files, expected, strict=True):
            if lens is None:
                with pytest.raises(ValueError, match=f"{file} has no lens"):
                    lenses[file].lens_of(file, SIZE)
            else:
                found = lenses[file].lens_of(file, SIZE)
                assert str(found) == str(in_upright_picture(lens, SIZE, 1))


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """A run, pictures that its lens fits, and others that have no answer."""
    folder = tmp_path_factory.mktemp("mixed")
    write_run(folder)
    (folder / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (folder / "folder.png").mkdir()
    cv2.imwrite(str(folder / "q.png"), np.zeros((32, 48), np.uint8))
    cv2.imwrite(str(folder / "square.png"), np.zeros((40, 40, 3), np.uint8))
    return folder


GOOD, BAD = ("p.png", "q.png"), ("broken.png", "folder.png", "square.png")


@given(st.lists(st.sampled_from(GOOD + BAD), min_size=1, max_size=6), st.integers(-3, 9))
def test_every_picture_is_answered_or_named(mixed, pictures, top):
    argv = [str(mixed / name) for name in pictures]
    argv += ["--run", str(mixed), "--top", str(top), "--out", str(mixed / "out.json")]
    argv += ["--lens", json.dumps(LENS | {"image_size": list(SIZE)})]
    good = [str(mixed / name) for name in pictures if name in GOOD and top > 0]
    (mixed / "out.json").unlink(missing_ok=True)
    if len(good) == len(pictures):
        main(["predict", *argv])
    else:
        with pytest.raises(SystemExit) as caught:
            main(["predict", *argv])
        bad = len(pictures) - len(good)
        first = f"darswin: no prediction for {bad} of {len(pictures)} pictures:"
        assert not good or str(caught.value).splitlines()[0] == first
        named = all(name in str(caught.value) for name in pictures if name in BAD)
        assert named if top > 0 else "--top must be at least 1" in str(caught.value)
    found = json.loads((mixed / "out.json").read_text()) if good else []
    assert [answer["image"] for answer in found] == good
    assert all(len(answer["top"]) == min(top, 6) for answer in found)


# With each thing that a turn changes: a center, oblong pixels, tangential terms.
SENSOR_LENS = {
    "model": "KannalaBrandt", "focal": 30, "radial": [0.02, -0.01], "tangential": [0.01, -0.02],
    "theta_max": 1.3, "center": [52.0, 29.0], "affine": [[1.0, 0.02], [0.0, 0.95]],
    "image_size": [64, 96],
}  # fmt: skip


def test_a_picture_that_exif_turns_is_answered_as_the_upright_one(run, capsys):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.open(run / "p.png").save(run / "exif.png", exif=exif)
    ImageOps.exif_transpose(Image.open(run / "exif.png")).save(run / "upright.png")
    turned = in_upright_picture(from_dict(SENSOR_LENS), SIZE[::-1], 6)
    save(turned, run / "turned.json")
    (expected,) = answers([run / "upright.png"], run, capsys, run / "turned.json")
    (found,) = answers([run / "exif.png"], run, capsys, SENSOR_LENS)
    assert close(found, expected)
    with pytest.raises(SystemExit, match=r"exif\.png: the calibration is for .*orientation is 6"):
        answers([run / "exif.png"], run, capsys, SENSOR_LENS | {"image_size": [90, 90]})


def test_a_large_picture_is_reduced_by_area(run, monkeypatch):
    noise = np.random.default_rng(0).integers(256, size=(1024, 1024, 3), dtype=np.uint8)
    cv2.imwrite(str(run / "noise.png"), noise[..., ::-1])
    read, predict = [], ClassAnswers._run
    monkeypatch.setattr(
        ClassAnswers, "_run", lambda self, *inputs: read.append(inputs) or predict(self, *inputs)
    )
    main(["predict", str(run / "noise.png"), "--lens", json.dumps(LENS), "--run", str(run)])
    ((images, _),) = read
    means = noise.reshape(32, 32, 32, 32, 3).mean((1, 3))  # 32 × 32 px become one
    np.testing.assert_allclose(images[0].permute(1, 2, 0), means, atol=0.51)


def test_weights_of_the_released_model(tmp_path, capsys):
    """As `darswin convert` writes them: what the released code computes of ImageNet's pixels."""
    _, state, _ = fixture("angular")
    pixels = np.random.default_rng(1).integers(256, size=(64, 64, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "p.png"), pixels[..., ::-1])
    config = {"DATA": {"IMG_SIZE": 64}}
    torch.save({"model": state, "config": config, "epoch": 325}, tmp_path / "released.pth")
    main(["convert", str(tmp_path / "released.pth"), str(tmp_path / "m.safetensors")])
    argv = ["predict", str(tmp_path / "p.png"), "--lens", json.dumps(LENS), "--top", "10"]
    main([*argv, "--model", str(tmp_path / "m.safetensors")])
    (found,) = json.loads(capsys.readouterr().out)
    mean, std = (torch.tensor(t)[:, None, None] for t in (IMAGENET_MEAN, IMAGENET_STD))
    image = (torch.from_numpy(pixels).permute(2, 0, 1) / 255 - mean) / std
    with torch.no_grad():
        logits = load_official(state)(image[None], Spherical.from_fov(0.5, 2.8, 32.0))
    expected = logits.softmax(-1)[0]
    for entry in found["top"]:
        assert entry["probability"] == pytest.approx(expected[entry["class"]].item(), abs=1e-5)
    # Its pictures are square: of another the middle is taken.
    cv2.imwrite(str(tmp_path / "p.png"), np.pad(pixels, ((0, 0), (8, 8), (0, 0)))[..., ::-1])
    main([*argv, "--model", str(tmp_path / "m.safetensors")])
    assert close(found, json.loads(capsys.readouterr().out)[0])
    torch.save({"model": {"a": torch.ones(2)}}, tmp_path / "other.pth")
    main(["convert", str(tmp_path / "other.pth"), str(tmp_path / "other.safetensors")])
    said = "not the name of their model, and are not a state dict.*LensAdapter, runs in Python"
    with pytest.raises(SystemExit, match=said):
        main([*argv, "--model", str(tmp_path / "other.safetensors")])


def test_the_first_prediction(capsys):
    """Without a run, pictures or a lens of one's own; and the same, spelled out."""
    main(["predict", "--model", "digits"])
    (found,) = json.loads(capsys.readouterr().out)
    sample, lens = (str(pretrained_file("digits", kind)) for kind in ("png", "json"))
    assert found["image"] == sample and found["top"][0]["class"] == "4"
    assert found["top"][0]["probability"] > 0.8
    main(["predict", sample, "--model", "digits", "--lens", lens])
    assert json.loads(capsys.readouterr().out) == [found]


@pytest.mark.parametrize("kind", ["a pipe", "a socket", "a device"])
def test_what_is_no_file_is_refused_at_once(run, capsys, kind, monkeypatch):
    """As a picture, a video, a calibration, a model, and in a folder."""
    monkeypatch.chdir(run)  # paths of sockets must be short
    (run / "in").mkdir()
    for name in ("f.png", "f.mp4", "f", "in/f.png", "f.safetensors", "f.json"):
        if kind == "a pipe":
            os.mkfifo(name)
        elif kind == "a socket":
            with socket.socket(socket.AF_UNIX) as made:
                made.bind(name)
        else:
            (run / name).symlink_to("/dev/zero")
    lens, known = ["--lens", json.dumps(LENS)], ["--run", "."]
    for words, name in (
        (["f.png", *known, *lens], "f.png"),
        (["p.png", "f.mp4", *known, *lens], "f.mp4"),
        (["f", *known, *lens], "f"),
        (["in", *known, *lens], "in/f.png"),
        (["p.png", *known, "--lens", "f.json"], "f.json"),
        (["p.png", "--model", "f.safetensors", *lens], "f.safetensors"),
    ):
        with pytest.raises(SystemExit) as caught:
            main(["predict", *words])
        assert str(caught.value) == f"darswin: {name} must be a file, but is {kind}"
        assert caught.value.code == 2 and not capsys.readouterr().out
    with pytest.raises(SystemExit, match=f"must be a file, but is {kind}"):
        main(["fit", "--run", "r", "--data.path", "digits", "--data.lens", "f.json"])


# -- the lens of the run ----------------------------------------------------------------------


def begun(run, task="classification", **data):
    """A run's folder with a configuration."""
    data = {"path": str(run), "lens": None, "camera": None, "coefficients": None} | data
    (run / "config.yaml").write_text(yaml.safe_dump({"task": task, "data": data}))
    return run


def test_a_run_brings_its_own_lens(run, capsys, tmp_path):
    """Of each form that `fit` takes; a lens that is given wins."""
    far = LENS | {"xi": 1.0}
    (run / "one.json").write_text(json.dumps(far))
    (run / "sub").mkdir()
    (run / "sub" / "p.png").write_bytes((run / "p.png").read_bytes())
    entries = {"sub": "one.json", ".": LENS}
    (run / "lenses.json").write_text(json.dumps(entries))
    argv = ["predict", str(run / "p.png"), str(run / "sub" / "p.png"), "--run", str(run)]
    argv += ["--top", "6"]

    def printed(*more):
        main([*argv, *more])
        said = capsys.readouterr()
        return json.loads(said.out), said.err

    one, near = (printed("--lens", json.dumps(lens))[0] for lens in (far, LENS))
    assert not close(one[0], near[0])
    unnamed = printed("--lens", str(run / "kd.json"), "--coefficients", "pinhole")[0]
    second = printed("--lens", str(run / "cameras.txt"), "--camera", "2")[0]
    for data, more, expected in (
        (dict(lens=str(run / "one.json")), (), one),
        (dict(lens=json.dumps(LENS)), (), near),
        (dict(lens=str(run / "lenses.json")), (), [near[0], one[1]]),
        (dict(lens=str(run / "cameras.txt"), camera="2"), (), second),
        (dict(lens=str(run / "cameras.txt"), camera="1"), ("--camera", "2"), second),
        (dict(lens=str(run / "kd.json"), coefficients="pinhole"), (), unnamed),
        (dict(lens=str(run / "kd.json")), ("--coefficients", "pinhole"), unnamed),
    ):
        begun(run, **data)
        found, said = printed(*more)
        assert all(close(a, b) for a, b in zip(found, expected, strict=True))
        assert said == f"darswin: lens of the run: {data['lens']}\n"
    given, said = printed("--lens", json.dumps(LENS))
    assert given == near and "lens of the run" not in said


@pytest.mark.parametrize("task", ["segmentation", "distance"])
@pytest.mark.parametrize("kind", ["one", "each", "splits"])
def test_a_run_brings_the_lenses_of_its_scenes(tmp_path, monkeypatch, capsys, kind, task):
    scenes = tmp_path / "scenes"
    first, second = (from_dict(LENS | {"xi": xi, "image_size": [121, 160]}) for xi in (0.2, 0.9))
    if kind == "splits":
        for split, lens in (("train", first), ("test", second)):
            write_plain(scenes, 4, lens=lens, split=split)
    else:
        write_plain(scenes, 4, lens=first, own_lenses=kind == "each")
    begun(tmp_path, task, path=str(scenes), holdout=0.1)
    monkeypatch.chdir(tmp_path)
    folder = "scenes/test/images" if kind == "splits" else "scenes/images"
    files = [f"{folder}/{k:03}.png" for k in range(4)]
    found = lenses_of_run(".", None, None, files)
    assert capsys.readouterr().err == f"darswin: lenses of the run's data set: {scenes}\n"
    expected = second if kind == "splits" else first
    for file in files:
        got = found[file].lens_of(file, (121, 160))
        assert got.same_as(expected.replace(center=got.center))
    if kind == "one":
        assert lenses_of_run(".", None, None, ["elsewhere.png"])["elsewhere.png"].camera_of("x")
        return
    with pytest.raises(ValueError, match=r"several lenses, but not these files: \['elsewhere"):
        lenses_of_run(".", None, None, [*files, "elsewhere.png"])


def test_a_run_without_a_lens_for_the_pictures_is_named(run, tmp_path):
    (run / "sub").mkdir()
    (run / "lenses.json").write_text(json.dumps({"sub": CIRCLE}))
    for data, said in (
        (dict(lens=str(run / "lenses.json")), r"lenses\.json has no lens for .*p\.png"),
        (dict(lens=str(run / "gone.json")), r"there is no calibration file .*gone\.json"),
        (dict(lens=str(run / "cameras.txt")), "several cameras, choose one with --camera"),
        ({}, "was trained on pictures without a lens"),
        (dict(task="segmentation", path=str(run / "gone")), "no folder .*gone"),
        (dict(task="distance"), "no scenes in "),
    ):
        begun(run, **data)
        with pytest.raises(SystemExit, match=f"missing --lens: give the camera's .*{said}"):
            main(["predict", str(run / "p.png"), "--run", str(run)])


def as_pictures(video, folder, **options):
    """The frames of a video as upright pictures."""
    folder.mkdir()
    for frame in read_frames(video, **options):
        cv2.imwrite(str(folder / f"{frame.number:03}.png"), frame.image[..., ::-1])
    return folder


def test_each_frame_of_a_video(run, capsys):
    write_video(run / "v.mp4", 19)
    argv = ["--lens", json.dumps(LENS), "--run", str(run), "--top", "6", "--every", "4"]
    main(["predict", str(run / "p.png"), str(run / "v.mp4"), *argv])
    said = capsys.readouterr()
    picture, *found, speed = json.loads(said.out)
    assert picture["image"] == str(run / "p.png")
    assert all(answer["video"] == str(run / "v.mp4") for answer in found)
    assert [answer["frame"] for answer in found] == [0, 4, 8, 12, 16]
    assert [answer["time"] for answer in found] == pytest.approx([0, 0.4, 0.8, 1.2, 1.6])
    same = answers([as_pictures(run / "v.mp4", run / "f", every=4)], run, capsys)
    assert all(close(a, b) for a, b in zip(found, same, strict=True))
    assert speed["video"] == str(run / "v.mp4") and speed["frames"] == 5
    overall, network = speed["frames_per_second"], speed["network_frames_per_second"]
    assert 0 < overall < network
    line = f"darswin: {run}/v.mp4: 5 frames at {overall} frames/s; the network alone:"
    assert f"{line} {network} frames/s" in said.err


def test_a_video_that_its_metadata_turns(run, capsys):
    """As its upright frames, with their lens turned another way: by EXIF of a picture."""
    write_video(run / "v.mp4", 3)
    turn_video(run / "v.mp4", 90)
    *found, _ = answers([run / "v.mp4"], run, capsys, SENSOR_LENS)
    save(in_upright_picture(from_dict(SENSOR_LENS), SIZE[::-1], 6), run / "turned.json")
    same = answers([as_pictures(run / "v.mp4", run / "f")], run, capsys, run / "turned.json")
    assert all(close(a, b) for a, b in zip(found, same, strict=True))
    other = {key: value for key, value in SENSOR_LENS.items() if key != "center"}
    assert not close(found[0], answers([run / "v.mp4"], run, capsys, other)[0])


def test_a_video_that_is_damaged(run, capsys):
    write_video(run / "cut.avi", 40, codec="MJPG")
    content = (run / "cut.avi").read_bytes()
    (run / "cut.avi").write_bytes(content[: len(content) // 2])
    (run / "none.mp4").write_text("no video")
    write_video(run / "wide.avi", 2, size=(64, 128), codec="MJPG")
    names = ("cut.avi", "none.mp4", "p.png", "wide.avi")
    with pytest.raises(SystemExit) as caught:
        answers([run / name for name in names], run, capsys, LENS | {"image_size": list(SIZE)})
    *frames, speed, picture = json.loads(capsys.readouterr().out)
    assert [answer["frame"] for answer in frames] == list(range(speed["frames"]))
    assert 5 < speed["frames"] < 35 and picture["image"] == str(run / "p.png")
    first, *lines = str(caught.value).splitlines()
    assert first == "darswin: no complete prediction for 3 of 4 files:"
    said = ("cut.avi is damaged or cut off", "none.mp4", "the picture is 128×64")
    assert all(text in line for text, line in zip(said, lines, strict=True))
