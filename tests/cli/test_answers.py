"""Answers to a stream of images: classes, and files of a network whose answer is known."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from helpers import refused, save_picture
from PIL import Image
from videos import write_video

from darswin import create_model
from darswin.cli import answers as module
from darswin.cli import predict as predict_module
from darswin.cli.answers import (
    ClassAnswers,
    distance_png,
    label_png,
)
from darswin.cli.main import main
from darswin.cli.pictures import claim_folder, file_names
from darswin.cli.predict import ANSWERS as RECORD
from darswin.data import FullSize, fitted
from darswin.lens import from_dict
from darswin.models.encoder import Encoder
from darswin.models.prepared import Prepared
from darswin.models.saving import ModelCard, save_model
from darswin.views.base import PreparedPixels
from darswin.viz.pixels import UNKNOWN, palette

# A circle inside of pictures of 48×64, of whose middle square it leaves the corners out.
LENS = {"model": "Spherical", "xi": 0.5, "fov": 2.8, "image_size": [48, 64]}
COLORS = [[250, 0, 0], [0, 250, 0], [0, 0, 250]]
NAMES = ["red", "green", "blue"]
FULL = FullSize(fitted((48, 64), 48, "crop").at(from_dict(LENS), (48, 64)))
SEEN = FULL.seen


# -- classes ----------------------------------------------------------------------------------


@torch.no_grad()
def test_answers_are_the_models_in_order_whatever_the_lenses(monkeypatch):
    model = create_model("darswin_a_nano", num_classes=6).eval()
    card = ModelCard("", dict(num_classes=6), "abcdef", 32, fit="crop")
    lenses = [from_dict(LENS | {"xi": xi / 20}) for xi in range(20)]
    # Two that take turns, then more than are kept.
    order = [2] * 10 + [16, 2, 16, 16] + [2] * 3 + [*range(3, 16), 17, 18, 19] + [19, 18, 2]
    rng = np.random.default_rng(0)
    images = [rng.integers(256, size=(48, 64, 3), dtype=np.uint8) for _ in order]
    answers = ClassAnswers(model, card, 6)
    sizes, prepared = [], []
    run, prepare = answers.model.run, answers.model.prepare
    monkeypatch.setattr(answers.model, "run", lambda x, p: sizes.append(len(x)) or run(x, p))
    monkeypatch.setattr(answers.model, "prepare", lambda *a: prepared.append(a) or prepare(*a))
    for k, (image, which) in enumerate(zip(images, order, strict=True)):
        answers.add({"image": k}, image, lenses[which])
    answers.flush()
    answers.flush()
    assert sizes[:6] == [module.BATCH, 2, 1, 1, 2, 3] and answers.seconds > 0
    assert len(prepared) == 18 + 1  # the first one was no longer kept
    assert [entry["image"] for entry in answers.found] == list(range(len(order)))
    for entry, image, which in zip(answers.found, images, order, strict=True):
        remap = fitted(image.shape[:2], 32, "crop").at(lenses[which], image.shape[:2])
        pixels = torch.from_numpy(remap(image)[None]).permute(0, 3, 1, 2)
        expected = model(pixels, remap.camera).softmax(-1)[0]
        assert len(entry["top"]) == 6
        for found in entry["top"]:
            k = "abcdef".index(found["class"])
            assert found["probability"] == pytest.approx(expected[k].item(), abs=1e-5)


# -- labels and distances ---------------------------------------------------------------------


class Stub(Encoder):
    """The class is a pixel's strongest colour; the distance is its red, in quarters of a metre."""

    in_chans, square_images = 3, True

    def __init__(self, task):
        super().__init__()
        self.task, self.num_classes, self.prepared = task, 3, 0

    def prepare(self, lens, size):
        assert tuple(lens.image_size[0].tolist()) == size == (48, 48)
        self.prepared += 1
        return Prepared(PreparedPixels(size, None))

    def run(self, images, prepared, *, stop_after=None):
        images = images.float()
        return images if self.task == "segmentation" else images[:, :1] / 4


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """A function that makes `predict` take a stub for a task; the current folder is a new one."""
    monkeypatch.chdir(tmp_path)

    def install(task, **card):
        net = Stub(task)
        known = dict(classes=NAMES, colors=COLORS, size=48, fit="crop", task=task)
        card = ModelCard("stub", **(known | card))
        monkeypatch.setattr(predict_module, "trained_model", lambda path: (net, card))
        monkeypatch.setattr(module, "fast", lambda model, card: model)
        return net

    return install


def picture_of(labels):
    """RGB to which the stub answers these labels."""
    return np.take(np.array(COLORS, np.uint8), labels, 0)


@pytest.fixture
def labels():
    """Large regions; one class is nowhere."""
    labels = np.zeros((48, 64), np.uint8)
    labels[:, 32:] = 2
    return labels


def predict(command, lens=LENS):
    given = ["--model", "m.safetensors", "--lens", json.dumps(lens)]
    main(["predict", *command.split(), *given, "--out", "out"])
    return json.loads(Path("out/predictions.json").read_text())


def ids(path):
    with Image.open(path) as image:
        assert image.mode == "P"
        return np.asarray(image)


def colored(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def test_labels_of_a_picture(stub, labels):
    stub("segmentation")
    image = picture_of(labels)
    save_picture("p.png", image)
    (answer,) = predict("p.png")
    assert answer["image"] == "p.png"
    assert (answer["labels"], answer["overlay"]) == ("labels/p.png", "overlays/p.jpg")
    assert np.array_equal(ids("out/labels/p.png"), np.where(SEEN, labels, 255))
    colors = colored("out/labels/p.png")
    assert (colors[SEEN] == image[SEEN]).all() and (colors[~SEEN] == UNKNOWN).all()
    shares = {name: (labels[SEEN] == k).mean() for k, name in enumerate(NAMES)}
    assert answer["shares"] == pytest.approx(shares, abs=1e-6) and list(shares) == NAMES
    assert answer["unanswered"] == pytest.approx((~SEEN).mean(), abs=1e-6)
    # Classes without names and colours; the overlay is half of the colour, where there is one.
    stub("segmentation", classes=(), colors=[])
    (answer,) = predict("p.png")
    assert list(answer["shares"]) == ["0", "1", "2"]
    assert colored("out/labels/p.png")[24, 24].tolist() == (laid := palette(3)[0])
    overlay = cv2.imread("out/overlays/p.jpg")[..., ::-1].astype(int)
    middle = np.s_[16:32, 18:26]  # away from edges, which JPEG blurs
    assert np.abs(overlay - (image.astype(int) + laid) // 2)[middle].max() < 12
    assert np.abs(overlay - image)[:, :4].max() < 12


def test_distances_of_a_picture(stub):
    stub("distance")
    red = np.tile(np.linspace(40, 240, 64).astype(np.uint8), (48, 1))
    save_picture("p.png", np.stack((red, red, red), -1))
    (answer,) = predict("p.png --task distance")
    assert answer["distance"] == "distance/p.png"
    steps = cv2.imread("out/distance/p.png", cv2.IMREAD_UNCHANGED)
    assert steps.dtype == np.uint16 and steps.shape == (48, 64)
    expected = np.where(SEEN, red / 4, 0)
    np.testing.assert_allclose(steps / 256, expected, atol=0.5 / 256)
    known = expected[SEEN]
    for key, value in (("min_m", known.min()), ("median_m", np.median(known)),
                       ("max_m", known.max())):  # fmt: skip
        assert answer[key] == pytest.approx(value, abs=1e-3)
    assert answer["unanswered"] == pytest.approx((~SEEN).mean(), abs=1e-6)
    near, far = answer["colors_m"]
    assert known.min() <= near < far <= known.max()
    laid = cv2.imread("out/overlays/p.jpg")
    assert laid.shape == (48, 64, 3) and np.ptp(laid[24], 1).max() > 30  # colours over grey


def test_pngs_keep_every_value(tmp_path):
    distance = np.array([[0, 1e-4, 1, 255.996, 1e6, np.nan, np.inf, -1]], np.float32)
    png = np.frombuffer(distance_png(distance), np.uint8)
    steps = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    assert steps.tolist() == [[0, 1, 256, 65535, 65535, 0, 0, 0]]
    labels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    (tmp_path / "l.png").write_bytes(label_png(labels, palette(255)))
    assert np.array_equal(ids(tmp_path / "l.png"), labels)


@pytest.mark.parametrize(("task", "value"), [("segmentation", np.nan), ("distance", np.inf)])
def test_an_answer_that_is_not_finite_is_none(stub, monkeypatch, task, value):
    net = stub(task)
    run, reached = net.run, torch.ones(48, 48, dtype=torch.bool)

    def broken(images, prepared):
        output = run(images, prepared)
        output[-1, 0].masked_fill_(reached, value)
        return output

    monkeypatch.setattr(net, "run", broken)
    for name in ("0.png", "1.png"):
        save_picture(name, np.full((48, 64, 3), 50, np.uint8))
    with pytest.raises(SystemExit, match=r"darswin: no prediction for 1\.png: .* NaN or"):
        predict("0.png 1.png")
    found = json.loads(Path("out/predictions.json").read_text())
    assert [answer["image"] for answer in found] == ["0.png"]  # what was found is not lost
    reached = ~torch.from_numpy(FULL.reached)  # beyond θ_max it has no meaning
    assert len(predict("0.png 1.png")) == 2


def test_a_folder_means_pictures_and_videos(stub, labels, capsys):
    net = stub("segmentation")
    for name in ("front/1.png", "rear/1.png", "rear/deep/2.jpg"):
        save_picture(f"in/{name}", picture_of(labels if "front" in name else labels[:, ::-1]))
    frames = write_video(Path("in/rear/drive.avi"), 5, size=(48, 64), codec="MJPG")
    Path("out").symlink_to("in/out")
    Path("in/out").mkdir()
    *found, speed = predict("in --every 2")
    files = [answer["labels"] for answer in found]
    assert files == [
        "labels/front/1.png", "labels/rear/1.png", "labels/rear/deep/2.png",
        *(f"labels/rear/drive.avi/{k:06}.png" for k in (0, 2, 4)),
    ]  # fmt: skip
    assert all(Path("out", answer["overlay"]).exists() for answer in found)
    assert [ids(f"out/{name}")[24, 20] for name in files[:2]] == [0, 2]
    middle = np.s_[16:32, 24:40]
    for answer, k in zip(found[3:], (0, 2, 4), strict=True):
        same = ids(f"out/{answer['labels']}")[middle] == frames[k][middle].argmax(-1)
        assert answer["frame"] == k and same.mean() > 0.9
    assert speed["frames"] == 3 and "3 frames at" in capsys.readouterr().err
    assert net.prepared == 1  # one lens
    # Its own pictures are not predicted again, unless they are asked for.
    assert len(predict("in --every 2")) == len(found) + 1
    assert predict(f"in/out/{files[0]}")


def test_colours_of_distance_stay_for_a_video(stub):
    stub("distance")
    write_video(Path("v.avi"), 4, size=(48, 64), codec="MJPG")
    save_picture("p.png", np.full((48, 64, 3), 40, np.uint8))
    *frames, _, picture = predict("v.avi p.png")
    assert len({tuple(answer["colors_m"]) for answer in frames}) == 1
    assert picture["colors_m"] != frames[0]["colors_m"]


@pytest.mark.parametrize(
    ("paths", "videos", "expected"),
    [
        (["a"], [], {"a/1.png": "1", "a/b/1.png": "b/1"}),
        (["a", "c"], [], {"a/1.png": "a/1", "c/1.jpg": "c/1"}),
        (["a/1.png"], [], {"a/1.png": "1"}),
        (["a/1.png", "c/1.png"], [], {"a/1.png": "a/1", "c/1.png": "c/1"}),
        (["a/1.png", "a/1.jpg"], [], {"a/1.png": "1.png", "a/1.jpg": "1.jpg"}),
        (["a"], ["a/v.mp4"], {"a/v.mp4": "v.mp4", "a/v/000000.png": "v/000000"}),
        (["a", "a/1.png"], [], {"a/1.png": "1"}),
    ],
)
def test_names_of_files_differ_and_keep_their_folders(
    paths, videos, expected, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for name in expected:
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    assert file_names(paths, [(name, name in videos) for name in expected]) == expected


def test_a_record_of_another_program_is_not_replaced(tmp_path):
    (tmp_path / "predictions.json").write_text('{"mine": 1}')
    refused("holds other files", claim_folder, str(tmp_path), RECORD)
    (tmp_path / "predictions.json").write_text("[]")
    (tmp_path / "labels").mkdir()  # of a run that was killed
    assert claim_folder(str(tmp_path), RECORD) == tmp_path


def test_more_classes_than_a_png_holds_are_refused(stub, labels):
    stub("segmentation").num_classes = 256
    save_picture("p.png", picture_of(labels))
    refused("at most 255 classes, got 256", predict, "p.png", error=SystemExit)


def test_a_real_model_answers_as_in_python(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = dict(task="segmentation", num_classes=3, mean=[0.5] * 3, std=[0.25] * 3)
    more = dict(fit="crop", task="segmentation", colors=COLORS)
    card = ModelCard("darswin_unet_a_nano", options, NAMES, 128, **more)
    model = card.create().eval()
    save_model("m.safetensors", model.state_dict(), card)
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(256, size=(9, 12, 3), dtype=np.uint8), (160, 140))
    save_picture("p.png", image)
    lens = LENS | {"image_size": [140, 160]}
    predict("p.png", lens)
    remap = fitted((140, 160), 128, "crop").at(from_dict(lens), (140, 160))
    with torch.no_grad():
        output = model(torch.from_numpy(remap(image))[None], remap.camera)[0].numpy()
    assert (ids("out/labels/p.png") == FullSize(remap).labels(output)).mean() > 0.998


def test_a_model_that_takes_squares_says_what_it_does_not_see(stub, labels, capsys):
    """Once, whatever it was trained on; only the old file's card asks for a new training."""
    for k in range(3):
        save_picture(f"in/{k}.png", picture_of(labels))
    lens = {"model": "Equidistant", "focal": 30, "theta_max": 1.5, "image_size": [48, 64]}
    for fit, reason in (
        ("crop", "it was trained on cropped pictures; `darswin fit --data.fit stretch` trains one"),
        ("whole", "it takes only square pictures"),
        ("stretch", None),
    ):
        assert stub("segmentation", fit=fit).square_images
        predict("in", lens)
        said = [line for line in capsys.readouterr().err.splitlines() if "does not see" in line]
        assert len(said) == (reason is not None)
        for line in said:
            assert line.startswith("darswin: the model does not see 8 px at the left and 8 px at")
            assert reason in line
    predict("in")  # a circle inside the square
    assert "does not see" not in capsys.readouterr().err
