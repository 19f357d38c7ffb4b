"""`darswin predict`: the lenses of files and of runs, and classes of pictures and videos."""

import json

import cv2
import numpy as np
import pytest
import torch
import yaml
from helpers import fixture, refused
from scenes import write_plain
from videos import write_video

from darswin.cli.answers import ClassAnswers
from darswin.cli.lenses import given_lenses, lenses_of_run
from darswin.cli.main import main
from darswin.compat import load_official
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD
from darswin.lens import Spherical, from_dict, load, save
from darswin.lens.orientation import in_upright_picture
from darswin.models.registry import pretrained_file
from darswin.models.saving import ModelCard, load_model, save_model

LENS = {"model": "Spherical", "xi": 0.5, "fov": 2.8}
CIRCLE = {"model": "Equidistant", "fov": 2.8}
SIZE = (64, 96)
COLMAP = """1 OPENCV_FISHEYE 96 64 40 40 48 32 0 0 0 0
2 OPENCV_FISHEYE 96 64 30 30 48 32 0 0 0 0
"""
UNNAMED = dict(K=[30.0, 0, 47.5, 0, 30.0, 31.5, 0, 0, 1], D=[0.1, 0.02, 0.01, 0], w=96, h=64)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run's folder, the current one, with an untrained model, a picture, and calibrations."""
    monkeypatch.chdir(tmp_path)
    options = dict(num_classes=6, in_chans=3, mean=[0.5] * 3, std=[0.25] * 3)
    card = ModelCard("darswin_a_nano", options, list("abcdef"), 32, 2.8)
    save_model(tmp_path / "checkpoints" / "best.safetensors", card.create().state_dict(), card)
    picture = np.random.default_rng(0).integers(256, size=(*SIZE, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "p.png"), picture)
    (tmp_path / "cameras.txt").write_text(COLMAP)
    (tmp_path / "kd.json").write_text(json.dumps(UNNAMED))
    return tmp_path


def close(one: dict, other: dict) -> bool:
    a, b = ({t["class"]: t["probability"] for t in answer["top"]} for answer in (one, other))
    return all(a[name] == pytest.approx(b[name], abs=1e-4) for name in a)


def test_the_most_probable_classes(run, capsys):
    argv = ["p.png", "p.png", "--top", "3", "--run", "."]
    main(["predict", *argv, "--lens", json.dumps(LENS)])
    printed = json.loads(capsys.readouterr().out)
    assert [p["image"] for p in printed] == ["p.png"] * 2
    assert all(len({t["class"] for t in p["top"]}) == 3 for p in printed)
    probabilities = [t["probability"] for t in printed[0]["top"]]
    assert probabilities == sorted(probabilities, reverse=True)
    (run / "lens.json").write_text(json.dumps(LENS))
    main(["predict", *argv, "--lens", "lens.json", "--out", "out.json"])
    assert json.loads((run / "out.json").read_text()) == printed
    # They are the model's for the normalised picture.
    net, _ = load_model(run / "checkpoints" / "best.safetensors")
    image = cv2.imread("p.png")[..., ::-1]
    image = cv2.resize(np.ascontiguousarray(image), (48, 32), interpolation=cv2.INTER_AREA)
    image = (torch.from_numpy(image).permute(2, 0, 1)[None] / 255 - 0.5) / 0.25
    expected = net(image, Spherical.from_fov(0.5, 2.8, 16)).softmax(-1)[0]
    for entry in printed[0]["top"]:
        k = "abcdef".index(entry["class"])
        assert entry["probability"] == pytest.approx(expected[k].item(), abs=1e-5)


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
                refused(f"{file} has no lens", lenses[file].lens_of, file, SIZE)
            else:
                found = lenses[file].lens_of(file, SIZE)
                assert str(found) == str(in_upright_picture(lens, SIZE, 1))


def test_without_any_answer_nothing_is_written(run, capsys):
    (run / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    argv = ["predict", "broken.png", "--run", ".", "--lens", json.dumps(LENS)]
    with pytest.raises(SystemExit, match=r"^darswin: cannot read .*broken\.png: no image"):
        main([*argv, "--out", "out.json"])
    assert not (run / "out.json").exists() and not capsys.readouterr().out


def test_a_large_picture_is_reduced_by_area(run, monkeypatch):
    noise = np.random.default_rng(0).integers(256, size=(1024, 1024, 3), dtype=np.uint8)
    cv2.imwrite("noise.png", noise[..., ::-1])
    read, predict = [], ClassAnswers._run
    monkeypatch.setattr(
        ClassAnswers, "_run", lambda self, *inputs: read.append(inputs) or predict(self, *inputs)
    )
    main(["predict", "noise.png", "--lens", json.dumps(LENS), "--run", "."])
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
    refused(said, main, [*argv, "--model", str(tmp_path / "other.safetensors")], error=SystemExit)


def test_the_first_prediction(capsys):
    """Without a run, pictures or a lens of one's own; and the same, spelled out."""
    main(["predict", "--model", "digits"])
    (found,) = json.loads(capsys.readouterr().out)
    sample, lens = (str(pretrained_file("digits", kind)) for kind in ("png", "json"))
    assert found["image"] == sample and found["top"][0]["class"] == "4"
    assert found["top"][0]["probability"] > 0.8
    main(["predict", sample, "--model", "digits", "--lens", lens])
    assert json.loads(capsys.readouterr().out) == [found]


# -- the lens of the run ----------------------------------------------------------------------


def begun(run, task="classification", **data):
    """A run's folder with a configuration."""
    data = {"path": ".", "lens": None, "camera": None, "coefficients": None} | data
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
    argv = ["predict", "p.png", "sub/p.png", "--run", "."]
    argv += ["--top", "6"]

    def printed(*more):
        main([*argv, *more])
        said = capsys.readouterr()
        return json.loads(said.out), said.err

    one, near = (printed("--lens", json.dumps(lens))[0] for lens in (far, LENS))
    assert not close(one[0], near[0])
    unnamed = printed("--lens", "kd.json", "--coefficients", "pinhole")[0]
    second = printed("--lens", "cameras.txt", "--camera", "2")[0]
    for data, more, expected in (
        (dict(lens="one.json"), (), one),
        (dict(lens=json.dumps(LENS)), (), near),
        (dict(lens="lenses.json"), (), [near[0], one[1]]),
        (dict(lens="cameras.txt", camera="2"), (), second),
        (dict(lens="cameras.txt", camera="1"), ("--camera", "2"), second),
        (dict(lens="kd.json", coefficients="pinhole"), (), unnamed),
        (dict(lens="kd.json"), ("--coefficients", "pinhole"), unnamed),
    ):
        begun(run, **data)
        found, said = printed(*more)
        assert all(close(a, b) for a, b in zip(found, expected, strict=True))
        assert said == f"darswin: lens of the run: {data['lens']}\n"
    given, said = printed("--lens", json.dumps(LENS))
    assert given == near and "lens of the run" not in said


@pytest.mark.parametrize(
    ("kind", "task"), [("one", "distance"), ("each", "segmentation"), ("splits", "distance")]
)
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
        (dict(lens="lenses.json"), r"lenses\.json has no lens for .*p\.png"),
        (dict(lens="gone.json"), r"there is no calibration file .*gone\.json"),
        (dict(lens="cameras.txt"), "several cameras, choose one with --camera"),
        ({}, "was trained on pictures without a lens"),
        (dict(task="segmentation", path="gone"), "no folder .*gone"),
        (dict(task="distance"), "no scenes in "),
    ):
        begun(run, **data)
        with pytest.raises(SystemExit, match=f"missing --lens: give the camera's .*{said}"):
            main(["predict", "p.png", "--run", "."])


def test_the_frames_of_a_video_have_their_times_and_its_speed(run, capsys):
    write_video(run / "v.mp4", 19)
    argv = ["--lens", json.dumps(LENS), "--run", ".", "--every", "4"]
    main(["predict", "p.png", "v.mp4", *argv])
    said = capsys.readouterr()
    picture, *found, speed = json.loads(said.out)
    assert picture["image"] == "p.png"
    assert all(answer["video"] == "v.mp4" for answer in found)
    assert [answer["frame"] for answer in found] == [0, 4, 8, 12, 16]
    assert [answer["time"] for answer in found] == pytest.approx([0, 0.4, 0.8, 1.2, 1.6])
    assert speed["video"] == "v.mp4" and speed["frames"] == 5
    overall, network = speed["frames_per_second"], speed["network_frames_per_second"]
    assert 0 < overall < network
    line = f"darswin: v.mp4: 5 frames at {overall} frames/s; the network alone:"
    assert f"{line} {network} frames/s" in said.err
