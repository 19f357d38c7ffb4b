import json
import math

import cv2
import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from helpers import fixture
from hypothesis import given
from PIL import ExifTags, Image, ImageOps
from videos import turn_video, write_video

from darswin.cli.answers import resized
from darswin.cli.main import main
from darswin.compat import load_official
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD
from darswin.lens import Equidistant, Spherical, from_dict, load, save
from darswin.lens.orientation import in_upright_picture
from darswin.models import pretrained_file
from darswin.models.encoder import Encoder
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.utils.image import read_oriented
from darswin.utils.video import read_frames

LENS = {"model": "Spherical", "xi": 0.5, "fov": 2.8}


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path)


def write_run(folder):
    """A run's folder with an untrained model in it, and a picture."""
    options = dict(num_classes=6, in_chans=3, mean=[0.5] * 3, std=[0.25] * 3)
    card = ModelCard("darswin_a_nano", options, list("abcdef"), 32, 2.8)
    save_model(folder / "checkpoints" / "best.safetensors", card.create().state_dict(), card)
    picture = np.random.default_rng(0).integers(256, size=(64, 96, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "p.png"), picture)
    return folder


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
        ("none.png --run . --lens L", r"cannot read .*none\.png"),
        ("none.png --lens L", "either --run, a run's folder, or --model, a safetensors file or on"),
        ("p.png --model digits --run .", "or --model, a safetensors file or one of digits"),
        ("p.png --run . --lens {}", '"model" must be one of'),
        ("p.png --run . --lens none.json", r"none\.json"),
        ('p.png --run . --lens {"model":"Spherical","xi":0.5}', "focal is missing"),
        ("--run .", "needs pictures or videos, and --lens"),
        ("p.png --run .", "needs pictures or videos, and --lens"),
        ("--lens L --run .", "needs pictures or videos, and --lens"),
        ("p.png --model digits", "needs pictures or videos, and --lens"),
        ("p.png --run . --lens L --every 0", "--every must be at least 1, got 0"),
        ("p.png --run . --lens L --top 0", "--top must be at least 1, got 0"),
        ("p.png --run . --lens L --top -1", "--top must be at least 1, got -1"),
        ("p.png --run . --lens L --task distance", r"--task distance was asked of .*best\.safe"),
        ("checkpoints --run . --lens L", "no pictures or videos in checkpoints"),
        ("p.png --run . --lens checkpoints", r"no calibration in .*: the first would be .*p\.json"),
        ("p.png --run . --lens checkpoints --camera 1", "--camera 1 is one of a calibration file"),
    ],
)
def test_what_is_wrong_is_named(run, monkeypatch, argv, said):
    monkeypatch.chdir(run)
    words = [json.dumps(LENS) if word == "L" else word for word in argv.split()]
    with pytest.raises(SystemExit, match=said):
        main(["predict", *words])


def test_weights_that_are_not_finite_give_no_answer(run, capsys):
    path = run / "checkpoints" / "best.safetensors"
    net, card = load_model(path)
    weights = net.state_dict()
    weights["head.weight"][0, 0] = math.nan
    save_model(path, weights, card)
    picture = str(run / "p.png")
    with pytest.raises(SystemExit, match=f"darswin: no answer for {picture}: .* NaN or") as caught:
        main(["predict", picture, "--run", str(run), "--lens", json.dumps(LENS)])
    assert isinstance(caught.value.code, str)  # which Python prints, and ends with 1
    assert capsys.readouterr().out == ""


def test_calibration_files(run, capsys):
    """Of another tool, whose pictures are larger; of several cameras; of another shape."""
    calibration = {"value0": {"intrinsics": [
        {"camera_type": "ucm", "intrinsics": dict(fx=fx, fy=fx, cx=95.5, cy=63.5, alpha=0.5)}
        for fx in (80.0, 120.0)
    ], "resolution": [[192, 128]] * 2}}  # fmt: skip
    path = run / "calibration.json"
    path.write_text(json.dumps(calibration))
    argv = [str(run / "p.png"), "--lens"]
    with pytest.raises(SystemExit, match="choose one as --camera: 'cam0', 'cam1'"):
        answers([*argv, str(path)], run, capsys)
    # The same lens in pixels of the picture, half as large: its center stays between two pixels.
    lens = in_upright_picture(load(path, camera="cam1", image_size=(64, 96)), (64, 96), 1)
    assert lens.focal.item() == pytest.approx(60) and lens.center.tolist() == [[47.5, 31.5]]
    same = dict(model="EnhancedUnified", alpha=0.5, beta=1, focal=60)
    same = json.dumps(same | {"theta_max": lens.theta_max.item()})
    (found,) = answers([*argv, str(path), "--camera", "cam1"], run, capsys)
    assert close(found, *answers([*argv, same], run, capsys))
    calibration["value0"]["resolution"] = [[192, 192]] * 2
    path.write_text(json.dumps(calibration))
    with pytest.raises(SystemExit, match="pictures of 192×192 px, and 64×96 is not of that shape"):
        answers([*argv, str(path), "--camera", "cam1"], run, capsys)


def answers(argv, run, capsys) -> list[dict]:
    main(["predict", *argv, "--run", str(run), "--top", "6"])
    return json.loads(capsys.readouterr().out)


def close(one: dict, other: dict) -> bool:
    a, b = ({t["class"]: t["probability"] for t in answer["top"]} for answer in (one, other))
    return all(a[name] == pytest.approx(b[name], abs=1e-4) for name in a)


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


GOOD, BAD = ("p.png", "q.png"), ("broken.png", "folder.png", "square.png", "none.png")


@given(st.lists(st.sampled_from(GOOD + BAD), min_size=1, max_size=6), st.integers(-3, 9))
def test_every_picture_is_answered_or_named(mixed, pictures, top):
    argv = [str(mixed / name) for name in pictures]
    argv += ["--run", str(mixed), "--top", str(top), "--out", str(mixed / "out.json")]
    argv += ["--lens", json.dumps(LENS | {"image_size": [64, 96]})]
    good = [str(mixed / name) for name in pictures if name in GOOD and top > 0]
    (mixed / "out.json").unlink(missing_ok=True)
    if len(good) == len(pictures):
        main(["predict", *argv])
    else:
        with pytest.raises(SystemExit) as caught:
            main(["predict", *argv])
        bad = len(pictures) - len(good)
        first = f"darswin: no answer for {bad} of {len(pictures)} pictures:"
        assert not good or str(caught.value).splitlines()[0] == first
        named = all(name in str(caught.value) for name in pictures if name in BAD)
        assert named if top > 0 else "--top must be at least 1" in str(caught.value)
    found = json.loads((mixed / "out.json").read_text()) if good else []
    assert [answer["image"] for answer in found] == good
    assert all(len(answer["top"]) == min(top, 6) for answer in found)


COLMAP = """1 OPENCV_FISHEYE 96 64 40 40 48 32 0 0 0 0
2 OPENCV_FISHEYE 96 64 30 30 48 32 0 0 0 0
5 OPENCV_FISHEYE 96 64 20 20 48 32 0 0 0 0
"""


def test_a_camera_that_is_called_by_a_number(run, capsys):
    (run / "cameras.txt").write_text(COLMAP)
    picture, calibration = str(run / "p.png"), str(run / "cameras.txt")
    for name, focal in (("1", 40), ("2", 30), ("5", 20)):
        lens = load(calibration, camera=name, image_size=(64, 96))
        assert lens.focal.item() == focal
        save(lens, run / "lens.json")
        (same,) = answers([picture, "--lens", str(run / "lens.json")], run, capsys)
        argv = [picture, "--lens", calibration, "--camera", name]
        assert close(answers(argv, run, capsys)[0], same)


def test_coefficients_that_the_file_does_not_name(run, capsys):
    picture, calibration = str(run / "p.png"), run / "kd.json"
    matrix = [30.0, 0, 47.5, 0, 30.0, 31.5, 0, 0, 1]
    calibration.write_text(json.dumps(dict(K=matrix, D=[0.1, 0.02, 0.01, 0], w=96, h=64)))
    argv = [picture, "--lens", str(calibration)]
    with pytest.raises(SystemExit):
        main(["predict", *argv, "--run", str(run)])
    assert 'give --coefficients "fisheye" or --coefficients "pinhole"' in (
        said := capsys.readouterr().err
    )
    assert said.count("\n") == 1
    for model in ("fisheye", "pinhole"):
        save(load(calibration, model=model), run / "lens.json")
        (same,) = answers([picture, "--lens", str(run / "lens.json")], run, capsys)
        assert close(answers([*argv, "--coefficients", model], run, capsys)[0], same)
    (run / "own").mkdir()
    (run / "own" / "p.json").write_text(calibration.read_text())
    argv = [picture, "--lens", str(run / "own"), "--coefficients", "pinhole"]
    assert close(answers(argv, run, capsys)[0], same)


def exif_picture(path, orientation, stored):
    """A picture file of these pixels (RGB) with an EXIF orientation."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(stored).save(path, exif=exif)


# With each thing that a turn changes: a center, oblong pixels, tangential terms.
SENSOR_LENS = {
    "model": "KannalaBrandt", "focal": 30, "radial": [0.02, -0.01], "tangential": [0.01, -0.02],
    "theta_max": 1.3, "center": [52.0, 29.0], "affine": [[1.0, 0.02], [0.0, 0.95]],
}  # fmt: skip


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_picture_that_exif_turns_is_answered_as_the_upright_one(run, capsys, orientation):
    """tests/lens/test_orientation.py holds that the lens is turned as the pixels are."""
    lens = from_dict(SENSOR_LENS | {"image_size": [64, 96]})
    stored = cv2.imread(str(run / "p.png"))[..., ::-1]
    exif_picture(run / "exif.png", orientation, np.ascontiguousarray(stored))
    upright = np.asarray(ImageOps.exif_transpose(Image.open(run / "exif.png")).convert("RGB"))
    exif_picture(run / "upright.png", 1, upright)
    image, found = read_oriented(run / "exif.png")
    assert np.array_equal(image, upright) and found == orientation
    save(in_upright_picture(lens, upright.shape[:2], orientation), run / "turned.json")
    argv = [str(run / "upright.png"), "--lens", str(run / "turned.json")]
    (expected,) = answers(argv, run, capsys)
    for size in ({}, {"image_size": [64, 96]}):
        argv = [str(run / "exif.png"), "--lens", json.dumps(SENSOR_LENS | size)]
        assert close(answers(argv, run, capsys)[0], expected)


def test_a_calibration_of_upright_pictures(run, capsys):
    """One of OpenCV, which turned them upright as it read them: known by its shape."""
    stored = cv2.imread(str(run / "p.png"))[..., ::-1]
    exif_picture(run / "exif.jpg", 6, np.ascontiguousarray(stored))
    image, orientation = read_oriented(run / "exif.jpg")
    assert image.shape == (96, 64, 3) and orientation == 6
    lens = from_dict(dict(SENSOR_LENS, image_size=[96, 64]))
    assert torch.equal(in_upright_picture(lens, (96, 64), 6).center, lens.center)
    described = json.dumps(dict(SENSOR_LENS, image_size=[90, 90]))
    with pytest.raises(
        SystemExit, match=r"exif\.jpg: .* not of that shape .*EXIF orientation is 6"
    ):
        main(["predict", str(run / "exif.jpg"), "--run", str(run), "--lens", described])


@given(
    st.integers(8, 200), st.integers(8, 200), st.integers(8, 64), st.booleans(), st.floats(0, 1.2)
)
def test_the_lens_of_a_resized_picture_is_exact(height, width, side, square, theta):
    """Where a ray lands in the resized picture is where its pixel went, in the place `cv2.resize`
    gives it."""
    lens = Equidistant(
        50.0, theta_max=1.3, center=(width / 3, height / 2), image_size=(height, width)
    )
    net = Encoder()
    net.square_images = square
    image = np.zeros((height, width, 3), np.uint8)
    small, taken_with = resized(net, ModelCard("", size=side), image, lens)
    azimuth = torch.linspace(0, 6, 7)
    before = lens.project_rays(theta, azimuth[None])[0]
    top = left = 0
    if square:
        cut = min(height, width)
        top, left = (height - cut) // 2, (width - cut) // 2
        height = width = cut
    scale = torch.tensor([small.shape[3] / width, small.shape[2] / height])
    expected = (before - torch.tensor([left, top]) + 0.5) * scale - 0.5
    after = taken_with.project_rays(theta, azimuth[None])[0]
    torch.testing.assert_close(after, expected, atol=1e-3, rtol=0)
    assert taken_with.image_size.tolist() == [list(small.shape[2:])]


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
    with pytest.raises(
        SystemExit, match="not the name of their model, and are not a state dict of"
    ):
        main([*argv, "--model", str(tmp_path / "other.safetensors")])


# -- a model that comes with darswin, folders, videos ------------------------------------------


def test_the_first_prediction(capsys):
    """Without a run, pictures or a lens of one's own; and the same, spelled out."""
    main(["predict", "--model", "digits"])
    (found,) = json.loads(capsys.readouterr().out)
    sample, lens = (str(pretrained_file("digits", kind)) for kind in ("png", "json"))
    assert found["image"] == sample and found["top"][0]["class"] == "4"
    assert found["top"][0]["probability"] > 0.8
    main(["predict", sample, "--model", "digits", "--lens", lens])
    assert json.loads(capsys.readouterr().out) == [found]


@pytest.fixture
def folder(run):
    """Pictures of several folders, between files that are none."""
    pictures = run / "pictures"
    names = ("b/2.png", "b/10.png", "a/x/1.PNG", "0.png", "a/y.png")
    for k, name in enumerate(names):
        (pictures / name).parent.mkdir(parents=True, exist_ok=True)
        image = np.random.default_rng(k).integers(256, size=(64, 96, 3), dtype=np.uint8)
        (pictures / name).write_bytes(cv2.imencode(".png", image)[1].tobytes())
    for name in (".hidden/1.png", ".2.png", "notes.txt", "a/lens.json"):
        (pictures / name).parent.mkdir(exist_ok=True)
        (pictures / name).write_text("no picture")
    return pictures


def test_a_folder_means_its_pictures(run, folder, capsys):
    lens = ["--lens", json.dumps(LENS)]
    found = answers([str(folder), *lens], run, capsys)
    names = ["0.png", "a/x/1.PNG", "a/y.png", "b/10.png", "b/2.png"]
    assert [answer["image"] for answer in found] == [str(folder / name) for name in names]
    for answer in found:  # as one after the other
        assert close(answer, *answers([answer["image"], *lens], run, capsys))
    mixed = answers([str(run / "p.png"), str(folder / "a"), *lens], run, capsys)
    assert [answer["image"] for answer in mixed][1:] == [str(folder / name) for name in names[1:3]]
    (folder / "b" / "bad.jpg").write_text("no picture")
    (folder / "b" / "z.heic").write_text("not read")
    with pytest.raises(SystemExit, match=r"no answer for 1 of 6 pictures:\n.*bad\.jpg"):
        answers([str(folder), *lens], run, capsys)
    said = capsys.readouterr()
    assert len(json.loads(said.out)) == 5 and "does not read, 1 .heic" in said.err


def test_a_lens_for_each_folder(run, folder, capsys):
    """As a lenses.json says: each picture as with its own lens alone."""
    lenses = {xi: {"model": "Spherical", "xi": xi, "fov": 2.8} for xi in (0.1, 0.5, 0.9)}
    (run / "wide.json").write_text(json.dumps(lenses[0.9] | {"image_size": [64, 96]}))
    said = {"pictures": lenses[0.1], "pictures/a": lenses[0.5], "pictures/b/2.png": "wide.json"}
    (run / "lenses.json").write_text(json.dumps(said))
    found = answers([str(folder), "--lens", str(run / "lenses.json")], run, capsys)
    for answer, xi in zip(found, (0.1, 0.5, 0.5, 0.1, 0.9), strict=True):
        (alone,) = answers([answer["image"], "--lens", json.dumps(lenses[xi])], run, capsys)
        assert close(answer, alone)
    with pytest.raises(SystemExit, match=r"lenses\.json has no lens for .*p\.png"):
        answers([str(run / "p.png"), "--lens", str(run / "lenses.json")], run, capsys)


def test_a_lens_for_each_picture(run, folder, capsys, monkeypatch):
    """As a folder of calibrations says: each picture as with its own lens alone."""
    own = run / "lenses"
    own.mkdir()
    for k, stem in enumerate(("0", "1", "y", "10", "2")):
        lens = {"model": "Spherical", "xi": k / 10, "fov": 2.8, "image_size": [64, 96]}
        (own / f"{stem}.json").write_text(json.dumps(lens))
    monkeypatch.chdir(folder)
    found = answers(["./0.png", ".", "--lens", str(own)], run, capsys)
    assert close(found[0], dict(found[1], image="./0.png"))
    for answer in found[1:]:
        stem = answer["image"].split("/")[-1].split(".")[0]
        (alone,) = answers([answer["image"], "--lens", str(own / f"{stem}.json")], run, capsys)
        assert close(answer, alone)
    (own / "10.json").unlink()
    with pytest.raises(SystemExit, match=r"no answer for 1 of 5 pictures:\n.*10\.png has no lens"):
        answers([str(folder), "--lens", str(own)], run, capsys)


def as_pictures(video, folder, **options):
    """The frames of a video as upright pictures."""
    folder.mkdir()
    for frame in read_frames(video, **options):
        cv2.imwrite(str(folder / f"{frame.number:03}.png"), frame.image[..., ::-1])
    return str(folder)


@pytest.mark.parametrize("every", [1, 4])
def test_each_frame_of_a_video(run, capsys, every):
    write_video(run / "v.mp4", 19)
    argv = ["--lens", json.dumps(LENS), "--run", str(run), "--top", "6"]
    main(["predict", str(run / "p.png"), str(run / "v.mp4"), *argv, "--every", str(every)])
    said = capsys.readouterr()
    picture, *found, speed = json.loads(said.out)
    assert picture["image"] == str(run / "p.png")
    assert all(answer["video"] == str(run / "v.mp4") for answer in found)
    assert [answer["frame"] for answer in found] == list(range(0, 19, every))
    times = [k / 10 for k in range(0, 19, every)]
    assert [answer["time"] for answer in found] == pytest.approx(times)
    for answer, same in zip(
        found,
        answers([as_pictures(run / "v.mp4", run / "f", every=every), *argv[:2]], run, capsys),
        strict=True,
    ):
        assert close(answer, same)
    assert speed["video"] == str(run / "v.mp4") and speed["frames"] == len(found)
    overall, network = speed["frames_per_second"], speed["network_frames_per_second"]
    assert 0 < overall < network
    line = f"darswin: {run}/v.mp4: {len(found)} frames at {overall} a second, by the network alone"
    assert f"{line} {network}" in said.err


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_video_that_its_metadata_turns(run, capsys, degrees):
    """As its upright frames, with their lens turned another way: by EXIF of a picture."""
    write_video(run / "v.mp4", 3)
    turn_video(run / "v.mp4", degrees)
    lens = from_dict(SENSOR_LENS | {"image_size": [64, 96]})
    (run / "lens.json").write_text(json.dumps(SENSOR_LENS | {"image_size": [64, 96]}))
    *found, _ = answers([str(run / "v.mp4"), "--lens", str(run / "lens.json")], run, capsys)
    upright = as_pictures(run / "v.mp4", run / "f")
    shape = cv2.imread(f"{upright}/000.png").shape[:2]
    assert shape == ((64, 96) if degrees == 180 else (96, 64))
    save(in_upright_picture(lens, shape, {90: 6, 180: 3, 270: 8}[degrees]), run / "turned.json")
    same = answers([upright, "--lens", str(run / "turned.json")], run, capsys)
    assert all(close(a, b) for a, b in zip(found, same, strict=True))
    save(lens.replace(center=None), run / "centered.json")  # and it matters that it is turned
    other = answers([str(run / "v.mp4"), "--lens", str(run / "centered.json")], run, capsys)
    assert not close(found[0], other[0])


def test_a_video_that_is_damaged(run, capsys):
    write_video(run / "cut.avi", 40, codec="MJPG")
    content = (run / "cut.avi").read_bytes()
    (run / "cut.avi").write_bytes(content[: len(content) // 2])
    (run / "none.mp4").write_text("no video")
    paths = [str(run / name) for name in ("cut.avi", "none.mp4", "p.png")]
    with pytest.raises(SystemExit) as caught:
        answers([*paths, "--lens", json.dumps(LENS)], run, capsys)
    *frames, speed, picture = json.loads(capsys.readouterr().out)
    assert [answer["frame"] for answer in frames] == list(range(speed["frames"]))
    assert 5 < speed["frames"] < 35 and picture["image"] == str(run / "p.png")
    first, *lines = str(caught.value).splitlines()
    assert first == "darswin: no answer, or not for all frames, for 2 of 3 files:"
    assert "cut.avi is damaged or cut off" in lines[0] and "none.mp4" in lines[1]
    square = json.dumps(LENS | {"image_size": [64, 64]})
    write_video(run / "v.mp4", 4)
    with pytest.raises(SystemExit, match=r"v\.mp4: .*64×96 is not of that shape"):
        answers([str(run / "v.mp4"), "--lens", square], run, capsys)
