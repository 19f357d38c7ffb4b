"""`darswin lens undistort` and `darswin lens crop`, with OpenCV as the oracle."""

import json
import math

import cv2
import numpy as np
import pytest
import torch
from helpers import save_picture
from lens_examples import write_opencv
from PIL import Image
from videos import write_video

from darswin import lens as lenses
from darswin.cli import undistort as module
from darswin.cli.main import main
from darswin.data.cameras import Calibrations
from darswin.lens import Equidistant, to_dict
from darswin.utils.video import read_frames
from darswin.views import make_view, turned

SIZE = (96, 128)  # of the calibration's pictures
K = np.array([[52.0, 0.0, 62.0], [0.0, 51.0, 49.5], [0.0, 0.0, 1.0]])
D = np.array([0.02, -0.005, 0.001, 0.0])


def picture(size=SIZE, channels=3):
    """A smooth picture, whose interpolation has no large error."""
    y, x = np.mgrid[: size[0], : size[1]]
    planes = (np.sin(x / 15), np.cos(y / 12), np.sin((x + 2 * y) / 20))
    return np.stack([128 + 100 * p for p in planes[:channels]], -1).astype(np.uint8)


def read(path):
    return np.array(Image.open(path))


@pytest.fixture
def folder(tmp_path):
    """A folder with a calibration of OpenCV's fisheye model and a picture."""
    entries = dict(image_width=SIZE[1], image_height=SIZE[0], fisheye_model=1, camera_matrix=K)
    write_opencv(tmp_path / "fisheye.yaml", **entries, distortion_coefficients=D)
    save_picture(tmp_path / "in" / "a.png", picture())
    return tmp_path


def run(folder, *options, source="in", calib="fisheye.yaml", out="out"):
    calib, source, out = (str(folder / name) for name in (calib, source, out))
    if calib.endswith("fisheye.yaml"):
        options = (*options, "--coefficients=fisheye")
    main(["lens", "undistort", calib, source, "--out", out, *map(str, options)])
    return folder / "out"


def test_a_perspective_view_is_that_of_opencv(folder, capsys):
    out = run(folder, "--fov", 100)  # an unambiguous beginning of --fov_deg
    assert "1 of 1 file, perspective view, 100° across, 96 × 128 px" in capsys.readouterr().out
    camera = lenses.load(out / "lens.json", dtype=torch.float64)
    assert math.isclose(camera.focal.item(), 64 / math.tan(math.radians(50)))
    f, (x, y) = camera.focal.item(), camera.center_in()[0].tolist()
    assert math.isclose(camera.theta_max.item(), math.atan(math.hypot(64, 48) / f), rel_tol=1e-6)
    new = np.array([[f, 0, x], [0, f, y], [0, 0, 1]])
    maps = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), new, SIZE[::-1], cv2.CV_32FC1)
    expected = cv2.remap(picture(), *maps, cv2.INTER_LINEAR)
    found = read(out / "a.png")
    assert found.shape == (*SIZE, 3)
    assert np.abs(found.astype(int) - expected).max() <= 3  # remap rounds places to 1/32 px
    assert np.abs(found.astype(int) - expected).mean() < 0.5


TURNS = {
    "--yaw_deg=20": turned(math.radians(20), 0.0),
    "--pitch_deg=-15": turned(0.0, math.radians(-15)),
    "--up=0.5,-0.8660254,0": {"up": (0.5, -0.8660254, 0.0)},
}
CURVED = ("cylindrical", "equirectangular", "mercator", "stereographic")


@pytest.mark.parametrize(
    ("view", "option"),
    [*zip(CURVED, [*TURNS, ""], strict=True), ("square", ""), ("panorama", "--up=0,0,-1")],
)
def test_other_views_are_those_of_the_library(folder, view, option):
    size = (60, 60) if view == "square" else (40, 72)
    fov = "" if view == "panorama" else "--fov_deg=100"
    out = run(folder, f"--view={view}", *fov.split(), *option.split(), "--size", *size)
    lens = lenses.load(folder / "fisheye.yaml", coefficients="fisheye").with_theta_max(None)
    turn = {"up": (0, 0, -1)} if view == "panorama" else TURNS.get(option, {})
    made = make_view(view, size, fov=math.radians(100) if fov else None, **turn)
    expected, found = made.at(lens, SIZE)(picture()), read(out / "a.png")
    assert (found.max(-1) > 0).mean() > 0.4
    assert np.abs(found.astype(int) - expected).max() <= 1
    assert not (out / "lens.json").exists()


def test_the_views_show_all_that_the_picture_shows_by_default(folder, capsys):
    lens = Equidistant(50.0, image_size=SIZE)  # 146.7° in the row of the principal point
    (folder / "own.json").write_text(json.dumps(to_dict(lens) | {"theta_max": 64 / 50}))
    for view, fov, size in (
        ("perspective", 100, "96 × 128 px"),
        ("cylindrical", 146.7, "64 × 128 px"),
        ("equirectangular", 146.7, "96 × 128 px"),
        ("mercator", 146.7, "96 × 128 px"),
        ("stereographic", 146.7, "96 × 128 px"),
        ("panorama", 360, "43 × 128 px"),
        ("square", 146.7, "96 × 96 px"),
    ):
        run(folder, f"--view={view}", calib="own.json", out=view)
        assert f"{view} view, {fov}° across, {size}" in capsys.readouterr().out


def test_corners_are_shown_unless_the_calibration_ends_before(folder):
    """The picture's sides end at 64 px and its corners at 80 px from the principal point."""
    lens = Equidistant(64.0, image_size=SIZE)
    described = to_dict(lens)
    for theta_max, options, whole in (
        (lens.theta_max.item(), (), True),  # of the model
        (1.0, (), True),  # of the picture's sides, as every other format has it
        (0.9, (), False),
        (1.0, ("--theta_max_deg=50",), False),
    ):
        (folder / "own.json").write_text(json.dumps(described | {"theta_max": theta_max}))
        found = read(run(folder, "--fov=100", *options, calib="own.json") / "a.png")
        assert (found.max(-1) > 0).all() == whole


def test_pictures_and_videos_of_many_kinds_in_subfolders(folder, capsys, monkeypatch):
    source, planned, plan = folder / "in", [], module._Views._planned
    save_picture(source / "front" / "grey.png", picture(channels=1))
    save_picture(source / "front" / "a.png", picture()[::-1])
    save_picture(source / "large.bmp", cv2.resize(picture(), (256, 192)))
    save_picture(source / "b.jpg", picture(), quality=95)
    save_picture(source / "name.ppm", picture())
    write_video(source / "front" / "drive.mp4", 4, size=SIZE)
    write_video(source / "clip.mkv", 3, size=SIZE)
    monkeypatch.setattr(module._Views, "_planned", lambda *a: planned.append(a[2:]) or plan(*a))
    out = run(folder)
    # One plan serves all pictures of one size.
    assert sorted(planned) == [(SIZE, False), (SIZE, True), ((192, 256), False)]
    assert "8 of 8 files, perspective view, in several sizes; their cal" in capsys.readouterr().out
    files = {file.relative_to(out).as_posix() for file in out.rglob("*") if file.is_file()}
    assert files == {
        "a.png", "b.jpg", "large.bmp", "name.ppm.png", "clip.mkv", "front/a.png",
        "front/grey.png", "front/drive.mp4", "lens.json", "undistorted.json",
    }  # fmt: skip
    assert read(out / "front" / "grey.png").shape == SIZE
    np.testing.assert_array_equal(read(out / "front" / "grey.png"), read(out / "a.png")[..., 0])
    assert read(out / "large.bmp").shape == (192, 256, 3)
    small = cv2.resize(read(out / "large.bmp"), SIZE[::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(small[2:-2, 2:-2].astype(int) - read(out / "a.png")[2:-2, 2:-2]).mean() < 3
    cameras = Calibrations(out / "lens.json", out)
    for name, size in (("large.bmp", (192, 256)), ("front/a.png", SIZE), ("clip.mkv", SIZE)):
        camera = cameras.lens_of(out / name, size)
        assert math.isclose(
            camera.focal.item(), size[1] / 2 / math.tan(math.radians(50)), rel_tol=1e-5
        )


def test_frames_of_videos_are_undistorted_as_pictures(folder):
    frames = write_video(folder / "in" / "drive.mp4", 5, size=(96, 128))
    for k, frame in enumerate(frames):
        save_picture(folder / "in" / f"{k}.png", frame)
    out = run(folder, "--fov=100", "--size=71,91")
    found = list(read_frames(out / "drive.mp4"))
    assert [frame.number for frame in found] == [*range(5)] and math.isclose(found[2].time, 0.2)
    for k, frame in enumerate(found):
        assert frame.image.shape == (70, 90, 3)  # even
        expected = cv2.resize(read(out / f"{k}.png"), (90, 70))
        assert np.abs(frame.image.astype(int) - expected).mean() < 6


def test_an_interrupted_video_leaves_no_file(folder, monkeypatch):
    write_video(folder / "in" / "drive.mp4", 5, size=SIZE)
    (folder / "in" / "a.png").unlink()

    real, calls = module._Views.of, []

    def third(self, *arguments, **options):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(self, *arguments, **options)

    monkeypatch.setattr(module._Views, "of", third)
    with pytest.raises(SystemExit, match="130"):
        run(folder)
    assert [file.name for file in (folder / "out").iterdir()] == ["undistorted.json"]


def test_a_second_run_replaces_the_first(folder):
    out = run(folder)
    first = read(out / "a.png")
    run(folder, "--view=square")
    assert read(out / "a.png").shape == (96, 96, 3) != first.shape
    assert not (out / "lens.json").exists()


# -- crop -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--box=3,10,80,90"], lambda lens: lens.cropped(3, 10, 80, 90)),
        (["--box", "-8", "-8", "112", "144"], lambda lens: lens.cropped(-8, -8, 112, 144)),
        (["--size=48,64"], lambda lens: lens.resized((48, 64))),
        (["--box=0,16,96,96", "--size=32,32"],
         lambda lens: lens.cropped(0, 16, 96, 96).resized((32, 32))),
    ],
)  # fmt: skip
def test_crop_writes_the_lens_of_cropped_pictures(folder, capsys, options, expected):
    calib, new = str(folder / "fisheye.yaml"), folder / "new.json"
    main(["lens", "crop", calib, str(new), *options, "--coefficients=fisheye"])
    assert "KannalaBrandt" in capsys.readouterr().out
    exact = dict(dtype=torch.float64)
    lens = expected(lenses.load(calib, coefficients="fisheye", **exact))
    found = lenses.load(new, theta_max=lens.theta_max.item(), **exact)
    assert torch.equal(found.image_size, lens.image_size)
    theta = torch.linspace(0, 1, 9, dtype=torch.float64)
    torch.testing.assert_close(found.project_rays(theta, 0.3), lens.project_rays(theta, 0.3))
