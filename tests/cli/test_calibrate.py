"""`darswin lens calibrate`, on rendered pictures."""

import json
import math
import re
import shutil

import cv2
import numpy as np
import pytest
import torch
from calibrate_boards import Renderer
from PIL import ExifTags, Image

from darswin import lens
from darswin.calibrate import Board
from darswin.cli.main import main

TRUE = lens.KannalaBrandt(
    torch.tensor(100.0, dtype=torch.float64), (0.02, -0.004), math.radians(95),
    center=(181.0, 158.0), image_size=(320, 360),
)  # fmt: skip
BOARD = ("--board", "6x5", "--square", "0.03")
CHARUCO = ("--board", "6x5", "--square", "0.03", "--kind", "charuco", "--marker", "0.022")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Pictures of a chessboard, boards/0.png to 8.png, and of a ChArUco board, markers/."""
    folder = tmp_path_factory.mktemp("rendered")
    view, rng = Renderer(TRUE, samples=2), np.random.default_rng(0)
    for name, board, count in (
        ("boards", Board.chessboard(6, 5, 0.03), 9),
        ("markers", Board.charuco(6, 5, 0.03, 0.022), 1),
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
    with pytest.raises(SystemExit) as end:
        calibrate(*arguments)
    printed = capsys.readouterr()
    assert end.value.code == 2 and not printed.out
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
    assert "made.json: darswin, KannalaBrandt up to 9" in printed
    found = lens.load("made.json", dtype=torch.float64)
    assert_is_true(found)
    assert found.image_size.tolist() == [[320, 360]]
    # The image circle, of which the sensor's sides cut off nothing here.
    assert math.degrees(found.theta_max.item()) == pytest.approx(95, abs=0.6)
    report = json.loads((folder / "report.json").read_text())
    assert report["no_board"] == ["boards/wall.png"] and len(report["names"]) == 9
    assert np.array(report["residuals"]).shape == (9, 30, 2)
    assert report["lens"] == json.loads((folder / "made.json").read_text())
    assert cv2.imread("made.png").shape[1] == 1200
    main(["lens", "show", "made.json", "boards/0.png", "--rings=4", "--sectors=8"])


def test_any_format_is_written_and_models_are_compared(folder, capsys, monkeypatch):
    # All models take too long for a test of the command.
    monkeypatch.setattr(
        "darswin.calibrate.calibration.CANDIDATES", ("Perspective", "Equidistant", "KannalaBrandt")
    )
    calibrate("boards", *BOARD, "--model=auto", "--out=made.yaml")
    printed = capsys.readouterr().out
    assert "made.yaml: opencv, KannalaBrandt" in printed
    rows = [line.split()[0] for line in printed.splitlines()]
    assert rows[rows.index("model") :][1:4] == ["KannalaBrandt", "Equidistant", "Perspective"]
    assert_is_true(lens.load("made.yaml", dtype=torch.float64))


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_pixels_are_those_that_the_camera_stores(folder, capsys, orientation):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    for k in range(0, 9, 2):
        Image.open(f"boards/{k}.png").save(f"boards/{k}.png", exif=exif)
    calibrate("boards", *BOARD)
    assert "pictures        9 of 9" in capsys.readouterr().out
    assert_is_true(lens.load("camera.json", dtype=torch.float64))


def blur(file: str, sigma: float) -> None:
    cv2.imwrite(file, cv2.GaussianBlur(cv2.imread(file), (0, 0), sigma))


def test_a_blurred_board_is_named(folder, capsys):
    blur("boards/3.png", 2.0)
    calibrate("boards", *BOARD)
    (line,) = (x for x in capsys.readouterr().out.splitlines() if "boards/3.png" in x)
    assert "blurred" in line or "no board found" in line


def test_what_pictures_do_not_show_is_said_in_a_sentence(folder, capsys):
    some = [f"boards/{k}.png" for k in (0, 1)]
    line = refusal(capsys, *some, "--board=7x4", "--square=1")
    assert line.endswith(
        "0 of 2 pictures show the board of --board 7x4: they show 6x5 inner corners"
    )
    line = refusal(capsys, *some, *BOARD)
    assert "2 of 2 pictures show the board: 3 are needed, and 10 to 20 are better" in line
    (folder / "empty").mkdir()
    assert "no pictures or videos in empty" in refusal(capsys, "empty", *BOARD)
    assert "missing pictures" in refusal(capsys, *BOARD)
    assert "no file or folder none" in refusal(capsys, "none", *BOARD)
    (folder / "broken.png").write_bytes((folder / "boards/0.png").read_bytes()[:2000])
    assert "cannot read broken.png" in refusal(capsys, *some, "broken.png", *BOARD)
    cv2.imwrite("large.png", np.zeros((360, 320), np.uint8))
    line = refusal(capsys, *some, "large.png", *BOARD)
    assert "boards/0.png has 360×320 (W×H) px, large.png has 320×360" in line


def test_mirrored_pictures_are_told(folder, capsys):
    for file in (folder / "markers").iterdir():
        cv2.imwrite(str(file), cv2.imread(str(file))[:, ::-1])
    line = refusal(capsys, "markers", *CHARUCO)
    assert line.endswith(
        "0 of 1 pictures show the board: the pictures are mirrored, flip them first"
    )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--board=9", "--square=1"], "--board must be columns and rows from 3 to 100, such as"),
        (["--board=1x6", "--square=1"], "--board must be columns and rows from 3 to 100"),
        (["--board=9x6", "--square=0"], "--square must be positive, got 0"),
        (["--board=9x6", "--square=.nan"], "--square must be"),
        (["--board=9x6"], "--square"),
        ([*BOARD, "--kind=round"], "--kind must be one of chessboard, charuco, april"),
        ([*BOARD, "--kind=charuco"], "--kind charuco, and no other, needs --marker"),
        ([*BOARD, "--kind=april"], "--kind april, and no other, needs --gap"),
        ([*BOARD, "--marker=0.1"], "--kind charuco, and no other, needs --marker"),
        ([*CHARUCO, "--gap=0.1"], "--kind april, and no other, needs --gap"),
        ([*BOARD, "--kind=charuco", "--marker=0.1"], "--marker must be below the square of 0.03"),
        ([*CHARUCO, "--dictionary=4X4_5"], "did you mean 4X4_50?"),
        ([*BOARD, "--dictionary=4X4_50"], "a chessboard has no --dictionary"),
        ([*BOARD, "--model=KanalaBrandt"], "--model: .*did you mean KannalaBrandt"),
        ([*BOARD, "--picture=made.gif"], "must end in one of .png"),
        ([*BOARD, "--out=boards/0.png"], "--out boards/0.png would replace"),
        ([*BOARD, "--report=boards/0.png"], "--report boards/0.png would replace"),
    ],
)
def test_misuse_is_refused_before_any_picture_is_read(folder, capsys, monkeypatch, options, said):
    def read(*arguments):
        raise AssertionError("it was refused too late")

    monkeypatch.setattr("darswin.utils.image.read_oriented", read)
    with pytest.raises(SystemExit) as end:
        calibrate("boards", *options)
    assert end.value.code == 2
    assert re.search(said, capsys.readouterr().err)
