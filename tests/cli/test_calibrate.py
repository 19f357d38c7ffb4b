"""`darswin lens calibrate`, on rendered pictures."""

import json
import math
import os
import re
import shutil

import cv2
import numpy as np
import pytest
import torch
from calibrate_boards import Renderer
from helpers import ended, exif_of, slow_but
from PIL import Image

from darswin import lens
from darswin.calibrate import Board, find_corners
from darswin.cli.main import main
from darswin.utils.video import write_frames

TRUE = lens.KannalaBrandt(
    torch.tensor(100.0, dtype=torch.float64), (0.02, -0.004), math.radians(95),
    center=(181.0, 158.0), image_size=(320, 360),
)  # fmt: skip
# A comparison of all models takes too long for tests of the command.
BOARD = ("--board", "6x5", "--square", "0.03", "--model", "KannalaBrandt")
CHARUCO = (*BOARD, "--kind", "charuco", "--marker", "0.022")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Pictures of a chessboard, boards/0.png to 8.png, and of a ChArUco board, markers/."""
    folder = tmp_path_factory.mktemp("rendered")
    view, rng = Renderer(TRUE, samples=2), np.random.default_rng(0)
    for name, board, count in (
        ("boards", Board.chessboard(6, 5, 0.03), 9),
        ("markers", Board.charuco(6, 5, 0.03, 0.022), 4),
    ):
        (folder / name).mkdir()
        for k, pose in enumerate(view.poses(board, count, rng)):
            cv2.imwrite(str(folder / name / f"{k}.png"), view.picture(board, pose, rng))
    return folder


@pytest.fixture
def folder(rendered, tmp_path, monkeypatch):
    shutil.copytree(rendered, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def calibrate(*arguments) -> None:
    main(["lens", "calibrate", *map(str, arguments)])


def refusal(capsys, *arguments) -> str:
    """The line with which the command refuses, with exit code 2."""
    printed = ended(capsys, 2, calibrate, *arguments)
    assert not printed.out
    return printed.err.splitlines()[-1]  # after signs of life, on a slow machine


def assert_is_true(found: lens.Lens) -> None:
    theta = torch.linspace(0.01, math.radians(85), 30, dtype=torch.float64)
    torch.testing.assert_close(found.project(theta), TRUE.project(theta), rtol=0, atol=0.7)
    torch.testing.assert_close(found.center, TRUE.center, rtol=0, atol=0.7)


def test_pictures_become_a_lens_a_figure_and_a_report(folder, capsys):
    cv2.imwrite("boards/wall.png", np.full((320, 360), 90, np.uint8))
    calibrate("boards", *BOARD, "--out=made.json", "--picture=made.png", "--report=report.json")
    printed = capsys.readouterr().out
    assert "pictures        9 of 10" in printed and "corners         270 of 270" in printed
    assert "no board found in boards/wall.png" in printed
    noise, left_out = re.findall(r"^(?:noise|left out) +([\d.]+) px, the ", printed, re.M)
    assert 0.8 < float(left_out) / float(noise) < 2  # in one unit
    assert "made.json: darswin, KannalaBrandt up to 9" in printed
    found = lens.load("made.json", dtype=torch.float64)
    assert_is_true(found)
    assert found.image_size.tolist() == [[320, 360]]
    # The image circle, of which the sensor's sides cut off nothing here.
    assert math.degrees(found.theta_max.item()) == pytest.approx(95, abs=0.6)
    report = json.loads((folder / "report.json").read_text())
    assert report["no_board"] == ["boards/wall.png"] and len(report["names"]) == 9
    assert np.array(report["residuals"]).shape == (9, 30, 2)
    for name, corners in zip(report["names"], report["corners"], strict=True):
        places = find_corners(cv2.imread(name, cv2.IMREAD_GRAYSCALE), Board.chessboard(6, 5, 0.03))
        np.testing.assert_array_equal(corners, places)
    written = report["lens"] | {"supported": report["supported"]}
    assert written == json.loads((folder / "made.json").read_text())
    assert cv2.imread("made.png").shape[1] == 1200
    main(["lens", "show", "made.json", "boards/0.png", "--rings=4", "--sectors=8"])


@pytest.mark.slow
def test_any_format_is_written_and_models_are_compared(folder, capsys, monkeypatch):
    monkeypatch.setattr(
        "darswin.calibrate.search.CANDIDATES", ("Perspective", "Equidistant", "KannalaBrandt")
    )
    calibrate("boards", *BOARD, "--model=auto", "--out=made.yaml")
    printed = capsys.readouterr().out
    assert "made.yaml: opencv, KannalaBrandt" in printed
    rows = [line.split()[0] for line in printed.splitlines()]
    assert rows[rows.index("model") :][1:4] == ["KannalaBrandt", "Equidistant", "Perspective"]
    assert_is_true(lens.load("made.yaml", dtype=torch.float64))


@pytest.mark.parametrize("orientation", slow_but([2, 3, 5, 6, 8], 6))
def test_a_folder_as_people_have_it(folder, capsys, monkeypatch, orientation):
    """Pixels are those that the camera stores, whatever EXIF says of some pictures. One is blurred,
    one has no text as its name, one is there twice, one is given twice, and two are broken."""
    for k in range(0, 9, 2):
        Image.open(f"boards/{k}.png").save(f"boards/{k}.png", exif=exif_of(orientation))
    stored = cv2.imread("boards/4.png", cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_COLOR_RGB)
    cv2.imwrite("boards/7.png", cv2.GaussianBlur(cv2.imread("boards/7.png"), (0, 0), 2.0))
    name = os.fsdecode(b"boards/\xff.png")
    os.rename("boards/3.png", name)
    shutil.copy("boards/2.png", "boards/copy.png")
    for k in "xy":
        (folder / f"boards/{k}.png").write_bytes(b"no picture")
    from matplotlib.figure import Figure

    drawn = []
    draw = "darswin.viz.calibration.draw_calibration"
    monkeypatch.setattr(draw, lambda *given: drawn.append(given) or Figure((1, 1)))
    options = ("--picture=made.png", "--report=report.json", "--theta_max_deg=80")
    printed = ended(capsys, 2, calibrate, "boards", "boards/5.png", *BOARD, *options)
    assert re.search("pictures        [89] of 9", printed.out)
    assert re.search("(blurred|no board found).*boards/7.png", printed.out)
    assert "boards/copy.png shows the same as boards/2.png, and is left out" in printed.out
    assert "boards/5.png shows the same as boards/5.png, and is left out" in printed.out
    for k in "xy":
        assert f"cannot read boards/{k}.png: no image that OpenCV can decode" in printed.err
    assert name in json.loads((folder / "report.json").read_text())["names"]
    made = lens.load("camera.json", dtype=torch.float64)
    assert made.theta_max.item() == pytest.approx(math.radians(80))
    assert_is_true(made)
    ((_, _, read),) = drawn
    np.testing.assert_array_equal(read("boards/4.png"), stored)


def test_a_video_is_read_by_its_sharpest_frames(folder, capsys):
    boards = [cv2.imread(str(file)) for file in sorted((folder / "boards").iterdir())]
    blurred = [cv2.GaussianBlur(board, (0, 0), 3.0) for board in boards]
    frames = [frame for a, b in zip(boards, blurred, strict=True) for frame in (b, b, a, b)]
    write_frames("film.mp4", [*frames, *blurred[:1]], 10.0)
    calibrate("film.mp4", *BOARD, "--picture=made.png", "--report=report.json")
    assert "looks wrong     blurred" not in capsys.readouterr().out
    assert_is_true(lens.load("camera.json", dtype=torch.float64))
    names = json.loads((folder / "report.json").read_text())["names"]
    assert len(names) > 5 and {int(name.split("film.mp4, frame ")[1]) % 4 for name in names} == {2}
    assert cv2.imread("made.png").shape[1] == 1200


def test_markers_are_found_in_pictures_that_the_camera_mirrors(folder, capsys):
    calibrate("markers", *CHARUCO, "--out=plain.json")
    for orientation, file in zip((2, 4, 5, 7), (folder / "markers").iterdir(), strict=True):
        mirrored = Image.open(file).transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        mirrored.save(file, exif=exif_of(orientation))
    calibrate("markers", *CHARUCO)
    printed = capsys.readouterr().out
    assert printed.count("pictures        4 of 4") == 2 and "mirrored" not in printed
    plain, found = (lens.load(f, dtype=torch.float64) for f in ("plain.json", "camera.json"))
    theta = torch.linspace(0.01, math.radians(60), 30, dtype=torch.float64)
    torch.testing.assert_close(found.project(theta), plain.project(theta), rtol=0, atol=0.2)
    mirrored = torch.stack((359 - plain.center[:, 0], plain.center[:, 1]), 1)
    torch.testing.assert_close(found.center, mirrored, rtol=0, atol=0.2)


@pytest.mark.parametrize(
    "out", slow_but(["made.json", "made.yaml", "made.txt", "camchain.yaml"], "made.yaml")
)
def test_the_ratio_of_pixels_that_are_not_square_is_kept(folder, capsys, out):
    for file in (folder / "boards").iterdir():
        wide = cv2.resize(cv2.imread(str(file)), (400, 320), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(file), wide)
    calibrate("boards", *BOARD, "--square_pixels=false", f"--out={out}")
    (a, b), (c, d) = lens.load(out, dtype=torch.float64).affine[0].tolist()
    assert b == c == 0 and a / d == pytest.approx(400 / 360, rel=2e-3)


def test_a_lens_that_the_format_cannot_hold_is_written_as_json(folder, capsys):
    printed = ended(capsys, 2, calibrate, "boards", *BOARD, "--model=OCam", "--out=made.yaml")
    assert "made.yaml.json: darswin, OCam" in printed.out
    assert "cannot hold this OCam lens" in printed.err and "is in made.yaml.json" in printed.err
    assert isinstance(lens.load("made.yaml.json"), lens.OCam)


@pytest.mark.parametrize(
    ("out", "model"),
    slow_but([("made.yaml", "Equidistant"), ("made.json", "OCam")], ("made.yaml", "Equidistant")),
)
def test_models_that_the_format_cannot_hold_are_not_taken(folder, capsys, monkeypatch, out, model):
    monkeypatch.setattr("darswin.calibrate.search.CANDIDATES", ("OCam", "Equidistant"))
    calibrate("boards", *BOARD, "--model=auto", f"--out={out}")
    printed = capsys.readouterr().out
    rows = [line.split()[0] for line in printed.splitlines()]
    first, second = rows[rows.index("model") + 1 :][:2]  # the one that was taken is the first
    assert first == model and {first, second} == {"OCam", "Equidistant"}
    assert type(lens.load(out)).__name__ == model


@pytest.mark.slow
def test_another_board_is_described(folder, capsys):
    line = refusal(capsys, "markers", *CHARUCO, "--dictionary=5X5_250")
    assert re.search("they show markers [0-4] to 14 of 4X4_", line)
    line = refusal(capsys, "markers", *CHARUCO, "--board=7x5")
    assert re.search("they show markers [0-4] to 14 of 4X4_250", line)
    calibrate(*(f"boards/{k}.png" for k in range(8)), "markers", *BOARD)
    assert "no board found in markers/0.png" in capsys.readouterr().out


@pytest.mark.slow
def test_a_zoom_that_changes_looks_wrong(folder, capsys):
    words = "looks wrong     (.* pictures disagree|the scale changes by .[5-9])"
    calibrate("boards", *BOARD)
    assert not re.search(words, capsys.readouterr().out)
    for k in range(5, 9):
        picture = cv2.imread(f"boards/{k}.png")
        near = cv2.resize(picture, None, fx=1.05, fy=1.05, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(f"boards/{k}.png", near[8:-8, 9:-9])
    calibrate("boards", *BOARD)
    assert re.search(words, capsys.readouterr().out)


@pytest.mark.slow
def test_what_pictures_do_not_show_is_said_in_a_sentence(folder, capsys):
    some = [f"boards/{k}.png" for k in (0, 1)]
    line = refusal(capsys, *some, "--board=7x4", "--square=1")
    assert line.endswith(
        "0 of 2 pictures with the board of --board 7x4: 3 are needed, and 10 to 20 are better; "
        "no board found in boards/0.png, boards/1.png: they show 6x5 inner corners"
    )
    line = refusal(capsys, *some, *BOARD)
    assert line.endswith(
        "2 of 2 pictures with the board of --board 6x5: 3 are needed, and 10 to 20 are better"
    )
    (folder / "broken.png").write_bytes((folder / "boards/0.png").read_bytes()[:2000])
    assert "cannot read broken.png" in refusal(capsys, *some, "broken.png", *BOARD)
    cv2.imwrite("large.png", np.zeros((360, 320), np.uint8))
    line = refusal(capsys, *some, "large.png", *BOARD)
    assert "boards/0.png has 320 × 360 px (H × W), large.png has 360 × 320" in line


@pytest.mark.slow
def test_mirrored_pictures_are_told(folder, capsys):
    for file in (folder / "markers").iterdir():
        cv2.imwrite(str(file), cv2.imread(str(file))[:, ::-1])
    line = refusal(capsys, "markers", *CHARUCO)
    assert line.endswith("markers/2.png, markers/3.png: they show it mirrored, flip them first")
