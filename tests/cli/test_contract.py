"""What every command that reads pictures does when something is amiss: command × mishap."""

import errno
import json
import os
import socket
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import ended, exif_of, save_picture
from PIL import Image
from videos import turn_video, write_video

from darswin.cli.main import main
from darswin.lens import from_dict, save
from darswin.lens.orientation import in_upright_picture
from darswin.models.saving import ModelCard, save_model
from darswin.utils.image import read_image
from darswin.utils.video import read_frames

SIZE = (64, 96)
# Off the middle, as a turn of the picture shows; what else a turn changes is in lens/.
LENS = from_dict({
    "model": "Equidistant", "focal": 30, "theta_max": 1.3, "center": [52.0, 29.0],
    "image_size": [64, 96],
})  # fmt: skip
PREDICT = "predict in --lens lens.json --out out"
COMMANDS = {
    "classes": f"{PREDICT} --model classes.safetensors --top 9",
    "labels": f"{PREDICT} --model labels.safetensors",
    "network": f"{PREDICT} --network n.onnx --view stereographic",
    "undistort": "lens undistort lens.json in --fov_deg 80 --size 48,64 --out out",
    "warp": "warp set.json --pictures in --to mercator --size 48,64 --lens lens.json --out out",
}
# How much results of equal pictures may differ: numbers at most, pixels in the mean.
APART = {"classes": 1e-4, "labels": 0.01, "network": 0.05, "undistort": 0.5, "warp": 0.5}
VIDEOS = ("classes", "labels", "undistort")  # frames have no sharp disc for the network
FOLDERS = [name for name in COMMANDS if name != "classes"]


def picture(seed):
    """A dark picture with one bright disc, for the network and for the labels."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    dark = np.stack([40 + 30 * np.sin(x / 9 + seed), 40 + 30 * np.cos(y / 7), 60 + 0 * x], -1)
    disc = np.hypot(x - 60 + 3 * seed, y - 25) < 9
    return np.where(disc[..., None], (40, 250, 40), dark).astype(np.uint8)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    statistics = dict(mean=[0.5] * 3, std=[0.25] * 3)
    small = dict(embed_dim=8, depths=[1, 1, 1], rings=8, sectors=32, samples=[2, 2])
    for card in (
        ModelCard("darswin_a_nano", statistics | dict(num_classes=6), list("abcdef"), 32, 2.8),
        ModelCard("darswin_unet_a_nano", statistics | small | dict(task="segmentation",
                  num_classes=3), list("abc"), 32, fit="stretch", task="segmentation"),
    ):  # fmt: skip
        name = "labels" if card.task == "segmentation" else "classes"
        save_model(folder / f"{name}.safetensors", card.create().state_dict(), card)
    return folder


@pytest.fixture
def run(models, tmp_path, monkeypatch):
    """Runs a command on pictures in the folder `in`, which it makes: see `Run`."""
    monkeypatch.chdir(tmp_path)
    for file in models.iterdir():
        Path(file.name).symlink_to(file)
    save(LENS, "lens.json")
    return Run


class Run:
    """A command, and its results in a folder by the names of the pictures and frames."""

    def __init__(self, command: str, **pictures: np.ndarray):
        self.command = command
        for name, array in pictures.items():
            put(f"in/{name}.png", array)
        if command == "network":
            pytest.importorskip("onnx")
            pytest.importorskip("onnxruntime")
            from graphs import write_graph

            write_graph(Path("n.onnx"), size=(64, 64))

    def __call__(self, *options: str) -> dict[str, np.ndarray]:
        if self.command == "warp":
            write_set()
        main([*COMMANDS[self.command].split(), *options])
        return self.results()

    def fails(self, capsys) -> str:
        """What the command says when it ends with exit code 2."""
        capsys.readouterr()
        return ended(capsys, 2, self).err

    def results(self) -> dict[str, np.ndarray]:
        if self.command in ("undistort", "warp"):
            return self._pictures(Path("out/images" if self.command == "warp" else "out"))
        found = {}
        record = Path("out" if self.command == "classes" else "out/predictions.json")
        for entry in json.loads(record.read_text()):
            if "frames" in entry:
                continue  # the speed
            name = Path(entry.get("image", entry.get("video"))).relative_to("in").with_suffix("")
            name = str(name / str(entry["frame"]) if "frame" in entry else name)
            if self.command == "classes":
                top = {one["class"]: one["probability"] for one in entry["top"]}
                found[name] = np.array([top[label] for label in "abcdef"])
            elif self.command == "labels":
                found[name] = np.array(Image.open(Path("out", entry["labels"])), float)
            else:
                (one,) = entry["detections"]
                found[name] = np.array([*one["box"], one["score"], one["label"]])
        return found

    def _pictures(self, folder: Path) -> dict[str, np.ndarray]:
        found = {}
        for file in sorted(folder.rglob("*")):
            name = str(file.relative_to(folder).with_suffix(""))
            if file.suffix == ".png":
                found[name] = cv2.imread(str(file)).astype(float)
            elif file.suffix in (".mp4", ".avi"):
                frames = {f"{name}/{f.number}": f.image[..., ::-1] for f in read_frames(file)}
                found |= frames
        if self.command == "warp" and Path("out/annotations.json").exists():
            content = json.loads(Path("out/annotations.json").read_text())
            files = {one["id"]: Path(one["file_name"]).stem for one in content["images"]}
            for one in content["annotations"]:
                found[f"{files[one['image_id']]}: box"] = np.array(one["bbox"])
        return found


def assert_same(command, found, expected, apart=None):
    assert found.keys() == expected.keys() and found
    for name, array in expected.items():
        difference = np.abs(found[name] - array)
        away = difference.mean() if difference.ndim > 1 else difference.max()
        assert away <= (apart or APART[command]), name


def put(name, array, orientation=1):
    save_picture(name, array, exif=Image.Exif() if orientation == 1 else exif_of(orientation))


def write_set():
    """Labels in COCO's form: a box around the disc of each picture that can be read."""
    images, annotations = [], []
    for k, file in enumerate(sorted(Path("in").iterdir())):
        height, width = SIZE
        if "broken" not in file.name:
            disc = read_image(file)[..., 1] > 128
            (height, width), (y, x) = disc.shape, np.nonzero(disc)
            box = [int(n) for n in (x.min(), y.min(), np.ptp(x) + 1, np.ptp(y) + 1)]
            annotations.append({"id": k + 1, "image_id": k, "category_id": 1, "bbox": box})
        images.append({"id": k, "file_name": file.name, "height": height, "width": width})
    content = {"images": images, "annotations": annotations}
    content["categories"] = [{"id": 1, "name": "disc"}]
    Path("set.json").write_text(json.dumps(content))


# -- pictures -------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("orientation", [6, 7])
def test_a_picture_that_exif_turns_is_as_the_upright_one(run, command, orientation):
    made = run(command)
    put("in/p.png", picture(0), orientation)
    found = made()
    put("in/p.png", read_image("in/p.png"))
    save(in_upright_picture(LENS, SIZE[::-1], orientation), "lens.json")
    Path("out").rename("before")
    assert_same(command, found, made())


@pytest.mark.parametrize("command", VIDEOS)
def test_frames_of_a_turned_video_are_as_upright_pictures(run, command):
    made = run(command)
    Path("in").mkdir()
    write_video(Path("v.mp4"), 4, size=SIZE)
    turn_video(Path("v.mp4"), 90)
    frames = list(read_frames("v.mp4", every=2))
    Path("v.mp4").rename("in/v.mp4")
    every = [] if command == "undistort" else ["--every", "2"]
    found = {name: array for name, array in made(*every).items() if int(name[-1]) % 2 == 0}
    Path("in/v.mp4").unlink()
    Path("out").rename("before")
    for frame in frames:
        put(f"in/v/{frame.number}.png", frame.image)
    save(in_upright_picture(LENS, SIZE[::-1], 6), "lens.json")
    assert_same(command, found, made(), apart=6 if command == "undistort" else None)


@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_broken_is_named_and_all_others_are_done(run, command, capsys):
    made = run(command, a=picture(0), b=picture(1))
    expected = made()
    put("in/square.png", picture(0)[:, :64])
    Path("in/broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    broken = ["square", "broken"]
    if command != "warp":
        Path("in/none.mp4").write_text("no video")
        broken.append("none")
    if command in VIDEOS:
        write_video(Path("in/cut.avi"), 40, size=SIZE, codec="MJPG")
        content = Path("in/cut.avi").read_bytes()
        Path("in/cut.avi").write_bytes(content[: len(content) // 2])
        broken.append("cut")
    Path("out").rename("before")
    said = made.fails(capsys)
    assert all(f"in/{name}." in said for name in broken)
    assert not any(f"in/{name}.png" in said for name in "ab")
    found = made.results()
    frames = {name for name in found if name.startswith("cut")}
    assert_same(command, {name: found[name] for name in found if name not in frames}, expected)
    assert ("cut" in broken) == (10 < len(frames) < 30)
    total = 2 + len(broken)
    if "predict" in COMMANDS[command]:
        assert f"darswin: no complete prediction for {len(broken)} of {total} files:\n" in said
    assert "for 64 × 96 px (H × W), but the picture has 64 × 64" in said


# -- folders, disks and keys ----------------------------------------------------------------------


def state_of(*names):
    """Each file with its content."""
    files = (p for name in names for p in [Path(name), *Path(name).rglob("*")] if p.is_file())
    return {str(path): path.read_bytes() for path in files}


@pytest.mark.parametrize("command", FOLDERS)
def test_a_foreign_folder_is_refused_and_the_commands_own_is_not(run, command, capsys):
    made = run(command, a=picture(0))
    Path("out").mkdir()
    Path("out/notes.txt").write_text("mine")
    assert "--out out holds other files: give a new or an empty folder" in made.fails(capsys)
    assert state_of("out") == {"out/notes.txt": b"mine"}
    Path("out/notes.txt").unlink()
    expected = made()
    Path("out/notes.txt").write_text("mine")
    assert_same(command, made(), expected)
    assert Path("out/notes.txt").read_text() == "mine"


WRITERS = {
    "show": "lens show lens.json in/a.png --rings 2 --sectors 4 --out old.png",
    "convert": "lens convert lens.json old.json",
    "crop": "lens crop lens.json old.json --size 32,48",
}


@pytest.mark.parametrize("command", [*COMMANDS, *WRITERS])
def test_a_full_disk_leaves_old_files_and_no_halves(run, command, capsys, monkeypatch):
    made = run(command, a=picture(0))
    if command in WRITERS:
        save(LENS, "old.json")
        put("old.png", picture(1))
    else:
        made()

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = state_of("out", "old.json", "old.png")
    if command == "warp":  # which keeps what is there
        before.pop(str(next(Path("out/images").iterdir())))
        next(Path("out/images").iterdir()).unlink()
    monkeypatch.setattr(os, "fsync", full)
    printed = ended(capsys, 2, main, (COMMANDS | WRITERS)[command].split())
    assert "cannot write the file, which is unchanged: No space left" in printed.err
    after = state_of("out", "old.json", "old.png")
    assert after == {name: before[name] for name in after}  # a lens.json may be gone
    assert len(before) - len(after) <= 1


@pytest.mark.parametrize("command", COMMANDS)
def test_ctrl_c_keeps_what_is_done_and_the_command_goes_on(run, command, capsys, monkeypatch):
    made = run(command, a=picture(0), b=picture(1))
    expected = made()
    Path("out").rename("before")
    decode, read = cv2.imdecode, []

    def interrupted(*arguments):
        read.append(arguments)
        if len(read) == 2:
            raise KeyboardInterrupt
        return decode(*arguments)

    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(cv2, "imdecode", interrupted)
        with pytest.raises(SystemExit) as end:
            main(COMMANDS[command].split())
    assert end.value.code == 130 and end.value.__suppress_context__
    assert "Traceback" not in capsys.readouterr().err
    assert {name.removesuffix(": box") for name in made.results()} == {"a"}
    assert not [name for name in state_of("out") if "partial" in name]
    assert_same(command, made(), expected)


@pytest.mark.parametrize("kind", ["a pipe", "a socket", "a device"])
def test_what_is_no_file_is_refused_at_once(run, capsys, kind, monkeypatch):
    """As a picture, a video, a calibration, a model, and in a folder."""
    run("classes", a=picture(0))
    for name in ("f.png", "f.mp4", "f", "in/f.png", "f.safetensors", "f.json"):
        if kind == "a pipe":
            os.mkfifo(name)
        elif kind == "a socket":
            with socket.socket(socket.AF_UNIX) as made:
                made.bind(name)
        else:
            Path(name).symlink_to("/dev/zero")
    known = "--model classes.safetensors --lens lens.json"
    for command, name in (
        (f"predict f.png {known}", "f.png"),
        (f"predict in/a.png f.mp4 {known}", "f.mp4"),
        (f"predict f {known}", "f"),
        (f"predict in {known}", "in/f.png"),
        ("predict in/a.png --model classes.safetensors --lens f.json", "f.json"),
        ("predict in/a.png --model f.safetensors --lens lens.json", "f.safetensors"),
        ("lens undistort lens.json in --out out", "in/f.png"),
        ("lens calibrate f.png --board 6x5 --square 1", "f.png"),
        ("fit --run r --data.path digits --data.lens f.json", ""),  # it follows links
    ):
        printed = ended(capsys, 2, main, command.split())
        assert not printed.out
        assert f"{name} must be a file, but is {kind}" in printed.err
