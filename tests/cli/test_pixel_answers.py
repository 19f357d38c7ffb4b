"""Files of labels and distances, of a network whose answer is known: it says what it sees."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from videos import write_video

from darswin.cli import answers as dense_answers
from darswin.cli import predict as predict_module
from darswin.cli.answers import claim_folder, distance_png, file_names, label_png
from darswin.cli.main import main
from darswin.data.warp import FullSize, at_size
from darswin.lens import from_dict
from darswin.models.encoder import Encoder, Prepared
from darswin.models.saving import ModelCard, save_model
from darswin.viz.pixels import UNKNOWN, palette

# A circle inside of pictures of 48×64, of whose middle square it leaves the corners out.
LENS = {"model": "Spherical", "xi": 0.5, "fov": 2.8, "image_size": [48, 64]}
COLORS = [[250, 0, 0], [0, 250, 0], [0, 0, 250]]
NAMES = ["red", "green", "blue"]
SEEN = FullSize(from_dict(LENS, (48, 64)), 48, "crop").seen


class Stub(Encoder):
    """The class is a pixel's strongest colour; the distance is its red, in quarters of a metre."""

    in_chans, square_images = 3, True

    def __init__(self, task):
        super().__init__()
        self.task, self.num_classes, self.prepared = task, 3, 0

    def prepare(self, lens, size):
        assert tuple(lens.image_size[0].tolist()) == size == (48, 48)
        self.prepared += 1
        return Prepared(None, ())

    def run(self, images, prepared, *, stop_after=None):
        images = images.float()
        return images if self.task == "segmentation" else images[:, :1] / 4


@pytest.fixture
def stub(monkeypatch):
    """A function that makes `predict` take a stub for a task."""

    def install(task, **card):
        net = Stub(task)
        known = dict(classes=NAMES, colors=COLORS, size=48, fit="crop", task=task)
        card = ModelCard("stub", **(known | card))
        monkeypatch.setattr(predict_module, "trained_model", lambda path: (net, card))
        monkeypatch.setattr(dense_answers, "fast", lambda model, card: model)
        return net

    return install


def picture_of(labels):
    """RGB of which the stub says these labels."""
    return np.take(np.array(COLORS, np.uint8), labels, 0)


def write(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1])
    return str(path)


@pytest.fixture
def labels():
    """Large regions, with one class that is rare and one that is nowhere."""
    labels = np.zeros((48, 64), np.uint8)
    labels[:, 32:] = 2
    return labels


def predict(*argv, out):
    main(
        ["predict", *map(str, argv), "--model", "m", "--lens", json.dumps(LENS), "--out", str(out)]
    )
    return json.loads((Path(out) / "predictions.json").read_text())


def ids(path):
    with Image.open(path) as image:
        assert image.mode == "P"
        return np.asarray(image)


def test_labels_of_a_picture(stub, labels, tmp_path):
    stub("segmentation")
    picture = write(tmp_path / "p.png", picture_of(labels))
    out = tmp_path / "out"
    (answer,) = predict(picture, out=out)
    assert answer["image"] == picture
    assert (answer["labels"], answer["overlay"]) == ("labels/p.png", "overlays/p.jpg")
    found = ids(out / "labels/p.png")
    assert np.array_equal(found, np.where(SEEN, labels, 255))
    with Image.open(out / "labels/p.png") as image:
        colored = np.asarray(image.convert("RGB"))
    assert (colored[SEEN] == picture_of(labels)[SEEN]).all() and (colored[~SEEN] == UNKNOWN).all()
    shares = {name: (labels[SEEN] == k).mean() for k, name in enumerate(NAMES)}
    assert answer["shares"] == pytest.approx(shares, abs=1e-6) and list(shares) == NAMES
    assert answer["unanswered"] == pytest.approx((~SEEN).mean(), abs=1e-6)
    overlay = cv2.imread(str(out / "overlays/p.jpg"))[..., ::-1].astype(int)
    middle = np.abs(overlay - picture_of(labels))[20:28, 8:24]  # the colours are the picture's own
    assert overlay.shape == (48, 64, 3) and middle.max() < 40


def test_the_overlay_shows_the_picture_where_there_is_no_answer(stub, labels, tmp_path):
    stub("segmentation", colors=[[255, 255, 255]] * 3)
    image = picture_of(labels)
    predict(write(tmp_path / "p.png", image), out=tmp_path / "out")
    laid = cv2.imread(str(tmp_path / "out/overlays/p.jpg"))[..., ::-1].astype(int)
    inside = np.zeros_like(SEEN)
    inside[16:32, 20:28] = True  # away from edges, which JPEG blurs
    assert np.abs(laid - (image.astype(int) + 255) // 2)[inside].max() < 12
    outside = np.zeros_like(SEEN)
    outside[:, :4] = True
    assert np.abs(laid - image)[outside].max() < 12


def test_classes_without_names_or_colours(stub, labels, tmp_path):
    stub("segmentation", classes=(), colors=[])
    (answer,) = predict(write(tmp_path / "p.png", picture_of(labels)), out=tmp_path / "out")
    assert list(answer["shares"]) == ["0", "1", "2"]
    with Image.open(tmp_path / "out/labels/p.png") as image:
        assert np.asarray(image.convert("RGB"))[24, 24].tolist() == palette(3)[0]


def test_distances_of_a_picture(stub, tmp_path):
    stub("distance")
    red = np.tile(np.linspace(40, 240, 64).astype(np.uint8), (48, 1))
    image = np.stack((red, red, red), -1)
    out = tmp_path / "out"
    (answer,) = predict(write(tmp_path / "p.png", image), "--task", "distance", out=out)
    assert answer["distance"] == "distance/p.png"
    steps = cv2.imread(str(out / "distance/p.png"), cv2.IMREAD_UNCHANGED)
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
    laid = cv2.imread(str(out / "overlays/p.jpg"))
    assert laid.shape == (48, 64, 3) and np.ptp(laid[24], 1).max() > 30  # colours over grey


def test_distances_beyond_the_range_of_16_bits():
    distance = np.array([[0, 1e-4, 1, 255.996, 1e6, np.nan, np.inf, -1]], np.float32)
    png = np.frombuffer(distance_png(distance), np.uint8)
    steps = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    assert steps.tolist() == [[0, 1, 256, 65535, 65535, 0, 0, 0]]


def test_a_label_png_keeps_every_id(tmp_path):
    labels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    (tmp_path / "l.png").write_bytes(label_png(labels, palette(255)))
    assert np.array_equal(ids(tmp_path / "l.png"), labels)


@pytest.mark.parametrize("task", ["segmentation", "distance"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_answer_that_is_not_finite_is_none(stub, monkeypatch, tmp_path, task, value):
    net = stub(task)
    run, reached = net.run, torch.ones(48, 48, dtype=torch.bool)

    def broken(images, prepared):
        said = run(images, prepared)
        said[-1, 0].masked_fill_(reached, value)
        return said

    monkeypatch.setattr(net, "run", broken)
    pictures = [write(tmp_path / f"{k}.png", np.full((48, 64, 3), 50, np.uint8)) for k in (0, 1)]
    with pytest.raises(SystemExit, match=f"darswin: no answer for {pictures[1]}: .* NaN or"):
        predict(*pictures, out=tmp_path / "out")
    found = json.loads((tmp_path / "out" / "predictions.json").read_text())
    assert [answer["image"] for answer in found] == pictures[:1]  # what was found is not lost
    # Beyond θ_max it has no meaning.
    reached = ~torch.from_numpy(FullSize(from_dict(LENS, (48, 64)), 48, "crop").reached)
    assert len(predict(*pictures, out=tmp_path / "out")) == 2


@pytest.fixture
def folder(tmp_path, labels):
    """Pictures of the same name in two folders, and a video."""
    for name in ("front/1.png", "rear/1.png", "rear/deep/2.jpg"):
        write(tmp_path / "in" / name, picture_of(labels if "front" in name else labels[:, ::-1]))
    write_video(tmp_path / "in/rear/drive.avi", 5, size=(48, 64), codec="MJPG")
    return tmp_path / "in"


def test_a_folder_means_pictures_and_videos(stub, folder, tmp_path, capsys):
    net = stub("segmentation")
    out = tmp_path / "out"
    *found, speed = predict(folder, "--every", "2", out=out)
    files = [answer["labels"] for answer in found]
    assert files == [
        "labels/front/1.png", "labels/rear/1.png", "labels/rear/deep/2.png",
        *(f"labels/rear/drive.avi/{k:06}.png" for k in (0, 2, 4)),
    ]  # fmt: skip
    for answer in found:
        assert ids(out / answer["labels"]).shape == (48, 64)
        assert cv2.imread(str(out / answer["overlay"])).shape == (48, 64, 3)
    front, rear = (ids(out / name) for name in files[:2])
    assert front[24, 20] == 0 and rear[24, 20] == 2
    assert [answer.get("frame") for answer in found[3:]] == [0, 2, 4]
    assert speed["frames"] == 3 and speed["frames_per_second"] > 0
    assert speed["frames_per_second"] <= speed["network_frames_per_second"]
    assert "3 frames at" in capsys.readouterr().err
    assert net.prepared == 1  # one lens
    assert len(list(out.rglob("*.png"))) == len(list(out.rglob("*.jpg"))) == 6


def test_frames_are_those_of_the_video(stub, tmp_path):
    stub("segmentation")
    frames = write_video(tmp_path / "v.avi", 3, size=(48, 64), codec="MJPG")
    out = tmp_path / "out"
    *found, _ = predict(tmp_path / "v.avi", out=out)
    for frame, answer in zip(frames, found, strict=True):
        labels = ids(out / answer["labels"])
        middle = np.s_[16:32, 24:40]
        same = labels[middle] == frame[middle].argmax(-1)
        assert answer["labels"] == f"labels/v.avi/{answer['frame']:06}.png" and same.mean() > 0.9


def test_colours_of_distance_stay_for_a_video(stub, tmp_path):
    stub("distance")
    write_video(tmp_path / "v.avi", 4, size=(48, 64), codec="MJPG")
    write(tmp_path / "p.png", np.full((48, 64, 3), 40, np.uint8))
    *frames, _, picture = predict(tmp_path / "v.avi", tmp_path / "p.png", out=tmp_path / "out")
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


def test_what_cannot_be_read_is_named_when_the_others_are_written(stub, labels, tmp_path):
    stub("segmentation")
    good = [write(tmp_path / f"in/{k}.png", picture_of(labels)) for k in "ac"]
    (tmp_path / "in/b.png").write_text("no picture")
    write(tmp_path / "in/d.png", np.zeros((20, 20, 3), np.uint8))
    (tmp_path / "in/e.avi").write_text("no video")
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as caught:
        predict(tmp_path / "in", out=out)
    first, *lines = str(caught.value).splitlines()
    assert "for 3 of 5 files" in first
    for name, line in zip(("b.png", "d.png", "e.avi"), lines, strict=True):
        assert name in line
    found = json.loads((out / "predictions.json").read_text())
    assert [answer["image"] for answer in found] == good
    assert sorted(path.name for path in (out / "labels").iterdir()) == ["a.png", "c.png"]


def test_nothing_but_its_own_is_replaced(stub, labels, tmp_path, monkeypatch):
    stub("segmentation")
    picture = write(tmp_path / "in/p.png", picture_of(labels))
    with pytest.raises(SystemExit, match="holds files that are none of predict's"):
        predict(picture, out=tmp_path / "in")
    assert [path.name for path in (tmp_path / "in").iterdir()] == ["p.png"]
    with pytest.raises(SystemExit, match="is a file"):
        predict(picture, out=picture)
    (tmp_path / "list").mkdir()
    (tmp_path / "list/predictions.json").write_text('{"mine": 1}')
    with pytest.raises(SystemExit, match="none of predict's"):
        predict(picture, out=tmp_path / "list")
    (tmp_path / "empty").mkdir()
    assert len(predict(picture, out=tmp_path / "empty")) == 1
    write(Path(picture), picture_of(labels[:, ::-1]))  # its own are, by what it says now
    predict(picture, out=tmp_path / "empty")
    assert ids(tmp_path / "empty/labels/p.png")[24, 20] == 2


def test_its_own_pictures_are_not_predicted_again(stub, labels, tmp_path):
    stub("segmentation")
    picture = write(tmp_path / "in/p.png", picture_of(labels))
    for _ in range(2):
        found = predict(tmp_path / "in", out=tmp_path / "in/out")
        assert [answer["image"] for answer in found] == [picture]
    assert predict(tmp_path / "in/out/labels/p.png", out=tmp_path / "again")  # if asked for


def test_a_folder_is_claimed_before_any_work(tmp_path):
    assert claim_folder(str(tmp_path / "new/out")) == tmp_path / "new/out"
    assert json.loads((tmp_path / "new/out/predictions.json").read_text()) == []
    (tmp_path / "new/out/labels").mkdir()  # of a run that was killed
    claim_folder(str(tmp_path / "new/out"))


def test_what_the_arguments_must_say(stub, labels, tmp_path):
    picture = write(tmp_path / "p.png", picture_of(labels))
    net = stub("segmentation")
    argv = ["predict", picture, "--model", "m", "--lens", json.dumps(LENS)]
    with pytest.raises(SystemExit, match="--out must be their folder"):
        main(argv)
    with pytest.raises(
        SystemExit, match="--task distance was asked of m, a model for segmentation"
    ):
        main([*argv, "--out", str(tmp_path / "o"), "--task", "distance"])
    net.num_classes = 256
    with pytest.raises(SystemExit, match="for 255 classes, got 256"):
        main([*argv, "--out", str(tmp_path / "o")])


def test_pictures_of_several_lenses_go_through_their_own(stub, labels, tmp_path):
    """Pixels that have an answer are those of each picture's lens."""
    stub("segmentation")
    narrow = LENS | {"fov": 1.0, "focal": 10.0}
    del narrow["fov"]
    lenses = {"a": LENS, "b": narrow | {"theta_max": 0.8}}
    for name in lenses:
        write(tmp_path / name / "p.png", picture_of(labels))
    (tmp_path / "lenses.json").write_text(json.dumps(lenses))
    argv = ["predict", str(tmp_path / "a"), str(tmp_path / "b"), "--model", "m"]
    out = tmp_path / "out"
    main([*argv, "--lens", str(tmp_path / "lenses.json"), "--out", str(out)])
    for name, described in lenses.items():
        seen = FullSize(from_dict(described, (48, 64)), 48, "crop").seen
        assert np.array_equal(ids(out / f"labels/{name}/p.png") != 255, seen)


@pytest.mark.parametrize("task", ["segmentation", "distance"])
@pytest.mark.parametrize("name", ["darswin_unet_a_nano", "swin_unet_adapted_nano"])
def test_a_real_model_says_what_it_says_in_python(name, task, tmp_path):
    options = dict(task=task, num_classes=3, in_chans=3, mean=[0.5] * 3, std=[0.25] * 3)
    size = 128
    card = ModelCard(name, options, NAMES, size, fit="crop", task=task, colors=COLORS)
    model = card.create().eval()
    save_model(tmp_path / "m.safetensors", model.state_dict(), card)
    rng = np.random.default_rng(0)
    image = cv2.resize(rng.integers(256, size=(9, 12, 3), dtype=np.uint8), (160, 140))
    picture, out = write(tmp_path / "p.png", image), tmp_path / "out"
    lens = {"model": "Spherical", "xi": 0.5, "fov": 2.8, "image_size": [140, 160]}
    argv = ["predict", picture, "--model", str(tmp_path / "m.safetensors"), "--out", str(out)]
    main([*argv, "--lens", json.dumps(lens)])
    taken_with = from_dict(lens, (140, 160))
    small, small_lens = at_size(image, taken_with, size, "crop")
    with torch.no_grad():
        said = model(torch.from_numpy(small)[None], small_lens)[0].numpy()
    full = FullSize(taken_with, size, "crop")
    if task == "segmentation":
        assert (ids(out / "labels/p.png") == full.labels(said)).mean() > 0.998
    else:
        steps = cv2.imread(str(out / "distance/p.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(steps / 256, full.distance(said[0]), atol=1 / 256, rtol=1e-3)
